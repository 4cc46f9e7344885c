// Smoothness loss: sum over edges of (1 + cos(theta))^2, theta the angle between the two faces at the edge (-1 when flat), in
// Kato's guarded form. theta is measured between the heights that the faces' other corners have over the edge.
#include <Eigen/Core>

#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

constexpr double kGuard = 1e-6;  // added to every squared length and denominator

template <class T>
using Vec3 = Eigen::Matrix<T, 3, 1>;

// Height of one face over the edge a: b runs from the edge's first vertex to the face's other corner.
template <class T>
struct Height {
  Vec3<T> vector;  // b - a (a.b) / (|a|^2 + e)
  T length;        // |b| sqrt(1 - cos^2 + e)
};

// The parts of a height that its derivative needs again.
template <class T>
struct HeightParts {
  T a2, ab, length_a, length_b, cos, sin, along;
};

template <class T>
inline Height<T> height(const Vec3<T>& a, const Vec3<T>& b, HeightParts<T>& p) {
  const T e = T(kGuard);
  p.a2 = a.squaredNorm();
  p.ab = a.dot(b);
  p.length_a = std::sqrt(p.a2 + e);
  p.length_b = std::sqrt(b.squaredNorm() + e);
  p.cos = p.ab / (p.length_a * p.length_b + e);
  p.sin = std::sqrt(1 - p.cos * p.cos + e);
  p.along = p.ab / (p.a2 + e);
  return {b - a * p.along, p.length_b * p.sin};
}

template <class T>
inline void height_backward(const Vec3<T>& a, const Vec3<T>& b, const HeightParts<T>& p, const Vec3<T>& grad_vector,
                            T grad_length, Vec3<T>& grad_a, Vec3<T>& grad_b) {
  const T e = T(kGuard);
  const T q = p.length_a * p.length_b + e;
  const T grad_cos = -grad_length * p.length_b * p.cos / p.sin;
  const T grad_q = -grad_cos * p.cos / q;
  const T grad_along = -a.dot(grad_vector);
  const T grad_ab = grad_along / (p.a2 + e) + grad_cos / q;
  const T grad_length_a = grad_q * p.length_b;
  const T grad_length_b = grad_length * p.sin + grad_q * p.length_a;
  const T grad_a2 = -grad_along * p.along / (p.a2 + e) + grad_length_a / (2 * p.length_a);
  grad_a += -p.along * grad_vector + grad_ab * b + 2 * grad_a2 * a;
  grad_b = grad_vector + grad_ab * a + (grad_length_b / p.length_b) * b;
}

template <class T>
struct Edge {
  Eigen::Map<const Vec3<T>> origin, end, left, right;
  Edge(const T* vertices, const int64_t* e)
      : origin(vertices + 3 * e[0]), end(vertices + 3 * e[1]), left(vertices + 3 * e[2]), right(vertices + 3 * e[3]) {}
};

}  // namespace

template <class T>
void smoothness_forward(const Smoothness<T>& args) {
  parallel_for(args.batch, args.num_threads, [&](int64_t b) {
    const T* vertices = args.vertices + b * args.num_vertices * 3;
    double sum = 0;
    for (int64_t n = 0; n < args.num_edges; ++n) {
      const Edge<T> edge(vertices, args.edges + 4 * n);
      const Vec3<T> a = edge.end - edge.origin;
      HeightParts<T> parts;
      const Height<T> h1 = height<T>(a, edge.left - edge.origin, parts);
      const Height<T> h2 = height<T>(a, edge.right - edge.origin, parts);
      const T cos = h1.vector.dot(h2.vector) / (h1.length * h2.length + T(kGuard));
      sum += static_cast<double>((1 + cos) * (1 + cos));
    }
    args.loss[b] = static_cast<T>(sum);
  });
}

template <class T>
void smoothness_backward(const Smoothness<T>& args) {
  parallel_for(args.batch, args.num_threads, [&](int64_t b) {
    const T* vertices = args.vertices + b * args.num_vertices * 3;
    T* grad = args.grad_vertices + b * args.num_vertices * 3;
    std::fill_n(grad, args.num_vertices * 3, T(0));
    for (int64_t n = 0; n < args.num_edges; ++n) {
      const int64_t* e = args.edges + 4 * n;
      const Edge<T> edge(vertices, e);
      const Vec3<T> a = edge.end - edge.origin, b1 = edge.left - edge.origin, b2 = edge.right - edge.origin;
      HeightParts<T> p1, p2;
      const Height<T> h1 = height<T>(a, b1, p1), h2 = height<T>(a, b2, p2);
      const T denominator = h1.length * h2.length + T(kGuard);
      const T cos = h1.vector.dot(h2.vector) / denominator;
      const T grad_dot = 2 * (1 + cos) * args.grad_loss[b] / denominator;
      const T grad_denominator = -grad_dot * cos;
      Vec3<T> grad_a = Vec3<T>::Zero(), grad_b1, grad_b2;
      height_backward<T>(a, b1, p1, grad_dot * h2.vector, grad_denominator * h2.length, grad_a, grad_b1);
      height_backward<T>(a, b2, p2, grad_dot * h1.vector, grad_denominator * h1.length, grad_a, grad_b2);
      Eigen::Map<Vec3<T>>(grad + 3 * e[0]) -= grad_a + grad_b1 + grad_b2;
      Eigen::Map<Vec3<T>>(grad + 3 * e[1]) += grad_a;
      Eigen::Map<Vec3<T>>(grad + 3 * e[2]) += grad_b1;
      Eigen::Map<Vec3<T>>(grad + 3 * e[3]) += grad_b2;
    }
  });
}

template void smoothness_forward(const Smoothness<float>&);
template void smoothness_forward(const Smoothness<double>&);
template void smoothness_backward(const Smoothness<float>&);
template void smoothness_backward(const Smoothness<double>&);

}  // namespace nmr
