// Input and memory of the sweeps of the silhouette gradient (sweep.h).
#pragma once

#include <cstdint>
#include <vector>

#include "parallel.h"
#include "stages.h"

namespace nmr {

constexpr int64_t kPad = 8;  // entries that lanes may touch before and after the used ones

// The pixels that can pull, for the lines of one axis: N lines of M pixels. Positions are in pixels along the line.
// Sweeps go up the line (direction 0) or down (direction 1). What belongs to a direction is in its own coordinate:
// positions are negative for sweeps down, so that every sweep goes towards larger coordinates.
template <class T>
struct ScanlineGrads {
  // [N, pad + M + pad] background pixels with gradient < 0, ascending, and -gradient. Their neighbours in the padding
  // have positions before and after every pixel.
  Buffer<T> position, weight;
  std::vector<int32_t> count;  // [N] their number; [parts, N] for rows whose parts are not joined yet (join_rows)
  // [N + pad] by direction: a crossing before outer_end has a pulling pixel beyond it; one before inner_start has no
  // pixel with gradient > 0 inside. Rows whose parts are not joined yet have inner_start [parts, N].
  std::vector<T> outer_end[2], inner_start[2];
  int64_t stride;  // pad + M + pad

  void reserve_lines(int64_t N, int64_t M, int64_t parts) {
    stride = M + 2 * kPad;
    for (Buffer<T>* v : {&position, &weight}) reserve(*v, N * stride);
    for (std::vector<T>* v : {&outer_end[0], &outer_end[1]}) reserve(*v, N + kPad);
    for (std::vector<T>* v : {&inner_start[0], &inner_start[1]}) reserve(*v, parts * N + kPad);
    reserve(count, parts * N);
  }
  const T* positions(int64_t n) const { return position.data() + n * stride + kPad; }
  const T* weights(int64_t n) const { return weight.data() + n * stride + kPad; }
};

// Input of the sweeps for one image.
template <class T>
struct SweepImage {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  Size raster, size;  // H x W, and that of the image
  bool anti_aliasing;
  T eps;
  const int32_t* face_index;  // row 0 = top; pixel (column i, row j from the bottom) is face_index[(H - 1 - j) W + i]
  const T* grad_alpha;
  ScanlineGrads<T>* lines;  // [0] columns: lines of constant x, swept along y; [1] rows
  T largest_factor;         // above this, or with a tiny eps, the product of two distances could overflow or underflow
  static constexpr bool kFarSides = false;  // whether sweeps need Crossings::far_side

  // Gradient of raster pixel (column i, row j from the bottom). With a 2x2 mean each pixel gets a quarter of the
  // image's gradient.
  T grad(int64_t i, int64_t j) const {
    return anti_aliasing ? grad_alpha[(size.height - 1 - j / 2) * size.width + i / 2] / 4
                         : grad_alpha[(size.height - 1 - j) * size.width + i];
  }
};

// Part `number` of an image: columns [number * width, (number + 1) * width), and the pieces of all rows in them.
struct ColumnPart {
  int64_t number, width;
};

constexpr int64_t kSweptFaces = 128;  // faces that are swept together; a power of two
constexpr int64_t kCrossings = 256;   // crossings of one kind that are worked on together

// Crossings of edges and lines, for one axis and one direction.
template <class T>
struct Crossings {
  int64_t count;
  // Crossing, and the entries of its line in ScanlineGrads, in the coordinate of the direction.
  T at[kCrossings + kPad], outer_end[kCrossings + kPad], inner_start[kCrossings + kPad];
  int32_t line[kCrossings + kPad];
  // Colours only: coordinate of the line's exit from the face on the other side, as an infinite line.
  T far_side[kCrossings + kPad];
  int32_t edge[kCrossings + kPad];  // k * kSweptFaces + face: edge k, k + 1 of a face of the block
  // Numbers of the crossings that have something to sweep: outside the face, and inside.
  int32_t outer[kCrossings + kPad], inner[kCrossings + kPad];
};

// Memory for a block of faces.
template <class T>
struct SweepScratch {
  int32_t id[kSweptFaces];  // in the face index map
  // x (0) and y (1) of the corners in pixels, in drawing order.
  T corner[2][3][kSweptFaces];
  // Of edge P-Q = corners k, k + 1 and the lines of an axis: scan coordinates, and 2 / M (Qs - Ps), the numerator of
  // EdgeDerivative's factors.
  T ps[2][3 * kSweptFaces], qs[2][3 * kSweptFaces], reach[2][3 * kSweptFaces];
  T pulls[2][3 * kSweptFaces][2];  // sum of the pulls on P and on Q
  Crossings<T> crossings[2][2];    // by axis and direction
};

// Adds the gradients [count, 3, 2] of x and y of the corners of faces to their vertices.
template <class T, class Image>
void scatter_corners(const Image& image, const int32_t* ids, int64_t count, const T* grad, T* grad_vertices) {
  for (int64_t n = 0; n < count; ++n, grad += 6) {
    const bool reversed = ids[n] >= image.num_faces;
    const int64_t* face = image.faces + 3 * (reversed ? ids[n] - image.num_faces : ids[n]);
    for (int k = 0; k < 3; ++k) {
      T* vertex = grad_vertices + 3 * face[reversed ? 2 - k : k];
      vertex[0] += grad[2 * k];
      vertex[1] += grad[2 * k + 1];
    }
  }
}

}  // namespace nmr
