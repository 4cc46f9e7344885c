// Screen geometry: pixel coordinates, facing, barycentric weights. Every expression is evaluated in
// the written order, in T, without fused multiply-adds: rounding decides which face owns a pixel on
// an edge, so the order of operations is part of the definition.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "parallel.h"

namespace nmr {

// The face that a face index names, which may be a reversed copy; -1 on background.
NMR_INLINE int64_t face_of(int64_t id, int64_t num_faces) {
  return id < num_faces ? id : id - num_faces;
}

// Centre of raster column (or row) i in [-1, 1]; size: the number of columns (or rows).
template <class T>
NMR_INLINE T pixel_centre(int64_t i, int64_t size) {
  return static_cast<T>(2 * i + 1 - size) / static_cast<T>(size);
}

// Pixel coordinate of x (or y) in [-1, 1]: pixel centres are the integers. size: the number of
// columns (or rows).
template <class T>
NMR_INLINE T to_pixel(T x, T size) {
  return (x * size + size - 1) / 2;
}

// The pixels from `margin` before to `margin` + 1 behind those whose centres lie in [lo, hi], up to
// rounding.
template <class T>
NMR_INLINE void pixels_around(T lo, T hi, int64_t size, int64_t margin, int64_t& first,
                              int64_t& last) {
  const T n = static_cast<T>(size), from = to_pixel(lo, n), to = to_pixel(hi, n);
  first =
      std::max<int64_t>(0, static_cast<int64_t>(from > 0 ? (from < n ? from : n) : T(0)) - margin);
  last = std::min<int64_t>(size - 1,
                           static_cast<int64_t>(to > -1 ? (to < n ? to : n) : T(-2)) + 1 + margin);
}

// One face on the screen: corners in [-1, 1] and depths, in drawing order.
template <class T>
struct Triangle {
  T x[3], y[3], z[3];
};

template <class T>
NMR_INLINE Triangle<T> load_triangle(const T* vertices, const int64_t* face, bool reversed) {
  Triangle<T> t;
  for (int k = 0; k < 3; ++k) {
    const T* v = vertices + 3 * face[reversed ? 2 - k : k];
    t.x[k] = v[0];
    t.y[k] = v[1];
    t.z[k] = v[2];
  }
  return t;
}

// Faces with a non-finite x or y, a NaN depth, or no area are not drawn. The area is computed in
// double, which is almost exact for float coordinates. Otherwise the inclusive edge tests of a
// collinear face could pass along its whole line.
template <class T>
NMR_INLINE bool is_drawable(const Triangle<T>& t) {
  bool finite = true;
  for (int k = 0; k < 3; ++k)
    finite = finite && std::isfinite(t.x[k]) && std::isfinite(t.y[k]) && !std::isnan(t.z[k]);
  const double x0 = t.x[0], y0 = t.y[0];
  return finite && ((t.x[1] - x0) * (t.y[2] - y0) != (t.y[1] - y0) * (t.x[2] - x0));
}

// Rows of the matrix M with barycentric weight w_k = M[k][0] X + M[k][1] Y + M[k][2] at pixel
// coordinates (X, Y): the inverse of the matrix with columns (X_k, Y_k, 1).
template <class T>
struct BarycentricMatrix {
  T m[3][3];
};

template <class T>
NMR_INLINE BarycentricMatrix<T> barycentric_matrix(const Triangle<T>& t, T width, T height) {
  T X[3], Y[3];
  for (int k = 0; k < 3; ++k) {
    X[k] = to_pixel(t.x[k], width);
    Y[k] = to_pixel(t.y[k], height);
  }
  const T det = X[2] * (Y[0] - Y[1]) + X[0] * (Y[1] - Y[2]) + X[1] * (Y[2] - Y[0]);
  return {{{(Y[1] - Y[2]) / det, (X[2] - X[1]) / det, (X[1] * Y[2] - X[2] * Y[1]) / det},
           {(Y[2] - Y[0]) / det, (X[0] - X[2]) / det, (X[2] * Y[0] - X[0] * Y[2]) / det},
           {(Y[0] - Y[1]) / det, (X[1] - X[0]) / det, (X[0] * Y[1] - X[1] * Y[0]) / det}}};
}

// Clamps a weight to [0, 1]; NaN becomes 0.
template <class T>
NMR_INLINE T clamp_weight(T w) {
  w = w > 0 ? w : T(0);
  return w < 1 ? w : T(1);
}

// Weights of the corners at pixel coordinates (X, Y): clamped, and divided by their sum. NaN if all
// are 0, which no drawn face has.
template <class T>
NMR_INLINE void weights_at(const BarycentricMatrix<T>& matrix, T X, T Y, T (&w)[3]) {
  for (int k = 0; k < 3; ++k)
    w[k] = clamp_weight(matrix.m[k][0] * X + matrix.m[k][1] * Y + matrix.m[k][2]);
  const T sum = w[0] + w[1] + w[2];
  for (T& weight : w) weight /= sum;
}

// Depth at such weights, of a face with corners at depths z.
template <class T>
NMR_INLINE T depth_at(const T* w, const T* z, bool perspective) {
  return perspective ? 1 / (w[0] / z[0] + w[1] / z[1] + w[2] / z[2])
                     : w[0] * z[0] + w[1] * z[1] + w[2] * z[2];
}

template <class T>
NMR_INLINE T min3(T a, T b, T c) {
  const T ab = a < b ? a : b;
  return ab < c ? ab : c;
}

template <class T>
NMR_INLINE T max3(T a, T b, T c) {
  const T ab = a > b ? a : b;
  return ab > c ? ab : c;
}

}  // namespace nmr
