// Cameras given by a place and a direction, forward and backward. Poses that are not finite are
// handled here.
#include <algorithm>
#include <cmath>
#include <limits>

#include "stages.h"
#include "vectors.h"

namespace nmr {
namespace {

template <class T>
using Matrix34 = Eigen::Matrix<T, 3, 4, Eigen::RowMajor>;
using Vec3d = Vec3<double>;

constexpr double kShortestAxis =
    1e-5;  // as published: a shorter vector is divided by this, and stays short
constexpr double kRadians = 3.14159265358979323846 / 180;  // of a degree
constexpr double kLargestAxis =
    1e15;  // up to this size lengths and their derivatives do not overflow, even in float

// Lengths and cross products round as the published ones, which were compiled with fused
// multiply-adds. These are the only fused multiply-adds in this library; they are written
// explicitly, so that every processor gives the same bits.
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
  return v / std::max(length(v), T(kShortestAxis));
}

Vec3d normalized_backward(const Vec3d& v, const Vec3d& grad) {
  const double size = std::max(v.norm(), kShortestAxis);
  return unit_backward<double>(v / size, size, kShortestAxis, grad);
}

Vec3d vector_of(const Parameter<double>& parameter, int64_t b) {
  return Eigen::Map<const Vec3d>(parameter.of(b, 3));
}

void add(const Parameter<double>& parameter, int64_t b, const Vec3d& grad) {
  for (int k = 0; k < 3 && parameter.grad; ++k)
    parameter.grad[(parameter.each ? 3 * b : 0) + k] += grad[k];
}

template <class T>
struct Axes {
  Vec3<T> forward, up;
  Vec3<T> sideways, upright;  // x and y before they are normalized
  Vec3<T> x, y, z;
  bool usable;

  Axes(const Project<T>& args, int64_t b) : usable(true) {
    const Vec3d place = vector_of(args.eye, b), target = vector_of(args.at, b);
    forward = (args.along ? target : Vec3d(target - place)).template cast<T>();
    up = vector_of(args.up, b).template cast<T>();
    for (int k = 0; k < 3; ++k)
      usable =
          usable && std::abs(forward[k]) < T(kLargestAxis) && std::abs(up[k]) < T(kLargestAxis);
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
void look_at(const Project<T>& args) {
  for (int64_t b = 0; b < args.cameras; ++b) {
    T* camera = args.camera + kCamera * b;
    Eigen::Map<Matrix34<T>> matrix(camera);
    const Axes<T> axes(args, b);
    if (axes.usable)
      matrix << axes.x.transpose(), T(0), -axes.y.transpose(), T(0), axes.z.transpose(), T(0);
    else
      matrix.setConstant(std::numeric_limits<T>::quiet_NaN());
    if (args.right_handed) matrix.row(0) *= T(-1);
    const double view = *args.view.of(b, 1);
    const T scale = args.perspective ? T(1) : static_cast<T>(view);
    const T intrinsics[6] = {scale, 0, 0, 0, -scale, 0};
    std::copy_n(intrinsics, 6, camera + kIntrinsics);
    for (int k = 0; k < 3; ++k) camera[kOrigin + k] = static_cast<T>(args.eye.of(b, 3)[k]);
    const double angle = static_cast<T>(view * kRadians);  // rounded, as published
    camera[kExtent] = args.perspective ? static_cast<T>(std::tan(angle)) : T(1);
  }
}

namespace {

struct PoseGradient {
  Vec3d forward = Vec3d::Zero(), up = Vec3d::Zero();
};

// In double: for float inputs, divisions by numbers as small as 1e-5 then cannot overflow. An
// upstream gradient that is infinite or NaN makes the gradient NaN.
template <class T>
PoseGradient pose_gradient(const Axes<T>& axes, const Matrix34<T>& grad_matrix, bool right_handed) {
  PoseGradient grad;
  if (!axes.usable) return grad;
  if (!grad_matrix.allFinite()) {
    grad.forward.setConstant(std::numeric_limits<double>::quiet_NaN());
    grad.up = grad.forward;
    return grad;
  }
  const Vec3d up = axes.up.template cast<double>();
  const Vec3d x = axes.x.template cast<double>(), z = axes.z.template cast<double>();
  const Eigen::Matrix<double, 3, 3> grad_rows =
      grad_matrix.template leftCols<3>().transpose().template cast<double>();
  Vec3d grad_x = right_handed ? Vec3d(-grad_rows.col(0)) : Vec3d(grad_rows.col(0)),
        grad_z = grad_rows.col(2);
  const Vec3d grad_upright = normalized_backward(axes.upright.template cast<double>(),
                                                 -grad_rows.col(1));  // gradient of z x x
  grad_x += cross(grad_upright, z);
  grad_z += cross(x, grad_upright);
  const Vec3d grad_sideways =
      normalized_backward(axes.sideways.template cast<double>(), grad_x);  // gradient of up x z
  grad_z += cross(grad_sideways, up);
  grad.up = cross(z, grad_sideways);
  grad.forward = normalized_backward(axes.forward.template cast<double>(), grad_z);
  return grad;
}

// Gradients stay in the range of T, as those of tensors of T would.
template <class T>
Vec3d clamped(const Vec3d& grad) {
  const double largest = std::numeric_limits<T>::max();
  return {std::clamp(grad[0], -largest, largest), std::clamp(grad[1], -largest, largest),
          std::clamp(grad[2], -largest, largest)};
}

}  // namespace

template <class T>
void look_at_backward(const Project<T>& args, const T* grad_camera) {
  for (const Parameter<double>* vector : {&args.eye, &args.at, &args.up})
    if (vector->grad) std::fill_n(vector->grad, vector->each ? 3 * args.cameras : 3, 0.0);
  if (args.view.grad) std::fill_n(args.view.grad, args.view.each ? args.cameras : 1, 0.0);
  for (int64_t b = 0; b < args.cameras; ++b, grad_camera += kCamera) {
    const PoseGradient grad =
        pose_gradient(Axes<T>(args, b), Matrix34<T>(Eigen::Map<const Matrix34<T>>(grad_camera)),
                      args.right_handed);
    const Vec3d of_forward = clamped<T>(grad.forward);
    Vec3d of_eye = Eigen::Map<const Vec3<T>>(grad_camera + kOrigin).template cast<double>();
    if (!args.along) of_eye -= of_forward;
    add(args.eye, b, of_eye);
    add(args.at, b, of_forward);
    add(args.up, b, clamped<T>(grad.up));
    if (!args.view.grad) continue;
    const double tangent =
        std::tan(static_cast<double>(static_cast<T>(*args.view.of(b, 1) * kRadians)));
    args.view.grad[args.view.each ? b : 0] +=
        args.perspective ? grad_camera[kExtent] * (1 + tangent * tangent) * kRadians
                         : double(grad_camera[kIntrinsics]) - double(grad_camera[kIntrinsics + 4]);
  }
}

template void look_at(const Project<float>&);
template void look_at(const Project<double>&);
template void look_at_backward(const Project<float>&, const float*);
template void look_at_backward(const Project<double>&, const double*);

}  // namespace nmr
