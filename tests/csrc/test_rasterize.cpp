#include "check.h"
#include "meshes.h"
#include "slow.h"

namespace nmr::test {
namespace {

template <class T>
std::vector<int32_t> rasterized(const Scene<T>& scene, int num_threads = 1) {
  std::vector<int32_t> face_index(scene.pixels(), -7);
  rasterize(Rasterize<T>{scene.mesh(), {scene.raster(), scene.fill_back, scene.near, scene.far}, face_index.data(), num_threads});
  return face_index;
}

template <class T>
Scene<T> raster_of(const Mesh& mesh, Size raster, bool fill_back = true) {
  Scene<T> scene = single<T>(mesh);
  scene.image = raster;
  scene.anti_aliasing = false;
  scene.fill_back = fill_back;
  return scene;
}

template <class T>
Scene<T> raster_of(const Mesh& mesh, int64_t raster_size, bool fill_back = true) {
  return raster_of<T>(mesh, square(raster_size), fill_back);
}

int64_t covered(const std::vector<int32_t>& face_index) {
  return std::count_if(face_index.begin(), face_index.end(), [](int32_t id) { return id >= 0; });
}

// Coverage exactly; the face index, too, unless two faces are equally deep to rounding.
template <class T>
void check_against_definition(const Scene<T>& scene) {
  const int64_t H = scene.raster().height, W = scene.raster().width;
  const std::vector<int32_t> face_index = rasterized(scene);
  for (int64_t b = 0; b < scene.batch; ++b) {
    std::vector<int32_t> expected;
    std::vector<T> depth;
    slow_rasterize(scene, b, expected, depth);
    for (int64_t n = 0; n < H * W; ++n) {
      const int32_t id = face_index[b * H * W + n];
      CHECK_EQUAL(id >= 0, expected[n] >= 0);
      if (id == expected[n]) continue;
      const SlowHit<T> hit = SlowFace<T>(scene, b, id).at(n % W, H - 1 - n / W, scene.raster());
      CHECK(hit.inside);
      CHECK_NEAR(hit.depth, depth[n], 1e-5 * depth[n]);
    }
  }
}

}  // namespace

TEST_REAL(rasterize_draws_the_definition) {
  for (uint64_t seed = 0; seed < 6; ++seed) {
    for (int64_t R : {1, 2, 7, 24, 33, 64}) check_against_definition(raster_of<T>(soup(12, seed), R, seed % 2));
    check_against_definition(raster_of<T>(sphere(2, seed), 40, seed % 2));
  }
  Scene<T> packed = pack<T>({sphere(1, 1), soup(5, 2), Mesh{}, soup(30, 3)});
  packed.image = square(20);
  check_against_definition(packed);
}

TEST_REAL(rasterize_draws_rectangles) {
  for (uint64_t seed = 0; seed < 4; ++seed) {
    for (Size raster : {Size{1, 9}, Size{9, 1}, Size{7, 40}, Size{40, 7}, Size{33, 64}, Size{130, 24}}) {
      const Scene<T> scene = raster_of<T>(seed % 2 ? soup(12, seed) : sphere(2, seed), raster);
      check_against_definition(scene);
      for (int threads : {2, 5}) CHECK(rasterized(scene, threads) == rasterized(scene));
    }
  }
  Scene<T> packed = pack<T>({sphere(1, 1), soup(5, 2), Mesh{}, soup(30, 3)});
  packed.image = {9, 21};
  check_against_definition(packed);
}

// One image after the other on the same thread: nothing of the first one's size may stay.
TEST_REAL(rasterize_of_another_size_starts_afresh) {
  const Mesh mesh = soup(12, 3);
  const std::vector<int32_t> wide = rasterized(raster_of<T>(mesh, {16, 24})), tall = rasterized(raster_of<T>(mesh, {24, 24}));
  CHECK(rasterized(raster_of<T>(mesh, {16, 24})) == wide);
  CHECK(rasterized(raster_of<T>(mesh, {24, 24})) == tall);
  check_against_definition(raster_of<T>(mesh, {24, 16}));
}

// Corners on pixel centres and borders: every comparison is exact, so no rounding excuses a difference.
TEST_REAL(rasterize_edges_are_inclusive) {
  for (uint64_t seed = 0; seed < 40; ++seed) {
    Mesh mesh = soup(3, seed);
    for (size_t n = 0; n < mesh.vertices.size(); ++n)
      if (n % 3 != 2) mesh.vertices[n] = (2 * std::floor(8 * (mesh.vertices[n] + 1)) + 1 - 16) / 16;
    check_against_definition(raster_of<T>(mesh, 16));
  }
  const double c = 0.75;  // the four outer pixel centres of a 4x4 raster
  CHECK_EQUAL(covered(rasterized(raster_of<T>(Mesh{{-c, -c, 1, c, -c, 1, c, c, 1, -c, c, 1}, {0, 1, 2, 0, 2, 3}}, 4))), 16);
}

TEST_REAL(rasterize_of_equally_near_faces_the_first_wins) {
  const Mesh once = triangle({-0.9, -0.9, 2, 0.9, -0.9, 2, 0, 0.9, 2});
  Mesh twice = once;
  twice.faces = {2, 1, 0, 0, 1, 2, 0, 1, 2};  // the first one's reversed copy is the others, to the last bit
  for (int32_t id : rasterized(raster_of<T>(twice, 16))) CHECK(id == -1 || id == 1);
  twice.faces = {2, 1, 0, 2, 1, 0};
  for (int32_t id : rasterized(raster_of<T>(twice, 16))) CHECK(id == -1 || id == 2);
  CHECK_EQUAL(covered(rasterized(raster_of<T>(twice, 16, false))), 0);
}

// Faces on one plane of the scene, but for some units in the last place of their depths: only the published rounding tells which is
// nearer, bounds must not.
TEST_REAL(rasterize_almost_coplanar_faces_by_exact_depth) {
  for (uint64_t seed = 0; seed < 60; ++seed) {
    Mesh mesh = soup(15, seed);
    for (size_t n = 0; n < mesh.vertices.size(); n += 3) {
      const double z = 1 / (0.4 + 0.02 * static_cast<double>(seed % 5) * mesh.vertices[n] - 0.03 * mesh.vertices[n + 1]);
      mesh.vertices[n + 2] = z * (1 + static_cast<double>(n * (seed + 1) % 7) * std::numeric_limits<T>::epsilon());
    }
    for (Size raster : {Size{48, 48}, Size{12, 90}, Size{90, 12}}) {
      const Scene<T> scene = raster_of<T>(mesh, raster);
      std::vector<int32_t> expected;
      std::vector<T> depth;
      slow_rasterize(scene, 0, expected, depth);
      CHECK(rasterized(scene) == expected);
    }
  }
}

TEST_REAL(rasterize_row_0_is_the_top) {
  const std::vector<int32_t> face_index = rasterized(raster_of<T>(triangle({-1, 0.1, 1, 1, 0.1, 1, -1, 1, 1}), 8));
  for (int n = 32; n < 64; ++n) CHECK_EQUAL(face_index[n], -1);
  CHECK_EQUAL(face_index[8 * 3], 0);  // just above the middle, at the left
}

// z is linear in 1/z on the screen: a slanted face meets near and far where the closed form says.
TEST_REAL(rasterize_near_and_far_cut_each_pixel) {
  Scene<T> scene = raster_of<T>(Mesh{{-2, -1, 1, 2, -1, 5, 2, 1, 5, -2, 1, 1}, {0, 1, 2, 0, 2, 3}}, 64);
  scene.near = T(2);
  scene.far = T(3);
  const std::vector<int32_t> face_index = rasterized(scene);
  for (int64_t n = 0; n < 64 * 64; ++n) {
    const double x = static_cast<double>(2 * (n % 64) + 1 - 64) / 64, z = 1 / (1 + (0.2 - 1) * (x + 2) / 4);
    if (std::abs(z - 2) > 1e-4 && std::abs(z - 3) > 1e-4) CHECK_EQUAL(face_index[n] >= 0, z > 2 && z < 3);
  }
  scene.near = scene.far = T(2.5);
  CHECK_EQUAL(covered(rasterized(scene)), 0);
}

TEST_REAL(rasterize_permuted_faces_cover_the_same) {
  const Mesh mesh = soup(20, 5);
  Mesh turned = mesh;
  for (size_t f = 0; f < 20; ++f)
    for (int k = 0; k < 3; ++k) turned.faces[3 * f + k] = mesh.faces[3 * ((7 * f + 3) % 20) + (k + f) % 3];
  const std::vector<int32_t> a = rasterized(raster_of<T>(mesh, 48)), b = rasterized(raster_of<T>(turned, 48));
  for (size_t n = 0; n < a.size(); ++n) {
    CHECK_EQUAL(a[n] < 0, b[n] < 0);
    if (a[n] >= 0) CHECK_EQUAL(a[n] % 20, (7 * (b[n] % 20) + 3) % 20);
  }
}

}  // namespace nmr::test
