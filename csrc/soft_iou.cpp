// Soft intersection over union of each pair of images: I / U with I = sum p t and U = sum (p + t -
// p t); 1 if U = 0.
#include <algorithm>

#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

constexpr int64_t kValueChunk = 4096;  // a multiple of 16

struct Totals {
  double product = 0;  // sum p t
  double sum = 0;      // sum (p + t)
};

}  // namespace
}  // namespace nmr

#define NMR_LEVEL_FILE "soft_iou_lanes.h"
#include "levels.h"

namespace nmr {

template <class T>
void soft_iou_forward(const SoftIou<T>& args) {
  parallel_for(args.batch, args.num_threads, [&](int64_t b) {
    const T *prediction = args.prediction + b * args.count, *target = args.target + b * args.count;
    const Totals totals = NMR_AT_BEST_LEVEL(totals_of, prediction, target, args.count);
    const double both = totals.product, either = totals.sum - totals.product;
    args.areas[2 * b] = both;
    args.areas[2 * b + 1] = either;
    args.iou[b] = static_cast<T>(either == 0 ? 1 : both / either);
  });
}

template <class T>
void soft_iou_backward(const SoftIou<T>& args) {
  parallel_for(args.batch, args.num_threads, [&](int64_t b) {
    const double both = args.areas[2 * b], either = args.areas[2 * b + 1];
    const double scale = either == 0 ? 0 : static_cast<double>(args.grad_iou[b]) / either / either;
    const T factor = static_cast<T>(scale * (either + both)), offset = static_cast<T>(scale * both);
    const int64_t first = b * args.count;
    if (args.grad_prediction)
      NMR_AT_BEST_LEVEL(gradient_of, args.target + first, factor, offset,
                        args.grad_prediction + first, args.count);
    if (args.grad_target)
      NMR_AT_BEST_LEVEL(gradient_of, args.prediction + first, factor, offset,
                        args.grad_target + first, args.count);
  });
}

NMR_FLOAT_AND_DOUBLE(soft_iou_forward, SoftIou)
NMR_FLOAT_AND_DOUBLE(soft_iou_backward, SoftIou)

}  // namespace nmr
