// Which face is nearest at each pixel of each image.
//
// Three steps per image. Set-up: for each face, the vertex orders that face the camera, its box of
// pixels, bounds of its depth. Fill: for each face (all originals, then all reversed copies), mark
// the pixels inside. Copy: to the face index map. The published depth needs sixteen divisions per
// pixel, and its rounding decides which face is nearer; it is computed only if the bounds do not
// decide. Several threads can share one image: set-up by chunks of faces, fill by bands of rows.
//
// The bounds are those of q = 1 / depth, or -depth without perspective, which is linear on the
// screen: at a pixel (i, j) inside a face, q differs from slope_x i + slope_y j + level by at most
// `margin`. See `bound_depth` in fill.h, where the loops are.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

#include "face_table.h"

#define NMR_LEVEL_FILE "fill.h"
#include "levels.h"

namespace nmr {

constexpr int64_t kBandPixels =
    int64_t(1) << 16;  // pixels of a band that fits into a core's cache: 12 bytes each
constexpr int64_t kPixelsPerFace = 64;  // bands get that small only with this many pixels per face

template <class T>
void rasterize(const Rasterize<T>& args) {
  const Size raster = args.settings.raster;
  const int64_t H = raster.height, W = raster.width, batch = args.mesh.batch;
  const int64_t scale = args.anti_aliasing ? 2 : 1;  // rows that no two bands share
  // Many images: one thread per image. Few images: all threads share one image at a time.
  const bool share = batch < args.num_threads;
  parallel_for(batch, share ? 1 : args.num_threads, [&](int64_t b) {
    FaceTable<T>& table = thread_scratch<FaceTable<T>>();
    const int64_t num_faces = args.mesh.face_rows.count(b);
    table.reserve_faces(num_faces);
    const Image<T> image{args.mesh.image_vertices(b), args.mesh.image_faces(b), num_faces,
                         args.settings, &table};
    const int threads = share ? args.num_threads : 1;
    // Small bands fit into a core's cache, but every band looks at all faces.
    const int64_t small =
        std::min(H * W / kBandPixels, H * W / (kPixelsPerFace * std::max<int64_t>(num_faces, 1)));
    const int64_t bands = std::clamp<int64_t>(std::max<int64_t>(share ? threads * 4 : 1, small), 1,
                                              (H + 2 * kLanes - 1) / (2 * kLanes));
    parallel_for((num_faces + kFaceChunk - 1) / kFaceChunk, threads,
                 [&](int64_t chunk) { NMR_AT_BEST_LEVEL(set_up_faces, image, chunk); });
    parallel_for(bands, threads, [&](int64_t n) {
      BandScratch<T>& scratch = thread_scratch<BandScratch<T>>();
      if (!(scratch.raster == raster)) {
        scratch.columns.resize(W + kLanes);
        scratch.rows.resize(H + kLanes);
        for (int64_t i = 0; i < W + kLanes; ++i) scratch.columns[i] = pixel_centre<T>(i, W);
        for (int64_t j = 0; j < H + kLanes; ++j) scratch.rows[j] = pixel_centre<T>(j, H);
        scratch.raster = raster;
      }
      Band<T> band{n * (H / scale) / bands * scale,
                   (n + 1) * (H / scale) / bands * scale - 1,
                   raster,
                   W + 3 * kLanes,  // with one kLanes, rows of 1024 floats share cache lines
                   scratch.columns.data(),
                   scratch.rows.data(),
                   nullptr,
                   nullptr,
                   nullptr};
      const int64_t rows = band.row_last - band.row_first + 1, blocks = (W + kLanes - 1) / kLanes;
      band.most = reserve(scratch.most, rows * band.stride + kLanes);
      band.least = reserve(scratch.least, rows * band.stride + kLanes);
      band.face_index = reserve(scratch.face_index, rows * band.stride + kLanes);
      T* block_least = reserve(scratch.block_least, (rows / kLanes + 1) * blocks);
      NMR_AT_BEST_LEVEL(fill_band, image, band, blocks, block_least, args.face_index + b * H * W);
      if (args.alpha)
        NMR_AT_BEST_LEVEL(cover_band, band, args.face_index + b * H * W, args.anti_aliasing,
                          args.alpha + b * H * W / (scale * scale));
    });
  });
}

NMR_FLOAT_AND_DOUBLE(rasterize, Rasterize)

}  // namespace nmr
