// The K nearest faces at each pixel, by the same tests and the same depth as in the rasterizer: the
// first layer is its face index map.
//
// Faces are visited in ascending order, all originals, then all reversed copies, and inserted into
// the sorted list of each pixel that they cover, behind those that are equally near. Bands of rows
// are independent.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "geometry.h"
#include "insert_sorted.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

constexpr int64_t kGroup = 16;     // pixels evaluated together
constexpr int64_t kBandRows = 32;  // rows per task

// Rows [first, last] of one image, from the bottom.
template <class T>
struct LayerBand {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  RasterSettings<T> settings;
  int64_t layers, first, last;
  const T* centres;     // centres of the columns, padded to whole groups
  T* depth;             // [rows, W, K], sorted; `far` without a face
  int32_t* face_index;  // [H, W, K] of the image, row 0 = top
};

}  // namespace
}  // namespace nmr

#define NMR_LEVEL_V4
#define NMR_LEVEL_FILE "fill_layers.h"
#include "levels.h"

namespace nmr {

template <class T>
void rasterize_layers(const RasterizeLayers<T>& args) {
  const Size raster = args.settings.raster;
  const int64_t K = args.layers, bands = (raster.height + kBandRows - 1) / kBandRows;
  std::vector<T> centres(raster.width + kGroup);
  for (int64_t i = 0; i < raster.width + kGroup; ++i) centres[i] = pixel_centre<T>(i, raster.width);
  parallel_for(args.mesh.batch * bands, args.num_threads, [&](int64_t task) {
    const int64_t b = task / bands, first = task % bands * kBandRows,
                  last = std::min(first + kBandRows, raster.height) - 1;
    std::vector<T> depth((last - first + 1) * raster.width * K, args.settings.far);
    int32_t* face_index = args.face_index + b * raster.pixels() * K;
    std::fill_n(face_index + (raster.height - 1 - last) * raster.width * K,
                (last - first + 1) * raster.width * K, -1);
    const LayerBand<T> band{args.mesh.image_vertices(b),
                            args.mesh.image_faces(b),
                            args.mesh.face_count(b),
                            args.settings,
                            K,
                            first,
                            last,
                            centres.data(),
                            depth.data(),
                            face_index};
    NMR_AT_BEST_LEVEL(fill_layers, band);
  });
}

template void rasterize_layers(const RasterizeLayers<float>&);
template void rasterize_layers(const RasterizeLayers<double>&);

}  // namespace nmr
