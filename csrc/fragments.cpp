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

#include "fragment_table.h"

#define NMR_LEVEL_FILE "fragment_rows.h"
#include "levels.h"

namespace nmr {

template <class T>
void fragments_forward(const Fragments<T>& args) {
  for_blocks(args.mesh.batch, raster_of(args.image, args.anti_aliasing), args.num_threads,
             args.mesh.face_rows, [&](const RowBlock& block) {
               FragmentScratch<T>& scratch = thread_scratch<FragmentScratch<T>>();
               scratch.reserve_for(block.blocks, args.perspective, thread_scratch<VisibleFaces>());
               NMR_AT_BEST_LEVEL(forward_block, args, FragmentBlock<T>(args, block), scratch);
             });
}

template <class T>
void fragments_backward(const Fragments<T>& args) {
  const MeshBatch<T>& mesh = args.mesh;
  std::fill_n(args.grad_vertices, 3 * mesh.vertex_rows.total(mesh.batch), T(0));
  sum_blocks<FaceSums<T>>(
      mesh.batch, raster_of(args.image, args.anti_aliasing), false, args.num_threads,
      mesh.face_rows,
      [&](const RowBlock& block, FaceSums<T>& sums) {
        const int64_t most = block.blocks.most_visible();
        FragmentScratch<T>& scratch = thread_scratch<FragmentScratch<T>>();
        scratch.reserve_for(block.blocks, args.perspective, sums.visible);
        reserve(scratch.sums, (most + 1 + kLanes) * 12);
        reserve(sums.values, 9 * (most + 1));
        NMR_AT_BEST_LEVEL(backward_rows, args, FragmentBlock<T>(args, block), scratch, sums);
      },
      [&](int64_t b, const FaceSums<T>& sums) {
        scatter_corner_sums<3>(sums, image_attributes(mesh, b), 3, args.grad_vertices);
      });
}

NMR_FLOAT_AND_DOUBLE(fragments_forward, Fragments)
NMR_FLOAT_AND_DOUBLE(fragments_backward, Fragments)

}  // namespace nmr
