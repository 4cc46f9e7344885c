// Work on a face index map in blocks of raster rows, with sums that do not depend on the number of
// threads: the blocks depend only on the sizes, each block has its own sum, and the sums are added
// in the order of the blocks.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <utility>
#include <vector>

#include "parallel.h"
#include "stages.h"

namespace nmr {

// The rows of one image, in blocks. Each has an even number of rows, so that every 2x2 mean is
// within one block.
struct RowBlocks {
  Size raster;
  int64_t rows;  // per block
  int64_t count;

  // A block has at least 2^14 pixels, and at least half as many pixels as there are faces, because
  // it reads every face's mark.
  RowBlocks(Size raster, int64_t num_faces) : raster(raster) {
    const int64_t pixels = std::max<int64_t>(int64_t(1) << 14, num_faces / 2);
    rows = (pixels + raster.width - 1) / raster.width;
    rows = std::min(rows + rows % 2, raster.height);
    count = (raster.height + rows - 1) / rows;
  }
  int64_t first(int64_t block) const { return block * rows; }
  int64_t last(int64_t block) const { return std::min(first(block) + rows, raster.height); }
  // Largest number of faces (originals and copies) that can own a pixel of one block.
  int64_t most_visible(int64_t num_faces) const {
    return std::min(2 * num_faces, rows * raster.width);
  }
};

// The faces that own a pixel, numbered from 1 in ascending order; the background is number 0.
struct VisibleFaces {
  std::vector<uint8_t> seen;  // [2 F + 1 + 8] by face index + 1
  std::vector<int32_t>
      slots;  // [2 F + 1 + 8] number of face index id at [id + 1]; defined only for visible faces
  std::vector<int32_t> ids;  // [count] face indices; ids[0] = -1
  int64_t count;

  void reserve_for(int64_t num_faces, int64_t most_visible) {
    reserve(seen, 2 * num_faces + 1 + 8);
    reserve(slots, 2 * num_faces + 1 + 8);
    reserve(ids, most_visible + 1 + 8);
  }

  NMR_INLINE void find(const int32_t* face_index, int64_t pixels, int64_t num_faces) {
    const int64_t entries = 2 * num_faces + 1;
    std::fill_n(seen.data(), entries + 8, uint8_t(0));
    int64_t n = 0;
    for (; n + 8 <= pixels; n += 8) {
      uint64_t pairs[4];
      std::memcpy(pairs, face_index + n, sizeof pairs);
      const uint64_t signs = pairs[0] & pairs[1] & pairs[2] & pairs[3];
      if ((~signs & UINT64_C(0x8000000080000000)) == 0) continue;  // background
      for (int64_t k = 0; k < 8; ++k) seen[face_index[n + k] + 1] = 1;
    }
    for (; n < pixels; ++n) seen[face_index[n] + 1] = 1;
    seen[0] = 1;  // the background
    count = 0;
    for (int64_t e = 0; e < entries; e += 8) {
      uint64_t any;
      std::memcpy(&any, seen.data() + e, sizeof any);
      for (int64_t k = e; any && k < e + 8; ++k) {
        slots[k] = static_cast<int32_t>(count);
        ids[count] = static_cast<int32_t>(k - 1);
        count += seen[k];
      }
    }
  }
};

// Calls produce(b, block, result) for every block of every image, on several threads, and then
// consume(b, result) for each block. Blocks that add to the same output are consumed one after the
// other, in ascending order of (b, block). Each image has its own output, unless the images share
// one. block_count(b) is the number of blocks of image b.
template <class Result, class BlockCount, class Produce, class Consume>
void sum_blocks(int64_t batch, bool shared, int num_threads, const BlockCount& block_count,
                const Produce& produce, const Consume& consume) {
  const ScratchUse use;
  if (!shared && batch >= num_threads) {
    parallel_for(batch, num_threads, [&](int64_t b) {
      Result& result = thread_scratch<Result>();
      for (int64_t block = 0; block < block_count(b); ++block) {
        produce(b, block, result);
        consume(b, result);
      }
    });
    return;
  }
  // All threads produce a group of blocks, which are then consumed in order.
  std::vector<Result>& results = thread_scratch<std::vector<Result>>();
  std::vector<std::pair<int64_t, int64_t>>& tasks =
      thread_scratch<std::vector<std::pair<int64_t, int64_t>>>();
  tasks.clear();
  const auto flush = [&] {
    if (results.size() < tasks.size()) results.resize(tasks.size());
    parallel_for(static_cast<int64_t>(tasks.size()), num_threads,
                 [&](int64_t n) { produce(tasks[n].first, tasks[n].second, results[n]); });
    for (size_t n = 0; n < tasks.size(); ++n) consume(tasks[n].first, results[n]);
    tasks.clear();
  };
  const size_t wave = num_threads <= 1 ? 1 : 4 * static_cast<size_t>(num_threads);
  for (int64_t b = 0; b < batch; ++b) {
    for (int64_t block = 0; block < block_count(b); ++block) {
      tasks.emplace_back(b, block);
      if (tasks.size() == wave) flush();
    }
  }
  flush();
}

// Gradients per visible face of a block, in drawing order.
template <class T>
struct FaceGradients {
  std::vector<int32_t> ids;  // [count] face indices
  std::vector<T> values;     // [count, 3, 3] of the three corners' x, y, z
  int64_t count;

  // Names the faces; there is memory for them.
  NMR_INLINE void list(const int32_t* faces, int64_t number) {
    count = number;
    std::copy_n(faces, number, ids.data());
  }
};

// Adds these gradients to the vertices of one image (faces [F, 3]).
template <class T>
void scatter_face_gradients(const FaceGradients<T>& gradients, const int64_t* faces,
                            int64_t num_faces, T* grad_vertices) {
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
