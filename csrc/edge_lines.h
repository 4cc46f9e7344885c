// The lines of pixels that NMR's gradient reads, and their runs (edge_gradient.cpp).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "average.h"
#include "blocks.h"
#include "corner_values.h"
#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

constexpr int64_t kCoverage = -1;  // in place of a number of channels: a silhouette
constexpr int64_t kLines = 16;     // lines that are read together: columns of one cache line
constexpr int64_t kEdgeEntry =
    16;  // numbers per face: x of its corners in pixels, y, gradients of x, of y; four of each

// Pixels first, ..., last - 1 of a line.
struct PixelRange {
  int64_t first, last;
};

// The columns and the rows (from the top) that contain the vertices, and so all that is drawn;
// within the raster.
struct Reach {
  PixelRange columns, rows;
};

template <class T>
Reach reach_of(const T* vertices, int64_t count, Size raster) {
  T low[2] = {2, 2}, high[2] = {-2, -2};
  for (int64_t v = 0; v < count; ++v)
    for (int k = 0; k < 2; ++k) {
      low[k] = std::min(low[k], vertices[3 * v + k]);
      high[k] = std::max(high[k], vertices[3 * v + k]);
    }
  const auto pixels = [](T from, T to, int64_t size) {  // one more on both sides
    const T n = static_cast<T>(size), first = to_pixel(std::max(from, T(-2)), n),
            last = to_pixel(std::min(to, T(2)), n);
    return PixelRange{std::clamp<int64_t>(static_cast<int64_t>(first) - 1, 0, size),
                      std::clamp<int64_t>(static_cast<int64_t>(last) + 3, 0, size)};
  };
  return {pixels(low[0], high[0], raster.width), pixels(-high[1], -low[1], raster.height)};
}

// One image.
template <class T>
struct EdgeImage {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  Size raster, size;  // H x W, and that of the image
  bool anti_aliasing;
  T eps;
  const int32_t* face_index;  // [H, W]
  const T* grad;              // [h, w, C]
  int64_t channels;           // C; 1 of a silhouette
  const T* pixels;            // [H, W, C], or nullptr: a silhouette
  const T* background;  // [C] the colour of pixels without a face, or nullptr: that in `pixels`
  Reach reach;
};

// Up to kLines lines: columns, or rows from the top.
struct LineRange {
  int64_t first, count;
  bool columns;
};

// First and last pixels of runs; their face indices, then the numbers of these faces in EdgeSums.
// Each line's runs are filled up to a multiple of eight by runs of the background.
struct RunList {
  int32_t *first, *last, *face;
};

// A group of lines of M pixels, upwards or to the right, and its runs.
template <class T>
struct LineGroup {
  LineRange lines;
  int64_t length, stride;     // M; stride: between the lines of colours and gradients
  PixelRange window;          // where faces can be; whole vectors
  const int32_t* face_index;  // [count, face_stride]
  int64_t face_stride;
  RunList runs;
  int64_t* runs_end;    // [count] the end of each line's
  int32_t* transposed;  // [count, stride] memory for columns
  T *colors, *grads;    // [count, C, stride]; with anti-aliasing, two lines share their gradients
  T* half_grads;        // with anti-aliasing: [count / 2, C, stride] gradients of the image
};

// One line.
template <class T>
struct EdgeLine {
  const int32_t* face_index;         // [M]
  const T *colors, *grads;           // [C, stride]; 0 behind the pixels
  int64_t length, stride, channels;  // M, C
  bool columns;
  T number, eps;    // number: of the column, or of the row from the bottom
  int64_t pulling;  // number of pixels in its list
  bool gains;       // a pixel of a face can pull an edge inwards
};

// The pixels of a line that pull edges from outside, in order.
template <class T>
struct PixelList {
  T *position, *weight;  // weight: of a silhouette
  int32_t* pixel;        // of an image: the number of the pixel
  T* near_colors;        // [C, 8] scratch
};

// The faces that own a pixel of one task, numbered as they are met; the background is number 0.
template <class T>
struct EdgeSums {
  std::vector<int32_t> ids;  // face indices
  Buffer<T> entries;         // [faces, kEdgeEntry], corners in drawing order
  int64_t count;
  bool finite;  // all gradients of the task's rows
};

template <class T>
struct EdgeScratch {
  std::vector<int32_t> numbers;  // [2 F + 1] number of face index id at [id + 1]; -1: not met yet
  Buffer<int32_t> transposed, run_first, run_last, run_face;
  Buffer<T> colors, grads, half_grads;
  std::vector<int64_t> runs_end;
  std::vector<int32_t> pixel;
  std::vector<T> position, weight, near_colors;
  PixelList<T> list;

  // Memory for lines of up to `longest` pixels.
  LineGroup<T> reserve_group(const EdgeImage<T>& image, int64_t longest) {
    const int64_t C = image.channels, stride = (longest + 7) / 8 * 8 + kLanes,
                  size = kLines * stride;
    list = {reserve(position, stride + kLanes) + kLanes, reserve(weight, stride),
            reserve(pixel, stride), reserve(near_colors, 8 * C)};
    return {{},
            0,
            stride,
            {},
            nullptr,
            0,
            {reserve(run_first, size), reserve(run_last, size), reserve(run_face, size)},
            reserve(runs_end, kLines),
            reserve(transposed, size),
            image.pixels ? reserve(colors, size * C) : nullptr,
            reserve(grads, size * C),
            image.anti_aliasing ? reserve(half_grads, size * C / 2) : nullptr};
  }
};

}  // namespace nmr
