// The K nearest faces at each pixel: of those that cover it, by the same tests and the same depth
// as in the rasterizer, so that the first layer is its face index map; or of those that reach it,
// as SoftRas takes them.
//
// Faces are visited in ascending order, all originals, then all reversed copies, and inserted into
// the sorted list of each pixel, behind those that are equally near. Bands of rows are independent.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

#include "layer_band.h"

#define NMR_LEVEL_V4
#define NMR_LEVEL_FILE "fill_layers.h"
#include "levels.h"

namespace nmr {
namespace {

// Calls fill(b, band) for bands of all images, with empty lists.
template <class Args, class T, class Fill>
void fill_bands(const Args& args, const RasterSettings<T>& settings, const Fill& fill) {
  const int64_t H = settings.raster.height, row = settings.raster.width * args.layers;
  const auto start = [&](int64_t b, int64_t first, int64_t last) {
    std::vector<T> depth((last - first) * row, settings.far);
    int32_t* face_index = args.face_index + b * H * row;
    std::fill_n(face_index + (H - last) * row, (last - first) * row, -1);
    fill(b, LayerBand<T>{settings, args.layers, first, last, depth.data(), face_index});
  };
  for_bands(args.mesh.batch, H, kBandRows, args.num_threads, start);
}

}  // namespace

template <class T>
void rasterize_layers(const RasterizeLayers<T>& args) {
  const int64_t W = args.settings.raster.width;
  std::vector<T> columns(W + kGroup);
  for (int64_t i = 0; i < W + kGroup; ++i) columns[i] = pixel_centre<T>(i, W);
  fill_bands(args, args.settings, [&](int64_t b, const LayerBand<T>& band) {
    const HardImage<T> image{args.mesh.image_vertices(b), args.mesh.image_faces(b),
                             args.mesh.face_rows.count(b), columns.data()};
    NMR_AT_BEST_LEVEL(fill_hard, image, band);
  });
}

template <class T>
void soft_layers(const SoftLayers<T>& args) {
  const std::vector<T> columns = scaled_columns<T>(args.settings.raster.raster);
  fill_bands(args, args.settings.raster, [&](int64_t b, const LayerBand<T>& band) {
    const SoftImage<T> image = soft_image(args.mesh, args.settings, b, columns.data());
    NMR_AT_BEST_LEVEL(fill_soft, image, band);
  });
}

NMR_FLOAT_AND_DOUBLE(rasterize_layers, RasterizeLayers)
NMR_FLOAT_AND_DOUBLE(soft_layers, SoftLayers)

}  // namespace nmr
