#include "check.h"
#include "meshes.h"
#include "slow.h"

namespace nmr::test {
namespace {

template <class T>
std::vector<int32_t> face_index_of(const Scene<T>& scene) {
  std::vector<int32_t> face_index(scene.pixels());
  rasterize(Rasterize<T>{scene.mesh(), {scene.raster(), scene.fill_back, scene.near, scene.far}, face_index.data(), 1});
  return face_index;
}

template <class T>
std::vector<T> gradient(const Scene<T>& scene, const std::vector<int32_t>& face_index, const std::vector<T>& image,
                        const std::vector<T>& grad) {
  std::vector<T> result = unwritten<T>(3 * scene.rows());
  const int64_t channels = static_cast<int64_t>(image.size()) / std::max<int64_t>(1, scene.pixels());
  edges_backward(EdgesBackward<T>{scene.mesh(), scene.image, scene.anti_aliasing, scene.eps, face_index.data(), image.data(),
                                  channels, nullptr, 0, grad.data(), result.data(), 2});
  return result;
}

// The gradient of the pixels of the raster, of that of the image [B, h, w, C].
template <class T>
std::vector<T> at_raster(const Scene<T>& scene, const std::vector<T>& grad, int64_t channels) {
  const Size raster = scene.raster();
  const int64_t step = scene.anti_aliasing ? 2 : 1;
  std::vector<T> pixels(scene.pixels() * channels);
  for (int64_t n = 0; n < scene.pixels() * channels; ++n) {
    const int64_t c = n % channels, x = n / channels % raster.width / step, y = n / channels / raster.width % raster.height / step;
    const int64_t b = n / channels / raster.pixels();
    pixels[n] = grad[((b * scene.image.height + y) * scene.image.width + x) * channels + c] / T(step * step);
  }
  return pixels;
}

template <class T>
void check_close(const std::vector<T>& a, const std::vector<T>& b, double tolerance) {
  double difference = 0, norm = 0;
  for (size_t n = 0; n < b.size(); ++n) {
    difference += (double(a[n]) - double(b[n])) * (double(a[n]) - double(b[n]));
    norm += double(b[n]) * double(b[n]);
  }
  CHECK(norm > 0);
  CHECK_NEAR(std::sqrt(difference / norm), 0, tolerance);
}

}  // namespace

TEST_REAL(edge_gradients_are_the_definition) {
  for (int64_t channels : {1, 3, 4})
    for (uint64_t seed = 0; seed < 4; ++seed) {
      Scene<T> scene = seed == 0 ? pack<T>({sphere(1, 1), Mesh{}, soup(6, 5)}) : stack<T>({soup(8, seed), soup(8, seed + 50)}, seed % 2);
      scene.image = square(13);
      const int64_t R = scene.raster_size();
      const std::vector<int32_t> face_index = face_index_of(scene);
      const std::vector<T> image = noise_array<T>(1, scene.pixels() * channels);
      const std::vector<T> grad = noise_array<T>(2, scene.batch * scene.image.pixels() * channels);
      const std::vector<T> pixels = at_raster(scene, grad, channels);
      std::vector<T> expected(3 * scene.rows(), T(0));
      for (int64_t b = 0; b < scene.batch; ++b)
        slow_edge_gradient(scene, b, face_index.data() + b * R * R, image.data() + b * R * R * channels,
                           pixels.data() + b * R * R * channels, channels, expected.data() + 3 * scene.mesh().vertex_start(b));
      check_close(gradient(scene, face_index, image, grad), expected, sizeof(T) == 4 ? 1e-4 : 1e-11);
    }
}

// An image that is its own coverage has the silhouette's gradient.
TEST_REAL(edge_gradients_of_coverage_are_the_silhouettes) {
  Scene<T> scene = stack<T>({sphere(2, 1), sphere(2, 2)}, true);
  scene.image = square(16);
  const int64_t S = 16;
  const std::vector<int32_t> face_index = face_index_of(scene);
  const std::vector<T> grad_alpha = noise_array<T>(3, 2 * S * S);
  std::vector<T> image(scene.pixels()), expected(3 * scene.rows());
  for (int64_t n = 0; n < scene.pixels(); ++n) image[n] = T(face_index[n] >= 0);
  silhouette_backward(
      SilhouetteBackward<T>{scene.mesh(), square(S), true, scene.eps, face_index.data(), grad_alpha.data(), expected.data(), 1});
  check_close(gradient(scene, face_index, image, grad_alpha), expected, sizeof(T) == 4 ? 1e-5 : 1e-12);
}

TEST_REAL(edge_gradients_of_an_image_of_one_colour_are_zero) {
  Scene<T> scene = single<T>(sphere(1, 1));
  scene.image = square(12);
  const std::vector<int32_t> face_index = face_index_of(scene);
  const std::vector<T> image(2 * scene.pixels(), T(0.3)), grad = noise_array<T>(1, 2 * scene.image.pixels());
  for (T g : gradient(scene, face_index, image, grad)) CHECK_EQUAL(g, T(0));
}

TEST_REAL(resolve_is_a_mean_and_its_gradient_the_adjoint) {
  for (bool anti_aliasing : {false, true})
    for (int64_t C : {1, 3, 4}) {
      const int64_t B = 2, S = 7, step = anti_aliasing ? 2 : 1, R = step * S;
      const std::vector<T> image = noise_array<T>(1, B * R * R * C), grad_resolved = noise_array<T>(2, B * S * S * C);
      std::vector<T> resolved = unwritten<T>(grad_resolved.size()), grad_image = unwritten<T>(image.size());
      const Resolve<T> args{B, square(S), anti_aliasing, C, nullptr, image.data(), nullptr, 0,
                            resolved.data(), grad_resolved.data(), grad_image.data(), nullptr, 2};
      resolve_forward(args);
      resolve_backward(args);
      double product = 0, adjoint = 0;
      for (int64_t n = 0; n < B * S * S * C; ++n) {
        const int64_t c = n % C, x = n / C % S, y = n / C / S % S, b = n / C / S / S;
        double sum = 0;
        for (int64_t j = 0; j < step; ++j)
          for (int64_t i = 0; i < step; ++i) sum += image[((b * R + step * y + j) * R + step * x + i) * C + c];
        CHECK_NEAR(resolved[n], sum / double(step * step), 1e-6);
        product += double(resolved[n]) * double(grad_resolved[n]);
      }
      for (size_t n = 0; n < image.size(); ++n) adjoint += double(image[n]) * double(grad_image[n]);
      CHECK_NEAR(product, adjoint, 1e-4);
    }
}

}  // namespace nmr::test
