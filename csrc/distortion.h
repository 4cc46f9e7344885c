// OpenCV's lens distortion: p -> q, both at depth 1.
//
//   5 or 8 coefficients:  q = m p + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y),  r
//   = |p|,
//                         m = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
//   4, a fisheye:         q = m p,  m = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8) / r,  a = atan(r)
//
// These formulas are those of a lens up to the radius at which q turns back. Beyond it (`reach`)
// the image goes on straight, q(c) + p - c with c the nearest p within, so that nothing is folded
// into the image.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>

#include "parallel.h"

namespace nmr {

constexpr int kFisheye = 4, kRational = 8, kMostCoefficients = 8;

// atan(r) for r >= 0, by operations that round alike on every processor: the angle is halved three
// times, then a series.
template <class T>
NMR_INLINE T arc_tangent(T r) {
  constexpr int kTerms = sizeof(T) == sizeof(double) ? 11 : 6;
  T x = r < T(1e18) ? r : T(1e18);
  for (int n = 0; n < 3; ++n) x = x / (1 + std::sqrt(1 + x * x));
  const T square = x * x;
  T sum = 0;
  for (int n = kTerms; n >= 0; --n) sum = T(1) / T(2 * n + 1) - square * sum;
  return 8 * x * sum;
}

// The factor m at r^2, and its derivative by r^2.
template <class T>
struct Radial {
  T m, slope;
  T angle2, per_r;  // fisheye: a^2 and a / r
  T inverse;        // 8 coefficients: 1 / denominator
};

template <int kCoefficients, class T>
NMR_INLINE Radial<T> radial_of(const T* d, T r2) {
  Radial<T> s{};
  if (kCoefficients == kFisheye) {
    const bool centre = r2 < T(1e-12);
    const T r = std::sqrt(centre ? T(1) : r2), a = arc_tangent(r);
    s.angle2 = centre ? T(0) : a * a;
    s.per_r = centre ? T(1) : a / r;
    const T a2 = s.angle2;
    s.m = s.per_r * (1 + a2 * (d[0] + a2 * (d[1] + a2 * (d[2] + a2 * d[3]))));
    const T turn =
        1 + a2 * (3 * d[0] + a2 * (5 * d[1] + a2 * (7 * d[2] + a2 * (9 * d[3]))));  // d (m r) / d a
    s.slope = centre ? d[0] - T(1) / 3 : (turn / (1 + r2) - s.m) / (2 * r2);
    return s;
  }
  s.m = 1 + r2 * (d[0] + r2 * (d[1] + r2 * d[4]));
  s.slope = d[0] + r2 * (2 * d[1] + r2 * (3 * d[4]));
  if (kCoefficients == kRational) {
    s.inverse = 1 / (1 + r2 * (d[5] + r2 * (d[6] + r2 * d[7])));
    s.m *= s.inverse;
    s.slope = (s.slope - s.m * (d[5] + r2 * (2 * d[6] + r2 * (3 * d[7])))) * s.inverse;
  }
  return s;
}

// Largest r^2 at which q still moves outwards with p; infinity if q never turns back.
template <int kCoefficients, class T>
double square_reach(const T* coefficients) {
  double d[kMostCoefficients] = {};
  for (int k = 0; k < kCoefficients; ++k) d[k] = static_cast<double>(coefficients[k]);
  const double tangential = kCoefficients == kFisheye ? 0 : 6 * (std::abs(d[2]) + std::abs(d[3]));
  // Whether a bound from below of the derivative of |q| by r is positive, and no pole is near.
  const auto outwards = [&](double r) {
    const Radial<double> s = radial_of<kCoefficients>(d, r * r);
    if (!(s.m > 0) || (kCoefficients == kRational && !(s.inverse > 0 && s.inverse < 1e3)))
      return false;
    return s.m + 2 * s.slope * r * r > tangential * r;
  };
  double inside = 0;
  for (double r = 0.05; r < 1e3; r *= 1.08) {
    if (outwards(r)) {
      inside = r;
      continue;
    }
    for (int n = 0; n < 40; ++n) {
      const double middle = (inside + r) / 2;
      (outwards(middle) ? inside : r) = middle;
    }
    return inside * inside;
  }
  return std::numeric_limits<double>::infinity();
}

}  // namespace nmr
