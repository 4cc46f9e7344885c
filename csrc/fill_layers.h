// The loops of the K nearest faces.
#include "layer_band.h"
#include "soft_pixels.h"

namespace nmr::NMR_LEVEL {
namespace {

// Inserts a face into the lists of those pixels of a box (rows from the bottom) for which
// row(j)(i, depth) holds, which also computes its depth there.
template <class T, class Row>
NMR_INLINE void insert_face(const LayerBand<T>& band, int64_t id, int64_t column_first,
                            int64_t column_last, int64_t row_first, int64_t row_last,
                            const Row& row) {
  const Size raster = band.settings.raster;
  const T near = band.settings.near, far = band.settings.far;
  const int64_t K = band.layers;
  for (int64_t j = std::max(row_first, band.first); j < std::min(row_last + 1, band.last); ++j) {
    const auto covers = row(j);
    for (int64_t i = column_first; i <= column_last; i += kGroup) {
      T depth[kGroup];
      int32_t covered[kGroup], any = 0;
      for (int64_t n = 0; n < kGroup; ++n) {
        const bool reached = covers(i + n, depth[n]);
        covered[n] = reached & (depth[n] > near) & (depth[n] < far);
        any |= covered[n];
      }
      const int64_t lanes = any ? std::min(kGroup, column_last - i + 1) : 0;
      for (int64_t n = 0; n < lanes; ++n) {
        T* depths = band.depth + ((j - band.first) * raster.width + i + n) * K;
        if (!covered[n] || !(depth[n] < depths[K - 1])) continue;
        int32_t* face_indices =
            band.face_index + ((raster.height - 1 - j) * raster.width + i + n) * K;
        int64_t k = K - 1;
        for (; k > 0 && depth[n] < depths[k - 1]; --k) {
          depths[k] = depths[k - 1];
          face_indices[k] = face_indices[k - 1];
        }
        depths[k] = depth[n];
        face_indices[k] = static_cast<int32_t>(id);
      }
    }
  }
}

template <bool perspective, class T>
NMR_INLINE void insert_hard(const HardImage<T>& image, const LayerBand<T>& band, int64_t f,
                            bool reversed) {
  const Size raster = band.settings.raster;
  const Triangle<T> t = load_triangle(image.vertices, image.faces + 3 * f, reversed);
  const T *x = t.x, *y = t.y;
  if ((y[2] - y[0]) * (x[1] - x[0]) < (y[1] - y[0]) * (x[2] - x[0])) return;
  // As in the rasterizer, of the face's own order: rounding may find only one of the two orders
  // flat.
  if (!is_drawable(load_triangle(image.vertices, image.faces + 3 * f, false))) return;
  const T left = min3(x[0], x[1], x[2]), right = max3(x[0], x[1], x[2]);
  const T bottom = min3(y[0], y[1], y[2]), top = max3(y[0], y[1], y[2]);
  int64_t i_first, i_last, j_first, j_last;
  pixels_around(left, right, raster.width, 1, i_first, i_last);
  pixels_around(bottom, top, raster.height, 1, j_first, j_last);
  j_first = std::max(j_first, band.first);
  j_last = std::min(j_last, band.last - 1);
  if (i_first > i_last || j_first > j_last) return;
  while (j_first <= j_last && pixel_centre<T>(j_first, raster.height) < bottom) ++j_first;
  while (j_first <= j_last && pixel_centre<T>(j_last, raster.height) > top) --j_last;
  const auto matrix =
      barycentric_matrix(t, static_cast<T>(raster.width), static_cast<T>(raster.height));
  const auto row = [&](int64_t j) {
    const T yp = pixel_centre<T>(j, raster.height);
    return [&, yp, j](int64_t i, T& depth) {
      const T xp = image.columns[i];
      T w[3];
      weights_at(matrix, static_cast<T>(static_cast<int32_t>(i)), static_cast<T>(j), w);
      depth = depth_at(w, t.z, perspective);
      const bool outside = ((yp - y[0]) * (x[1] - x[0]) < (xp - x[0]) * (y[1] - y[0])) |
                           ((yp - y[1]) * (x[2] - x[1]) < (xp - x[1]) * (y[2] - y[1])) |
                           ((yp - y[2]) * (x[0] - x[2]) < (xp - x[2]) * (y[0] - y[2]));
      return !outside & (xp >= left) & (xp <= right);
    };
  };
  insert_face(band, reversed ? image.num_faces + f : f, i_first, i_last, j_first, j_last, row);
}

// Inserts all faces that cover pixels.
template <class T>
void fill_hard(const HardImage<T>& image, const LayerBand<T>& band) {
  for (int reversed = 0; reversed <= band.settings.fill_back; ++reversed)
    for (int64_t f = 0; f < image.num_faces; ++f)
      band.settings.perspective ? insert_hard<true>(image, band, f, reversed)
                                : insert_hard<false>(image, band, f, reversed);
}

// Inserts all faces that reach pixels.
template <class T>
void fill_soft(const SoftImage<T>& image, const LayerBand<T>& band) {
  for (int64_t f = 0; f < image.num_faces; ++f) {
    SoftFace<T> face;
    if (!set_up_face(image, f, face)) continue;
    T z[3];
    for (int k = 0; k < 3; ++k) z[k] = image.vertices[3 * face.corner[k] + 2];
    const auto row = [&](int64_t j) {
      const T py = image.row(j);
      return [&, py](int64_t i, T& depth) {
        const T px = image.columns[i];
        depth = SoftWeights<T>(face.x, face.y, px, py).depth(z, image.settings.perspective);
        return evaluate<T, false>(face, px, py, image.sigma, image.reach).reaches;
      };
    };
    insert_face(band, face.back ? image.num_faces + f : f, face.column_first, face.column_last,
                face.row_first, face.row_last, row);
  }
}

}  // namespace
}  // namespace nmr::NMR_LEVEL
