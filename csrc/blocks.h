// Work on an owner map in blocks of raster rows, and sums over blocks that do not depend on the number of threads: the blocks
// are fixed by the sizes alone, each block sums on its own, and the sums are added up in the order of the blocks.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "parallel.h"

namespace nmr {

// The rows of one image, in blocks. An even number of rows each, so that no 2x2 mean crosses two blocks.
struct RowBlocks {
  int64_t raster_size;  // R
  int64_t rows;         // per block
  int64_t count;

  // A block has at least 2^14 pixels and, as every block looks once at every face's mark, a quarter as many as faces.
  RowBlocks(int64_t R, int64_t num_faces) : raster_size(R) {
    const int64_t pixels = std::max<int64_t>(int64_t(1) << 14, num_faces / 2);
    rows = (pixels + R - 1) / R;
    rows = std::min(rows + rows % 2, R);
    count = (R + rows - 1) / rows;
  }
  int64_t first(int64_t block) const { return block * rows; }
  int64_t last(int64_t block) const { return std::min(first(block) + rows, raster_size); }
  // Most faces (originals and copies) that can own a pixel of one block.
  int64_t most_visible(int64_t num_faces) const { return std::min(2 * num_faces, rows * raster_size); }
};

// The faces that own a pixel, numbered from 1 in ascending order; the background is number 0.
struct VisibleFaces {
  std::vector<int32_t> slots;  // [2 F + 1] number of owner entry id at [id + 1]; only the entries of visible faces mean anything
  std::vector<int32_t> ids;    // [count] owner entries; ids[0] = -1
  int64_t count;

  void reserve_for(int64_t num_faces, int64_t most_visible) {
    reserve(slots, 2 * num_faces + 1);
    reserve(ids, most_visible + 2);  // the search writes one entry beyond the last that it keeps
  }

  NMR_INLINE void find(const int32_t* owner, int64_t pixels, int64_t num_faces) {
    int32_t *slot = slots.data(), *id = ids.data();
    std::fill_n(slot, 2 * num_faces + 1, 0);
    for (int64_t n = 0; n < pixels; ++n) slot[owner[n] + 1] = 1;
    int32_t found = 1;
    for (int64_t n = 0; n < 2 * num_faces; ++n) {
      const int32_t visible = slot[n + 1];
      id[found] = static_cast<int32_t>(n);
      slot[n + 1] = found;
      found += visible;
    }
    id[0] = -1;
    slot[0] = 0;
    count = found;
  }
};

// produce(i, results[.]) for all i in [0, count), some at a time on several threads; then consume(i, result) one after the
// other in ascending order of i.
template <class Result, class Produce, class Consume>
void produce_in_order(int64_t count, int num_threads, std::vector<Result>& results, const Produce& produce, const Consume& consume) {
  const int64_t wave = std::min<int64_t>(count, num_threads <= 1 ? 1 : 4 * static_cast<int64_t>(num_threads));
  if (static_cast<int64_t>(results.size()) < wave) results.resize(wave);
  for (int64_t first = 0; first < count; first += wave) {
    const int64_t size = std::min(wave, count - first);
    parallel_for(size, num_threads, [&](int64_t n) { produce(first + n, results[n]); });
    for (int64_t n = 0; n < size; ++n) consume(first + n, results[n]);
  }
}

// Gradients per visible face of a block, in the vertex order in which the face is drawn.
template <class T>
struct FaceGradients {
  std::vector<int32_t> ids;  // [count] owner entries
  std::vector<T> values;     // [count, 3, 3] of the three corners' x, y, z
  int64_t count;
};

// Adds them to the vertices of one image (faces [F, 3]).
template <class T>
void scatter_face_gradients(const FaceGradients<T>& gradients, const int64_t* faces, int64_t num_faces, T* grad_vertices) {
  const T* value = gradients.values.data();
  for (int64_t n = 0; n < gradients.count; ++n) {
    const bool reversed = gradients.ids[n] >= num_faces;
    const int64_t* face = faces + 3 * (reversed ? gradients.ids[n] - num_faces : gradients.ids[n]);
    for (int k = 0; k < 3; ++k, value += 3) {
      T* grad = grad_vertices + 3 * face[reversed ? 2 - k : k];
      for (int c = 0; c < 3; ++c) grad[c] += value[c];
    }
  }
}

}  // namespace nmr
