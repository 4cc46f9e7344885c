#include <cmath>

#include "check.h"
#include "meshes.h"

namespace nmr::test {
namespace {

template <class T>
double dot(const std::vector<T>& a, const std::vector<T>& b) {
  double sum = 0;
  for (size_t n = 0; n < a.size(); ++n) sum += double(a[n]) * double(b[n]);
  return sum;
}

// Fragments that no camera needs to have seen: a face for most pixels, weights that sum to 1.
template <class T>
struct Fragment {
  int64_t batch = 3, raster_size = 9, num_faces = 5;
  std::vector<int32_t> face_index;
  std::vector<T> weights;

  explicit Fragment(bool packed = false) : face_index(3 * 81), weights(3 * face_index.size(), T(0)) {
    const std::vector<T> random = noise_array<T>(9, static_cast<int64_t>(weights.size()));
    for (size_t n = 0; n < face_index.size(); ++n) {
      const int64_t faces = packed ? starts[2 * (n / 81) + 3] - starts[2 * (n / 81) + 1] : num_faces;
      face_index[n] = static_cast<int32_t>((n * 7 + 3) % (2 * faces + 1)) - 1;
      if (face_index[n] < 0) continue;
      const T a = std::abs(random[3 * n]), b = std::abs(random[3 * n + 1]), c = std::abs(random[3 * n + 2]) + T(0.01);
      weights[3 * n] = a / (a + b + c);
      weights[3 * n + 1] = b / (a + b + c);
      weights[3 * n + 2] = c / (a + b + c);
    }
  }
  int64_t face(size_t n, bool packed = false) const {  // row of the nearest face's texture cube
    const int64_t faces = packed ? starts[2 * (n / 81) + 3] - starts[2 * (n / 81) + 1] : num_faces;
    return face_index[n] % faces + (packed ? starts[2 * (n / 81) + 1] : 0);
  }
  static constexpr int64_t starts[8] = {0, 0, 3, 1, 7, 3, 15, 6};  // rows of attributes and faces of three packed meshes
};

template <class T>
TextureCubes<T> cubes(const Fragment<T>& f, const std::vector<T>& textures, int64_t groups, int64_t ts, int64_t channels, T eps) {
  return {f.face_index.data(),
          f.weights.data(),
          f.batch,
          {f.raster_size, f.raster_size},
          textures.data(),
          groups,
          f.num_faces,
          nullptr,
          ts,
          channels,
          eps,
          nullptr,
          nullptr,
          nullptr,
          2};
}

}  // namespace

// A texture that is linear in its coordinates is reproduced by trilinear interpolation: t_k = b_k (ts - 1), eps aside.
TEST_REAL(texture_cubes_reproduce_linear_textures) {
  const Fragment<T> f;
  for (int64_t ts : {2, 3, 6}) {
    std::vector<T> textures;
    for (int64_t face = 0; face < f.num_faces; ++face)
      for (int64_t n = 0; n < ts * ts * ts; ++n)
        for (int64_t c = 0; c < 2; ++c) textures.push_back(T(face) + T(n / ts / ts) / T(ts - 1) + T(c + 2) * T(n / ts % ts) / T(ts - 1) - T(n % ts) / T(ts - 1));
    std::vector<T> colors = unwritten<T>(2 * f.face_index.size());
    TextureCubes<T> args = cubes(f, textures, 1, ts, 2, T(1e-4));
    args.colors = colors.data();
    texture_cubes_forward(args);
    for (size_t n = 0; n < f.face_index.size(); ++n)
      for (int c = 0; c < 2; ++c) {
        const T* w = f.weights.data() + 3 * n;
        const double expected =
            f.face_index[n] < 0 ? 0 : double(f.face(n)) + double(w[0]) + (c + 2) * double(w[1]) - double(w[2]);
        CHECK_NEAR(colors[2 * n + c], expected, 1e-3);
      }
  }
}

TEST_REAL(a_texture_of_one_texel_is_a_colour) {
  const Fragment<T> f;
  const std::vector<T> textures{1, 2, 3, 4, 5};
  std::vector<T> colors = unwritten<T>(f.face_index.size());
  TextureCubes<T> args = cubes(f, textures, 1, 1, 1, T(1e-4));
  args.colors = colors.data();
  texture_cubes_forward(args);
  for (size_t n = 0; n < f.face_index.size(); ++n) CHECK_NEAR(colors[n], f.face_index[n] < 0 ? 0 : double(f.face(n)) + 1, 1e-6);
}

// Colours are linear in the textures: <colors(t), g> = <t, grad(g)>.
TEST_REAL(texture_cube_gradients_are_the_adjoint) {
  for (bool packed : {false, true})
    for (int64_t groups : {1, 3})
      for (int64_t channels : {1, 3, 4}) {
        const Fragment<T> f(packed);
        const int64_t ts = 3, num_faces = packed ? 6 : f.num_faces;
        const std::vector<T> textures = noise_array<T>(1, (packed ? 1 : groups) * num_faces * 27 * channels);
        const std::vector<T> grad_colors = noise_array<T>(2, static_cast<int64_t>(f.face_index.size()) * channels);
        std::vector<T> colors = unwritten<T>(grad_colors.size()), grad_textures = unwritten<T>(textures.size());
        TextureCubes<T> args = cubes(f, textures, packed ? 1 : groups, ts, channels, T(1e-4));
        args.num_faces = num_faces;
        args.starts = packed ? f.starts : nullptr;
        args.colors = colors.data();
        args.grad_colors = grad_colors.data();
        args.grad_textures = grad_textures.data();
        texture_cubes_forward(args);
        texture_cubes_backward(args);
        CHECK_NEAR(dot(colors, grad_colors), dot(textures, grad_textures), sizeof(T) == 4 ? 1e-3 : 1e-10);
      }
}

TEST_REAL(interpolation_is_the_weighted_mean_and_its_gradients_the_adjoint) {
  for (bool packed : {false, true})
    for (bool corners_per_image : {false, true})
      for (int64_t groups : {1, 3})
        for (int64_t channels : {1, 2, 5}) {
          if (packed && (corners_per_image || groups == 3)) continue;
          const Fragment<T> f(packed);
          const int64_t num_faces = packed ? 6 : f.num_faces, rows = packed ? 15 : 7;
          std::vector<int64_t> corners((corners_per_image ? 3 : 1) * num_faces * 3);
          for (size_t n = 0; n < corners.size(); ++n) {
            const size_t image = packed ? (n < 3 ? 0 : n < 9 ? 1 : 2) : 0;
            corners[n] = static_cast<int64_t>(n * 5 + 1) % (packed ? f.starts[2 * image + 2] - f.starts[2 * image] : rows);
          }
          const std::vector<T> attributes = noise_array<T>(1, groups * rows * channels);
          const std::vector<T> grad_values = noise_array<T>(2, static_cast<int64_t>(f.face_index.size()) * channels);
          std::vector<T> values = unwritten<T>(grad_values.size()), grad_attributes = unwritten<T>(attributes.size());
          std::vector<T> grad_weights = unwritten<T>(f.weights.size());
          const Interpolate<T> args{f.face_index.data(),
                                    f.weights.data(),
                                    f.batch,
                                    {f.raster_size, f.raster_size},
                                    attributes.data(),
                                    groups,
                                    rows,
                                    channels,
                                    corners.data(),
                                    num_faces,
                                    corners_per_image,
                                    packed ? f.starts : nullptr,
                                    values.data(),
                                    grad_values.data(),
                                    grad_attributes.data(),
                                    grad_weights.data(),
                                    2};
          interpolate_forward(args);
          interpolate_backward(args);
          for (size_t n = 0; n < f.face_index.size(); ++n)
            for (int64_t c = 0; c < channels; ++c) {
              double expected = 0;
              for (int k = 0; f.face_index[n] >= 0 && k < 3; ++k) {
                const int64_t image = static_cast<int64_t>(n) / 81, face = f.face(n, packed) + (corners_per_image ? image * num_faces : 0);
                const int64_t first = packed ? f.starts[2 * image] : groups == 3 ? image * rows : 0;
                expected += double(f.weights[3 * n + k]) * double(attributes[(first + corners[3 * face + k]) * channels + c]);
              }
              CHECK_NEAR(values[n * channels + c], expected, 1e-6);
            }
          const double product = dot(values, grad_values), tolerance = sizeof(T) == 4 ? 1e-3 : 1e-10;
          CHECK_NEAR(product, dot(attributes, grad_attributes), tolerance);
          CHECK_NEAR(product, dot(f.weights, grad_weights), tolerance);
          Interpolate<T> only = args;  // either gradient can be left out
          std::vector<T> again = unwritten<T>(grad_weights.size());
          only.grad_attributes = nullptr;
          only.grad_weights = again.data();
          interpolate_backward(only);
          CHECK(again == grad_weights);
          again = unwritten<T>(grad_attributes.size());
          only.grad_attributes = again.data();
          only.grad_weights = nullptr;
          interpolate_backward(only);
          CHECK(again == grad_attributes);
        }
}

}  // namespace nmr::test
