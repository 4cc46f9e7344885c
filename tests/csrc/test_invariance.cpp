// Every stage: the same bits for any number of threads, alone or in company, packed or not.
#include "check.h"
#include "meshes.h"

namespace nmr::test {
namespace {

constexpr int kMeshes = 9;  // more than some stages work on together

std::vector<Mesh> meshes() {
  std::vector<Mesh> all;
  for (int n = 0; n < kMeshes; ++n) all.push_back(sphere(1, n + 1));
  return all;
}

template <class T>
std::vector<Scene<T>> scenes() {
  std::vector<Scene<T>> all{stack<T>(meshes(), true), stack<T>(meshes(), false),
                            pack<T>({sphere(1, 1), Mesh{}, soup(9, 2), sphere(2, 3), soup(1, 4), Mesh{}})};
  all.push_back(all[0]);
  all[1].per_image_values = true;
  all[1].distorted = false;
  all[3].anti_aliasing = all[3].fill_back = all[3].perspective = false;
  all[0].image = {5, 11};
  all[1].image = {12, 7};
  all[2].image = {8, 9};
  all[3].image = {19, 6};
  all[3].channels = 1;
  all.push_back(single<T>(sphere(2, 6)));  // a raster that is worked on in blocks
  all[4].image = {75, 150};
  return all;
}

// The parts of a result array that belong to image b, when every image has the same share.
template <class Values>
Values share(const Values& values, int64_t b, int64_t batch) {
  const auto size = static_cast<std::ptrdiff_t>(values.size()) / batch;
  return Values(values.begin() + b * size, values.begin() + (b + 1) * size);
}

}  // namespace

TEST_REAL(any_number_of_threads_gives_the_same_bits) {
  for (const Scene<T>& scene : scenes<T>()) {
    const Results<T> one = run_stages(scene, 1);
    CHECK_EQUAL(std::string(broken_promise(scene, one) ? broken_promise(scene, one) : ""), "");
    for (int threads : {2, 5}) {
      const char* difference = first_difference(one, run_stages(scene, threads));
      CHECK_EQUAL(std::string(difference ? difference : ""), "");
    }
  }
}

TEST_REAL(an_image_does_not_depend_on_its_company) {
  const std::vector<Mesh> all = meshes();
  Scene<T> scene = stack<T>(all, true);
  scene.image = {6, 11};
  const Results<T> together = run_stages(scene, 2);
  const char* difference = depends_on_company(scene, together, run_stages(first_image(scene), 1));
  CHECK_EQUAL(std::string(difference ? difference : ""), "");
  for (int64_t b = 0; b < kMeshes; ++b) {
    // Upstream gradients are numbered within the batch, so only what does not depend on them is compared.
    scene = stack<T>({all[b]}, true);
    scene.image = {6, 11};
    const Results<T> alone = run_stages(scene, 1);
    CHECK(alone.face_index == share(together.face_index, b, kMeshes));
    CHECK(alone.alpha == share(together.alpha, b, kMeshes));
    CHECK(alone.weights == share(together.weights, b, kMeshes));
    CHECK(alone.depth == share(together.depth, b, kMeshes));
    CHECK(alone.depth_image == share(together.depth_image, b, kMeshes));
    CHECK(alone.colors == share(together.colors, b, kMeshes));
    CHECK(alone.values == share(together.values, b, kMeshes));
    CHECK(alone.loss == share(together.loss, b, kMeshes));
    CHECK(alone.voxels == share(together.voxels, b, kMeshes));
    CHECK(alone.touched_voxels == share(together.touched_voxels, b, kMeshes));
  }
}

TEST_REAL(packed_meshes_give_what_stacked_ones_give) {
  Scene<T> stacked = stack<T>(meshes(), false);
  stacked.per_image_values = true;
  for (const Size image : {Size{8, 8}, Size{13, 5}}) {
    stacked.image = image;
    const char* difference = depends_on_packing(run_stages(stacked, 2), run_stages(packed(stacked), 2));
    CHECK_EQUAL(std::string(difference ? difference : ""), "");
  }
}

}  // namespace nmr::test
