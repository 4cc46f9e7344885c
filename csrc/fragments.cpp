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
#include <vector>

#include "average.h"
#include "blocks.h"
#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

// Numbers per face in the table: columns 0, 1, 2 of M and the depths, each padded to four.
constexpr int64_t kFaceEntry = 16;

// Memory for one block.
template <class T>
struct FragmentScratch {
  VisibleFaces visible;
  std::vector<T> table;  // [visible + 1 + 8, kFaceEntry]
  std::vector<T> rows;   // [2, W + 8] a row of depths or gradients each
  std::vector<T> sums;   // [visible + 1 + 8, 4 or 12] gradients per face
  bool perspective;

  void reserve_for(const RowBlocks& blocks, bool has_perspective) {
    const int64_t most = blocks.most_visible();
    perspective = has_perspective;
    visible.reserve_for(blocks.num_faces, most);
    reserve(table, (most + 1 + kLanes) * kFaceEntry);
    reserve(rows, 2 * (blocks.raster.width + kLanes));
  }
};

// One block of rows of image b.
template <class T>
struct FragmentBlock {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  Size raster;
  const int32_t* face_index;  // [H, W], row 0 = top
  int64_t b, first, last;     // first, last: rows

  FragmentBlock(const Fragments<T>& args, const RowBlock& block)
      : vertices(args.mesh.image_vertices(block.b)),
        faces(args.mesh.image_faces(block.b)),
        num_faces(block.blocks.num_faces),
        raster(block.blocks.raster),
        face_index(args.face_index + block.b * raster.pixels()),
        b(block.b),
        first(block.first()),
        last(block.last()) {}
};

}  // namespace
}  // namespace nmr

#define NMR_LEVEL_FILE "fragment_rows.h"
#include "levels.h"

namespace nmr {

template <class T>
void fragments_forward(const Fragments<T>& args) {
  for_blocks(
      args.mesh.batch, raster_of(args.image, args.anti_aliasing), args.num_threads,
      [&](int64_t b) { return args.mesh.face_count(b); },
      [&](const RowBlock& block) {
        FragmentScratch<T>& scratch = thread_scratch<FragmentScratch<T>>();
        scratch.reserve_for(block.blocks, args.perspective);
        NMR_AT_BEST_LEVEL(forward_block, args, FragmentBlock<T>(args, block), scratch);
      });
}

template <class T>
void fragments_backward(const Fragments<T>& args) {
  const MeshBatch<T>& mesh = args.mesh;
  std::fill_n(args.grad_vertices, 3 * mesh.num_vertices * (mesh.starts ? 1 : mesh.batch), T(0));
  sum_blocks<FaceGradients<T>>(
      mesh.batch, raster_of(args.image, args.anti_aliasing), false, args.num_threads,
      [&](int64_t b) { return mesh.face_count(b); },
      [&](const RowBlock& block, FaceGradients<T>& result) {
        const int64_t most = block.blocks.most_visible();
        FragmentScratch<T>& scratch = thread_scratch<FragmentScratch<T>>();
        scratch.reserve_for(block.blocks, args.perspective);
        reserve(scratch.sums, (most + 1 + kLanes) * 12);
        reserve(result.ids, most);
        reserve(result.values, 9 * most);
        NMR_AT_BEST_LEVEL(backward_rows, args, FragmentBlock<T>(args, block), scratch, result);
      },
      [&](int64_t b, const FaceGradients<T>& result) {
        scatter_face_gradients(result, mesh.image_faces(b), mesh.face_count(b),
                               args.grad_vertices + 3 * mesh.vertex_start(b));
      });
}

NMR_FLOAT_AND_DOUBLE(fragments_forward, Fragments)
NMR_FLOAT_AND_DOUBLE(fragments_backward, Fragments)

}  // namespace nmr
