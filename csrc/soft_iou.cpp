// Soft intersection over union of each pair of images: I / U with I = sum p t and U = sum (p + t -
// p t); 1 if U = 0.
#include <algorithm>
#include <vector>

#include "chunk_sums.h"

#define NMR_LEVEL_FILE "soft_iou_lanes.h"
#include "levels.h"

namespace nmr {

constexpr int64_t kValueChunk = 4096;              // a multiple of 16
constexpr int64_t kTaskValues = 16 * kValueChunk;  // of a pair of images, that one task reads

// The partial sums are added in the order of the chunks and lanes, in double precision.
template <class T>
void soft_iou_forward(const SoftIou<T>& args) {
  const int64_t chunks = (args.count + kValueChunk - 1) / kValueChunk;
  const ScratchUse use;
  ChunkSums<T>* sums = reserve(thread_scratch<std::vector<ChunkSums<T>>>(), args.batch * chunks);
  for_bands(args.batch, args.count, kTaskValues, args.num_threads,
            [&](int64_t b, int64_t first, int64_t last) {
              const T *prediction = args.prediction + b * args.count,
                      *target = args.target + b * args.count;
              for (int64_t n = first; n < last; n += kValueChunk)
                NMR_AT_BEST_LEVEL(sum_chunk, prediction + n, target + n,
                                  std::min(kValueChunk, last - n),
                                  sums[b * chunks + n / kValueChunk]);
            });
  T low = 0, high = 1;
  for (int64_t b = 0; b < args.batch; ++b) {
    double both = 0, sum = 0;
    for (int64_t c = b * chunks; c < (b + 1) * chunks; ++c) {
      for (int64_t l = 0; l < 2 * kLanes; ++l) {
        both += static_cast<double>(sums[c].product[l]);
        sum += static_cast<double>(sums[c].sum[l]);
      }
      low = std::min(low, *std::min_element(sums[c].low, sums[c].low + kLanes));
      high = std::max(high, *std::max_element(sums[c].high, sums[c].high + kLanes));
    }
    const double either = sum - both;
    args.areas[2 * b] = both;
    args.areas[2 * b + 1] = either;
    args.iou[b] = static_cast<T>(either == 0 ? 1 : both / either);
  }
  args.target_range[0] = low;
  args.target_range[1] = high;
}

template <class T>
void soft_iou_backward(const SoftIou<T>& args) {
  for_bands(args.batch, args.count, kTaskValues, args.num_threads,
            [&](int64_t b, int64_t first, int64_t last) {
              const double both = args.areas[2 * b], either = args.areas[2 * b + 1];
              const double scale =
                  either == 0 ? 0 : static_cast<double>(args.grad_iou[b]) / either / either;
              const T factor = static_cast<T>(scale * (either + both)),
                      offset = static_cast<T>(scale * both);
              const int64_t n = b * args.count + first;
              if (args.grad_prediction)
                NMR_AT_BEST_LEVEL(gradient_of, args.target + n, factor, offset,
                                  args.grad_prediction + n, last - first);
              if (args.grad_target)
                NMR_AT_BEST_LEVEL(gradient_of, args.prediction + n, factor, offset,
                                  args.grad_target + n, last - first);
            });
}

NMR_FLOAT_AND_DOUBLE(soft_iou_forward, SoftIou)
NMR_FLOAT_AND_DOUBLE(soft_iou_backward, SoftIou)

}  // namespace nmr
