// Input and memory of the sweeps of the colour gradient (color_sweep.h).
#pragma once

#include <cstdint>
#include <vector>

#include "parallel.h"
#include "scanline_grads.h"
#include "stages.h"

namespace nmr {

// The lines of one task: whole rows [row_first, row_last) and whole columns [column_first, column_last).
struct LineRange {
  int64_t row_first, row_last, column_first, column_last;
};

// The pixels with a gradient, for the lines of one axis: N lines of M pixels, C channels. Others cannot pull.
// Sweeps go up the line (direction 0) or down (direction 1).
template <class T>
struct ScanlineColors {
  // [N, blocks, 1 + 2 C, 8] position on the line in pixels, ascending; colour; gradient. What belongs to eight
  // pixels is contiguous. The last block is filled with zeros, which have no effect.
  Buffer<T> values;
  Buffer<int32_t> face_index;  // [N, blocks, 8]
  std::vector<int32_t> count;       // [N + pad] number of listed pixels
  // Number of listed pixels of line n before pixel m, for m up to M: before[n * step_n + m * step_m].
  Buffer<int32_t> before;
  std::vector<T>
      outer_end[2];  // [N + pad] by direction: a crossing before this has a listed pixel beyond its outer one
  std::vector<T> inner_start[2];  // [N + pad] by direction: a crossing before this has no listed pixel of a face inside
  int64_t stride, channels;       // stride: 8 blocks
  int64_t step_n, step_m;         // steps of `before`

  // axis 0: columns, whose numbers are contiguous; 1: rows, each with room for eight numbers from any pixel on.
  void reserve_lines(int axis, int64_t N, int64_t M, int64_t C) {
    stride = (M + kPad - 1) / kPad * kPad + kPad;
    channels = C;
    step_n = axis == 0 ? 1 : stride;
    step_m = axis == 0 ? N : 1;
    reserve(values, N * (1 + 2 * C) * stride);
    reserve(face_index, N * stride);
    reserve(count, N + kPad);
    reserve(before, axis == 0 ? N * (M + 1) : N * stride);
    for (std::vector<T>* v : {&outer_end[0], &outer_end[1], &inner_start[0], &inner_start[1]}) reserve(*v, N + kPad);
  }
  // Block `block` of line n: eight positions, then as many of each colour and of each gradient.
  T* at(int64_t n, int64_t block) { return values.data() + (n * stride + block * kPad) * (1 + 2 * channels); }
  const T* at(int64_t n, int64_t block) const {
    return values.data() + (n * stride + block * kPad) * (1 + 2 * channels);
  }
  T position(int64_t n, int64_t k) const { return at(n, k / kPad)[k % kPad]; }
  int32_t* face_indices(int64_t n) { return face_index.data() + n * stride; }
  const int32_t* face_indices(int64_t n) const { return face_index.data() + n * stride; }
};

// Input of the sweeps for one image.
template <class T>
struct ColorImage {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  Size raster, size;  // H x W, and that of the image
  bool anti_aliasing;
  T eps;
  const int32_t* face_index;  // row 0 = top; pixel (column i, row j from the bottom) is face_index[(H - 1 - j) W + i]
  const T* pixels;            // [H, W, C]
  const T* background;        // [C] the colour of pixels without a face, or nullptr: that in `pixels`
  const T* grad_resolved;     // [h, w, C]
  int64_t channels;           // C
  ScanlineColors<T>* lines;   // [0] columns: lines of constant x, swept along y; [1] rows
  T largest_factor;  // above this, or with a tiny eps, the product of two distances could overflow or underflow
  static constexpr bool kFarSides = true;  // whether sweeps need Crossings::far_side

  const T* color(int64_t pixel) const {
    return background && face_index[pixel] < 0 ? background : pixels + pixel * channels;
  }
};

}  // namespace nmr
