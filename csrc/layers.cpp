// The K nearest faces at each pixel, by the same tests and the same depth as in the rasterizer: the first layer is its
// face index map.
//
// Faces are visited in ascending order, all originals, then all reversed copies, and inserted into the sorted list of
// each pixel that they cover, behind those that are equally near. Bands of rows are independent.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "geometry.h"
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
  const T* centres;  // of the columns, padded to whole groups
  T* depth;          // [rows, W, K], sorted; `far` where there is no face
  int32_t* face_index;  // [H, W, K] of the image, row 0 = top
};

// A range of pixels that contains all centres in [lo, hi], and few others.
template <class T>
NMR_INLINE void around(T lo, T hi, int64_t size, int64_t& first, int64_t& last) {
  const T n = static_cast<T>(size), from = to_pixel(lo, n), to = to_pixel(hi, n);
  first = std::max<int64_t>(0, static_cast<int64_t>(from > 0 ? (from < n ? from : n) : T(0)) - 1);
  last = std::min<int64_t>(size - 1, static_cast<int64_t>(to > 0 ? (to < n ? to : n) : T(-2)) + 2);
}

// Inserts one face into the lists of the pixels that it covers.
template <class T>
NMR_INLINE void insert_face(const LayerBand<T>& band, int64_t f, bool reversed) {
  const Size raster = band.settings.raster;
  const Triangle<T> t = load_triangle(band.vertices, band.faces + 3 * f, reversed);
  const T *x = t.x, *y = t.y, *z = t.z;
  if ((y[2] - y[0]) * (x[1] - x[0]) < (y[1] - y[0]) * (x[2] - x[0])) return;
  // As in the rasterizer, of the face's own order: rounding may find only one of the two orders flat.
  if (!is_drawable(load_triangle(band.vertices, band.faces + 3 * f, false))) return;
  const T left = std::min({x[0], x[1], x[2]}), right = std::max({x[0], x[1], x[2]});
  const T bottom = std::min({y[0], y[1], y[2]}), top = std::max({y[0], y[1], y[2]});
  int64_t i_first, i_last, j_first, j_last;
  around(left, right, raster.width, i_first, i_last);
  around(bottom, top, raster.height, j_first, j_last);
  j_first = std::max(j_first, band.first), j_last = std::min(j_last, band.last);
  if (i_first > i_last || j_first > j_last) return;
  const int32_t id = static_cast<int32_t>(reversed ? band.num_faces + f : f);
  const auto m = barycentric_matrix(t, static_cast<T>(raster.width), static_cast<T>(raster.height));
  const T near = band.settings.near, far = band.settings.far;
  const int64_t K = band.layers;

  for (int64_t j = j_first; j <= j_last; ++j) {
    const T yp = pixel_centre<T>(j, raster.height), row = static_cast<T>(j);
    if (!(yp >= bottom && yp <= top)) continue;
    for (int64_t i = i_first; i <= i_last; i += kGroup) {
      T depth[kGroup];
      int32_t covered[kGroup], any = 0;
      for (int64_t n = 0; n < kGroup; ++n) {
        const T xp = band.centres[i + n], column = static_cast<T>(static_cast<int32_t>(i + n));
        const bool outside = ((yp - y[0]) * (x[1] - x[0]) < (xp - x[0]) * (y[1] - y[0])) |
                             ((yp - y[1]) * (x[2] - x[1]) < (xp - x[1]) * (y[2] - y[1])) |
                             ((yp - y[2]) * (x[0] - x[2]) < (xp - x[2]) * (y[0] - y[2]));
        T w[3];
        for (int k = 0; k < 3; ++k) w[k] = clamp_weight(column * m.m[k][0] + m.m[k][1] * row + m.m[k][2]);
        const T sum = w[0] + w[1] + w[2];
        depth[n] = 1 / (w[0] / sum / z[0] + w[1] / sum / z[1] + w[2] / sum / z[2]);
        covered[n] = !outside & (xp >= left) & (xp <= right) & (depth[n] > near) & (depth[n] < far);
        any |= covered[n];
      }
      if (!any) continue;
      const int64_t lanes = std::min(kGroup, i_last - i + 1);
      for (int64_t n = 0; n < lanes; ++n) {
        T* depths = band.depth + ((j - band.first) * raster.width + i + n) * K;
        if (!covered[n] || !(depth[n] < depths[K - 1])) continue;
        int32_t* face_indices = band.face_index + ((raster.height - 1 - j) * raster.width + i + n) * K;
        int64_t k = K - 1;
        for (; k > 0 && depth[n] < depths[k - 1]; --k) {
          depths[k] = depths[k - 1];
          face_indices[k] = face_indices[k - 1];
        }
        depths[k] = depth[n];
        face_indices[k] = id;
      }
    }
  }
}

template <class T>
NMR_INLINE void fill_layers_body(const LayerBand<T>& band) {
  for (int reversed = 0; reversed <= band.settings.fill_back; ++reversed)
    for (int64_t f = 0; f < band.num_faces; ++f) insert_face(band, f, reversed);
}

NMR_CLONES void fill_layers(const LayerBand<float>& band) { fill_layers_body(band); }
NMR_CLONES void fill_layers(const LayerBand<double>& band) { fill_layers_body(band); }

}  // namespace

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
    std::fill_n(face_index + (raster.height - 1 - last) * raster.width * K, (last - first + 1) * raster.width * K, -1);
    fill_layers(LayerBand<T>{args.mesh.image_vertices(b), args.mesh.image_faces(b), args.mesh.face_count(b),
                             args.settings, K, first, last, centres.data(), depth.data(), face_index});
  });
}

template void rasterize_layers(const RasterizeLayers<float>&);
template void rasterize_layers(const RasterizeLayers<double>&);

}  // namespace nmr
