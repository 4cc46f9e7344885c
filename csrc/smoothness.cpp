// Smoothness loss: sum over edges of (1 + cos(theta))^2; theta is the angle between the two faces
// at the edge (cos = -1 when flat), with Kato's guards against division by zero. theta is the angle
// between the heights of the two faces over the edge.
//
// All meshes share the edges, so kGroup meshes are processed together, one per lane: their vertices
// are interleaved first, and every load and every sum of the gradient is a whole vector. The
// remaining meshes are processed one by one, kGroup edges at a time. Both ways sum a mesh's edges
// in the same order, and give the same bits.
#include <algorithm>
#include <cmath>
#include <vector>

#include "parallel.h"
#include "stages.h"

#define NMR_LEVEL_V4
#define NMR_LEVEL_FILE "smoothness_lanes.h"
#include "levels.h"

namespace nmr {
namespace {

template <class T>
struct SmoothnessScratch {
  std::vector<T> vertices, grad;  // [V, 3, kGroup]
};

// Calls meshes(b) for groups of kGroup images from b on, and mesh(b) for each remaining image.
template <class Meshes, class Mesh>
void for_groups(int64_t batch, int num_threads, const Meshes& meshes, const Mesh& mesh) {
  const int64_t groups = batch / kGroup;
  parallel_for(groups + batch % kGroup, num_threads, [&](int64_t i) {
    if (i < groups)
      meshes(i * kGroup);
    else
      mesh(groups * kGroup + i - groups);
  });
}

}  // namespace

template <class T>
void smoothness_forward(const Smoothness<T>& args) {
  const auto meshes = [&](int64_t b) {
    T* vertices =
        reserve(thread_scratch<SmoothnessScratch<T>>().vertices, args.num_vertices * 3 * kGroup);
    NMR_AT_BEST_LEVEL(meshes_forward, args, b, vertices);
  };
  for_groups(args.batch, args.num_threads, meshes,
             [&](int64_t b) { NMR_AT_BEST_LEVEL(mesh_forward, args, b); });
}

template <class T>
void smoothness_backward(const Smoothness<T>& args) {
  const auto meshes = [&](int64_t b) {
    SmoothnessScratch<T>& scratch = thread_scratch<SmoothnessScratch<T>>();
    T* vertices = reserve(scratch.vertices, args.num_vertices * 3 * kGroup);
    T* grad = reserve(scratch.grad, args.num_vertices * 3 * kGroup);
    NMR_AT_BEST_LEVEL(meshes_backward, args, b, vertices, grad);
  };
  for_groups(args.batch, args.num_threads, meshes,
             [&](int64_t b) { NMR_AT_BEST_LEVEL(mesh_backward, args, b); });
}

NMR_FLOAT_AND_DOUBLE(smoothness_forward, Smoothness)
NMR_FLOAT_AND_DOUBLE(smoothness_backward, Smoothness)

}  // namespace nmr
