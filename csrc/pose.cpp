// The pose of a camera that looks along a direction, forward and backward: one call instead of about twenty tensor
// operations. Poses that are not finite are handled here.
#include <algorithm>
#include <cmath>
#include <limits>

#include <Eigen/Core>

#include "stages.h"

namespace nmr {
namespace {

template <class T>
using Vec3 = Eigen::Matrix<T, 3, 1>;
template <class T>
using Matrix34 = Eigen::Matrix<T, 3, 4, Eigen::RowMajor>;

constexpr double kShortest = 1e-5;  // as published: a shorter vector is divided by this, and stays short
constexpr double kLargest = 1e15;   // up to this size lengths and their derivatives do not overflow, even in float

// Lengths and cross products round as the published ones, which were compiled with fused multiply-adds. These are the
// only fused multiply-adds in this library; they are written explicitly, so that every processor gives the same bits.
template <class T>
T length(const Vec3<T>& v) {
  return std::sqrt(std::fma(v[2], v[2], std::fma(v[1], v[1], v[0] * v[0])));
}

template <class T>
Vec3<T> cross(const Vec3<T>& a, const Vec3<T>& b) {
  return {std::fma(a[1], b[2], -(a[2] * b[1])), std::fma(a[2], b[0], -(a[0] * b[2])),
          std::fma(a[0], b[1], -(a[1] * b[0]))};
}

template <class T>
Vec3<T> normalized(const Vec3<T>& v) {
  return v / std::max(length(v), T(kShortest));
}

Vec3<double> normalized_backward(const Vec3<double>& v, const Vec3<double>& grad) {
  const double size = v.norm();
  if (!(size > kShortest)) return grad / kShortest;
  const Vec3<double> n = v / size;
  return (grad - n * n.dot(grad)) / size;
}

template <class T>
struct Axes {
  Vec3<T> forward, up;
  Vec3<T> sideways, upright;  // x and y before they are normalized
  Vec3<T> x, y, z;
  bool usable;

  Axes(const Pose<T>& args, int64_t b) : usable(true) {
    std::copy_n(args.forward + 3 * b, 3, forward.data());
    std::copy_n(args.up + 3 * b, 3, up.data());
    for (int k = 0; k < 3; ++k) usable = usable && std::abs(forward[k]) < T(kLargest) && std::abs(up[k]) < T(kLargest);
    if (!usable) return;
    z = normalized(forward);
    sideways = cross(up, z);
    x = normalized(sideways);
    upright = cross(z, x);
    y = normalized(upright);
  }
};

}  // namespace

template <class T>
void pose_forward(const Pose<T>& args) {
  for (int64_t b = 0; b < args.batch; ++b) {
    Eigen::Map<Matrix34<T>> matrix(args.matrix + 12 * b);
    const Axes<T> axes(args, b);
    if (axes.usable)
      matrix << axes.x.transpose(), T(0), -axes.y.transpose(), T(0), axes.z.transpose(), T(0);
    else
      matrix.setConstant(std::numeric_limits<T>::quiet_NaN());
  }
}

// In double: for float inputs, divisions by numbers as small as 1e-5 then cannot overflow. An upstream gradient that
// is infinite or NaN makes the gradient NaN.
template <class T>
void pose_backward(const Pose<T>& args) {
  const double largest = std::numeric_limits<T>::max();
  for (int64_t b = 0; b < args.batch; ++b) {
    Vec3<double> grad_forward = Vec3<double>::Zero(), grad_up = Vec3<double>::Zero();
    const Axes<T> axes(args, b);
    const Eigen::Map<const Matrix34<T>> grad_matrix(args.grad_matrix + 12 * b);
    if (axes.usable && !grad_matrix.allFinite()) {
      grad_forward.setConstant(std::numeric_limits<double>::quiet_NaN());
      grad_up = grad_forward;
    } else if (axes.usable) {
      const Vec3<double> up = axes.up.template cast<double>();
      const Vec3<double> x = axes.x.template cast<double>(), z = axes.z.template cast<double>();
      const Eigen::Matrix<double, 3, 3> grad_rows =
          grad_matrix.template leftCols<3>().transpose().template cast<double>();
      Vec3<double> grad_x = grad_rows.col(0), grad_z = grad_rows.col(2);
      const Vec3<double> grad_upright =
          normalized_backward(axes.upright.template cast<double>(), -grad_rows.col(1));  // gradient of z x x
      grad_x += cross(grad_upright, z);
      grad_z += cross(x, grad_upright);
      const Vec3<double> grad_sideways =
          normalized_backward(axes.sideways.template cast<double>(), grad_x);  // gradient of up x z
      grad_z += cross(grad_sideways, up);
      grad_up = cross(z, grad_sideways);
      grad_forward = normalized_backward(axes.forward.template cast<double>(), grad_z);
    }
    for (int k = 0; k < 3; ++k) {
      args.grad_forward[3 * b + k] = static_cast<T>(std::clamp(grad_forward[k], -largest, largest));
      args.grad_up[3 * b + k] = static_cast<T>(std::clamp(grad_up[k], -largest, largest));
    }
  }
}

template void pose_forward(const Pose<float>&);
template void pose_forward(const Pose<double>&);
template void pose_backward(const Pose<float>&);
template void pose_backward(const Pose<double>&);

}  // namespace nmr
