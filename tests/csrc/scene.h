// A batch of meshes with everything the stages ask for, and one call that runs them all. Shared by
// the tests, the fuzz target and the instruction count.
#pragma once

#include <cstdint>
#include <cstring>
#include <deque>
#include <limits>
#include <tuple>
#include <vector>

#include "../../csrc/stages.h"

namespace nmr::test {

// A number in [-1, 1) with 20 bits, the same on every machine (splitmix64 of the arguments).
inline double noise(uint64_t seed, uint64_t index) {
  uint64_t x = seed * 0x9e3779b97f4a7c15ull + (index + 1) * 0xd1b54a32d192ed03ull;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
  x ^= x >> 31;
  return static_cast<double>(static_cast<int64_t>(x >> 44)) / 524288.0 - 1.0;
}

// Numbers at the limits of T.
template <class T, class Limits = std::numeric_limits<T>>
constexpr T kSpecial[] = {Limits::quiet_NaN(),
                          Limits::infinity(),
                          -Limits::infinity(),
                          Limits::max(),
                          Limits::lowest(),
                          Limits::denorm_min(),
                          Limits::min(),
                          -Limits::min(),
                          Limits::epsilon(),
                          1 + Limits::epsilon(),
                          1 - Limits::epsilon(),
                          T(-0.0),
                          T(1e10),
                          T(-1e30),
                          T(1e-20)};

// What a scene holds besides numbers of its type.
struct SceneShape {
  int64_t batch = 0, num_vertices = 0,
          num_faces = 0;  // as in MeshBatch: packed, the sums over all meshes
  bool faces_per_image = false;
  std::vector<int64_t> faces;
  std::vector<int64_t> starts;  // empty unless packed

  Size image{8, 8};
  bool anti_aliasing = true, fill_back = true;
  int64_t channels = 3, texture_size = 2, grid_size = 4;
  bool per_image_values = false;  // textures and attributes of each image, not shared
  bool perspective = true,
       distorted = true;  // the camera; undistorted ones have an origin and an extent
  bool no_grad_weights = false,
       no_grad_depth = false;  // optional upstream gradients and results of a backward stage
  bool foreign_face_index =
      false;  // backward stages get a made-up face index map: any in range is allowed
  const int32_t* given_face_index = nullptr;  // or this one
  bool hostile_upstream = false;  // NaN, infinities and huge numbers among the upstream gradients
  uint64_t seed = 1;              // of textures, attributes, cameras and upstream gradients

  bool packed() const { return !starts.empty(); }
  Size raster() const { return raster_of(image, anti_aliasing); }
  int64_t pixels() const { return batch * raster().pixels(); }
  Rows face_rows() const {
    if (packed()) return {num_faces, true, starts.data() + 1};
    return {num_faces, faces_per_image, nullptr};
  }
  int64_t rows() const { return packed() ? num_vertices : batch * num_vertices; }  // of vertices
  void add_start() {  // of the next packed mesh, or the end
    starts.push_back(num_vertices);
    starts.push_back(num_faces);
  }
};

template <class T>
struct Scene : SceneShape {
  std::vector<T> vertices;
  T near = T(0.1), far = T(100), eps = T(1e-4);

  MeshBatch<T> mesh() const {
    const int64_t* first = packed() ? starts.data() : nullptr;
    return {vertices.data(), faces.data(), batch, {num_vertices, true, first}, face_rows()};
  }
};

// Arrays by name. An array keeps its storage from scene to scene, but in sanitizer builds has
// exactly the size asked for, so that accesses beyond it are seen.
template <class Number>
struct Arrays {
  struct Array {
    const char* name;
    std::vector<Number> values;
  };
  std::deque<Array> arrays;

  std::vector<Number>& get(const char* name) {
    for (Array& array : arrays)
      if (array.name == name || std::strcmp(array.name, name) == 0) return array.values;
    return arrays.emplace_back(Array{name, {}}).values;
  }
  std::vector<Number>& resize(const char* name, int64_t size) {
    std::vector<Number>& values = get(name);
#ifdef NMR_FRESH_SCRATCH
    if (values.capacity() != static_cast<size_t>(size)) std::vector<Number>().swap(values);
#endif
    values.resize(size);
    return values;
  }
};

// What the stages computed.
template <class T>
struct Results {
  using Lists = std::tuple<Arrays<T>, Arrays<int32_t>, Arrays<int64_t>, Arrays<unsigned char>>;
  mutable Lists lists;
  Arrays<T> inputs;
  Arrays<int64_t> tables;
  Arrays<double> areas;

  template <class Number = T>
  const std::vector<Number>& get(const char* name) const {
    return std::get<Arrays<Number>>(lists).get(name);
  }
  // Memory that a stage must overwrite: NaN or an impossible number remains if it was forgotten.
  template <class Number = T>
  Number* out(const char* name, int64_t size) {
    using Limits = std::numeric_limits<Number>;
    constexpr Number kUnwritten = Limits::has_quiet_NaN ? Limits::quiet_NaN()
                                  : Limits::is_signed   ? Limits::min()
                                                        : Limits::max();
    std::vector<Number>& values = std::get<Arrays<Number>>(lists).resize(name, size);
    values.assign(size, kUnwritten);
    return values.data();
  }
};

// Runs every stage of csrc, forward and backward. Earlier results are overwritten, their storage
// used again.
template <class T>
void run_stages(const Scene<T>& scene, int num_threads, Results<T>& results);

template <class T>
Results<T> run_stages(const Scene<T>& scene, int num_threads) {
  Results<T> results;
  run_stages(scene, num_threads, results);
  return results;
}

// The same meshes packed; of a stacked batch.
template <class T>
Scene<T> packed(const Scene<T>& scene);

// The first image alone.
template <class T>
Scene<T> first_image(const Scene<T>& scene);

// Comparisons bit by bit (any NaN is a NaN) give the name of the first result that differs, or "".

template <class T>
const char* first_difference(const Results<T>& a, const Results<T>& b);

// Whether the results of first_image(scene) are the beginning of the batch's. Sums over the batch
// are not compared.
template <class T>
const char* depends_on_company(const Scene<T>& scene, const Results<T>& together,
                               const Results<T>& alone);

// A packed batch is one mesh to the smoothness loss, which is not compared.
template <class T>
const char* depends_on_packing(const Results<T>& stacked, const Results<T>& packed);

// What holds for every scene, however hostile: "", or a sentence that does not hold.
template <class T>
const char* broken_promise(const Scene<T>& scene, const Results<T>& results);

}  // namespace nmr::test
