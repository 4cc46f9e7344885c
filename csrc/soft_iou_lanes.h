// The loops of the soft intersection over union; included by levels.h for every instruction set.

// Adds p t and p + t of kLanes pairs to partial sums.
template <class T>
NMR_INLINE void add_pairs(const T* p, const T* t, Lanes<T>& product, Lanes<T>& sum) {
  const Lanes<T> a = load_lanes<Lanes<T>>(p), b = load_lanes<Lanes<T>>(t);
  product = product + a * b;
  sum = sum + (a + b);
}

// Two vectors of partial sums run side by side. After every kValueChunk values they are added, in
// order, to totals in double precision. The order depends on the number of values alone.
template <class T>
Totals totals_of(const T* p, const T* t, int64_t count) {
  Totals totals;
  for (int64_t begin = 0; begin < count; begin += kValueChunk) {
    const int64_t end = std::min(begin + kValueChunk, count),
                  whole = end - (end - begin) % (2 * kLanes);
    Lanes<T> product[2] = {splat(T(0)), splat(T(0))}, sum[2] = {splat(T(0)), splat(T(0))};
    for (int64_t n = begin; n < whole; n += 2 * kLanes) {
      add_pairs(p + n, t + n, product[0], sum[0]);
      add_pairs(p + n + kLanes, t + n + kLanes, product[1], sum[1]);
    }
    T rest_p[2 * kLanes] = {},
                 rest_t[2 * kLanes] = {};  // the last, incomplete vectors, filled up with zeros
    for (int64_t n = whole; n < end; ++n) rest_p[n - whole] = p[n], rest_t[n - whole] = t[n];
    for (int k = 0; k < 2; ++k) {
      if (whole < end) add_pairs(rest_p + k * kLanes, rest_t + k * kLanes, product[k], sum[k]);
      T products[kLanes], sums[kLanes];
      store_lanes(products, product[k]);
      store_lanes(sums, sum[k]);
      for (int64_t l = 0; l < kLanes; ++l) {
        totals.product += static_cast<double>(products[l]);
        totals.sum += static_cast<double>(sums[l]);
      }
    }
  }
  return totals;
}

// d (I / U) / dp = (t (U + I) - I) / U^2, and the same with p and t exchanged.
template <class T>
void gradient_of(const T* __restrict other, T factor, T offset, T* __restrict grad, int64_t count) {
  for (int64_t n = 0; n < count; ++n) grad[n] = factor * other[n] - offset;
}
