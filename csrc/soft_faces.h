// Faces that reach beyond their border, as SoftRas takes them (soft.cpp), and the images that they
// are in.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

constexpr int64_t kSoftSums = 7;  // gradients of x and y of three corners, and of sigma

// A face ready to be evaluated: corners counter-clockwise, and the pixels that it can reach.
template <class T>
struct SoftFace {
  T x[3], y[3], side_x[3], side_y[3];  // corner k; side k leads to corner k + 1
  T inverse[3];                        // 1 / squared length of side k, 0 if it has none
  int64_t corner[3];                   // vertices
  bool back;                           // seen from behind
  int64_t column_first, column_last, row_first, row_last;  // rows from the bottom
};

// One image, with the scale from [-1, 1] to units of half the shorter side.
template <class T>
struct SoftImage {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  RasterSettings<T> settings;
  T sigma, reach, scale_x, scale_y;
  const T* columns;  // pixel centres, scaled, padded to whole groups

  NMR_INLINE T row(int64_t j) const { return pixel_centre<T>(j, settings.raster.height) * scale_y; }
};

// Whether face f is drawn. It is not if its corners are all one vertex, if one of them is not
// finite, if all are nearer than `near` or all farther than `far`, or, without fill_back, if it is
// seen from behind.
template <class T>
NMR_INLINE bool set_up_face(const SoftImage<T>& image, int64_t f, SoftFace<T>& face) {
  const T largest =
      std::sqrt(std::sqrt(std::numeric_limits<T>::max()));  // squares of squares stay finite
  const T limit = largest < T(1e9) ? largest : T(1e9);
  bool usable = true, beyond_near = false, before_far = false;
  for (int k = 0; k < 3; ++k) {
    face.corner[k] = image.faces[3 * f + k];
    const T* v = image.vertices + 3 * face.corner[k];
    face.x[k] = v[0] * image.scale_x;
    face.y[k] = v[1] * image.scale_y;
    usable = usable && std::abs(face.x[k]) < limit && std::abs(face.y[k]) < limit && v[2] == v[2];
    beyond_near = beyond_near || v[2] > image.settings.near;
    before_far = before_far || v[2] < image.settings.far;
  }
  const bool listed =
      face.corner[0] != face.corner[1] || face.corner[1] != face.corner[2];  // else padding
  if (!listed || !usable || !beyond_near || !before_far) return false;
  T *x = face.x, *y = face.y;
  face.back = (y[2] - y[0]) * (x[1] - x[0]) < (y[1] - y[0]) * (x[2] - x[0]);  // clockwise
  if (face.back) {
    if (!image.settings.fill_back) return false;
    std::swap(x[0], x[2]), std::swap(y[0], y[2]), std::swap(face.corner[0], face.corner[2]);
  }
  for (int k = 0; k < 3; ++k) {
    const int q = (k + 1) % 3;
    face.side_x[k] = x[q] - x[k];
    face.side_y[k] = y[q] - y[k];
    const T square = face.side_x[k] * face.side_x[k] + face.side_y[k] * face.side_y[k];
    face.inverse[k] = square > std::numeric_limits<T>::min() ? 1 / square : T(0);
  }
  const T margin = std::sqrt(image.reach);
  pixels_around((min3(x[0], x[1], x[2]) - margin) / image.scale_x,
                (max3(x[0], x[1], x[2]) + margin) / image.scale_x, image.settings.raster.width, 0,
                face.column_first, face.column_last);
  pixels_around((min3(y[0], y[1], y[2]) - margin) / image.scale_y,
                (max3(y[0], y[1], y[2]) + margin) / image.scale_y, image.settings.raster.height, 0,
                face.row_first, face.row_last);
  return face.column_first <= face.column_last && face.row_first <= face.row_last;
}

// Scaled centres of the columns, padded.
template <class T>
std::vector<T> scaled_columns(Size raster) {
  const T scale =
      static_cast<T>(raster.width) / static_cast<T>(std::min(raster.height, raster.width));
  std::vector<T> columns(raster.width + kGroup);
  for (int64_t i = 0; i < raster.width + kGroup; ++i)
    columns[i] = pixel_centre<T>(i, raster.width) * scale;
  return columns;
}

template <class T>
SoftImage<T> soft_image(const MeshBatch<T>& mesh, const SoftSettings<T>& soft, int64_t b,
                        const T* columns) {
  const Size raster = soft.raster.raster;
  const T shorter = static_cast<T>(std::min(raster.height, raster.width));
  return {mesh.image_vertices(b),
          mesh.image_faces(b),
          mesh.face_rows.count(b),
          soft.raster,
          soft.sigma,
          soft.reach,
          static_cast<T>(raster.width) / shorter,
          static_cast<T>(raster.height) / shorter,
          columns};
}

}  // namespace nmr
