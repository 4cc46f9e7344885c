// Work on a face index map in blocks of raster rows, with sums that do not depend on the number of
// threads: the blocks depend only on the sizes, each block has its own sum, and the sums are added
// in the order of the blocks.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

constexpr int64_t kBandRows = 32;  // rows of a raster per task, if every task looks at all faces

// Calls body(b, first, last) for bands of `rows` rows of every image: rows first, ..., last - 1.
template <class Body>
void for_bands(int64_t batch, int64_t height, int64_t rows, int num_threads, const Body& body) {
  const int64_t bands = (height + rows - 1) / rows;
  parallel_for(batch * bands, num_threads, [&](int64_t n) {
    const int64_t first = n % bands * rows;
    body(n / bands, first, std::min(first + rows, height));
  });
}

// The rows of one image, in blocks. Each has an even number of rows, so that every 2x2 mean is
// within one block.
struct RowBlocks {
  Size raster;
  int64_t num_faces;
  int64_t rows;  // per block
  int64_t count;

  // A block has at least 2^14 pixels, and at least half as many pixels as there are faces, because
  // it reads every face's mark.
  RowBlocks(Size raster, int64_t num_faces) : raster(raster), num_faces(num_faces) {
    const int64_t pixels = std::max<int64_t>(int64_t(1) << 14, num_faces / 2);
    rows = (pixels + raster.width - 1) / raster.width;
    rows = std::min(rows + rows % 2, raster.height);
    count = (raster.height + rows - 1) / rows;
  }
  // Largest number of faces (originals and copies) that can own a pixel of one block.
  int64_t most_visible() const { return std::min(2 * num_faces, rows * raster.width); }
};

// One of the blocks of image b.
struct RowBlock {
  RowBlocks blocks;
  int64_t b, number;

  // Its rows first(), ..., last() - 1, and its pixels begin(), ..., end() - 1 in a batch [B, H, W].
  int64_t first() const { return number * blocks.rows; }
  int64_t last() const { return std::min(first() + blocks.rows, blocks.raster.height); }
  int64_t begin() const { return (b * blocks.raster.height + first()) * blocks.raster.width; }
  int64_t end() const { return (b * blocks.raster.height + last()) * blocks.raster.width; }
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

  // The same, with the memory for it.
  void list(const int32_t* face_index, int64_t pixels, int64_t num_faces) {
    reserve_for(num_faces, std::min(2 * num_faces, pixels));
    find(face_index, pixels, num_faces);
  }
};

// Sums per visible face of some pixels: `numbers` values for each, the background's first.
template <class T>
struct FaceSums {
  VisibleFaces visible;
  std::vector<T> values;  // [count, numbers]

  // Lists the faces that own one of these pixels. Their sums are 0.
  void start(const int32_t* face_index, int64_t pixels, int64_t num_faces, int64_t numbers) {
    visible.list(face_index, pixels, num_faces);
    const int64_t size = visible.count * numbers;
    std::fill_n(reserve(values, size), size, T(0));
  }
  // Those of the face with this face index.
  NMR_INLINE T* of(int64_t id, int64_t numbers) {
    return values.data() + visible.slots[id + 1] * numbers;
  }
};

// Calls body(block) for every block of every image. faces: those of the images. The blocks of an
// image do not depend on other images.
template <class Body>
void for_blocks(int64_t batch, Size raster, int num_threads, const Rows& faces, const Body& body) {
  int64_t most = 1;
  for (int64_t b = 0; b < batch; ++b)
    most = std::max(most, RowBlocks(raster, faces.count(b)).count);
  parallel_for(batch * most, num_threads, [&](int64_t task) {
    const RowBlock block{RowBlocks(raster, faces.count(task / most)), task / most, task % most};
    if (block.number < block.blocks.count) body(block);
  });
}

// Calls produce(block, result) for every block of every image, on several threads, and then
// consume(b, result) for each block. Blocks that add to the same output are consumed one after the
// other, in ascending order of image and block. Each image has its own output, unless the images
// share one. faces: as in for_blocks.
template <class Result, class Produce, class Consume>
void sum_blocks(int64_t batch, Size raster, bool shared, int num_threads, const Rows& faces,
                const Produce& produce, const Consume& consume) {
  const ScratchUse use;
  if (!shared && batch >= num_threads) {
    parallel_for(batch, num_threads, [&](int64_t b) {
      Result& result = thread_scratch<Result>();
      const RowBlocks blocks(raster, faces.count(b));
      for (int64_t n = 0; n < blocks.count; ++n) {
        produce(RowBlock{blocks, b, n}, result);
        consume(b, result);
      }
    });
    return;
  }
  // All threads produce a group of blocks, which are then consumed in order.
  std::vector<Result>& results = thread_scratch<std::vector<Result>>();
  std::vector<RowBlock>& tasks = thread_scratch<std::vector<RowBlock>>();
  tasks.clear();
  const auto flush = [&] {
    if (results.size() < tasks.size()) results.resize(tasks.size());
    parallel_for(static_cast<int64_t>(tasks.size()), num_threads,
                 [&](int64_t n) { produce(tasks[n], results[n]); });
    for (size_t n = 0; n < tasks.size(); ++n) consume(tasks[n].b, results[n]);
    tasks.clear();
  };
  const size_t wave = num_threads <= 1 ? 1 : 4 * static_cast<size_t>(num_threads);
  for (int64_t b = 0; b < batch; ++b) {
    const RowBlocks blocks(raster, faces.count(b));
    for (int64_t n = 0; n < blocks.count; ++n) {
      tasks.push_back({blocks, b, n});
      if (tasks.size() == wave) flush();
    }
  }
  flush();
}

}  // namespace nmr
