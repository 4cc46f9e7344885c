// The loops of the smoothness loss over edges.
#include <algorithm>
#include <cmath>

#include "level_lanes.h"
#include "stages.h"

namespace nmr::NMR_LEVEL {
namespace {

constexpr double kGuard = 1e-6;  // added to every squared length and denominator
constexpr int kCoordinates =
    12;  // x, y, z of an edge's first and second vertex and of the two opposite ones

// Not a vector of Eigen: GCC does not inline its constructors into code for another level, and the
// loops over lanes are then not vectorized (six times the instructions).
template <class T>
struct Vec3 {
  T x, y, z;
};

template <class T>
NMR_INLINE Vec3<T> operator+(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class T>
NMR_INLINE Vec3<T> operator-(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class T>
NMR_INLINE Vec3<T> operator*(T s, const Vec3<T>& a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <class T>
NMR_INLINE T dot(const Vec3<T>& a, const Vec3<T>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

// The edge a, with values that both heights over it use.
template <class T>
struct Base {
  Vec3<T> a;
  T length;     // sqrt(|a|^2 + e)
  T inverse_2;  // 1 / (|a|^2 + e)
};

template <class T>
NMR_INLINE Base<T> base(const Vec3<T>& a) {
  const T a2 = dot(a, a) + T(kGuard);
  return {a, std::sqrt(a2), 1 / a2};
}

// Height of one face over the edge a: b runs from the edge's first vertex to the face's other
// corner.
template <class T>
struct Height {
  Vec3<T> vector;  // b - a (a.b) / (|a|^2 + e)
  T length;        // |b| sin
  T length_b;      // sqrt(|b|^2 + e)
  T inverse_q;     // 1 / (|a| |b| + e)
  T cos;           // a.b / (|a| |b| + e)
  T sin;           // sqrt(1 - cos^2 + e)
  T along;         // (a.b) / (|a|^2 + e)
};

template <class T>
NMR_INLINE Height<T> height(const Base<T>& base, const Vec3<T>& b) {
  const T e = T(kGuard), ab = dot(base.a, b);
  Height<T> h;
  h.length_b = std::sqrt(dot(b, b) + e);
  h.inverse_q = 1 / (base.length * h.length_b + e);
  h.cos = ab * h.inverse_q;
  h.sin = std::sqrt(1 - h.cos * h.cos + e);
  h.along = ab * base.inverse_2;
  h.vector = b - h.along * base.a;
  h.length = h.length_b * h.sin;
  return h;
}

// Adds to grad_a, sets grad_b.
template <class T>
NMR_INLINE void height_backward(const Base<T>& base, const Vec3<T>& b, const Height<T>& h,
                                const Vec3<T>& grad_vector, T grad_length, Vec3<T>& grad_a,
                                Vec3<T>& grad_b) {
  const T inverse_length = 1 / h.length;  // times |b| it is 1 / sin, times sin it is 1 / |b|
  const T grad_cos = -grad_length * h.length_b * h.cos * (inverse_length * h.length_b);
  const T grad_q = -grad_cos * h.cos * h.inverse_q;
  const T grad_along = -dot(base.a, grad_vector);
  const T grad_ab = grad_along * base.inverse_2 + grad_cos * h.inverse_q;
  const T grad_length_b = grad_length * h.sin + grad_q * base.length;
  const T twice_grad_a2 =
      (grad_q * h.length_b * base.length - 2 * grad_along * h.along) * base.inverse_2;
  grad_a = grad_a + grad_ab * b + twice_grad_a2 * base.a - h.along * grad_vector;
  grad_b = grad_vector + grad_ab * base.a + (grad_length_b * (inverse_length * h.sin)) * b;
}

template <class T>
NMR_INLINE T edge_loss(const Vec3<T>& origin, const Vec3<T>& end, const Vec3<T>& left,
                       const Vec3<T>& right) {
  const Base<T> a = base(end - origin);
  const Height<T> h1 = height(a, left - origin), h2 = height(a, right - origin);
  const T cos = dot(h1.vector, h2.vector) / (h1.length * h2.length + T(kGuard));
  return (1 + cos) * (1 + cos);
}

// The gradients of end, left and right; that of origin is minus their sum.
template <class T>
NMR_INLINE void edge_backward(const Vec3<T>& origin, const Vec3<T>& end, const Vec3<T>& left,
                              const Vec3<T>& right, T grad_loss, Vec3<T>& grad_end,
                              Vec3<T>& grad_left, Vec3<T>& grad_right) {
  const Base<T> a = base(end - origin);
  const Vec3<T> b1 = left - origin, b2 = right - origin;
  const Height<T> h1 = height(a, b1), h2 = height(a, b2);
  const T inverse = 1 / (h1.length * h2.length + T(kGuard));
  const T cos = dot(h1.vector, h2.vector) * inverse;
  const T grad_dot = 2 * (1 + cos) * grad_loss * inverse;
  const T grad_denominator = -grad_dot * cos;
  grad_end = {0, 0, 0};
  height_backward(a, b1, h1, grad_dot * h2.vector, grad_denominator * h2.length, grad_end,
                  grad_left);
  height_backward(a, b2, h2, grad_dot * h1.vector, grad_denominator * h1.length, grad_end,
                  grad_right);
}

// kGroup points, as [3, kGroup].
template <class T>
NMR_INLINE Vec3<T> point(const T* points, int l) {
  return {points[l], points[kGroup + l], points[2 * kGroup + l]};
}
template <class T>
NMR_INLINE void set_point(T* points, int l, const Vec3<T>& p) {
  points[l] = p.x;
  points[kGroup + l] = p.y;
  points[2 * kGroup + l] = p.z;
}

template <class T>
NMR_INLINE void lanes_forward(const T* __restrict origin, const T* __restrict end,
                              const T* __restrict left, const T* __restrict right,
                              T* __restrict loss) {
  for (int l = 0; l < kGroup; ++l)
    loss[l] = edge_loss(point(origin, l), point(end, l), point(left, l), point(right, l));
}

template <class T>
NMR_INLINE void lanes_backward(const T* __restrict origin, const T* __restrict end,
                               const T* __restrict left, const T* __restrict right,
                               const T* __restrict grad_loss, T* __restrict grad) {
  for (int l = 0; l < kGroup; ++l) {
    Vec3<T> g1, g2, g3;
    edge_backward(point(origin, l), point(end, l), point(left, l), point(right, l), grad_loss[l],
                  g1, g2, g3);
    set_point(grad, l, T(-1) * (g1 + g2 + g3));
    set_point(grad + 3 * kGroup, l, g1);
    set_point(grad + 6 * kGroup, l, g2);
    set_point(grad + 9 * kGroup, l, g3);
  }
}

template <int64_t count, class T>
NMR_INLINE void add(const T* __restrict values, T* __restrict sums) {
  for (int64_t n = 0; n < count; ++n) sums[n] += values[n];
}

// Converts kGroup meshes, from image b on: [V * 3] of each <-> [V * 3, kGroup].
template <class T>
NMR_INLINE void interleave(const T* from, int64_t rows, T* to) {
  for (int64_t r = 0; r < rows; ++r)
    for (int l = 0; l < kGroup; ++l) to[r * kGroup + l] = from[l * rows + r];
}
template <class T>
NMR_INLINE void separate(const T* from, int64_t rows, T* to) {
  for (int l = 0; l < kGroup; ++l)
    for (int64_t r = 0; r < rows; ++r) to[l * rows + r] = from[r * kGroup + l];
}

template <class T>
void meshes_forward(const Smoothness<T>& args, int64_t b, T* vertices) {
  interleave(args.vertices + b * args.num_vertices * 3, args.num_vertices * 3, vertices);
  double sum[kGroup] = {};
  for (int64_t n = 0; n < args.num_edges; ++n) {
    const int64_t* e = args.edges + 4 * n;
    constexpr int64_t stride = 3 * kGroup;
    T loss[kGroup];
    lanes_forward(vertices + stride * e[0], vertices + stride * e[1], vertices + stride * e[2],
                  vertices + stride * e[3], loss);
    for (int l = 0; l < kGroup; ++l) sum[l] += static_cast<double>(loss[l]);
  }
  for (int l = 0; l < kGroup; ++l) args.loss[b + l] = static_cast<T>(sum[l]);
}

template <class T>
void meshes_backward(const Smoothness<T>& args, int64_t b, T* vertices, T* grad) {
  const int64_t rows = args.num_vertices * 3;
  interleave(args.vertices + b * rows, rows, vertices);
  std::fill_n(grad, rows * kGroup, T(0));
  T grad_loss[kGroup];
  for (int l = 0; l < kGroup; ++l) grad_loss[l] = args.grad_loss[b + l];
  for (int64_t n = 0; n < args.num_edges; ++n) {
    const int64_t* e = args.edges + 4 * n;
    constexpr int64_t stride = 3 * kGroup;
    T g[kCoordinates][kGroup];
    lanes_backward(vertices + stride * e[0], vertices + stride * e[1], vertices + stride * e[2],
                   vertices + stride * e[3], grad_loss, g[0]);
    for (int i = 0; i < 4; ++i) add<stride>(g[3 * i], grad + stride * e[i]);
  }
  separate(grad, rows, args.grad_vertices + b * rows);
}

// kGroup edges of one mesh; if there are fewer, the last one is repeated.
template <class T>
NMR_INLINE void gather(const T* vertices, const int64_t* edges, int64_t count,
                       T (&points)[kCoordinates][kGroup]) {
  for (int64_t l = 0; l < kGroup; ++l) {
    const int64_t* e = edges + 4 * std::min(l, count - 1);
    for (int k = 0; k < kCoordinates; ++k) points[k][l] = vertices[3 * e[k / 3] + k % 3];
  }
}

template <class T>
void mesh_forward(const Smoothness<T>& args, int64_t b) {
  const T* vertices = args.vertices + b * args.num_vertices * 3;
  double sum = 0;
  for (int64_t n = 0; n < args.num_edges; n += kGroup) {
    const int64_t count = std::min<int64_t>(kGroup, args.num_edges - n);
    T p[kCoordinates][kGroup], loss[kGroup];
    gather(vertices, args.edges + 4 * n, count, p);
    lanes_forward(p[0], p[3], p[6], p[9], loss);
    for (int64_t l = 0; l < count; ++l) sum += static_cast<double>(loss[l]);
  }
  args.loss[b] = static_cast<T>(sum);
}

template <class T>
void mesh_backward(const Smoothness<T>& args, int64_t b) {
  const T* vertices = args.vertices + b * args.num_vertices * 3;
  T* grad = args.grad_vertices + b * args.num_vertices * 3;
  std::fill_n(grad, args.num_vertices * 3, T(0));
  T grad_loss[kGroup];
  std::fill_n(grad_loss, kGroup, args.grad_loss[b]);
  for (int64_t n = 0; n < args.num_edges; n += kGroup) {
    const int64_t count = std::min<int64_t>(kGroup, args.num_edges - n);
    T p[kCoordinates][kGroup], g[kCoordinates][kGroup];
    gather(vertices, args.edges + 4 * n, count, p);
    lanes_backward(p[0], p[3], p[6], p[9], grad_loss, g[0]);
    for (int64_t l = 0; l < count; ++l) {
      const int64_t* e = args.edges + 4 * (n + l);
      for (int k = 0; k < kCoordinates; ++k) grad[3 * e[k / 3] + k % 3] += g[k][l];
    }
  }
}

}  // namespace
}  // namespace nmr::NMR_LEVEL
