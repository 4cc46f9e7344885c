// The tables of the rasterizer (rasterize.cpp): its faces, and the rows that it fills.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "average.h"
#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

constexpr int64_t kFaceChunk = 2048;  // faces that one thread sets up together

// Data of kLanes faces for the fill.
template <class T>
struct FaceBlock {
  T x[3][kLanes], y[3][kLanes];                       // corners, in the face's own order
  T slope_x[kLanes], slope_y[kLanes], level[kLanes];  // coefficients of q
  T margin[kLanes];                                   // infinity: no bounds
  T win_margin[kLanes];  // the same, and infinity if it wins by its exact depth alone
  T nearest[kLanes];     // largest q at any pixel
  // Pixels inside the box.
  int32_t column_first[kLanes], column_last[kLanes], row_first[kLanes], row_last[kLanes];
};

// Pixels from the first to the last column and row, inclusive.
struct PixelBox {
  int32_t column_first, column_last, row_first, row_last;
};

template <class T>
struct FaceTable {
  std::vector<FaceBlock<T>> blocks;  // [faces / 8]
  std::vector<int32_t> front,
      back;  // per chunk: faces drawn in their own order, and reversed; ascending
  std::vector<int32_t> num_front, num_back;  // [chunks]
  std::vector<T> front_sum, back_sum;        // [chunks] sums of `nearest` over them
  std::vector<PixelBox> boxes;               // [chunks] around the boxes of all their faces

  void reserve_faces(int64_t num_faces) {
    const size_t size = static_cast<size_t>(num_faces + 2 * kLanes);
    reserve(blocks, size / kLanes);
    for (std::vector<int32_t>* v : {&front, &back}) reserve(*v, size);
    for (std::vector<int32_t>* v : {&num_front, &num_back}) reserve(*v, size / kFaceChunk + 1);
    for (std::vector<T>* v : {&front_sum, &back_sum}) reserve(*v, size / kFaceChunk + 1);
    reserve(boxes, size / kFaceChunk + 1);
  }
};

// Rows of one band of an image, padded so that a vector of pixels may reach past the last column.
template <class T>
struct BandScratch {
  std::vector<T> columns, rows;  // [W + 8] and [H + 8] pixel centres in [-1, 1]
  Size raster{0, 0};             // for which they are computed
  // [rows, W + 8] bounds of the nearest face's q; -infinity on background; 8 more at the end.
  Buffer<T> most, least;
  Buffer<int32_t> face_index;  // the nearest face
  // [rows / 8, W / 8] the smallest of `least` in a block: the second pass skips faces behind it.
  std::vector<T> block_least;
};

template <class T>
struct Image {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  RasterSettings<T> settings;
  FaceTable<T>* table;
};

// One band of rows of an image.
template <class T>
struct Band {
  int64_t row_first, row_last;  // inclusive, from the bottom
  Size raster;
  int64_t stride;
  const T *columns, *rows;  // pixel centres
  T *most, *least;
  int32_t* face_index;
};

// Coefficients of the depth of a face at any pixel.
template <class T>
struct FacePlane {
  BarycentricMatrix<T> weights;
  T z[3];
};

// Those of face `id`, which is a reversed copy if id >= num_faces.
template <class T>
NMR_INLINE FacePlane<T> face_plane(const Image<T>& image, int32_t id) {
  const bool reversed = id >= image.num_faces;
  const int64_t* face = image.faces + 3 * face_of(id, image.num_faces);
  const Triangle<T> t = load_triangle(image.vertices, face, reversed);
  const Size raster = image.settings.raster;
  return {barycentric_matrix(t, static_cast<T>(raster.width), static_cast<T>(raster.height)),
          {t.z[0], t.z[1], t.z[2]}};
}

}  // namespace nmr
