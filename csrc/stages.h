// The argument struct of each stage: what goes in, what comes out, sizes, settings. Raw arrays only, row-major.
#pragma once

#include <cstdint>

namespace nmr {

// Settings that every raster stage shares.
template <class T>
struct RasterSettings {
  int64_t raster_size;  // R: pixels per side of the raster (2 S with anti-aliasing, else S)
  bool fill_back;       // also draw every face with its vertex order reversed
  T near;               // pixels with depth <= near are not drawn
  T far;                // nor those with depth >= far
};

// A batch of meshes in renderer space: x, y in [-1, 1] on the screen (y up), z = depth.
template <class T>
struct MeshBatch {
  const T* vertices;       // [B, V, 3]
  const int64_t* faces;    // [F, 3], or [B, F, 3] when faces_per_image
  int64_t batch;           // B
  int64_t num_vertices;    // V
  int64_t num_faces;       // F
  bool faces_per_image;

  const T* image_vertices(int64_t b) const { return vertices + b * num_vertices * 3; }
  const int64_t* image_faces(int64_t b) const { return faces_per_image ? faces + b * num_faces * 3 : faces; }
};

// Silhouettes of a batch (silhouette.cpp).
template <class T>
struct SilhouetteForward {
  MeshBatch<T> mesh;
  RasterSettings<T> settings;
  int64_t image_size;   // S
  bool anti_aliasing;   // R = 2 S, 2x2 mean
  T* alpha;             // out [B, S, S], row 0 = top
  int32_t* face_index;  // out [B, R, R], row 0 = bottom; -1 background, f front, F + f reversed copy
  int num_threads;
};

template <class T>
struct SilhouetteBackward {
  MeshBatch<T> mesh;
  int64_t image_size;
  bool anti_aliasing;
  T eps;                      // keeps the distance to an edge away from zero
  const int32_t* face_index;  // [B, R, R] of the forward pass
  const T* grad_alpha;        // [B, S, S]
  T* grad_vertices;           // out [B, V, 3]; z gets 0
  int num_threads;
};

// Occupancy grids (voxelize.cpp).
struct Voxelize {
  MeshBatch<float> mesh;  // vertices in [0, 1]^3
  int64_t size;           // s
  bool* voxels;           // out [B, s, s, s]
  int num_threads;
};

// Smoothness loss per mesh (smoothness.cpp).
template <class T>
struct Smoothness {
  const T* vertices;     // [B, V, 3]
  const int64_t* edges;  // [E, 4]: the edge's two vertices, then the two opposite ones
  int64_t batch, num_vertices, num_edges;
  T* loss;               // forward out [B]
  const T* grad_loss;    // backward in [B]
  T* grad_vertices;      // backward out [B, V, 3]
  int num_threads;
};

template <class T> void silhouette_forward(const SilhouetteForward<T>& args);
template <class T> void silhouette_backward(const SilhouetteBackward<T>& args);
template <class T> void smoothness_forward(const Smoothness<T>& args);
template <class T> void smoothness_backward(const Smoothness<T>& args);
void voxelize(const Voxelize& args);

}  // namespace nmr
