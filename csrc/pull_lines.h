// Input of the sweeps of the silhouette gradient: the pixels of every row and column of an image that can pull.
#pragma once

#include <algorithm>
#include <cstring>
#include <limits>
#include <vector>

#include "lanes.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

// The pixels that can pull, for the lines of one axis: N lines of M pixels. Positions are in pixels along the line.
template <class T>
struct PullLines {
  std::vector<T> position, weight;        // [N, M + lanes] background pixels with gradient < 0, ascending, and -gradient; 0 after
  std::vector<int32_t> count;             // [N] their number
  std::vector<T> first, last;             // [N + lanes] the first and last of them; +-infinity if there is none
  std::vector<T> gain_first, gain_last;   // [N + lanes] bounds of the covered pixels with gradient > 0
  int64_t stride;                         // M + lanes

  void reserve_lines(int64_t N, int64_t M) {
    stride = M + kLanes;
    for (std::vector<T>* v : {&position, &weight}) reserve(*v, N * stride);
    for (std::vector<T>* v : {&first, &last, &gain_first, &gain_last}) reserve(*v, N + kLanes);
    reserve(count, N);
  }
};

// Input of the sweeps for one image.
template <class T>
struct SweepImage {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  Size raster, size;     // H x W, and that of the image
  bool anti_aliasing;
  T eps;
  const int32_t* owner;  // row 0 = top; pixel (column i, row j from the bottom) is owner[(H - 1 - j) W + i]
  const T* grad_alpha;
  PullLines<T>* lines;   // [0] columns: lines of constant x, swept along y; [1] rows
  T largest_lever;  // above this, or with a tiny eps, the product of two distances could overflow or underflow

  // Gradient of raster pixel (column i, row j from the bottom). With a 2x2 mean each pixel gets a quarter of the image's gradient.
  NMR_INLINE T grad(int64_t i, int64_t j) const {
    return anti_aliasing ? grad_alpha[(size.height - 1 - j / 2) * size.width + i / 2] / 4
                         : grad_alpha[(size.height - 1 - j) * size.width + i];
  }
};

// Gradients of one row of raster pixels (counted from the bottom), followed by lanes of zeros.
template <class T>
NMR_INLINE void expand_row(const SweepImage<T>& image, int64_t j, T* row) {
  const int64_t w = image.size.width;
  if (image.anti_aliasing) {
    const T* grad = image.grad_alpha + (image.size.height - 1 - j / 2) * w;
    for (int64_t x = 0; x < w; ++x) row[2 * x] = row[2 * x + 1] = grad[x] / 4;
  } else {
    std::copy_n(image.grad_alpha + (image.size.height - 1 - j) * w, w, row);
  }
  std::fill_n(row + image.raster.width, kLanes, T(0));
}

// Empties lines [first, last).
template <class T>
NMR_INLINE void start_lines(PullLines<T>& lines, int64_t first, int64_t last) {
  const T infinity = std::numeric_limits<T>::infinity();
  std::fill(lines.count.begin() + first, lines.count.begin() + last, 0);
  std::fill(lines.gain_first.begin() + first, lines.gain_first.begin() + last, infinity);
  std::fill(lines.gain_last.begin() + first, lines.gain_last.begin() + last, -infinity);
}

template <class T>
NMR_INLINE void append_pull(PullLines<T>& lines, int64_t n, int64_t m, T weight) {
  const int64_t at = n * lines.stride + lines.count[n]++;
  lines.position[at] = static_cast<T>(m);
  lines.weight[at] = weight;
}

template <class T>
NMR_INLINE void finish_lines(PullLines<T>& lines, int64_t first, int64_t last) {
  const int64_t stride = lines.stride;
  const T infinity = std::numeric_limits<T>::infinity();
  for (int64_t n = first; n < last; ++n) {
    const int32_t count = lines.count[n];
    T* position = lines.position.data() + n * stride;
    lines.first[n] = count ? position[0] : infinity;
    lines.last[n] = count ? position[count - 1] : -infinity;
    store_lanes(position + count, splat(count ? position[count - 1] : T(0)));
    store_lanes(lines.weight.data() + n * stride + count, splat(T(0)));
  }
}

// A part of both sets of lines: rows [row_first, row_last), and columns [column_first, column_last) over all rows.
struct LineRange {
  int64_t row_first, row_last, column_first, column_last;
};

// Fills the lines of a range. grad_row: [W + lanes] of scratch.
template <class T>
NMR_INLINE void collect_lines(const SweepImage<T>& image, const LineRange& range, T* grad_row) {
  const int64_t H = image.raster.height, W = image.raster.width;
  const bool any_column = range.column_first < range.column_last;
  PullLines<T>&columns = image.lines[0], &rows = image.lines[1];
  start_lines(columns, range.column_first, range.column_last);
  start_lines(rows, range.row_first, range.row_last);
  const int64_t j_first = any_column ? 0 : range.row_first, j_last = any_column ? H : range.row_last;
  for (int64_t j = j_first; j < j_last; ++j) {
    const bool in_rows = j >= range.row_first && j < range.row_last;
    const int32_t* owner = image.owner + (H - 1 - j) * W;
    if (j == j_first || !image.anti_aliasing || j % 2 == 0) expand_row(image, j, grad_row);
    const int64_t i_last = in_rows ? W : range.column_last;
    for (int64_t start = in_rows ? 0 : range.column_first; start < i_last; start += kLanes) {
      const Lanes<T> g = load_lanes<Lanes<T>>(grad_row + start);
      Lanes32 id = splat32(-1);
      if (start + kLanes <= W)
        id = load_lanes<Lanes32>(owner + start);
      else
        std::memcpy(&id, owner + start, (W - start) * sizeof(int32_t));
      const Lanes32 background = id < 0, gains = narrow_mask(g > T(0)) & ~background;
      for (uint32_t bits = lane_bits(narrow_mask(g < T(0)) & background); bits; bits &= bits - 1) {
        const int64_t i = start + lowest_bit(bits);
        if (in_rows) append_pull(rows, j, i, -grad_row[i]);
        if (i >= range.column_first && i < range.column_last) append_pull(columns, i, j, -grad_row[i]);
      }
      const uint32_t gain_bits = lane_bits(gains);
      if (!gain_bits) continue;
      if (in_rows) {
        rows.gain_first[j] = std::min(rows.gain_first[j], static_cast<T>(start));  // at least that
        rows.gain_last[j] = static_cast<T>(start + kLanes - 1);                    // at most that
      }
      if (any_column) {
        const LaneMask<T> here = widen_mask<T>(gains);
        T *gain_first = columns.gain_first.data() + start, *gain_last = columns.gain_last.data() + start;
        const Lanes<T> line_first = load_lanes<Lanes<T>>(gain_first), at = splat(static_cast<T>(j));
        store_lanes(gain_first, select(here & (line_first > at), at, line_first));
        store_lanes(gain_last, select(here, at, load_lanes<Lanes<T>>(gain_last)));
      }
    }
  }
  finish_lines(columns, range.column_first, range.column_last);
  finish_lines(rows, range.row_first, range.row_last);
}

}  // namespace nmr
