// Which face is nearest at each pixel of one image.
#pragma once

#include <vector>

#include "stages.h"

namespace nmr {

// Working memory of one image; rows are padded so that a vector of pixels may reach past the last column.
template <class T>
struct RasterScratch {
  std::vector<T> centres;           // [stride] pixel centres in [-1, 1]
  std::vector<T> columns;           // [stride] column numbers
  std::vector<T> depth;             // [R, stride] depth of the nearest face so far
  std::vector<int32_t> face_index;  // [R, stride]
  std::vector<int32_t> back_faces;  // faces whose reversed copy faces the camera
};

// Writes face_index [R, R] of one image, row 0 = bottom: -1 for background, f where face f is nearest, F + f where its
// reversed copy is. The lowest index wins a tie.
void rasterize_image(const float* vertices, const int64_t* faces, int64_t num_faces, const RasterSettings<float>& settings,
                     RasterScratch<float>& scratch, int32_t* face_index);
void rasterize_image(const double* vertices, const int64_t* faces, int64_t num_faces, const RasterSettings<double>& settings,
                     RasterScratch<double>& scratch, int32_t* face_index);

}  // namespace nmr
