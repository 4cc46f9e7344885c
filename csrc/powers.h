// Powers and logarithms with the same bits on every processor. (The C library chooses between
// versions that round differently.)
#pragma once

#include <cmath>

namespace nmr {

// log2(x) of a positive, finite x, to a few units in the last place: x = m 2^e with m in
// [sqrt(1/2), sqrt(2)], and ln m = 2 (s + s^3 / 3 + s^5 / 5 + ...) with s = (m - 1) / (m + 1).
inline double log2_of(double x) {
  int exponent;
  double m = std::frexp(x, &exponent);
  if (m < 0.70710678118654752) {
    m *= 2;
    exponent -= 1;
  }
  const double s = (m - 1) / (m + 1), square = s * s;
  double sum = 0;
  for (int k = 23; k >= 3; k -= 2) sum = (sum + 1.0 / k) * square;
  return exponent + 2.8853900817779268 * (s + s * sum);  // 2 / ln 2
}

// 2^x: Taylor's series of the fraction in [-1/2, 1/2], scaled by the power of the whole part.
inline double exp2_of(double x) {
  if (!(x > -1080)) return 0;
  if (x > 1030) x = 1030;  // infinity
  const double whole = std::floor(x + 0.5), t = (x - whole) * 0.69314718055994531;
  double sum = 1;
  for (int k = 16; k >= 1; --k) sum = 1 + sum * t * (1.0 / k);
  return std::ldexp(sum, static_cast<int>(whole));
}

}  // namespace nmr
