// NMR's gradient of one image (silhouette or colours): lists the pixels that can pull, sweeps the visible faces, and
// adds up at the vertices.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "parallel.h"
#include "scanline_grads.h"
#include "stages.h"

namespace nmr {

// Memory for one image.
template <class T>
struct SweptFaces {
  std::vector<uint8_t> seen;  // [parts, 2 F + 1 + pad]
  std::vector<int32_t> ids;   // [visible faces + pad] their face indices
  std::vector<T> grad;        // [visible faces, 3, 2] gradients of x and y of their corners, in drawing order
};

// Memory for one task.
template <class T>
struct SweepTask {
  std::vector<T> grad_row;              // [C, W + pad]
  std::vector<SweepScratch<T>> blocks;  // [1]
};

// The width of the bands of `lines` columns or rows that several threads work on: a multiple of kPad, so that no two
// threads write to one vector. One thread has one band.
inline int64_t band_width(int64_t lines, int num_threads) {
  const int64_t share = lines / std::max(num_threads, 1);
  return std::max<int64_t>((share + kPad - 1) / kPad * kPad, 64);
}

// Adds the gradients of an image (SweepImage or ColorImage) to its vertices. If a gradient of the image is not finite,
// x and y of every vertex of a visible face get NaN.
//
//   mark(first, last, seen)           marks the faces that own one of these pixels
//   list(seen, ids)                   writes the face indices of marked faces, and returns their number
//   finite()                          whether all gradients of the image are finite
//   collect()                         lists the pixels of all lines that can pull
//   sweep(ids, first, last, block, grad)   writes the gradients of some of these faces
template <class T, class Image, class Mark, class List, class Finite, class Collect, class Sweep>
void sweep_image(const Image& image, int num_threads, const Mark& mark, const List& list, const Finite& finite,
                 const Collect& collect, const Sweep& sweep, T* grad_vertices) {
  const int64_t H = image.raster.height, W = image.raster.width;
  SweptFaces<T>& faces = thread_scratch<SweptFaces<T>>();
  // Several threads mark the faces of a part of the pixels each, unless there are almost as many faces as pixels.
  const int64_t marks = 2 * image.num_faces + 1 + kPad;
  const int64_t parts = std::max<int64_t>(std::min<int64_t>(num_threads, H * W / (4 * marks)), 1);
  uint8_t* seen = reserve(faces.seen, parts * marks);
  int32_t* ids = reserve(faces.ids, std::min(2 * image.num_faces, H * W) + kPad);
  parallel_for(parts, num_threads,
               [&](int64_t k) { mark(k * H * W / parts, (k + 1) * H * W / parts, seen + k * marks); });
  for (int64_t k = 1; k < parts; ++k)
    for (int64_t e = 0; e < marks; ++e) seen[e] |= seen[k * marks + e];
  const int64_t count = list(seen, ids);
  if (count == 0) return;
  T* grad = reserve(faces.grad, 6 * count);
  if (!finite()) {
    std::fill_n(grad, 6 * count, std::numeric_limits<T>::quiet_NaN());
    scatter_corners(image, ids, count, grad, grad_vertices);
    return;
  }
  collect();
  const int64_t chunk = num_threads > 1 ? 2 * kSweptFaces : count;
  parallel_for((count + chunk - 1) / chunk, num_threads, [&](int64_t n) {
    SweepScratch<T>& block = *reserve(thread_scratch<SweepTask<T>>().blocks, 1);
    sweep(ids, n * chunk, std::min((n + 1) * chunk, count), block, grad);
  });
  scatter_corners(image, ids, count, grad, grad_vertices);
}

}  // namespace nmr
