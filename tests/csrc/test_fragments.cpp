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
void fragments(const Scene<T>& scene, const std::vector<int32_t>& face_index, std::vector<T>& weights, std::vector<T>& depth) {
  weights = unwritten<T>(3 * scene.pixels());
  depth = unwritten<T>(scene.pixels());
  fragments_forward(Fragments<T>{scene.mesh(), scene.raster(), scene.far, face_index.data(), weights.data(), depth.data(),
                                 nullptr, nullptr, nullptr, 1});
}

template <class T>
std::vector<T> depth_image(const Scene<T>& scene, const std::vector<int32_t>& face_index) {
  std::vector<T> depth = unwritten<T>(scene.batch * scene.image.pixels());
  depth_forward(DepthImage<T>{scene.mesh(), scene.image, scene.anti_aliasing, scene.far, face_index.data(), depth.data(), nullptr,
                              nullptr, 1});
  return depth;
}

std::vector<Mesh> meshes() { return {soup(10, 1), sphere(1, 2), Mesh{}}; }

// Weights and depth of every pixel; each covered pixel shows a point of its face.
template <class T>
void check_against_definition(Size image) {
  Scene<T> scene = pack<T>(meshes());
  scene.image = image;
  const int64_t H = scene.raster().height, W = scene.raster().width;
  const std::vector<int32_t> face_index = face_index_of(scene);
  std::vector<T> weights, depth;
  fragments(scene, face_index, weights, depth);
  const double tolerance = sizeof(T) == 4 ? 1e-4 : 1e-12;
  int64_t covered = 0;
  for (int64_t n = 0; n < scene.pixels(); ++n) {
    const T* w = weights.data() + 3 * n;
    if (face_index[n] < 0) {
      CHECK(w[0] == 0 && w[1] == 0 && w[2] == 0 && depth[n] == scene.far);
      continue;
    }
    ++covered;
    const int64_t b = n / (H * W), F = scene.mesh().face_count(b);
    const SlowHit<T> hit = SlowFace<T>(scene, b, face_index[n]).at(n % W, H - 1 - n / W % H, scene.raster());
    CHECK_NEAR(depth[n], hit.depth, tolerance * hit.depth);
    // A point of the face: its depth and its place on the screen are those of the pixel.
    double z = 0, xz = 0, yz = 0;
    for (int k = 0; k < 3; ++k) {
      const T* v = scene.mesh().image_vertices(b) + 3 * scene.mesh().image_faces(b)[3 * (face_index[n] % F) + k];
      CHECK_NEAR(w[k], hit.weights[face_index[n] < F ? k : 2 - k] * hit.depth / v[2], tolerance);
      z += double(w[k]) * double(v[2]);
      xz += double(w[k]) * double(v[2]) * double(v[0]);
      yz += double(w[k]) * double(v[2]) * double(v[1]);
    }
    CHECK_NEAR(w[0] + w[1] + w[2], 1, tolerance);
    CHECK_NEAR(z, depth[n], tolerance * z);
    CHECK_NEAR(xz / z, static_cast<double>(2 * (n % W) + 1 - W) / static_cast<double>(W), 5 * tolerance);
    CHECK_NEAR(yz / z, static_cast<double>(H - 1 - 2 * (n / W % H)) / static_cast<double>(H), 5 * tolerance);
  }
  CHECK(covered > scene.pixels() / 10);
}

}  // namespace

TEST_REAL(fragments_are_the_definition) {
  for (Size image : {Size{21, 21}, Size{9, 40}, Size{40, 9}}) check_against_definition<T>(image);
}

TEST_REAL(depth_images_are_means_of_the_fragments) {
  for (int n = 0; n < 6; ++n) {
    const bool anti_aliasing = n % 2;
    const Size size[] = {{15, 15}, {5, 32}, {33, 6}};
    Scene<T> scene = pack<T>(meshes());
    scene.image = size[n / 2];
    scene.anti_aliasing = anti_aliasing;
    scene.far = T(50);
    const int64_t h = scene.image.height, w = scene.image.width, W = scene.raster().width, step = anti_aliasing ? 2 : 1;
    const std::vector<int32_t> face_index = face_index_of(scene);
    std::vector<T> weights, depth;
    fragments(scene, face_index, weights, depth);
    const std::vector<T> image = depth_image(scene, face_index);
    for (int64_t b = 0; b < scene.batch; ++b)
      for (int64_t y = 0; y < h; ++y)
        for (int64_t x = 0; x < w; ++x) {
          double sum = 0;
          for (int64_t j = 0; j < step; ++j)
            for (int64_t i = 0; i < step; ++i) sum += depth[b * scene.raster().pixels() + (step * y + j) * W + step * x + i];
          CHECK_NEAR(image[(b * h + y) * w + x], sum / (step * step), 1e-5 * sum);
        }
  }
}

// Depths whose square overflows: the gradient is a number, and that of faces at ordinary depths does not change.
TEST_REAL(depths_whose_square_overflows_have_finite_gradients) {
  const T limit = std::numeric_limits<T>::max();
  const Mesh mesh{{-0.9, -0.9, 1, -0.1, -0.9, 2, -0.9, 0.9, 3, 0.1, -0.9, 1, 0.9, -0.9, 1, 0.9, 0.9, 1}, {0, 1, 2, 3, 4, 5}};
  std::vector<T> usual[2];
  for (T deep : {T(2), 2 * std::sqrt(limit), std::sqrt(limit) / 2, limit / 4}) {
    Scene<T> scene = single<T>(mesh);
    for (int k = 3; k < 6; ++k) scene.vertices[3 * k + 2] = deep;
    scene.far = limit;
    scene.anti_aliasing = false;
    const std::vector<int32_t> face_index = face_index_of(scene);
    CHECK(std::count_if(face_index.begin(), face_index.end(), [](int32_t id) { return id % 2 == 1; }) > 0);
    const std::vector<T> upstream = noise_array<T>(5, scene.pixels()), of_weights = noise_array<T>(6, 3 * scene.pixels());
    std::vector<T> grad[2] = {unwritten<T>(18), unwritten<T>(18)};
    depth_backward(DepthImage<T>{scene.mesh(), scene.image, false, scene.far, face_index.data(), nullptr, upstream.data(),
                                 grad[0].data(), 1});
    fragments_backward(Fragments<T>{scene.mesh(), scene.raster(), scene.far, face_index.data(), nullptr, nullptr,
                                    of_weights.data(), upstream.data(), grad[1].data(), 1});
    for (int which = 0; which < 2; ++which) {
      for (T g : grad[which]) CHECK(std::isfinite(g));
      grad[which].resize(9);
      if (deep == 2) usual[which] = grad[which];
      CHECK(grad[which] == usual[which]);
    }
  }
}

// Central differences with the face index map held fixed.
void check_derivative(Size image_size) {
  Scene<double> scene = pack<double>(meshes());
  scene.image = image_size;
  const std::vector<int32_t> face_index = face_index_of(scene);
  const std::vector<double> u = noise_array<double>(1, 3 * scene.pixels()), g = noise_array<double>(2, scene.pixels());
  const std::vector<double> h = noise_array<double>(3, scene.batch * image_size.pixels());
  std::vector<double> of_weights = unwritten<double>(3 * scene.rows()), of_depth = of_weights, of_both = of_weights, of_image = of_weights;
  const auto backward = [&](const double* grad_weights, const double* grad_depth, std::vector<double>& out) {
    fragments_backward(Fragments<double>{scene.mesh(), scene.raster(), scene.far, face_index.data(), nullptr, nullptr,
                                         grad_weights, grad_depth, out.data(), 2});
  };
  backward(u.data(), nullptr, of_weights);
  backward(nullptr, g.data(), of_depth);
  backward(u.data(), g.data(), of_both);
  depth_backward(
      DepthImage<double>{scene.mesh(), image_size, true, scene.far, face_index.data(), nullptr, h.data(), of_image.data(), 2});
  const std::vector<double> original = scene.vertices;
  for (size_t n = 0; n < original.size(); ++n) {
    double difference[3] = {0, 0, 0};
    for (int side : {1, -1}) {
      scene.vertices = original;
      scene.vertices[n] += side * 1e-6;
      std::vector<double> weights, depth;
      fragments(scene, face_index, weights, depth);
      const std::vector<double> image = depth_image(scene, face_index);
      for (size_t m = 0; m < weights.size(); ++m) difference[0] += side * u[m] * weights[m] / 2e-6;
      for (size_t m = 0; m < depth.size(); ++m) difference[1] += side * g[m] * depth[m] / 2e-6;
      for (size_t m = 0; m < image.size(); ++m) difference[2] += side * h[m] * image[m] / 2e-6;
    }
    const double scale = 1e-5 * (1 + std::abs(difference[0]) + std::abs(difference[1]) + std::abs(difference[2]));
    CHECK_NEAR(of_weights[n], difference[0], scale);
    CHECK_NEAR(of_depth[n], difference[1], scale);
    CHECK_NEAR(of_both[n], difference[0] + difference[1], scale);
    CHECK_NEAR(of_image[n], difference[2], scale);
  }
}

TEST(fragment_gradients_are_the_derivative) {
  for (Size image : {Size{7, 7}, Size{4, 11}, Size{11, 4}}) check_derivative(image);
}

}  // namespace nmr::test
