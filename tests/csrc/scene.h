// A batch of meshes with everything the stages ask for, and one call that runs them all. Shared by the tests, the fuzz
// target and the instruction count.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
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

template <class T>
std::vector<T> noise_array(uint64_t seed, int64_t size) {
  std::vector<T> values(size);
  for (int64_t n = 0; n < size; ++n) values[n] = static_cast<T>(noise(seed, n));
  return values;
}

// Sizes an array that is used for scene after scene. It keeps its storage, but in sanitizer builds has exactly this
// size, so that accesses beyond it are seen.
template <class T>
void resize(std::vector<T>& values, int64_t size) {
#ifdef NMR_FRESH_SCRATCH
  if (values.capacity() != static_cast<size_t>(size)) std::vector<T>().swap(values);
#endif
  values.resize(size);
}

// Memory that a stage must overwrite: what stays NaN was forgotten.
template <class T>
void unwritten(std::vector<T>& values, int64_t size) {
  resize(values, size);
  std::fill(values.begin(), values.end(), std::numeric_limits<T>::quiet_NaN());
}

template <class T>
std::vector<T> unwritten(int64_t size) {
  return std::vector<T>(size, std::numeric_limits<T>::quiet_NaN());
}

inline Size square(int64_t size) { return {size, size}; }

template <class T>
struct Scene {
  int64_t batch = 0, num_vertices = 0, num_faces = 0;  // as in MeshBatch: packed, the sums over all meshes
  bool faces_per_image = false;
  std::vector<T> vertices;
  std::vector<int64_t> faces;
  std::vector<int64_t> starts;  // empty unless packed

  Size image = square(8);
  bool anti_aliasing = true, fill_back = true;
  T near = T(0.1), far = T(100), eps = T(1e-4);
  int64_t channels = 3, texture_size = 2, grid_size = 4;
  bool per_image_values = false;  // textures and attributes of each image, not shared
  bool perspective = true, distorted = true;  // the camera; undistorted ones have an origin and an extent
  bool foreign_face_index = false;            // backward stages get a made-up face index map: any in range is allowed
  bool hostile_upstream = false;  // NaN, infinities and huge numbers among the upstream gradients
  bool no_grad_weights = false, no_grad_depth = false;  // optional upstream gradients and results of a backward stage
  uint64_t seed = 1;           // of textures, attributes, cameras and upstream gradients

  bool packed() const { return !starts.empty(); }
  Size raster() const { return raster_of(image, anti_aliasing); }
  int64_t raster_size() const { return raster().width; }  // of a square raster
  int64_t pixels() const { return batch * raster().pixels(); }
  MeshBatch<T> mesh() const {
    return {vertices.data(),
            faces.data(),
            batch,
            num_vertices,
            num_faces,
            faces_per_image,
            packed() ? starts.data() : nullptr};
  }
  void add_start() {  // of the next packed mesh, or the end
    starts.push_back(num_vertices);
    starts.push_back(num_faces);
  }
  int64_t rows() const { return packed() ? num_vertices : batch * num_vertices; }  // of vertices
};

template <class T>
struct Results {
  std::vector<int32_t> face_index;
  std::vector<int64_t> clip_counts, clip_starts, clip_faces, clip_corners, clip_ends;
  std::vector<int32_t> clip_source;
  std::vector<T> alpha, grad_silhouette, grad_local;
  std::vector<T> weights, depth, grad_fragments;
  std::vector<T> depth_image, grad_depth;
  std::vector<T> colors, grad_textures;
  std::vector<T> values, grad_attributes, grad_weights;
  std::vector<T> pyramid, grad_texels, level, sampled, grad_sampled_texels, grad_uv, grad_uv_weights;
  std::vector<T> normals, grad_normals_vertices, lit, grad_lit_colors, grad_lit_normals, grad_lights, grad_lit_vertices,
      grad_lit_weights;
  std::vector<int32_t> layers;
  std::vector<T> clear, grad_soft;
  std::vector<T> resolved, grad_image, grad_background;
  std::vector<T> grad_edges;
  std::vector<T> points, grad_world, grad_matrix, grad_intrinsics, grad_distortion, grad_origin, grad_extent;
  std::vector<T> pose, grad_forward, grad_up;
  std::vector<T> loss, grad_loss;
  std::vector<unsigned char> voxels, touched_voxels;

  template <class Visit>
  void for_each(const Visit& visit) const {
    visit("face_index", face_index);
    visit("clip_counts", clip_counts);
    visit("clip_starts", clip_starts);
    visit("clip_faces", clip_faces);
    visit("clip_corners", clip_corners);
    visit("clip_ends", clip_ends);
    visit("clip_source", clip_source);
    visit("alpha", alpha);
    visit("grad_silhouette", grad_silhouette);
    visit("grad_local", grad_local);
    visit("weights", weights);
    visit("depth", depth);
    visit("grad_fragments", grad_fragments);
    visit("depth_image", depth_image);
    visit("grad_depth", grad_depth);
    visit("colors", colors);
    visit("grad_textures", grad_textures);
    visit("values", values);
    visit("grad_attributes", grad_attributes);
    visit("grad_weights", grad_weights);
    visit("pyramid", pyramid);
    visit("grad_texels", grad_texels);
    visit("level", level);
    visit("sampled", sampled);
    visit("grad_sampled_texels", grad_sampled_texels);
    visit("grad_uv", grad_uv);
    visit("grad_uv_weights", grad_uv_weights);
    visit("normals", normals);
    visit("grad_normals_vertices", grad_normals_vertices);
    visit("lit", lit);
    visit("grad_lit_colors", grad_lit_colors);
    visit("grad_lit_normals", grad_lit_normals);
    visit("grad_lights", grad_lights);
    visit("grad_lit_vertices", grad_lit_vertices);
    visit("grad_lit_weights", grad_lit_weights);
    visit("layers", layers);
    visit("clear", clear);
    visit("grad_soft", grad_soft);
    visit("resolved", resolved);
    visit("grad_image", grad_image);
    visit("grad_background", grad_background);
    visit("grad_edges", grad_edges);
    visit("points", points);
    visit("grad_world", grad_world);
    visit("grad_matrix", grad_matrix);
    visit("grad_intrinsics", grad_intrinsics);
    visit("grad_distortion", grad_distortion);
    visit("grad_origin", grad_origin);
    visit("grad_extent", grad_extent);
    visit("pose", pose);
    visit("grad_forward", grad_forward);
    visit("grad_up", grad_up);
    visit("loss", loss);
    visit("grad_loss", grad_loss);
    visit("voxels", voxels);
    visit("touched_voxels", touched_voxels);
  }
};

// Runs every stage of csrc, forward and backward. Earlier results are overwritten, their storage used again.
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

// The name of the first result that differs in a bit, or nullptr. Any NaN is a NaN.
template <class T>
const char* first_difference(const Results<T>& a, const Results<T>& b);

// The name of the first result of first_image(scene) that is not the beginning of the batch's, or nullptr. Sums over
// the batch are not compared.
template <class T>
const char* depends_on_company(const Scene<T>& scene, const Results<T>& together, const Results<T>& alone);

// The name of the first result that packing changed, or nullptr. A packed batch is one mesh to the smoothness loss: not
// compared.
template <class T>
const char* depends_on_packing(const Results<T>& stacked, const Results<T>& packed);

// What holds for every scene, however hostile; nullptr, or a sentence that says what does not.
template <class T>
const char* broken_promise(const Scene<T>& scene, const Results<T>& results);

}  // namespace nmr::test
