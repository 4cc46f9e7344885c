// The loops of the soft intersection over union.
#include "chunk_sums.h"
#include "level_lanes.h"

namespace nmr::NMR_LEVEL {
namespace {

// Two vectors of partial sums run side by side. Their order depends on the number of values alone.
template <class T>
void sum_chunk(const T* p, const T* t, int64_t count, ChunkSums<T>& sums) {
  Lanes<T> product[2] = {splat(T(0)), splat(T(0))}, sum[2] = {splat(T(0)), splat(T(0))};
  Lanes<T> low = splat(T(0)), high = splat(T(1));
  const auto add = [&](const T* pair_p, const T* pair_t) {
    for (int64_t k = 0; k < 2; ++k) {
      const Lanes<T> a = load_lanes<Lanes<T>>(pair_p + k * kLanes);
      const Lanes<T> b = load_lanes<Lanes<T>>(pair_t + k * kLanes);
      product[k] = product[k] + a * b;
      sum[k] = sum[k] + (a + b);
      low = min_of(b, low);
      high = max_of(b, high);
    }
  };
  const int64_t whole = count - count % (2 * kLanes);
  for (int64_t n = 0; n < whole; n += 2 * kLanes) add(p + n, t + n);
  if (whole < count) {  // the last, incomplete vectors, filled up with zeros
    T rest_p[2 * kLanes] = {}, rest_t[2 * kLanes] = {};
    std::copy(p + whole, p + count, rest_p);
    std::copy(t + whole, t + count, rest_t);
    add(rest_p, rest_t);
  }
  for (int64_t k = 0; k < 2; ++k) {
    store_lanes(sums.product + k * kLanes, product[k]);
    store_lanes(sums.sum + k * kLanes, sum[k]);
  }
  store_lanes(sums.low, low);
  store_lanes(sums.high, high);
}

// d (I / U) / dp = (t (U + I) - I) / U^2, and the same with p and t exchanged.
template <class T>
void gradient_of(const T* __restrict other, T factor, T offset, T* __restrict grad, int64_t count) {
  for (int64_t n = 0; n < count; ++n) grad[n] = factor * other[n] - offset;
}

}  // namespace
}  // namespace nmr::NMR_LEVEL
