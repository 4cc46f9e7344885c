// Barycentric weights and depth of the nearest face at each pixel. They are computed from the face
// index map, by the same expressions as in the rasterizer.
//
// With w_k the normalised screen weights and q = sum_k w_k / z_k: depth z = 1 / q,
// perspective-correct weights b_k = z w_k / z_k. Without perspective, z = sum_k w_k z_k and b_k =
// w_k. Moving corner k by (dX, dY) pixels changes the weights at a fixed pixel by dw_m = -w_k (M_m0
// dX + M_m1 dY), M as in geometry.h. The loops over pixels are in fragment_rows.h.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>
#include <vector>

#include "blocks.h"
#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

constexpr int64_t kTogether = 8;  // faces or pixels that are worked on together
// Numbers per face in the table: columns 0, 1, 2 of M and the depths, each padded to four.
constexpr int64_t kEntry = 16;

// Memory for one block.
template <class T>
struct FragmentScratch {
  VisibleFaces visible;
  std::vector<T> table;  // [visible + 1 + 8, kEntry]
  std::vector<T> rows;   // [2, W + 8] a row of depths or gradients each
  std::vector<T> sums;   // [visible + 1 + 8, 4 or 12] gradients per face
  bool perspective;

  void reserve_for(int64_t num_faces, const RowBlocks& blocks, bool has_perspective) {
    const int64_t most = blocks.most_visible(num_faces);
    perspective = has_perspective;
    visible.reserve_for(num_faces, most);
    reserve(table, (most + 1 + kTogether) * kEntry);
    reserve(rows, 2 * (blocks.raster.width + kTogether));
  }
};

// One block of rows of one image.
template <class T>
struct FragmentBlock {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  Size raster;
  const int32_t* face_index;  // [H, W], row 0 = top
  int64_t first, last;        // rows
};

template <class T>
FragmentBlock<T> make_block(const MeshBatch<T>& mesh, const int32_t* face_index,
                            const RowBlocks& blocks, int64_t b, int64_t block) {
  return {mesh.image_vertices(b),
          mesh.image_faces(b),
          mesh.face_count(b),
          blocks.raster,
          face_index + b * blocks.raster.pixels(),
          blocks.first(block),
          blocks.last(block)};
}

}  // namespace
}  // namespace nmr

#define NMR_LEVEL_FILE "fragment_rows.h"
#include "levels.h"

namespace nmr {
namespace {

// The blocks of an image depend only on its own number of faces, so that results do not depend on
// other images of a packed batch. Calls body(block, b, scratch) for each block.
template <class Args, class Body, class T = std::remove_pointer_t<decltype(Args::depth)>>
void forward(const Args& args, Size raster, const Body& body) {
  const MeshBatch<T>& mesh = args.mesh;
  int64_t most_blocks = 1;
  for (int64_t b = 0; b < mesh.batch; ++b)
    most_blocks = std::max(most_blocks, RowBlocks(raster, mesh.face_count(b)).count);
  parallel_for(mesh.batch * most_blocks, args.num_threads, [&](int64_t task) {
    const int64_t b = task / most_blocks, block = task % most_blocks, F = mesh.face_count(b);
    const RowBlocks blocks(raster, F);
    if (block >= blocks.count) return;
    FragmentScratch<T>& scratch = thread_scratch<FragmentScratch<T>>();
    scratch.reserve_for(F, blocks, args.perspective);
    body(make_block(mesh, args.face_index, blocks, b, block), b, scratch);
  });
}

// Sums the gradients that body(block, b, scratch, result) computes for each block. It needs `sums`
// numbers per face.
template <class Args, class Body, class T = std::remove_pointer_t<decltype(Args::grad_vertices)>>
void backward(const Args& args, Size raster, int64_t sums, const Body& body) {
  const MeshBatch<T>& mesh = args.mesh;
  std::fill_n(args.grad_vertices, 3 * mesh.num_vertices * (mesh.starts ? 1 : mesh.batch), T(0));
  sum_blocks<FaceGradients<T>>(
      mesh.batch, false, args.num_threads,
      [&](int64_t b) { return RowBlocks(raster, mesh.face_count(b)).count; },
      [&](int64_t b, int64_t block, FaceGradients<T>& result) {
        const int64_t F = mesh.face_count(b);
        const RowBlocks blocks(raster, F);
        const int64_t most = blocks.most_visible(F);
        FragmentScratch<T>& scratch = thread_scratch<FragmentScratch<T>>();
        scratch.reserve_for(F, blocks, args.perspective);
        reserve(scratch.sums, (most + 1 + kTogether) * sums);
        reserve(result.ids, most);
        reserve(result.values, 9 * most);
        body(make_block(mesh, args.face_index, blocks, b, block), b, scratch, result);
      },
      [&](int64_t b, const FaceGradients<T>& result) {
        scatter_face_gradients(result, mesh.image_faces(b), mesh.face_count(b),
                               args.grad_vertices + 3 * mesh.vertex_start(b));
      });
}

}  // namespace

template <class T>
void fragments_forward(const Fragments<T>& args) {
  forward(args, args.raster,
          [&](const FragmentBlock<T>& block, int64_t b, FragmentScratch<T>& scratch) {
            NMR_AT_BEST_LEVEL(fragments_forward_block, args, block, b, scratch);
          });
}

template <class T>
void fragments_backward(const Fragments<T>& args) {
  backward(args, args.raster, 12,
           [&](const FragmentBlock<T>& block, int64_t b, FragmentScratch<T>& scratch,
               FaceGradients<T>& result) {
             NMR_AT_BEST_LEVEL(fragments_backward_block, args, block, b, scratch, result);
           });
}

template <class T>
void depth_forward(const DepthImage<T>& args) {
  forward(args, raster_of(args.image, args.anti_aliasing),
          [&](const FragmentBlock<T>& block, int64_t b, FragmentScratch<T>& scratch) {
            NMR_AT_BEST_LEVEL(depth_forward_block, args, block, b, scratch);
          });
}

template <class T>
void depth_backward(const DepthImage<T>& args) {
  backward(args, raster_of(args.image, args.anti_aliasing), 4,
           [&](const FragmentBlock<T>& block, int64_t b, FragmentScratch<T>& scratch,
               FaceGradients<T>& result) {
             NMR_AT_BEST_LEVEL(depth_backward_block, args, block, b, scratch, result);
           });
}

template void fragments_forward(const Fragments<float>&);
template void fragments_forward(const Fragments<double>&);
template void fragments_backward(const Fragments<float>&);
template void fragments_backward(const Fragments<double>&);
template void depth_forward(const DepthImage<float>&);
template void depth_forward(const DepthImage<double>&);
template void depth_backward(const DepthImage<float>&);
template void depth_backward(const DepthImage<double>&);

}  // namespace nmr
