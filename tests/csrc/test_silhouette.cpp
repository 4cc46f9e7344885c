#include "check.h"
#include "meshes.h"
#include "slow.h"

namespace nmr::test {
namespace {

template <class T>
struct Drawn {
  std::vector<int32_t> face_index;
  std::vector<T> alpha;
};

template <class T>
Drawn<T> draw(const Scene<T>& scene) {
  Drawn<T> drawn{std::vector<int32_t>(scene.pixels()), unwritten<T>(scene.batch * scene.image.pixels())};
  rasterize(Rasterize<T>{scene.mesh(), {scene.raster(), scene.fill_back, scene.near, scene.far}, drawn.face_index.data(), 1});
  silhouette_forward(
      SilhouetteForward<T>{drawn.face_index.data(), scene.batch, scene.image, scene.anti_aliasing, drawn.alpha.data(), 1});
  return drawn;
}

template <class T>
std::vector<T> gradient(const Scene<T>& scene, const std::vector<int32_t>& face_index, const std::vector<T>& grad_alpha,
                        int num_threads = 2) {
  std::vector<T> grad = unwritten<T>(3 * scene.rows());
  silhouette_backward(SilhouetteBackward<T>{scene.mesh(), scene.image, scene.anti_aliasing, scene.eps, face_index.data(),
                                            grad_alpha.data(), grad.data(), num_threads});
  return grad;
}

// Face index maps of every image, drawn by the slow rasterizer.
template <class T>
std::vector<int32_t> slow_face_index(const Scene<T>& scene) {
  std::vector<int32_t> all, face_index;
  std::vector<T> depth;
  for (int64_t b = 0; b < scene.batch; ++b) {
    slow_rasterize(scene, b, face_index, depth);
    all.insert(all.end(), face_index.begin(), face_index.end());
  }
  return all;
}

// |a - b| / |b|
template <class T>
double relative_difference(const std::vector<T>& a, const std::vector<T>& b) {
  double difference = 0, norm = 0;
  for (size_t n = 0; n < b.size(); ++n) {
    difference += (double(a[n]) - double(b[n])) * (double(a[n]) - double(b[n]));
    norm += double(b[n]) * double(b[n]);
  }
  return norm > 0 ? std::sqrt(difference / norm) : std::sqrt(difference);
}

template <class T>
void check_gradient(const Scene<T>& scene) {
  const int64_t pixels = scene.raster().pixels(), W = scene.raster().width, w = scene.image.width;
  const std::vector<int32_t> face_index = slow_face_index(scene);
  const std::vector<T> grad_alpha = noise_array<T>(scene.seed, scene.batch * scene.image.pixels());
  std::vector<T> expected(3 * scene.rows(), T(0));
  for (int64_t b = 0; b < scene.batch; ++b) {
    std::vector<T> coverage(pixels), grad(pixels);
    const T* upstream = grad_alpha.data() + b * scene.image.pixels();
    for (int64_t n = 0; n < pixels; ++n) {
      coverage[n] = T(face_index[b * pixels + n] >= 0);
      grad[n] = scene.anti_aliasing ? upstream[n / W / 2 * w + n % W / 2] / 4 : upstream[n];
    }
    slow_edge_gradient(scene, b, face_index.data() + b * pixels, coverage.data(), grad.data(), 1,
                       expected.data() + 3 * scene.mesh().vertex_start(b));
  }
  const std::vector<T> grad = gradient(scene, face_index, grad_alpha, 1);
  CHECK_NEAR(relative_difference(grad, expected), 0, sizeof(T) == 4 ? 1e-5 : 1e-12);
  for (int threads : {2, 5}) CHECK(gradient(scene, face_index, grad_alpha, threads) == grad);
}

}  // namespace

TEST_REAL(silhouette_is_the_covered_share) {
  for (bool anti_aliasing : {false, true}) {
    Scene<T> scene = stack<T>({sphere(2, 1), sphere(2, 2)}, true);
    scene.image = square(17);
    scene.anti_aliasing = anti_aliasing;
    const Drawn<T> drawn = draw(scene);
    double sum = 0, pixels = 0;
    for (T a : drawn.alpha) sum += a;
    for (int32_t id : drawn.face_index) pixels += id >= 0;
    CHECK_EQUAL(sum, pixels / (anti_aliasing ? 4 : 1));
    CHECK(pixels > 50);
  }
}

TEST_REAL(silhouette_gradient_is_the_definition) {
  for (uint64_t seed = 0; seed < 8; ++seed) {
    for (Size image : {square(1), square(5), square(12), square(16), Size{1, 9}, Size{9, 1}, Size{2, 21}, Size{21, 4}, Size{12, 17}}) {
      Scene<T> scene = stack<T>({soup(8, seed), soup(8, seed + 100)}, seed % 2);
      scene.image = image;
      scene.anti_aliasing = seed % 4 < 2;
      scene.seed = seed;
      check_gradient(scene);
    }
  }
  Scene<T> scene = pack<T>({sphere(2, 1), soup(3, 1), Mesh{}, sphere(1, 2)});
  for (Size image : {square(24), Size{18, 47}, Size{83, 14}}) {  // the latter two: more than one band of lines per thread
    scene.image = image;
    check_gradient(scene);
  }
}

TEST_REAL(silhouette_of_a_wide_image_is_the_covered_share) {
  for (bool anti_aliasing : {false, true}) {
    const Size image{5, 13}, raster = raster_of(image, anti_aliasing);
    std::vector<int32_t> face_index(2 * raster.pixels());
    for (size_t n = 0; n < face_index.size(); ++n) face_index[n] = noise(7, n) > 0 ? static_cast<int32_t>(n % 3) : -1;
    std::vector<T> alpha = unwritten<T>(2 * 65);
    silhouette_forward(SilhouetteForward<T>{face_index.data(), 2, image, anti_aliasing, alpha.data(), 2});
    const int64_t k = anti_aliasing ? 2 : 1;
    for (int64_t n = 0; n < 2 * 65; ++n) {
      T covered = 0;
      for (int64_t dy = 0; dy < k; ++dy)
        for (int64_t dx = 0; dx < k; ++dx)
          covered += face_index[n / 65 * raster.pixels() + (n % 65 / 13 * k + dy) * raster.width + n % 13 * k + dx] >= 0;
      CHECK_EQUAL(alpha[n], covered / T(k * k));
    }
  }
}

// A square to the left of the pixels that the loss wants: its right side is pulled to the right, nothing else moves.
TEST_REAL(silhouette_gradient_pulls_towards_what_is_wanted) {
  Scene<T> scene = single<T>(Mesh{{-0.6, -0.45, 1, -0.1, -0.45, 1, -0.1, 0.45, 1, -0.6, 0.45, 1}, {0, 1, 2, 0, 2, 3}});
  scene.image = square(16);
  scene.anti_aliasing = false;
  const Drawn<T> drawn = draw(scene);
  std::vector<T> grad_alpha(256, T(0));
  for (int y = 6; y < 10; ++y)
    for (int x = 10; x < 14; ++x) grad_alpha[16 * y + x] = T(-1);
  const std::vector<T> grad = gradient(scene, drawn.face_index, grad_alpha);
  CHECK(grad[3 * 1] < 0 && grad[3 * 2] < 0);  // to the right is a lower loss
  for (T& g : grad_alpha) g = -g;  // pixels that are empty and should be
  for (T g : gradient(scene, drawn.face_index, grad_alpha)) CHECK_EQUAL(g, T(0));
}

TEST_REAL(silhouette_gradient_of_what_is_hidden_is_zero) {
  Mesh mesh = triangle({-0.9, -0.9, 2, 0.9, -0.9, 2, 0, 0.9, 2});
  for (double x : {-0.2, -0.2, 3.0, 0.2, -0.2, 3.0, 0.0, 0.2, 3.0}) mesh.vertices.push_back(x);  // behind it
  mesh.faces.insert(mesh.faces.end(), {3, 4, 5});
  Scene<T> scene = single<T>(mesh);
  scene.image = square(16);
  const std::vector<T> grad = gradient(scene, draw(scene).face_index, noise_array<T>(1, 256));
  for (int n = 9; n < 18; ++n) CHECK_EQUAL(grad[n], T(0));
  CHECK(grad[0] != 0);
}

// A gradient of alpha that is not finite must not vanish: gradient scalers look for it.
TEST_REAL(silhouette_gradient_of_an_image_with_a_gradient_that_is_not_finite_is_nan) {
  Scene<T> scene = stack<T>({sphere(1, 1), sphere(1, 2)}, true);
  scene.image = square(16);
  const Drawn<T> drawn = draw(scene);
  const std::vector<T> grad_alpha = noise_array<T>(1, 512), healthy = gradient(scene, drawn.face_index, grad_alpha);
  for (T bad : {std::numeric_limits<T>::quiet_NaN(), std::numeric_limits<T>::infinity(), -std::numeric_limits<T>::infinity()})
    for (size_t pixel : {0, 100, 255, 256, 511})
      for (int threads : {1, 5}) {
        std::vector<T> spoiled = grad_alpha;
        spoiled[pixel] = bad;
        const std::vector<T> grad = gradient(scene, drawn.face_index, spoiled, threads);
        const int64_t b = pixel / 256, per_image = 3 * scene.num_vertices;
        for (int64_t n = 0; n < 2 * per_image; ++n) {
          if (n / per_image != b) CHECK_EQUAL(grad[n], healthy[n]);  // the other image is well
          if (n / per_image == b && healthy[n] != 0) CHECK(std::isnan(grad[n]));
          if (n % 3 == 2) CHECK_EQUAL(grad[n], T(0));
        }
        CHECK(gradient(scene, drawn.face_index, grad_alpha, threads) == healthy);  // and so is the next call
      }
}

// Mirroring the world mirrors the gradient. (Column 0 has the published extrapolation quirk, so the mesh keeps off the borders.)
TEST_REAL(silhouette_gradient_mirrors) {
  Scene<T> scene = single<T>(sphere(2, 4)), mirrored = scene;
  scene.image = mirrored.image = square(32);
  for (size_t n = 0; n < scene.vertices.size(); n += 3) mirrored.vertices[n] = -scene.vertices[n];
  std::vector<T> grad_alpha = noise_array<T>(3, 32 * 32), flipped(32 * 32);
  for (int n = 0; n < 32 * 32; ++n) flipped[32 * (n / 32) + 31 - n % 32] = grad_alpha[n];
  std::vector<T> a = gradient(scene, draw(scene).face_index, grad_alpha),
                 b = gradient(mirrored, draw(mirrored).face_index, flipped);
  for (size_t n = 0; n < b.size(); n += 3) b[n] = -b[n];
  CHECK_NEAR(relative_difference(a, b), 0, sizeof(T) == 4 ? 1e-3 : 1e-9);
}

}  // namespace nmr::test
