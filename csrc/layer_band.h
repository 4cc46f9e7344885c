// The rows that layers.cpp fills.
#pragma once

#include <cstdint>

#include "blocks.h"
#include "soft_faces.h"
#include "soft_weights.h"

namespace nmr {

// For some rows of one image, the nearest faces of each pixel. The rows are first to last - 1,
// where row 0 is the lowest of the image.
template <class T>
struct LayerBand {
  RasterSettings<T> settings;
  int64_t layers, first, last;
  T* depth;             // [rows, W, K], sorted; `far` without a face
  int32_t* face_index;  // [H, W, K] of the image, row 0 = top
};

// One image whose faces cover pixels.
template <class T>
struct HardImage {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  const T* columns;  // pixel centres, padded to whole groups
};

}  // namespace nmr
