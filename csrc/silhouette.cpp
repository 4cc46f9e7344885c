// Coverage, and NMR's gradient of it: for every edge of a visible face and every raster line that crosses it, pixels that
// would change if the edge moved pull on its two vertices, each with strength (change of the loss) / (distance to move).
#include <algorithm>
#include <cmath>

#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

template <class T>
void silhouette_forward(const SilhouetteForward<T>& args) {
  const int64_t S = args.image_size, R = args.anti_aliasing ? 2 * S : S;
  parallel_for(args.batch, args.num_threads, [&](int64_t b) {
    const int32_t* owner = args.owner + b * R * R;
    T* alpha = args.alpha + b * S * S;
    if (!args.anti_aliasing) {
      for (int64_t n = 0; n < S * S; ++n) alpha[n] = owner[n] >= 0 ? T(1) : T(0);
      return;
    }
    for (int64_t y = 0; y < S; ++y, alpha += S) {
      const int32_t *upper = owner + 2 * y * R, *lower = upper + R;
      for (int64_t x = 0; x < S; ++x) {
        const int covered = (lower[2 * x] >= 0) + (lower[2 * x + 1] >= 0) + (upper[2 * x] >= 0) + (upper[2 * x + 1] >= 0);
        alpha[x] = T(0.25) * static_cast<T>(covered);
      }
    }
  });
}

namespace {

constexpr int64_t kLanes = 8;

// Background pixels that the loss wants covered (gradient < 0), line by line in ascending order.
template <class T>
struct PullList {
  std::vector<T> position;     // [R, R + lanes] coordinate along the line
  std::vector<T> weight;       // [R, R + lanes] minus the pixel's gradient, > 0
  std::vector<int32_t> before; // [R, R + 1] how many listed pixels of the line lie before each pixel
};

template <class T>
struct BackwardScratch {
  PullList<T> lists[2];          // [0] columns: lines of constant x, swept along y; [1] rows
  std::vector<uint8_t> visible;  // [2 F] face owns a pixel
};

// What the sweeps read of one image.
template <class T>
struct SweepImage {
  int64_t R, S;
  bool anti_aliasing;
  T eps;
  const int32_t* owner;  // row 0 = top; pixel (column i, row j from the bottom) is owner[(R - 1 - j) R + i]
  const T* grad_alpha;
  const PullList<T>* lists;

  // Gradient of raster pixel (column i, row j): the image is flipped, and a 2x2 mean shares its gradient in quarters.
  NMR_INLINE T grad(int64_t i, int64_t j) const {
    return anti_aliasing ? grad_alpha[(S - 1 - j / 2) * S + i / 2] / 4 : grad_alpha[(S - 1 - j) * S + i];
  }
};

template <class T>
NMR_INLINE void build_pull_lists(const SweepImage<T>& image, PullList<T>* lists) {
  const int64_t R = image.R, stride = R + kLanes;
  for (int a = 0; a < 2; ++a) {
    reserve(lists[a].position, R * stride);
    reserve(lists[a].weight, R * stride);
    reserve(lists[a].before, R * (R + 1));
  }
  PullList<T>&columns = lists[0], &rows = lists[1];
  int32_t* before_row = rows.before.data();
  for (int64_t i = 0; i < R; ++i) columns.before[i * (R + 1)] = 0;
  for (int64_t j = 0; j < R; ++j, before_row += R + 1) {
    const int32_t* owner = image.owner + (R - 1 - j) * R;
    int32_t count = 0;
    for (int64_t i = 0; i < R; ++i) {
      before_row[i] = count;
      int32_t* before_column = columns.before.data() + i * (R + 1) + j;
      int32_t column_count = *before_column;
      if (owner[i] < 0) {
        const T g = image.grad(i, j);
        if (g < 0) {
          rows.position[j * stride + count] = static_cast<T>(i);
          rows.weight[j * stride + count++] = -g;
          columns.position[i * stride + column_count] = static_cast<T>(j);
          columns.weight[i * stride + column_count++] = -g;
        }
      }
      before_column[1] = column_count;
    }
    before_row[R] = count;
  }
}

// How an edge P-Q, crossed at t = c by the current line, moves with each of its ends.
template <class T>
struct Lever {
  T crossing;         // c
  T factor_p;         // (Qs - Ps) / (Qs - n): travel of P that moves the crossing by one
  T factor_q;         // (Qs - Ps) / (n - Ps)
  bool p_acts, q_acts;  // false where the line passes through the other end, or the factor overflows
  T raster_size, eps;
};

// Travel in [-1, 1] coordinates that brings the crossing to pixel m, kept away from zero by eps.
template <class T, bool kPowerOfTwo>
NMR_INLINE T travel(T factor, T offset, const Lever<T>& lever) {
  const T h = kPowerOfTwo ? factor * offset * (2 / lever.raster_size) : factor * offset * 2 / lever.raster_size;
  return h + (h > 0 ? lever.eps : -lever.eps);
}

// Adds the pulls of listed pixels [first, last), one after the other: the order of summation is fixed.
template <class T, bool kPowerOfTwo>
NMR_INLINE void pull_listed(const T* position, const T* weight, int32_t count, const Lever<T>& lever, T& grad_p, T& grad_q) {
  T p = grad_p, q = grad_q;
  for (int32_t start = 0; start < count; start += kLanes) {
    T pull_p[kLanes], pull_q[kLanes];
    for (int32_t k = 0; k < kLanes; ++k) {
      const T offset = position[start + k] - lever.crossing;
      pull_p[k] = weight[start + k] / travel<T, kPowerOfTwo>(lever.factor_p, offset, lever);
      pull_q[k] = weight[start + k] / travel<T, kPowerOfTwo>(lever.factor_q, offset, lever);
    }
    const int32_t lanes = std::min<int32_t>(kLanes, count - start);
    for (int32_t k = 0; k < lanes; ++k) {
      p -= pull_p[k];
      q -= pull_q[k];
    }
  }
  if (lever.p_acts) grad_p = p;
  if (lever.q_acts) grad_q = q;
}

// Float to int as the published kernels convert: truncated, saturated to the pixel range [lo, hi], NaN to 0.
template <class T>
NMR_INLINE int64_t to_index(T t, int64_t lo, int64_t hi) {
  if (!(t == t)) return 0;
  if (t <= static_cast<T>(lo)) return lo;
  if (t >= static_cast<T>(hi)) return hi;
  return static_cast<int64_t>(t);
}

// Height of the infinite line A-B over the scan coordinate n.
template <class T>
NMR_INLINE T line_height(T as, T at, T bs, T bt, T n) {
  return (bt - at) / (bs - as) * (n - as) + at;
}

// Both sweeps of edge P-Q (O is the third corner) along one axis. s is the scan coordinate, t the sweep coordinate: (x, y) for
// axis 0, (y, x) for axis 1, all in pixels.
template <class T, bool kPowerOfTwo>
NMR_INLINE void sweep_edge(const SweepImage<T>& image, int axis, int32_t id, T ps, T pt, T qs, T qt, T os, T ot, T& grad_p,
                           T& grad_q) {
  if (ps == qs) return;  // the edge lies along the scan line: neither end can move its crossing
  const int64_t R = image.R, stride = R + kLanes;
  const T top = static_cast<T>(R - 1);
  const int64_t d = ((ps < qs) == (axis == 0)) ? -1 : 1;  // outward
  const T low = std::max(std::min(ps, qs), T(0)), high = std::min(std::max(ps, qs), top);
  if (!(low <= top)) return;
  const int64_t n_first = static_cast<int64_t>(std::ceil(low));
  // Truncation towards zero, as published: an edge that ends in (-1, 0) is extrapolated onto line 0.
  const int64_t n_last = high > -1 ? static_cast<int64_t>(high) : -1;
  const T slope = (qt - pt) / (qs - ps);
  const PullList<T>& list = image.lists[axis];
  // pixel m of line n: owner[n * step_s + m * step_t]
  const int32_t* origin = image.owner + (R - 1) * R;
  const int64_t step_s = axis == 0 ? 1 : -R, step_t = axis == 0 ? -R : 1;

  for (int64_t n = n_first; n <= n_last; ++n) {
    const T line = static_cast<T>(n);
    Lever<T> lever;
    lever.crossing = slope * (line - ps) + pt;
    const T rounded = d > 0 ? std::floor(lever.crossing) : std::ceil(lever.crossing);
    if (!(rounded >= 0 && rounded <= top)) continue;  // also NaN
    const int64_t in = static_cast<int64_t>(rounded), out = in + d;
    if (out < 0 || out >= R) continue;

    const int32_t* owner = origin + n * step_s;
    const bool owns_in = owner[in * step_t] == id;
    const bool out_is_background = owner[out * step_t] < 0;
    if (!owns_in && !out_is_background) continue;

    lever.factor_p = (qs - ps) / (qs - line);
    lever.factor_q = (qs - ps) / (line - ps);
    lever.p_acts = std::isfinite(lever.factor_p);
    lever.q_acts = std::isfinite(lever.factor_q);
    lever.raster_size = static_cast<T>(R);
    lever.eps = image.eps;

    // Outside: pixels from `out` to the border that should be covered. They gain if the edge moves out to them.
    if (owns_in) {
      const int32_t* before = list.before.data() + n * (R + 1);
      const int32_t first = d > 0 ? before[out] : 0;
      const int32_t last = d > 0 ? before[R] : before[out + 1];
      if (last > first)
        pull_listed<T, kPowerOfTwo>(list.position.data() + n * stride + first, list.weight.data() + n * stride + first,
                                    last - first, lever, grad_p, grad_q);
    }
    // Inside: own pixels that should be background. They gain if the edge moves in past them.
    if (out_is_background) {
      const bool beyond_p = (line - ps) * (line - os) < 0;
      const T far_side = beyond_p ? line_height(ps, pt, os, ot, line) : line_height(qs, qt, os, ot, line);
      const int64_t limit = to_index(d > 0 ? std::ceil(far_side) : std::floor(far_side), int64_t(-1), R);
      const int64_t m_first = std::max<int64_t>(std::min(in, limit), 0), m_last = std::min(std::max(in, limit), R - 1);
      for (int64_t m = m_first; m <= m_last; ++m) {
        if (owner[m * step_t] != id) continue;
        const T g = axis == 0 ? image.grad(n, m) : image.grad(m, n);
        if (!(g > 0)) continue;
        const T offset = static_cast<T>(m) - lever.crossing;
        if (lever.p_acts) grad_p -= g / travel<T, kPowerOfTwo>(lever.factor_p, offset, lever);
        if (lever.q_acts) grad_q -= g / travel<T, kPowerOfTwo>(lever.factor_q, offset, lever);
      }
    }
  }
}

template <class T, bool kPowerOfTwo>
NMR_INLINE void backward_image(const SilhouetteBackward<T>& args, int64_t b) {
  const int64_t S = args.image_size, R = args.anti_aliasing ? 2 * S : S;
  const int64_t F = args.mesh.face_count(b), V = args.mesh.vertex_count(b);
  const T* vertices = args.mesh.image_vertices(b);
  const int64_t* faces = args.mesh.image_faces(b);
  T* grad_vertices = args.grad_vertices + 3 * args.mesh.vertex_start(b);
  BackwardScratch<T>& scratch = thread_scratch<BackwardScratch<T>>();

  SweepImage<T> image{R, S, args.anti_aliasing, args.eps, args.owner + b * R * R, args.grad_alpha + b * S * S,
                      scratch.lists};
  std::fill_n(grad_vertices, 3 * V, T(0));
  build_pull_lists(image, scratch.lists);

  // A face that owns no pixel gets exactly zero.
  uint8_t* visible = reserve(scratch.visible, 2 * F);
  std::fill_n(visible, 2 * F, uint8_t(0));
  for (int64_t n = 0; n < R * R; ++n)
    if (image.owner[n] >= 0) visible[image.owner[n]] = 1;

  for (int64_t id = 0; id < 2 * F; ++id) {
    if (!visible[id]) continue;
    const bool reversed = id >= F;
    const int64_t* face = faces + 3 * (reversed ? id - F : id);
    const Triangle<T> t = load_triangle(vertices, face, reversed);
    T X[3], Y[3], grad_x[3] = {0, 0, 0}, grad_y[3] = {0, 0, 0};
    for (int k = 0; k < 3; ++k) {
      X[k] = to_pixel(t.x[k], static_cast<T>(R));
      Y[k] = to_pixel(t.y[k], static_cast<T>(R));
    }
    for (int p = 0; p < 3; ++p) {
      const int q = (p + 1) % 3, o = (p + 2) % 3;
      sweep_edge<T, kPowerOfTwo>(image, 0, static_cast<int32_t>(id), X[p], Y[p], X[q], Y[q], X[o], Y[o], grad_y[p], grad_y[q]);
      sweep_edge<T, kPowerOfTwo>(image, 1, static_cast<int32_t>(id), Y[p], X[p], Y[q], X[q], Y[o], X[o], grad_x[p], grad_x[q]);
    }
    for (int k = 0; k < 3; ++k) {
      T* grad = grad_vertices + 3 * face[reversed ? 2 - k : k];
      grad[0] += grad_x[k];
      grad[1] += grad_y[k];
    }
  }
}

template <class T>
NMR_INLINE void backward_image_body(const SilhouetteBackward<T>& args, int64_t b) {
  const int64_t R = args.anti_aliasing ? 2 * args.image_size : args.image_size;
  // Multiplying by 2 / R is exact when R is a power of two; otherwise the division is kept.
  if ((R & (R - 1)) == 0)
    backward_image<T, true>(args, b);
  else
    backward_image<T, false>(args, b);
}

NMR_CLONES void silhouette_backward_image(const SilhouetteBackward<float>& args, int64_t b) { backward_image_body(args, b); }
NMR_CLONES void silhouette_backward_image(const SilhouetteBackward<double>& args, int64_t b) { backward_image_body(args, b); }

}  // namespace

template <class T>
void silhouette_backward(const SilhouetteBackward<T>& args) {
  parallel_for(args.mesh.batch, args.num_threads, [&](int64_t b) { silhouette_backward_image(args, b); });
}

template void silhouette_forward(const SilhouetteForward<float>&);
template void silhouette_forward(const SilhouetteForward<double>&);
template void silhouette_backward(const SilhouetteBackward<float>&);
template void silhouette_backward(const SilhouetteBackward<double>&);

}  // namespace nmr
