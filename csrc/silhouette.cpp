// Coverage, and NMR's gradient: on every raster line that crosses an edge of a visible face, the pixels that would
// change if the edge moved pull its two vertices, each with strength (change of the loss) / (distance to move).
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "geometry.h"
#include "parallel.h"
#include "pull_lines.h"
#include "stages.h"

#define NMR_LEVEL_FILE "sweep.h"
#include "levels.h"

namespace nmr {

// Images in parallel.
template <class T>
void silhouette_forward(const SilhouetteForward<T>& args) {
  const Size image = args.image, raster = raster_of(image, args.anti_aliasing);
  parallel_for(args.batch, args.num_threads, [&](int64_t b) {
    const int32_t* owner = args.owner + b * raster.pixels();
    T* alpha = args.alpha + b * image.pixels();
    if (!args.anti_aliasing) {
      for (int64_t n = 0; n < image.pixels(); ++n) alpha[n] = owner[n] >= 0 ? T(1) : T(0);
      return;
    }
    NMR_AT_BEST_LEVEL(average_coverage, owner, image, alpha);
  });
}

namespace {

// Memory for one image.
template <class T>
struct BackwardScratch {
  PullLines<T> lines[2];      // [0] columns: lines of constant x, swept along y; [1] rows
  std::vector<uint8_t> seen;  // [2 F + 1 + pad]
  std::vector<int32_t> ids;   // [visible faces + pad] their owner entries
  std::vector<T> grad;        // [visible faces, 3, 2] of x and y of their corners, in the order in which they are drawn
};

// Memory for one task.
template <class T>
struct TaskScratch {
  std::vector<T> grad_row;              // [W + lanes]
  std::vector<SweepScratch<T>> blocks;  // [1]
};

}  // namespace

// grad_vertices of each image: lists the pixels that can pull, sweeps the visible faces, adds up at the vertices. If a
// gradient of alpha is not finite, x and y of every vertex of a visible face of that image get NaN.
template <class T>
void silhouette_backward(const SilhouetteBackward<T>& args) {
  const Size raster = raster_of(args.image, args.anti_aliasing);
  const int64_t H = raster.height, W = raster.width, batch = args.mesh.batch;
  // Many images: one thread per image. Few images: all threads share one image at a time.
  const bool share = batch < args.num_threads;
  const int threads = share ? args.num_threads : 1;
  parallel_for(batch, share ? 1 : args.num_threads, [&](int64_t b) {
    BackwardScratch<T>& scratch = thread_scratch<BackwardScratch<T>>();
    const SweepImage<T> image{args.mesh.image_vertices(b), args.mesh.image_faces(b), args.mesh.face_count(b), raster,
                              args.image, args.anti_aliasing, args.eps, args.owner + b * raster.pixels(),
                              args.grad_alpha + b * args.image.pixels(), scratch.lines,
                              args.eps > T(1e-15) ? T(1e15) : T(0)};
    T* grad_vertices = args.grad_vertices + 3 * args.mesh.vertex_start(b);
    std::fill_n(grad_vertices, 3 * args.mesh.vertex_count(b), T(0));

    uint8_t* seen = reserve(scratch.seen, 2 * image.num_faces + 1 + kPad);
    int32_t* ids = reserve(scratch.ids, std::min(2 * image.num_faces, raster.pixels()) + kPad);
    const int64_t count = NMR_AT_BEST_LEVEL(find_visible, image.owner, raster.pixels(), image.num_faces, seen, ids);
    T* grad = reserve(scratch.grad, 6 * count);
    if (!NMR_AT_BEST_LEVEL(all_finite, image.grad_alpha, args.image.pixels())) {
      std::fill_n(grad, 6 * count, std::numeric_limits<T>::quiet_NaN());
      scatter_corners(image, ids, count, grad, grad_vertices);
      return;
    }

    scratch.lines[0].reserve_lines(W, H);
    scratch.lines[1].reserve_lines(H, W);
    // Shared image: bands of columns, then bands of rows. Bands consist of whole vectors, so that no two threads write
    // the same vector.
    const int64_t longer = std::max(H, W);
    const int64_t band = share ? std::max<int64_t>(longer / threads / kPad * kPad, 64) : longer;
    const int64_t column_bands = (W + band - 1) / band, row_bands = (H + band - 1) / band;
    parallel_for(share ? column_bands + row_bands : 1, threads, [&](int64_t n) {
      T* grad_row = reserve(thread_scratch<TaskScratch<T>>().grad_row, W + kPad);
      const auto part = [band](int64_t k, int64_t lines) { return std::min(k * band, lines); };
      const int64_t k = n - column_bands;  // number of a band of rows
      const LineRange range = !share  ? LineRange{0, H, 0, W}
                              : k < 0 ? LineRange{0, 0, part(n, W), part(n + 1, W)}
                                      : LineRange{part(k, H), part(k + 1, H), 0, 0};
      NMR_AT_BEST_LEVEL(collect_lines, image, range, grad_row);
    });
    const int64_t chunk = share ? 2 * kSweptFaces : std::max<int64_t>(count, 1);
    parallel_for((count + chunk - 1) / chunk, threads, [&](int64_t n) {
      SweepScratch<T>& block = *reserve(thread_scratch<TaskScratch<T>>().blocks, 1);
      NMR_AT_BEST_LEVEL(sweep_faces, image, ids, n * chunk, std::min((n + 1) * chunk, count), block, grad);
    });
    scatter_corners(image, ids, count, grad, grad_vertices);
  });
}

template void silhouette_forward(const SilhouetteForward<float>&);
template void silhouette_forward(const SilhouetteForward<double>&);
template void silhouette_backward(const SilhouetteBackward<float>&);
template void silhouette_backward(const SilhouetteBackward<double>&);

}  // namespace nmr
