// The camera of one image, and sums of its gradient (camera.cpp).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <iterator>
#include <limits>

#include "distortion.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

// The gradient of one camera, summed over its vertices. While it is summed, Number is a vector of
// partial sums; the result has Number = double.
template <class Number>
struct LensGradient {
  Number matrix[12], intrinsics[6], distortion[kMostCoefficients];
};
struct CameraGradient : LensGradient<double> {
  double origin[3], extent;  // these follow from the sums
};

// Derivatives, and gradients multiplied by them, count as infinite beyond this limit. It is small
// enough that sums cannot overflow.
template <class T>
constexpr T kLimit = T(1e200);
template <>
constexpr float kLimit<float> = 1e30f;

// The camera of one image.
template <class T>
struct Lens {
  T a[12], k[6], d[kMostCoefficients], o[3], extent, inverse_extent;
  T reach2;  // largest r^2 at which the distortion is that of a lens
  T largest_a, largest_k,
      largest_d;  // largest |a|, |k / extent|, |d|; the first and the last at least 1
  bool usable;    // all of it is finite, and extent is not 0

  Lens(const Project<T>& args, int64_t b)
      : d{},
        o{},
        extent(1),
        reach2(std::numeric_limits<T>::infinity()),
        largest_a(1),
        largest_k(0),
        largest_d(1),
        usable(true) {
    const T* camera = args.camera + (args.cameras == args.batch ? kCamera * b : 0);
    std::copy_n(camera, 12, a);
    std::copy_n(camera + kIntrinsics, 6, k);
    std::copy_n(camera + kOrigin, 3, o);
    extent = camera[kExtent];
    if (args.distortion.values)
      std::copy_n(args.distortion.of(b, args.coefficients), args.coefficients, d);
    inverse_extent = 1 / extent;
    for (T value : a) largest_a = std::max(largest_a, std::abs(value));
    for (T value : k) largest_k = std::max(largest_k, std::abs(value * inverse_extent));
    for (T value : d) largest_d = std::max(largest_d, std::abs(value));
    for (T value : a) usable = usable && std::isfinite(value);
    for (T value : k) usable = usable && std::isfinite(value * inverse_extent);
    for (T value : d) usable = usable && std::abs(value) < kLimit<T>;
    for (T value : o) usable = usable && std::isfinite(value);
    usable = usable && std::isfinite(extent) && std::isfinite(inverse_extent);
    if (!args.distortion.values || !args.perspective || !usable) return;
    const int64_t n = args.coefficients;
    reach2 = static_cast<T>(n == 4   ? square_reach<4>(d)
                            : n == 5 ? square_reach<5>(d)
                                     : square_reach<8>(d));
  }
};

// Consecutive vertices of one image: their first row in the vertices and in the points.
struct Run {
  int64_t image, vertices, points, count;
};

}  // namespace nmr
