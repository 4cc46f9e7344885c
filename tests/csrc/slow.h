// The definition of docs/conventions.md, slow and plain: every face at every pixel, every sweep over every pixel of its line.
// One image, whole-raster arrays with row 0 at the top as in csrc/stages.h.
#pragma once

#include <algorithm>
#include <cmath>

#include "scene.h"

namespace nmr::test {

// What one face gives at one pixel.
template <class T>
struct SlowHit {
  bool inside = false;
  T weights[3] = {0, 0, 0};  // clamped, normalised, in the order in which the face is drawn; not perspective-correct
  T depth = 0;
};

template <class T>
struct SlowFace {
  T x[3], y[3], z[3];
  bool drawn;

  // Face id of [0, 2F): f, or F + f for the reversed copy of f.
  SlowFace(const Scene<T>& scene, int64_t b, int64_t id) {
    const MeshBatch<T> mesh = scene.mesh();
    const int64_t F = mesh.face_count(b);
    bool usable = true;
    for (int k = 0; k < 3; ++k) {
      const T* v = mesh.image_vertices(b) + 3 * mesh.image_faces(b)[3 * (id % F) + (id < F ? k : 2 - k)];
      x[k] = v[0], y[k] = v[1], z[k] = v[2];
      usable = usable && std::isfinite(v[0]) && std::isfinite(v[1]) && !std::isnan(v[2]);
    }
    const double x0 = x[0], y0 = y[0];
    const bool flat = (x[1] - x0) * (y[2] - y0) == (y[1] - y0) * (x[2] - x0);
    drawn = usable && !flat && !((y[2] - y[0]) * (x[1] - x[0]) < (y[1] - y[0]) * (x[2] - x[0]));
  }

  SlowHit<T> at(int64_t column, int64_t row_from_bottom, Size raster) const {
    const int64_t H = raster.height, W = raster.width;
    SlowHit<T> hit;
    const T px = T(2 * column + 1 - W) / T(W), py = T(2 * row_from_bottom + 1 - H) / T(H);
    hit.inside = drawn && px >= std::min({x[0], x[1], x[2]}) && px <= std::max({x[0], x[1], x[2]}) &&
                 py >= std::min({y[0], y[1], y[2]}) && py <= std::max({y[0], y[1], y[2]});
    for (int a = 0; a < 3 && hit.inside; ++a) {
      const int b = (a + 1) % 3;
      hit.inside = !((py - y[a]) * (x[b] - x[a]) < (px - x[a]) * (y[b] - y[a]));
    }
    if (!hit.inside) return hit;
    T X[3], Y[3], sum = 0, inverse = 0;
    for (int k = 0; k < 3; ++k) X[k] = (x[k] * T(W) + T(W) - 1) / 2, Y[k] = (y[k] * T(H) + T(H) - 1) / 2;
    const T det = X[2] * (Y[0] - Y[1]) + X[0] * (Y[1] - Y[2]) + X[1] * (Y[2] - Y[0]);
    for (int k = 0; k < 3; ++k) {
      const int a = (k + 1) % 3, b = (k + 2) % 3;
      const T w = (Y[a] - Y[b]) / det * T(column) + (X[b] - X[a]) / det * T(row_from_bottom) + (X[a] * Y[b] - X[b] * Y[a]) / det;
      hit.weights[k] = w > 0 ? std::min(w, T(1)) : T(0);
      sum += hit.weights[k];
    }
    for (int k = 0; k < 3; ++k) {
      hit.weights[k] /= sum;
      inverse += hit.weights[k] / z[k];
    }
    hit.depth = 1 / inverse;
    return hit;
  }
};

// Face index and depth of every pixel of image b.
template <class T>
void slow_rasterize(const Scene<T>& scene, int64_t b, std::vector<int32_t>& face_index, std::vector<T>& depth) {
  const Size raster = scene.raster();
  const int64_t H = raster.height, W = raster.width, F = scene.mesh().face_count(b);
  face_index.assign(H * W, -1);
  depth.assign(H * W, scene.far);
  for (int64_t id = 0; id < (scene.fill_back ? 2 * F : F); ++id) {
    const SlowFace<T> face(scene, b, id);
    for (int64_t n = 0; n < H * W; ++n) {
      const SlowHit<T> hit = face.at(n % W, H - 1 - n / W, raster);
      if (!hit.inside || !(hit.depth > scene.near) || !(hit.depth < depth[n])) continue;
      depth[n] = hit.depth;
      face_index[n] = static_cast<int32_t>(id);
    }
  }
}

// Float to int as in the definition: truncated, saturated, NaN to 0.
template <class T>
int64_t slow_index(T t, int64_t length) {
  return std::isnan(t) ? 0 : static_cast<int64_t>(std::min(std::max(t, T(-1)), T(length)));
}

// NMR's gradient of an image [H, W, C] with respect to vertices; added to grad [V, 3].
template <class T>
void slow_edge_gradient(const Scene<T>& scene, int64_t b, const int32_t* face_index, const T* image, const T* grad_image,
                        int64_t channels, T* grad) {
  const int64_t H = scene.raster().height, W = scene.raster().width, F = scene.mesh().face_count(b);
  for (int64_t id = 0; id < 2 * F; ++id) {
    if (std::find(face_index, face_index + H * W, static_cast<int32_t>(id)) == face_index + H * W) continue;
    const SlowFace<T> face(scene, b, id);
    const int64_t* corner = scene.mesh().image_faces(b) + 3 * (id % F);
    for (int axis = 0; axis < 2; ++axis)
      for (int p = 0; p < 3; ++p) {
        const int q = (p + 1) % 3, o = (p + 2) % 3;
        const int64_t N = axis == 0 ? W : H, M = axis == 0 ? H : W;  // N lines of M pixels
        // scan coordinate s, sweep coordinate t, in pixels
        const auto s = [&](int k) { return ((axis == 0 ? face.x[k] : face.y[k]) * T(N) + T(N) - 1) / 2; };
        const auto t = [&](int k) { return ((axis == 0 ? face.y[k] : face.x[k]) * T(M) + T(M) - 1) / 2; };
        const auto pixel = [&](int64_t n, int64_t m) { return axis == 0 ? (H - 1 - m) * W + n : (H - 1 - n) * W + m; };
        const T ps = s(p), pt = t(p), qs = s(q), qt = t(q), os = s(o), ot = t(o);
        const int64_t d = (ps < qs) == (axis == 0) ? -1 : 1;
        const auto gain = [&](int64_t m, int64_t reference) {  // how much the loss falls if pixel m takes the reference's value
          T sum = 0;
          for (int64_t c = 0; c < channels; ++c) sum += (image[m * channels + c] - image[reference * channels + c]) * grad_image[m * channels + c];
          return sum;
        };
        for (int64_t n = 0; n < N; ++n) {
          const T line = T(n);
          // n runs to trunc(max(ps, qs)): an edge that ends in (-1, 0) is extrapolated onto line 0
          const T high = std::max(ps, qs);
          if (ps == qs || line < std::min(ps, qs) || high <= -1 || n > static_cast<int64_t>(std::min(high, T(N)))) continue;
          const T crossing = (qt - pt) / (qs - ps) * (line - ps) + pt;
          if (!(crossing > -2 && crossing < T(M) + 1)) continue;
          const int64_t in = static_cast<int64_t>(d > 0 ? std::floor(crossing) : std::ceil(crossing)), out = in + d;
          if (std::min(in, out) < 0 || std::max(in, out) > M - 1) continue;
          const T far_side = (line - ps) * (line - os) < 0 ? (ot - pt) / (os - ps) * (line - ps) + pt
                                                           : (ot - qt) / (os - qs) * (line - qs) + qt;
          const int64_t limit = slow_index(d > 0 ? std::ceil(far_side) : std::floor(far_side), M);
          const auto deposit = [&](int64_t m, T strength) {
            if (!(strength > 0)) return;
            const T move_p = (qs - ps) / (qs - line) * (T(m) - crossing) * 2 / T(M);
            const T move_q = (qs - ps) / (line - ps) * (T(m) - crossing) * 2 / T(M);
            const auto end = [&](int k) -> T& { return grad[3 * corner[id < F ? k : 2 - k] + (axis == 0 ? 1 : 0)]; };
            if (qs != line) end(p) -= strength / (move_p + (move_p > 0 ? scene.eps : -scene.eps));
            if (ps != line) end(q) -= strength / (move_q + (move_q > 0 ? scene.eps : -scene.eps));
          };
          if (face_index[pixel(n, in)] == id)
            for (int64_t m = out; m >= 0 && m < M; m += d) deposit(m, gain(pixel(n, m), pixel(n, in)));
          for (int64_t m = std::max<int64_t>(0, std::min(in, limit)); m <= std::min(M - 1, std::max(in, limit)); ++m)
            if (face_index[pixel(n, m)] == id) deposit(m, gain(pixel(n, m), pixel(n, out)));
        }
      }
  }
}

}  // namespace nmr::test
