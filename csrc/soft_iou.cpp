// Soft intersection over union of each pair of images: I / U with I = sum p t and U = sum (p + t - p t); 1 if U = 0.
//
// Two vectors of partial sums run side by side. After every kChunk values they are added, in order, to totals in
// double precision. The order depends on the number of values alone.
#include <algorithm>

#include "lanes.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

constexpr int64_t kChunk = 4096;  // a multiple of 2 kLanes

struct Totals {
  double product = 0;  // sum p t
  double sum = 0;      // sum (p + t)
};

// Adds p t and p + t of kLanes pairs to partial sums.
template <class T>
NMR_INLINE void add(const T* p, const T* t, Lanes<T>& product, Lanes<T>& sum) {
  const Lanes<T> a = load_lanes<Lanes<T>>(p), b = load_lanes<Lanes<T>>(t);
  product = product + a * b;
  sum = sum + (a + b);
}

template <class T>
NMR_INLINE Totals totals_body(const T* p, const T* t, int64_t count) {
  Totals totals;
  for (int64_t begin = 0; begin < count; begin += kChunk) {
    const int64_t end = std::min(begin + kChunk, count), whole = end - (end - begin) % (2 * kLanes);
    Lanes<T> product[2] = {splat(T(0)), splat(T(0))}, sum[2] = {splat(T(0)), splat(T(0))};
    for (int64_t n = begin; n < whole; n += 2 * kLanes) {
      add(p + n, t + n, product[0], sum[0]);
      add(p + n + kLanes, t + n + kLanes, product[1], sum[1]);
    }
    T rest_p[2 * kLanes] = {}, rest_t[2 * kLanes] = {};  // the last, incomplete vectors, filled up with zeros
    std::copy(p + whole, p + end, rest_p);
    std::copy(t + whole, t + end, rest_t);
    for (int k = 0; k < 2; ++k) {
      if (whole < end) add(rest_p + k * kLanes, rest_t + k * kLanes, product[k], sum[k]);
      for (int64_t l = 0; l < kLanes; ++l) {
        totals.product += static_cast<double>(product[k][l]);
        totals.sum += static_cast<double>(sum[k][l]);
      }
    }
  }
  return totals;
}

// d (I / U) / dp = (t (U + I) - I) / U^2, and the same with p and t exchanged.
template <class T>
NMR_INLINE void gradient_body(const T* __restrict other, T factor, T offset, T* __restrict grad, int64_t count) {
  for (int64_t n = 0; n < count; ++n) grad[n] = factor * other[n] - offset;
}

NMR_CLONES Totals totals_of(const float* p, const float* t, int64_t count) { return totals_body(p, t, count); }
NMR_CLONES Totals totals_of(const double* p, const double* t, int64_t count) { return totals_body(p, t, count); }
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
    const Totals totals = totals_of(args.prediction + b * args.count, args.target + b * args.count, args.count);
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
