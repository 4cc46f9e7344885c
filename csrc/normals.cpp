// Normals of faces and of vertices. Computed in double, so that products of float coordinates
// neither over- nor underflow.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "parallel.h"
#include "stages.h"
#include "vectors.h"

namespace nmr {
namespace {

using Vec3d = Vec3<double>;

// Coordinates beyond this do not count: their products could overflow.
constexpr double kLargestCoordinate = 1e100;

// A shorter product counts as no area: its derivative could overflow.
template <class T>
constexpr double kLeastArea = 1e-290;
template <>
constexpr double kLeastArea<float> = std::numeric_limits<float>::min();

struct Direction {
  Vec3d unit;
  double length;  // 0 without a direction
};

template <class T>
NMR_INLINE Direction direction_of(const Vec3d& v) {
  const double scale = v.cwiseAbs().maxCoeff();
  if (!(scale >= kLeastArea<T>)) return {Vec3d::Zero(), 0};
  const double length = (v / scale).norm() * scale;
  return {v / length, length};
}

// dL/dv from dL/d(v / |v|).
NMR_INLINE Vec3d direction_backward(const Direction& d, const Vec3d& grad) {
  return unit_backward(d.unit, d.length, 0.0, grad);
}

// Whether a vertex is used: finite, with coordinates below kLargestCoordinate. Others count as the
// origin.
template <class T>
NMR_INLINE bool counts(const T* vertex) {
  const auto is_used = [](T x) { return std::abs(static_cast<double>(x)) < kLargestCoordinate; };
  return is_used(vertex[0]) && is_used(vertex[1]) && is_used(vertex[2]);
}

template <class T>
NMR_INLINE Vec3d vertex_of(const T* vertex) {
  return counts(vertex) ? Vec3d(vertex[0], vertex[1], vertex[2]) : Vec3d(Vec3d::Zero());
}

// Sides v0 - v1 and v2 - v1 of a face, and their product.
struct Sides {
  Vec3d a, b, across;
};

template <class T>
NMR_INLINE Sides sides_of(const T* vertices, const int64_t* face) {
  const Vec3d v1 = vertex_of(vertices + 3 * face[1]);
  Sides s{vertex_of(vertices + 3 * face[0]) - v1, vertex_of(vertices + 3 * face[2]) - v1, {}};
  s.across = s.a.cross(s.b);
  return s;
}

// Adds the gradient of the product to the corners.
NMR_INLINE void sides_backward(const Sides& s, const int64_t* face, const Vec3d& grad_across,
                               Vec3d* grad_vertices) {
  const Vec3d grad_a = s.b.cross(grad_across), grad_b = grad_across.cross(s.a);
  grad_vertices[face[0]] += grad_a;
  grad_vertices[face[2]] += grad_b;
  grad_vertices[face[1]] -= grad_a + grad_b;
}

// Sums of the products around each vertex of mesh b.
template <class T>
std::vector<Vec3d> vertex_sums(const MeshBatch<T>& mesh, int64_t b) {
  std::vector<Vec3d> sums(mesh.vertex_rows.count(b), Vec3d::Zero());
  const T* vertices = mesh.image_vertices(b);
  const int64_t *face = mesh.image_faces(b), num_faces = mesh.face_rows.count(b);
  for (int64_t f = 0; f < num_faces; ++f, face += 3) {
    const Vec3d across = sides_of(vertices, face).across;
    for (int k = 0; k < 3; ++k) sums[face[k]] += across;
  }
  return sums;
}

template <class T>
NMR_INLINE void store(T* to, const Vec3d& v) {
  for (int k = 0; k < 3; ++k) to[k] = static_cast<T>(v[k]);
}

// First row of the normals of mesh b, which has its own also if it shares its faces.
template <class T>
int64_t first_normal(const Normals<T>& args, int64_t b) {
  const Rows& faces = args.mesh.face_rows;
  return (args.smooth ? args.mesh.vertex_rows : Rows{faces.size, true, faces.starts}).first(b);
}

}  // namespace

template <class T>
void normals_forward(const Normals<T>& args) {
  const MeshBatch<T>& mesh = args.mesh;
  parallel_for(mesh.batch, args.num_threads, [&](int64_t b) {
    T* normals = args.normals + 3 * first_normal(args, b);
    if (args.smooth) {
      const std::vector<Vec3d> sums = vertex_sums(mesh, b);
      for (size_t v = 0; v < sums.size(); ++v)
        store(normals + 3 * v, direction_of<T>(sums[v]).unit);
      return;
    }
    const T* vertices = mesh.image_vertices(b);
    const int64_t *faces = mesh.image_faces(b), num_faces = mesh.face_rows.count(b);
    for (int64_t f = 0; f < num_faces; ++f)
      store(normals + 3 * f, direction_of<T>(sides_of(vertices, faces + 3 * f).across).unit);
  });
}

template <class T>
void normals_backward(const Normals<T>& args) {
  const MeshBatch<T>& mesh = args.mesh;
  constexpr double largest = std::numeric_limits<T>::max();
  parallel_for(mesh.batch, args.num_threads, [&](int64_t b) {
    const T *vertices = mesh.image_vertices(b),
            *grad_normals = args.grad_normals + 3 * first_normal(args, b);
    const int64_t V = mesh.vertex_rows.count(b), F = mesh.face_rows.count(b),
                  *face = mesh.image_faces(b);
    std::vector<Vec3d> grads(V, Vec3d::Zero()), grad_sums;
    if (args.smooth) {
      grad_sums = vertex_sums(mesh, b);
      for (int64_t v = 0; v < V; ++v)
        grad_sums[v] = direction_backward(direction_of<T>(grad_sums[v]),
                                          load3(grad_normals + 3 * v).template cast<double>());
    }
    for (int64_t f = 0; f < F; ++f, face += 3) {
      const Sides sides = sides_of(vertices, face);
      const Vec3d grad_across =
          args.smooth ? Vec3d(grad_sums[face[0]] + grad_sums[face[1]] + grad_sums[face[2]])
                      : direction_backward(direction_of<T>(sides.across),
                                           load3(grad_normals + 3 * f).template cast<double>());
      sides_backward(sides, face, grad_across, grads.data());
    }
    T* grad_vertices = args.grad_vertices + 3 * mesh.vertex_rows.first(b);
    for (int64_t v = 0; v < V; ++v)
      for (int k = 0; k < 3; ++k)
        grad_vertices[3 * v + k] = counts(vertices + 3 * v)
                                       ? static_cast<T>(std::clamp(grads[v][k], -largest, largest))
                                       : T(0);
  });
}

NMR_FLOAT_AND_DOUBLE(normals_forward, Normals)
NMR_FLOAT_AND_DOUBLE(normals_backward, Normals)

}  // namespace nmr
