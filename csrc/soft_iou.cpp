// Soft intersection over union of each pair of images: I / U with I = sum p t and U = sum (p + t - p t); 1 if U = 0.
#include <algorithm>

#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

constexpr int64_t kChunk = 4096;  // a multiple of 16

struct Totals {
  double product = 0;  // sum p t
  double sum = 0;      // sum (p + t)
};

}  // namespace
}  // namespace nmr

#define NMR_LEVEL_FILE "soft_iou_sums.h"
#include "levels.h"

namespace nmr {
namespace {

// d (I / U) / dp = (t (U + I) - I) / U^2, and the same with p and t exchanged.
template <class T>
NMR_INLINE void gradient_body(const T* __restrict other, T factor, T offset, T* __restrict grad, int64_t count) {
  for (int64_t n = 0; n < count; ++n) grad[n] = factor * other[n] - offset;
}

NMR_CLONES void gradient_of(const float* other, float factor, float offset, float* grad, int64_t count) {
  gradient_body(other, factor, offset, grad, count);
}
NMR_CLONES void gradient_of(const double* other, double factor, double offset, double* grad, int64_t count) {
  gradient_body(other, factor, offset, grad, count);
}

}  // namespace

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
      gradient_of(args.target + first, factor, offset, args.grad_prediction + first, args.count);
    if (args.grad_target) gradient_of(args.prediction + first, factor, offset, args.grad_target + first, args.count);
  });
}

template void soft_iou_forward(const SoftIou<float>&);
template void soft_iou_forward(const SoftIou<double>&);
template void soft_iou_backward(const SoftIou<float>&);
template void soft_iou_backward(const SoftIou<double>&);

}  // namespace nmr
