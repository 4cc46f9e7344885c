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
#include "scanline_grads.h"
#include "stages.h"
#include "swept_image.h"

#define NMR_LEVEL_FILE "sweep.h"
#include "levels.h"

namespace nmr {
namespace {

constexpr int64_t kBandPixels = int64_t(1) << 16;  // of an image, that one task averages

template <class T>
struct Lines {
  ScanlineGrads<T> lines[2];  // [0] columns: lines of constant x, swept along y; [1] rows
};

}  // namespace

// Bands of rows of all images in parallel.
template <class T>
void silhouette_forward(const SilhouetteForward<T>& args) {
  const Size image = args.image, raster = raster_of(image, args.anti_aliasing);
  const int64_t bands = std::min(image.height, image.pixels() / kBandPixels + 1);
  parallel_for(args.batch * bands, args.num_threads, [&](int64_t n) {
    const int64_t b = n / bands, k = n % bands, first = k * image.height / bands;
    const Size band{(k + 1) * image.height / bands - first, image.width};
    const int32_t* face_index = args.face_index + b * raster.pixels() + first * (raster.pixels() / image.height);
    T* alpha = args.alpha + b * image.pixels() + first * image.width;
    if (!args.anti_aliasing) {
      for (int64_t i = 0; i < band.pixels(); ++i) alpha[i] = face_index[i] >= 0 ? T(1) : T(0);
      return;
    }
    NMR_AT_BEST_LEVEL(average_coverage, face_index, band, alpha);
  });
}

// grad_vertices of each image.
template <class T>
void silhouette_backward(const SilhouetteBackward<T>& args) {
  const Size raster = raster_of(args.image, args.anti_aliasing);
  // Many images: one thread per image. Few images: all threads share one image at a time.
  const bool share = args.mesh.batch < args.num_threads;
  parallel_for(args.mesh.batch, share ? 1 : args.num_threads, [&](int64_t b) {
    ScanlineGrads<T>* lines = thread_scratch<Lines<T>>().lines;
    const SweepImage<T> image{args.mesh.image_vertices(b),
                              args.mesh.image_faces(b),
                              args.mesh.face_count(b),
                              raster,
                              args.image,
                              args.anti_aliasing,
                              args.eps,
                              args.face_index + b * raster.pixels(),
                              args.grad_alpha + b * args.image.pixels(),
                              lines,
                              args.eps > T(1e-15) ? T(1e15) : T(0)};
    T* grad_vertices = args.grad_vertices + 3 * args.mesh.vertex_start(b);
    std::fill_n(grad_vertices, 3 * args.mesh.vertex_count(b), T(0));
    const int threads = share ? args.num_threads : 1;
    const int64_t width = band_width(raster.width, threads), parts = (raster.width + width - 1) / width;
    lines[0].reserve_lines(raster.width, raster.height, 1);
    lines[1].reserve_lines(raster.height, raster.width, parts);
    sweep_image(
        image, threads,
        [&](int64_t first, int64_t last, uint8_t* seen) {
          NMR_AT_BEST_LEVEL(mark_visible, image.face_index + first, last - first, image.num_faces, seen);
        },
        [&](uint8_t* seen, int32_t* ids) { return NMR_AT_BEST_LEVEL(list_visible, image.num_faces, seen, ids); },
        [&] { return NMR_AT_BEST_LEVEL(all_finite, image.grad_alpha, args.image.pixels()); },
        [&] {
          parallel_for(parts, threads, [&](int64_t n) {
            T* grad_row = reserve(thread_scratch<SweepTask<T>>().grad_row, raster.width + kPad);
            const ColumnPart part{n, width};
            NMR_AT_BEST_LEVEL(collect_lines, image, part, grad_row);
          });
          if (parts == 1) return;
          const int64_t height = band_width(raster.height, threads);
          parallel_for((raster.height + height - 1) / height, threads, [&](int64_t n) {
            const int64_t first = n * height, last = std::min(first + height, raster.height);
            NMR_AT_BEST_LEVEL(join_rows, image, width, first, last);
          });
        },
        [&](const int32_t* ids, int64_t first, int64_t last, SweepScratch<T>& block, T* grad) {
          NMR_AT_BEST_LEVEL(sweep_faces, image, ids, first, last, block, grad);
        },
        grad_vertices);
  });
}

template void silhouette_forward(const SilhouetteForward<float>&);
template void silhouette_forward(const SilhouetteForward<double>&);
template void silhouette_backward(const SilhouetteBackward<float>&);
template void silhouette_backward(const SilhouetteBackward<double>&);

}  // namespace nmr
