#include "check.h"
#include "meshes.h"
#include "slow.h"

namespace nmr::test {
namespace {

template <class T>
std::vector<int32_t> draw(const Scene<T>& scene) {
  std::vector<int32_t> face_index(scene.pixels());
  rasterize(Rasterize<T>{scene.mesh(), {scene.raster(), scene.fill_back, scene.near, scene.far}, face_index.data(), 1});
  return face_index;
}

template <class T>
std::vector<T> gradient(const Scene<T>& scene, const std::vector<int32_t>& face_index, const std::vector<T>& grad_alpha) {
  std::vector<T> grad = unwritten<T>(3 * scene.rows());
  local_gradient(SilhouetteBackward<T>{scene.mesh(), scene.image, scene.anti_aliasing, scene.eps, face_index.data(),
                                       grad_alpha.data(), grad.data(), 2});
  return grad;
}

// By what the loss changes, not by rates: the coverage of a row of three pixels before and after what it shows moves by one.
template <class T>
T slow_move(const T (&coverage)[3], const T (&grad)[3], const bool (&exists)[3], T per_pixel, T eps) {
  T gain[2] = {0, 0};  // by moving up, by moving down
  for (int n = 0; n < 2; ++n) {
    if (!exists[n] || !exists[n + 1]) continue;
    gain[0] -= (coverage[n] - coverage[n + 1]) * grad[n + 1] * per_pixel;
    gain[1] -= (coverage[n + 1] - coverage[n]) * grad[n] * per_pixel;
  }
  if (!(gain[0] > 0 || gain[1] > 0) || std::abs(gain[0] - gain[1]) < eps) return 0;
  return gain[0] > gain[1] ? -gain[0] : gain[1];
}

template <class T>
void check_gradient(const Scene<T>& scene) {
  const int64_t H = scene.raster().height, W = scene.raster().width, w = scene.image.width;
  const std::vector<T> grad_alpha = noise_array<T>(scene.seed, scene.batch * scene.image.pixels());
  std::vector<int32_t> face_indices, face_index;
  std::vector<T> depth;
  std::vector<T> expected(3 * scene.rows(), T(0));
  for (int64_t b = 0; b < scene.batch; ++b) {
    const int64_t F = scene.mesh().face_count(b);
    const T* upstream = grad_alpha.data() + b * scene.image.pixels();
    slow_rasterize(scene, b, face_index, depth);
    face_indices.insert(face_indices.end(), face_index.begin(), face_index.end());
    for (int64_t n = 0; n < H * W; ++n) {
      const int32_t id = face_index[n];
      if (id < 0) continue;
      T move[2];
      for (int axis = 0; axis < 2; ++axis) {
        T coverage[3] = {}, grad[3] = {};
        bool exists[3];
        for (int k = 0; k < 3; ++k) {  // in ascending x or y
          const int64_t column = n % W + (axis == 0 ? k - 1 : 0), row = n / W - (axis == 1 ? k - 1 : 0);
          exists[k] = column >= 0 && column < W && row >= 0 && row < H;
          if (!exists[k]) continue;
          coverage[k] = face_index[row * W + column] >= 0;
          grad[k] = scene.anti_aliasing ? upstream[row / 2 * w + column / 2] / 4 : upstream[row * W + column];
        }
        move[axis] = slow_move(coverage, grad, exists, T(axis == 0 ? W : H) / 2, scene.eps);
      }
      const SlowHit<T> hit = SlowFace<T>(scene, b, id).at(n % W, H - 1 - n / W, scene.raster());
      const int64_t* corner = scene.mesh().image_faces(b) + 3 * (id % F);
      for (int k = 0; k < 3; ++k)
        for (int axis = 0; axis < 2; ++axis)
          expected[3 * (scene.mesh().vertex_start(b) + corner[id < F ? k : 2 - k]) + axis] += hit.weights[k] * move[axis];
    }
  }
  const std::vector<T> grad = gradient(scene, face_indices, grad_alpha);
  for (size_t n = 0; n < grad.size(); ++n) CHECK_NEAR(grad[n], expected[n], sizeof(T) == 4 ? 1e-4 : 1e-12);
}

Mesh square(double left, double bottom, double right, double top) {
  return {{left, bottom, 1, right, bottom, 1, right, top, 1, left, top, 1}, {0, 1, 2, 0, 2, 3}};
}

}  // namespace

TEST_REAL(local_gradient_is_the_definition) {
  for (uint64_t seed = 0; seed < 8; ++seed)
    for (Size image : {Size{1, 1}, Size{5, 5}, Size{12, 12}, Size{16, 16}, Size{1, 9}, Size{9, 1}, Size{12, 17}, Size{21, 4}}) {
      Scene<T> scene = stack<T>({soup(8, seed), soup(8, seed + 100)}, seed % 2);
      scene.image = image;
      scene.anti_aliasing = seed % 4 < 2;
      scene.fill_back = seed % 3 != 0;
      scene.eps = seed % 2 ? T(1e-4) : T(0.5);  // the latter: many ties
      scene.seed = seed;
      check_gradient(scene);
    }
  Scene<T> scene = pack<T>({sphere(2, 1), soup(3, 1), Mesh{}, sphere(1, 2)});
  scene.image = square(24);
  check_gradient(scene);
}

// The target is some pixels away: nothing moves until it is next to the square.
TEST_REAL(local_gradient_reaches_one_pixel) {
  for (int gap = 0; gap < 4; ++gap) {
    Scene<T> scene = single<T>(square(-0.75, -0.25, 0.0, 0.25));  // up to column 7 of 16
    scene.image = square(16);
    scene.anti_aliasing = false;
    std::vector<T> grad_alpha(256, T(0));
    for (int y = 6; y < 10; ++y)
      for (int x = 8 + gap; x < 14; ++x) grad_alpha[16 * y + x] = T(-1);
    const std::vector<T> grad = gradient(scene, draw(scene), grad_alpha);
    T sum = 0;
    for (size_t n = 0; n < grad.size(); n += 3) sum += grad[n];
    CHECK_NEAR(sum, gap == 0 ? -4 * 8 : 0, 1e-4);  // four rows, R / 2 each
    for (size_t n = 1; n < grad.size(); n += 3) CHECK_EQUAL(grad[n], T(0));
  }
}

TEST_REAL(local_gradient_mirrors) {
  Scene<T> scene = single<T>(sphere(2, 4)), mirrored = scene;
  scene.image = mirrored.image = square(32);
  for (size_t n = 0; n < scene.vertices.size(); n += 3) mirrored.vertices[n] = -scene.vertices[n];
  std::vector<T> grad_alpha = noise_array<T>(3, 32 * 32), flipped(32 * 32);
  for (int n = 0; n < 32 * 32; ++n) flipped[32 * (n / 32) + 31 - n % 32] = grad_alpha[n];
  const std::vector<T> a = gradient(scene, draw(scene), grad_alpha), b = gradient(mirrored, draw(mirrored), flipped);
  T largest = 0;
  for (size_t n = 0; n < a.size(); ++n) {
    CHECK_NEAR(a[n], n % 3 == 0 ? -b[n] : b[n], sizeof(T) == 4 ? 1e-3 : 1e-9);
    largest = std::max(largest, std::abs(a[n]));
  }
  CHECK(largest > 1);
}

}  // namespace nmr::test
