// Small vectors of Eigen.
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "parallel.h"

namespace nmr {

template <class T>
using Vec3 = Eigen::Matrix<T, 3, 1>;

template <class T>
NMR_INLINE Vec3<T> load3(const T* p) {
  return Vec3<T>(p[0], p[1], p[2]);
}

template <class T>
NMR_INLINE void add3(T* p, const Vec3<T>& v) {
  for (int k = 0; k < 3; ++k) p[k] += v[k];
}

// The gradient of v, where unit = v / length and `grad` is the gradient of unit. If |v| is above
// `shortest`, length is |v|. If not, length does not depend on v: it is `shortest`, and with a
// `shortest` of 0 the gradient is 0.
template <class T>
NMR_INLINE Vec3<T> unit_backward(const Vec3<T>& unit, T length, T shortest, const Vec3<T>& grad) {
  if (length > shortest) return (grad - unit * unit.dot(grad)) / length;
  return shortest > 0 ? Vec3<T>(grad / length) : Vec3<T>(Vec3<T>::Zero());
}

}  // namespace nmr
