// The K nearest faces at each pixel: against the slow definition, and the rasterizer.
#include <algorithm>

#include "check.h"
#include "meshes.h"
#include "slow.h"

namespace nmr::test {
namespace {

template <class T>
std::vector<int32_t> layers_of(const Scene<T>& scene, int64_t layers, int num_threads) {
  std::vector<int32_t> face_index(scene.pixels() * layers, -7);
  const RasterSettings<T> settings{scene.raster(), scene.fill_back, scene.near, scene.far};
  rasterize_layers(RasterizeLayers<T>{scene.mesh(), settings, layers, face_index.data(), num_threads});
  return face_index;
}

}  // namespace

TEST_REAL(layers_equal_the_slow_definition) {
  for (const bool fill_back : {true, false}) {
    Scene<T> scene = pack<T>({sphere(1, 1), soup(30, 2)});
    scene.image = square(20);
    scene.fill_back = fill_back;
    const int64_t R = scene.raster_size(), K = 4;
    const std::vector<int32_t> face_index = layers_of(scene, K, 1);
    CHECK(face_index == layers_of(scene, K, 3));
    for (int64_t b = 0; b < 2; ++b) {
      const int64_t F = scene.mesh().face_count(b);
      std::vector<std::vector<std::pair<T, int32_t>>> hits(R * R);
      for (int64_t id = 0; id < (fill_back ? 2 * F : F); ++id) {
        const SlowFace<T> face(scene, b, id);
        for (int64_t n = 0; n < R * R; ++n) {
          const SlowHit<T> hit = face.at(n % R, R - 1 - n / R, scene.raster());
          if (hit.inside && hit.depth > scene.near && hit.depth < scene.far) hits[n].push_back({hit.depth, static_cast<int32_t>(id)});
        }
      }
      for (int64_t n = 0; n < R * R; ++n) {
        std::sort(hits[n].begin(), hits[n].end());  // by depth, then by number
        hits[n].resize(K, {0, -1});
        for (int64_t k = 0; k < K; ++k) CHECK_EQUAL(face_index[(b * R * R + n) * K + k], hits[n][k].second);
      }
    }
  }
}

TEST_REAL(one_layer_is_the_face_index_map) {
  Scene<T> scene = pack<T>({sphere(2, 1), soup(60, 2), soup(200, 3)});
  scene.image = {40, 70};
  std::vector<int32_t> face_index(scene.pixels(), -7);
  rasterize(Rasterize<T>{scene.mesh(), {scene.raster(), scene.fill_back, scene.near, scene.far}, face_index.data(), 2});
  CHECK(face_index == layers_of(scene, 1, 2));
}

}  // namespace nmr::test
