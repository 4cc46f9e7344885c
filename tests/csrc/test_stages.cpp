// Properties of every stage: its results do not depend on threads, company, packing, the order of
// faces or earlier calls; float agrees with double; hostile inputs keep what broken_promise lists.
#include <cmath>

#include "check.h"
#include "meshes.h"

#define CHECK_NONE(what) CHECK_EQUAL(std::string(what), "")

namespace nmr::test {
namespace {

constexpr double kInf = std::numeric_limits<double>::infinity(),
                 kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr int kMeshes = 17;  // more than any stage works on together

std::vector<Mesh> meshes() {
  std::vector<Mesh> all;
  for (int n = 0; n < kMeshes; ++n) all.push_back(sphere(1, n + 1));
  return all;
}

template <class T>
std::vector<Scene<T>> scenes() {
  std::vector<Scene<T>> all{
      stack<T>(meshes(), true), stack<T>(meshes(), false),
      pack<T>({sphere(1, 1), Mesh{}, soup(9, 2), sphere(2, 3), soup(1, 4), Mesh{}})};
  all.push_back(all[0]);
  all.push_back(single<T>(sphere(2, 6)));  // a raster that is worked on in blocks
  all.push_back(single<T>(sphere(3, 7)));  // vertices that are worked on in chunks
  const Size images[] = {{5, 11}, {12, 7}, {8, 9}, {19, 6}, {75, 150}, {8, 8}};
  for (size_t n = 0; n < all.size(); ++n) {
    all[n].image = images[n];
    all[n].seed = n + 1;
  }
  all[1].per_image_values = true;
  all[1].distorted = false;
  all[3].anti_aliasing = all[3].fill_back = all[3].perspective = false;
  all[3].channels = 1;
  return all;
}

template <class A, class B>
double relative_difference(const std::vector<A>& a, const std::vector<B>& b) {
  double difference = 0, norm = 0;
  for (size_t n = 0; n < b.size(); ++n) {
    difference += (double(a[n]) - double(b[n])) * (double(a[n]) - double(b[n]));
    norm += double(b[n]) * double(b[n]);
  }
  return norm > 0 ? std::sqrt(difference / norm) : difference;
}

template <class T>
void check_survives(Scene<T> scene) {
  for (const Size image : {Size{1, 1}, Size{4, 9}})
    for (int variant = 0; variant < 4; ++variant) {
      scene.image = image;
      scene.hostile_upstream = variant == 1;
      scene.anti_aliasing = variant % 2 == 0;
      scene.fill_back = variant < 2;
      const Results<T> one = run_stages(scene, 1);
      CHECK_NONE(broken_promise(scene, one));
      if (variant < 2) CHECK_NONE(first_difference(one, run_stages(scene, 3)));
    }
}

}  // namespace

TEST_REAL(any_number_of_threads_gives_the_same_bits) {
  for (const Scene<T>& scene : scenes<T>()) {
    const Results<T> one = run_stages(scene, 1);
    CHECK_NONE(broken_promise(scene, one));
    for (int threads : {2, 5}) CHECK_NONE(first_difference(one, run_stages(scene, threads)));
  }
}

TEST_REAL(an_image_does_not_depend_on_its_company) {
  Scene<T> scene = stack<T>(meshes(), true);
  scene.image = {6, 11};
  const Results<T> together = run_stages(scene, 2);
  CHECK_NONE(depends_on_company(scene, together, run_stages(first_image(scene), 1)));
}

TEST_REAL(packed_meshes_give_what_stacked_ones_give) {
  Scene<T> stacked = stack<T>(meshes(), false);
  stacked.per_image_values = true;
  for (const Size image : {Size{8, 8}, Size{13, 5}}) {
    stacked.image = image;
    CHECK_NONE(depends_on_packing(run_stages(stacked, 2), run_stages(packed(stacked), 2)));
  }
}

TEST_REAL(the_order_of_faces_changes_nothing) {
  const Mesh mesh = soup(20, 5);
  Mesh turned = mesh;
  for (size_t n = 0; n < turned.faces.size(); ++n)
    turned.faces[n] = mesh.faces[3 * ((7 * (n / 3) + 3) % 20) + n % 3];
  Scene<T> scene = single<T>(mesh), other = single<T>(turned);
  scene.image = other.image = {24, 31};
  const Results<T> a = run_stages(scene, 1), b = run_stages(other, 1);
  for (const char* name : {"face_index", "layers", "soft_layers"}) {
    std::vector<int32_t> renamed = b.template get<int32_t>(name);
    for (int32_t& id : renamed) id = id < 0 ? id : (id / 20) * 20 + (7 * (id % 20) + 3) % 20;
    CHECK(renamed == a.template get<int32_t>(name));
  }
  for (const char* name : {"voxels", "touched"})
    CHECK(a.template get<unsigned char>(name) == b.template get<unsigned char>(name));
  for (const char* name : {"alpha", "weights", "depth", "depth_image", "values"})
    CHECK(a.get(name) == b.get(name));
  for (const char* name :
       {"transmittance", "grad_soft", "grad_silhouette", "grad_local", "grad_edges",
        "grad_fragments", "grad_depth_vertices", "grad_soft_fragments"})
    CHECK(relative_difference(a.get(name), b.get(name)) < (sizeof(T) == 4 ? 1e-4 : 1e-12));
}

// With one face index map for both. Thresholds and signs that rounding changes move the gradients
// of a few pixels.
TEST(float_agrees_with_double) {
  for (const Scene<float>& scene : scenes<float>()) {
    const Results<float> single = run_stages(scene, 1);
    Scene<double> wide;
    static_cast<SceneShape&>(wide) = scene;
    wide.vertices.assign(scene.vertices.begin(), scene.vertices.end());
    wide.near = scene.near, wide.far = scene.far, wide.eps = scene.eps;
    wide.given_face_index = single.get<int32_t>("face_index").data();
    const Results<double> twice = run_stages(wide, 1);
    for (const auto& array : std::get<0>(single.lists).arrays) {
      const double difference = relative_difference(array.values, twice.get(array.name));
      if (!(difference < 1e-2)) fail(__FILE__, __LINE__, array.name, ": ", difference);
    }
  }
}

// Uneven sizes one after the other: scratch that is kept between calls must not leak from one into
// another.
TEST_REAL(earlier_calls_do_not_show) {
  std::vector<Results<T>> first;
  const auto scene = [](int n) {
    Scene<T> s = single<T>(n % 2 ? sphere(2, 1) : soup(4, n));
    s.image = {3 + 11 * (n % 3), 4 + 7 * (n % 4)};
    s.anti_aliasing = n % 2;
    return s;
  };
  for (int n = 0; n < 6; ++n) first.push_back(run_stages(scene(n), 1));
  for (int n = 5; n >= 0; --n) CHECK_NONE(first_difference(first[n], run_stages(scene(n), 1)));
}

TEST_REAL(special_values_in_every_coordinate) {
  const Mesh fine = triangle({-0.9, -0.8, 2, 0.9, -0.7, 3, 0.1, 0.9, 4});
  for (const T special : kSpecial<T>)
    for (int n = 0; n < 9; ++n) {
      Mesh mesh = fine;
      mesh.vertices[n] = special;
      check_survives(single<T>(mesh));
      for (int k = n % 3; k < 9; k += 3) mesh.vertices[k] = special;
      check_survives(single<T>(mesh));
    }
}

TEST_REAL(strange_meshes) {
  for (const std::vector<double>& corners : std::vector<std::vector<double>>{
           {-0.9, -0.9, 1, 0, 0, 1, 0.9, 0.9, 1},          // collinear
           {-0.9, -0.3, 1, 0.3, 0.1, 1, 0.6, 0.2, 1},      // collinear to rounding
           {-0.9, 0, 1, 0.9, 0, 1, 0.9, 1e-7, 1},          // a sliver
           {-1e-30, 0, 1, 1e-30, 0, 1, 0, 1e-30, 1},       // an area that underflows
           {-1e18, -1e18, 1, 1e18, -1e18, 1, 0, 1e18, 1},  // one that is huge
           {-1e30, -1e30, 1, 1e30, -1e30, 1, 0, 1e30, 1},  // one that overflows
           {-0.9, -0.9, -1, 0.9, -0.9, -2, 0, 0.9, -3},    // behind the camera
           {-0.9, -0.9, -1, 0.9, -0.9, 2, 0, 0.9, 3},      // half behind it
           {-0.9, -0.9, 0, 0.9, -0.9, 0, 0, 0.9, 0},       // in its plane
           {5, 5, 1, 6, 5, 1, 5, 6, 1},                    // off the screen
           {-1.01, -0.5, 1, 0.5, -0.5, 1, -1.02, 0.5, 1},  // just over the border
           {-0.9, -0.9, 1e18, 0.9, -0.9, 2e19, 0, 0.9,
            1e20}}) {  // depths whose square overflows in float
    check_survives(single<T>(triangle(corners)));
    check_survives(single<T>(Mesh{corners, {0, 0, 0, 0, 0, 1, 1, 2, 1}}));  // repeated vertices
  }
  Mesh many = soup(1, 3);
  for (int64_t n = 3; n < 300; ++n) many.faces.push_back(n % 3);
  check_survives(single<T>(many));  // the same face a hundred times
  check_survives(stack<T>({}, true));
  check_survives(pack<T>({}));
  check_survives(single<T>(Mesh{}));
  check_survives(single<T>(Mesh{{0, 0, 1, 1, 0, 1}, {}}));  // vertices and no faces
  check_survives(stack<T>({Mesh{}, Mesh{}, Mesh{}}, false));
  check_survives(pack<T>({Mesh{}, soup(2, 1), Mesh{{0, 0, 1}, {}}, Mesh{}}));
}

TEST_REAL(strange_settings) {
  Scene<T> scene = single<T>(sphere(1, 1));
  for (auto [near, far] : {std::pair{0.0, 100.0},
                           {-5.0, 100.0},
                           {3.0, 2.0},
                           {0.1, kInf},
                           {kNaN, kNaN},
                           {0.1, 1e-30}}) {
    scene.near = static_cast<T>(near);
    scene.far = static_cast<T>(far);
    const Results<T> one = run_stages(scene, 1);
    CHECK_NONE(first_difference(one, run_stages(scene, 3)));
    for (int32_t id : one.template get<int32_t>("face_index"))
      CHECK(id >= -1 && id < 2 * scene.num_faces);
  }
}

TEST_REAL(face_indices_that_no_rasterizer_made) {
  for (uint64_t seed = 0; seed < 4; ++seed) {
    Scene<T> scene = seed % 2 ? stack<T>({soup(5, seed), soup(5, seed + 1)}, true)
                              : pack<T>({soup(5, seed), Mesh{}, sphere(1, seed)});
    scene.seed = seed;
    scene.foreign_face_index = true;
    if (seed % 3 == 0) scene.vertices[seed % 9] = T(seed % 2 ? kNaN : -kInf);
    check_survives(scene);
  }
}

}  // namespace nmr::test
