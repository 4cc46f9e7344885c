// Inputs that no renderer should be given: every stage survives them, keeps what it promises, and says the same on any thread.
#include "check.h"
#include "meshes.h"

namespace nmr::test {
namespace {

constexpr double kInf = std::numeric_limits<double>::infinity(), kNaN = std::numeric_limits<double>::quiet_NaN();

template <class T>
void check_survives(Scene<T> scene) {
  for (const Size image : {Size{1, 1}, Size{4, 9}}) {
    for (int variant = 0; variant < 4; ++variant) {
      scene.image = image;
      scene.hostile_upstream = variant == 1;
      scene.anti_aliasing = variant % 2 == 0;
      scene.fill_back = variant < 2;
      const Results<T> one = run_stages(scene, 1);
      const char* broken = broken_promise(scene, one);
      CHECK_EQUAL(std::string(broken ? broken : ""), "");
      const char* difference = first_difference(one, run_stages(scene, 3));
      CHECK_EQUAL(std::string(difference ? difference : ""), "");
    }
  }
}

}  // namespace

TEST_REAL(special_values_in_every_coordinate) {
  using Limits = std::numeric_limits<T>;
  const Mesh fine = triangle({-0.9, -0.8, 2, 0.9, -0.7, 3, 0.1, 0.9, 4});
  for (double special : {kNaN, kInf, -kInf, double(Limits::max()), -double(Limits::max()), double(Limits::denorm_min()),
                         double(Limits::min()), 0.0, -0.0, 1e10, -1e30, 1e30})
    for (int n = 0; n < 9; ++n) {
      Mesh mesh = fine;
      mesh.vertices[n] = special;
      check_survives(single<T>(mesh));
      for (int k = n % 3; k < 9; k += 3) mesh.vertices[k] = special;
      check_survives(single<T>(mesh));
    }
}

TEST_REAL(empty_batches_meshes_and_faces) {
  check_survives(stack<T>({}, true));
  check_survives(pack<T>({}));
  check_survives(single<T>(Mesh{}));
  check_survives(single<T>(Mesh{{0, 0, 1, 1, 0, 1}, {}}));  // vertices and no faces
  check_survives(stack<T>({Mesh{}, Mesh{}, Mesh{}}, false));
  check_survives(pack<T>({Mesh{}, soup(2, 1), Mesh{{0, 0, 1}, {}}, Mesh{}}));
}

TEST_REAL(degenerate_faces) {
  check_survives(single<T>(Mesh{{0, 0, 1, 0.5, 0, 1, 0, 0.5, 1}, {0, 0, 0, 0, 0, 1, 1, 2, 1}}));   // repeated vertices
  check_survives(single<T>(triangle({-0.9, -0.9, 1, 0, 0, 1, 0.9, 0.9, 1})));                      // collinear
  check_survives(single<T>(triangle({-0.9, -0.3, 1, 0.3, 0.1, 1, 0.6, 0.2, 1})));                  // collinear to rounding
  check_survives(single<T>(triangle({-0.9, 0, 1, 0.9, 0, 1, 0.9, 1e-7, 1})));                      // a sliver
  check_survives(single<T>(triangle({-1e-30, 0, 1, 1e-30, 0, 1, 0, 1e-30, 1})));                   // an area that underflows
  check_survives(single<T>(triangle({-1e18, -1e18, 1, 1e18, -1e18, 1, 0, 1e18, 1})));              // one that is huge
  check_survives(single<T>(triangle({-1e30, -1e30, 1, 1e30, -1e30, 1, 0, 1e30, 1})));              // one that overflows
  check_survives(single<T>(triangle({-0.9, -0.9, -1, 0.9, -0.9, -2, 0, 0.9, -3})));                // behind the camera
  check_survives(single<T>(triangle({-0.9, -0.9, -1, 0.9, -0.9, 2, 0, 0.9, 3})));                  // half behind it
  check_survives(single<T>(triangle({-0.9, -0.9, 0, 0.9, -0.9, 0, 0, 0.9, 0})));                   // in its plane
  check_survives(single<T>(triangle({5, 5, 1, 6, 5, 1, 5, 6, 1})));                                // off the screen
  check_survives(single<T>(triangle({-1.01, -0.5, 1, 0.5, -0.5, 1, -1.02, 0.5, 1})));              // just over the border
  Mesh many = soup(1, 3);
  many.faces.assign(300, 0);
  for (size_t n = 0; n < many.faces.size(); ++n) many.faces[n] = static_cast<int64_t>(n % 3);
  check_survives(single<T>(many));  // the same face a hundred times
}

TEST_REAL(strange_settings) {
  Scene<T> scene = single<T>(sphere(1, 1));
  for (auto [near, far] : {std::pair{0.0, 100.0}, {-5.0, 100.0}, {3.0, 2.0}, {0.1, kInf}, {kNaN, kNaN}, {0.1, 1e-30}}) {
    scene.near = static_cast<T>(near);
    scene.far = static_cast<T>(far);
    const Results<T> one = run_stages(scene, 1);
    const char* difference = first_difference(one, run_stages(scene, 3));
    CHECK_EQUAL(std::string(difference ? difference : ""), "");
    for (int32_t id : one.face_index) CHECK(id >= -1 && id < 2 * scene.num_faces);
  }
}

TEST_REAL(face_indices_that_no_rasterizer_made) {
  for (uint64_t seed = 0; seed < 4; ++seed) {
    Scene<T> scene = seed % 2 ? stack<T>({soup(5, seed), soup(5, seed + 1)}, true) : pack<T>({soup(5, seed), Mesh{}, sphere(1, seed)});
    scene.seed = seed;
    scene.foreign_face_index = true;
    if (seed % 3 == 0) scene.vertices[seed % 9] = T(seed % 2 ? kNaN : -kInf);
    check_survives(scene);
  }
}

// Uneven sizes of rasters and meshes one after the other: scratch that is kept between calls must not leak from one into another.
TEST_REAL(scratch_of_earlier_calls_does_not_show) {
  std::vector<Results<T>> first;
  const auto scene = [](int n) {
    Scene<T> s = single<T>(n % 2 ? sphere(2, 1) : soup(4, n));
    s.image = {3 + 11 * (n % 3), 4 + 7 * (n % 4)};
    s.anti_aliasing = n % 2;
    return s;
  };
  for (int n = 0; n < 6; ++n) first.push_back(run_stages(scene(n), 1));
  for (int n = 5; n >= 0; --n) {
    const char* difference = first_difference(first[n], run_stages(scene(n), 1));
    CHECK_EQUAL(std::string(difference ? difference : ""), "");
  }
}

}  // namespace nmr::test
