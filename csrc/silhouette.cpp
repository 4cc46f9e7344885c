// Coverage, and NMR's gradient: on every raster line that crosses an edge of a visible face, the pixels that would change if the edge
// moved pull its two vertices, each with strength (change of the loss) / (distance to move).
#include <algorithm>
#include <cmath>
#include <vector>

#include "blocks.h"
#include "geometry.h"
#include "lanes.h"
#include "parallel.h"
#include "pull_lines.h"
#include "stages.h"

namespace nmr {

template <class T>
void silhouette_forward(const SilhouetteForward<T>& args) {
  const Size image = args.image, raster = raster_of(image, args.anti_aliasing);
  parallel_for(args.batch, args.num_threads, [&](int64_t b) {
    const int32_t* owner = args.owner + b * raster.pixels();
    T* alpha = args.alpha + b * image.pixels();
    if (!args.anti_aliasing) {
      for (int64_t n = 0; n < image.pixels(); ++n) alpha[n] = owner[n] >= 0 ? T(1) : T(0);
      return;
    }
    for (int64_t y = 0; y < image.height; ++y, alpha += image.width) {
      const int32_t *upper = owner + 2 * y * raster.width, *lower = upper + raster.width;
      for (int64_t x = 0; x < image.width; ++x) {
        const int covered = (lower[2 * x] >= 0) + (lower[2 * x + 1] >= 0) + (upper[2 * x] >= 0) + (upper[2 * x + 1] >= 0);
        alpha[x] = T(0.25) * static_cast<T>(covered);
      }
    }
  });
}

namespace {

template <class T>
struct BackwardScratch {
  PullLines<T> lines[2];       // [0] columns: lines of constant x, swept along y; [1] rows
  VisibleFaces visible;
  FaceGradients<T> gradients;  // of their corners
};

template <class T>
struct RowScratch {
  std::vector<T> grad_row;  // [W + lanes]
};

// How the crossing c of an edge P-Q and a line moves with each end of the edge.
template <class T>
struct Lever {
  T crossing;  // c
  T factor_p;  // 2 / M (Qs - Ps) / (Qs - n): travel of P, in [-1, 1] coordinates, that moves the crossing by one of M pixels
  T factor_q;  // 2 / M (Qs - Ps) / (n - Ps)
  T eps;
};

// How far the end must travel to move the crossing by `offset` pixels; eps keeps it away from zero.
template <class T>
NMR_INLINE T travel(T factor, T offset, T eps) {
  const T h = factor * offset;
  return h > 0 ? h + eps : h - eps;
}

// The pull of one pixel, for pixels inside the face and for levers of extreme size. An end without a finite lever does not move.
template <class T>
NMR_INLINE void pull(T weight, T offset, const Lever<T>& lever, T& grad_p, T& grad_q) {
  if (std::isfinite(lever.factor_p)) grad_p -= weight / travel(lever.factor_p, offset, lever.eps);
  if (std::isfinite(lever.factor_q)) grad_q -= weight / travel(lever.factor_q, offset, lever.eps);
}

// Sums, per lane, the pulls of the listed pixels from `out` on in direction d. The quotients w / h_p and w / h_q share one division:
// w / (h_p h_q) times h_q and h_p.
template <class T>
NMR_INLINE void pull_listed(const T* position, const T* weight, int32_t count, T out, T d, const Lever<T>& lever, Lanes<T>& pulls_p,
                            Lanes<T>& pulls_q) {
  // All offsets have the sign of d, so the signs of both distances are constant.
  const T eps_p = lever.factor_p * d > 0 ? lever.eps : -lever.eps, eps_q = lever.factor_q * d > 0 ? lever.eps : -lever.eps;
  const Lanes<T> aside = splat(out - lever.crossing);  // for unused lanes
  int32_t start = 0;
  if (d > 0)
    while (position[start + kLanes - 1] < out) start += kLanes;
  for (; start < count; start += kLanes) {
    const Lanes<T> m = load_lanes<Lanes<T>>(position + start);
    const LaneMask<T> beyond = (m - out) * d >= T(0);
    const Lanes<T> w = select(beyond, load_lanes<Lanes<T>>(weight + start), splat(T(0)));
    const Lanes<T> offset = select(beyond, m - lever.crossing, aside);
    const Lanes<T> h_p = offset * lever.factor_p + eps_p, h_q = offset * lever.factor_q + eps_q;
    const Lanes<T> share = w / (h_p * h_q);
    pulls_p = pulls_p + share * h_q;
    pulls_q = pulls_q + share * h_p;
    if (d < 0 && position[start + kLanes - 1] >= out) break;
  }
}

// The sweeps of up to eight neighbouring lines that cross an edge P-Q. s is the scan coordinate and t the sweep coordinate, in pixels:
// (s, t) is (x, y) for axis 0 and (y, x) for axis 1.
template <class T>
struct Sweep {
  int32_t face;      // number in the list of visible faces
  int32_t id;        // in the owner map
  int32_t edge;      // 0-2: edges 01, 12, 20 crossed by columns (axis 0); 3-5: the same by rows (axis 1)
  int32_t start;     // the first line
  int32_t outward;   // 1 if outward is towards larger t, else -1
  uint32_t pulled;   // bit: the face owns the inner pixel, and pixels beyond the outer one may pull
  uint32_t gains;    // bit: the outer pixel is background, and inner pixels may gain
  uint32_t regular;  // bit: levers of ordinary size
  T crossing[kLanes], factor_p[kLanes], factor_q[kLanes];
  int32_t inner[kLanes];
};

// The work of one chunk of faces. All lines are prepared before the first is swept, which avoids mispredicted branches.
constexpr int64_t kSweeps = 128;

template <class T>
struct SweepScratch {
  std::vector<Sweep<T>> sweeps;  // [kSweeps + 1]
};

// Corners of a face in pixels, in the vertex order in which it is drawn.
template <class T>
NMR_INLINE void corner_pixels(const SweepImage<T>& image, int32_t id, T* X, T* Y) {
  const bool reversed = id >= image.num_faces;
  const Triangle<T> t = load_triangle(image.vertices, image.faces + 3 * (reversed ? id - image.num_faces : id), reversed);
  for (int k = 0; k < 3; ++k) {
    X[k] = to_pixel(t.x[k], static_cast<T>(image.raster.width));
    Y[k] = to_pixel(t.y[k], static_cast<T>(image.raster.height));
  }
}

// Sweeps one group of lines.
template <class T>
NMR_INLINE void run_sweep(const SweepImage<T>& image, const Sweep<T>& sweep, T* grad) {
  const int64_t H = image.raster.height, W = image.raster.width, d = sweep.outward;
  const int axis = sweep.edge < 3 ? 0 : 1, p = sweep.edge - 3 * axis, q = p < 2 ? p + 1 : 0, o = p > 0 ? p - 1 : 2;
  const PullLines<T>& lines = image.lines[axis];
  T grad_p = 0, grad_q = 0;
  Lanes<T> pulls_p = splat(T(0)), pulls_q = splat(T(0));

  // Outside: pixels from the outer one to the border that should be covered. The loss falls if the edge moves out to them.
  for (uint32_t bits = sweep.pulled; bits; bits &= bits - 1) {
    const int64_t k = lowest_bit(bits), n = sweep.start + k;
    const Lever<T> lever{sweep.crossing[k], sweep.factor_p[k], sweep.factor_q[k], image.eps};
    const T *position = lines.position.data() + n * lines.stride, *weight = lines.weight.data() + n * lines.stride;
    const T outer = static_cast<T>(sweep.inner[k] + d);
    if (sweep.regular >> k & 1) {
      pull_listed(position, weight, lines.count[n], outer, static_cast<T>(d), lever, pulls_p, pulls_q);
    } else {
      for (int32_t m = 0; m < lines.count[n]; ++m)
        if (d > 0 ? position[m] >= outer : position[m] <= outer)
          pull(weight[m], position[m] - lever.crossing, lever, grad_p, grad_q);
    }
  }
  grad_p -= sum_lanes(pulls_p);
  grad_q -= sum_lanes(pulls_q);

  // Inside: pixels of the face that should be background. The loss falls if the edge moves in past them.
  if (sweep.gains) {
    T X[3], Y[3];
    corner_pixels(image, sweep.id, X, Y);
    const T *s = axis == 0 ? X : Y, *t = axis == 0 ? Y : X;
    for (uint32_t bits = sweep.gains; bits; bits &= bits - 1) {
      const int64_t k = lowest_bit(bits), n = sweep.start + k, inner = sweep.inner[k];
      // pixel m of line n: owner[m * step]
      const int32_t* owner = axis == 0 ? image.owner + (H - 1) * W + n : image.owner + (H - 1 - n) * W;
      const int64_t step = axis == 0 ? -W : 1, length = axis == 0 ? H : W;
      const Lever<T> lever{sweep.crossing[k], sweep.factor_p[k], sweep.factor_q[k], image.eps};
      const T line = static_cast<T>(n);
      const int end = (line - s[p]) * (line - s[o]) < 0 ? p : q;
      const T far_side = line_height(s[end], t[end], s[o], t[o], line);
      const int64_t limit = sweep_limit(far_side, d, length);
      const int64_t m_first = std::max<int64_t>(std::min(inner, limit), 0), m_last = std::min(std::max(inner, limit), length - 1);
      for (int64_t m = m_first; m <= m_last; ++m) {
        if (owner[m * step] != sweep.id) continue;
        const T g = axis == 0 ? image.grad(n, m) : image.grad(m, n);
        if (g > 0) pull(g, static_cast<T>(m) - lever.crossing, lever, grad_p, grad_q);
      }
    }
  }
  // axis 0 moves y, axis 1 moves x
  grad[9 * sweep.face + 3 * p + 1 - axis] += grad_p;
  grad[9 * sweep.face + 3 * q + 1 - axis] += grad_q;
}

template <class T>
NMR_INLINE void run_sweeps(const SweepImage<T>& image, const Sweep<T>* sweeps, int64_t count, T* grad) {
  for (int64_t n = 0; n < count; ++n) run_sweep(image, sweeps[n], grad);
}

// Prepares the sweeps of one face, and runs all prepared sweeps when the scratch is full. Returns how many are prepared.
template <class T>
NMR_INLINE int64_t prepare_face(const SweepImage<T>& image, int32_t face, int32_t id, Sweep<T>* sweeps, int64_t count, T* grad) {
  const int64_t H = image.raster.height, W = image.raster.width;
  const T height = static_cast<T>(H), width = static_cast<T>(W);
  T X[3], Y[3];
  corner_pixels(image, id, X, Y);
  // All six crossings of edges and axes, one per lane; lanes 6 and 7 repeat.
  const Lanes<T> ps{X[0], X[1], X[2], Y[0], Y[1], Y[2], X[0], X[0]}, pt{Y[0], Y[1], Y[2], X[0], X[1], X[2], Y[0], Y[0]};
  const Lanes<T> qs{X[1], X[2], X[0], Y[1], Y[2], Y[0], X[1], X[1]}, qt{Y[1], Y[2], Y[0], X[1], X[2], X[0], Y[1], Y[1]};
  const Lanes<T> top{width - 1, width - 1, width - 1, height - 1, height - 1, height - 1, width - 1, width - 1};  // the last line
  const Lanes<T> length{height, height, height, width, width, width, height, height};  // of a line
  const LaneMask<T> ascending = ps < qs;
  const Lanes<T> least = select(ascending, ps, qs), most = select(ascending, qs, ps);
  const Lanes<T> low = select(least > T(0), least, splat(T(0))), high = select(most < top, most, top);
  // Edges parallel to the scan line (least == most) are left out: neither end can move a crossing.
  const LaneMask<T> in_reach = (least < most) & (low <= top) & (high > T(-1));
  const Lanes<T> from = select(in_reach, low, splat(T(1))), to = select(in_reach, high, splat(T(0)));
  Lanes<T> first = to_values<T>(truncate(from));
  first = select(first < from, first + T(1), first);
  // Truncation towards zero, as published: an edge that ends in (-1, 0) is extrapolated to line 0.
  const Lanes<T> last = to_values<T>(truncate(to));
  T ps_at[kLanes], pt_at[kLanes], qs_at[kLanes], slope_at[kLanes], scale_at[kLanes];
  int32_t first_at[kLanes], last_at[kLanes];
  store_lanes(ps_at, ps);
  store_lanes(pt_at, pt);
  store_lanes(qs_at, qs);
  store_lanes(slope_at, (qt - pt) / (qs - ps));
  store_lanes(scale_at, (qs - ps) * T(2) / length);
  store_lanes(first_at, truncate(first));
  store_lanes(last_at, truncate(last));
  const uint32_t outward_up = lane_bits(ascending) ^ 0x07;

  // A crossing lies between two pixels of its line.
  const uint32_t usable = (H > 1 ? 0x07 : 0) | (W > 1 ? 0x38 : 0);
  for (uint32_t bits = lane_bits(first <= last) & usable; bits; bits &= bits - 1) {
    const int64_t e = lowest_bit(bits);
    const bool by_columns = e < 3;
    const PullLines<T>& lines = image.lines[by_columns ? 0 : 1];
    const int32_t d = outward_up >> e & 1 ? 1 : -1;
    // pixel m of line n: origin[n * step_s + m * step_t]
    const int32_t* origin = image.owner + (H - 1) * W;
    const int32_t step_s = by_columns ? 1 : static_cast<int32_t>(-W), step_t = by_columns ? static_cast<int32_t>(-W) : 1;
    const T end = by_columns ? height - 1 : width - 1;  // the last pixel of a line
    const T direction = static_cast<T>(d);
    const T* pulls = d > 0 ? lines.last.data() : lines.first.data();
    const T* gains = d > 0 ? lines.gain_first.data() : lines.gain_last.data();
    for (int32_t start = first_at[e]; start <= last_at[e]; start += kLanes) {
      const Lanes32 number = lane_numbers() + start, last_number = splat32(last_at[e]);
      const Lanes<T> line = to_values<T>(number);
      const Lanes<T> crossing = (line - ps_at[e]) * slope_at[e] + pt_at[e];
      const LaneMask<T> on_screen = widen_mask<T>(number <= last_number) & (crossing >= T(-1)) & (crossing <= end + 1);
      // The pixel on the inner side: floor(c) if outward is up, else ceil(c) = -floor(-c).
      const Lanes<T> rising = select(on_screen, crossing * direction, splat(T(0)));
      Lanes<T> in = to_values<T>(truncate(rising));
      in = select(in > rising, in - T(1), in) * direction;
      const Lanes<T> out = in + direction;
      const LaneMask<T> valid = on_screen & (in >= T(0)) & (in <= end) & (out >= T(0)) & (out <= end);
      const LaneMask<T> pulled = (load_lanes<Lanes<T>>(pulls + start) - out) * direction >= T(0);
      const LaneMask<T> gained = (load_lanes<Lanes<T>>(gains + start) - in) * direction <= T(0);
      // Owners of the pixels on both sides; unused lanes read a pixel of the last line.
      const Lanes32 inner = truncate(select(valid, in, splat(d > 0 ? T(0) : T(1))));
      int32_t offset[kLanes];
      store_lanes(offset, select(number < last_number, number, last_number) * step_s + inner * step_t);
      const Lanes32 inner_owner = gather_lanes(origin, offset), outer_owner = gather_lanes(origin + d * step_t, offset);
      const Lanes<T> factor_p = scale_at[e] / (qs_at[e] - line), factor_q = scale_at[e] / (line - ps_at[e]);
      const T largest = image.largest_lever;

      Sweep<T>& sweep = sweeps[count];
      sweep.face = face;
      sweep.id = id;
      sweep.edge = static_cast<int32_t>(e);
      sweep.start = start;
      sweep.outward = d;
      sweep.pulled = lane_bits(narrow_mask(valid & pulled) & (inner_owner >= id) & (inner_owner <= id));
      sweep.gains = lane_bits(narrow_mask(valid & gained) & (outer_owner < 0));
      sweep.regular = lane_bits((factor_p < largest) & (factor_p > -largest) & (factor_q < largest) & (factor_q > -largest));
      store_lanes(sweep.crossing, crossing);
      store_lanes(sweep.factor_p, factor_p);
      store_lanes(sweep.factor_q, factor_q);
      store_lanes(sweep.inner, inner);
      count += (sweep.pulled | sweep.gains) != 0;
      if (count == kSweeps) {
        run_sweeps(image, sweeps, count, grad);
        count = 0;
      }
    }
  }
  return count;
}

// Gradients [3, 3] of the corners of visible faces [first, last) of the list, in the order in which they are drawn.
template <class T>
NMR_INLINE void sweep_faces(const SweepImage<T>& image, const int32_t* ids, int64_t first, int64_t last, Sweep<T>* sweeps, T* grad) {
  std::fill_n(grad + 9 * first, 9 * (last - first), T(0));
  int64_t count = 0;
  for (int64_t n = first; n < last; ++n) count = prepare_face(image, static_cast<int32_t>(n), ids[n], sweeps, count, grad);
  run_sweeps(image, sweeps, count, grad);
}

NMR_CLONES void collect(const SweepImage<float>& image, const LineRange& range, float* grad_row) {
  collect_lines(image, range, grad_row);
}
NMR_CLONES void collect(const SweepImage<double>& image, const LineRange& range, double* grad_row) {
  collect_lines(image, range, grad_row);
}
NMR_CLONES void sweep(const SweepImage<float>& image, const int32_t* ids, int64_t first, int64_t last, Sweep<float>* sweeps,
                      float* grad) {
  sweep_faces(image, ids, first, last, sweeps, grad);
}
NMR_CLONES void sweep(const SweepImage<double>& image, const int32_t* ids, int64_t first, int64_t last, Sweep<double>* sweeps,
                      double* grad) {
  sweep_faces(image, ids, first, last, sweeps, grad);
}

// The faces that own a pixel. All others have gradient 0.
NMR_CLONES void find_visible(const int32_t* owner, int64_t pixels, int64_t num_faces, VisibleFaces& visible) {
  visible.find(owner, pixels, num_faces);
}

}  // namespace

template <class T>
void silhouette_backward(const SilhouetteBackward<T>& args) {
  const Size raster = raster_of(args.image, args.anti_aliasing);
  const int64_t H = raster.height, W = raster.width, batch = args.mesh.batch;
  // Many images: one thread per image. Few images: all threads share one image at a time.
  const bool share = batch < args.num_threads;
  const int threads = share ? args.num_threads : 1;
  parallel_for(batch, share ? 1 : args.num_threads, [&](int64_t b) {
    BackwardScratch<T>& scratch = thread_scratch<BackwardScratch<T>>();
    const SweepImage<T> image{args.mesh.image_vertices(b), args.mesh.image_faces(b), args.mesh.face_count(b), raster,
                              args.image, args.anti_aliasing, args.eps, args.owner + b * raster.pixels(),
                              args.grad_alpha + b * args.image.pixels(), scratch.lines, args.eps > T(1e-15) ? T(1e15) : T(0)};
    scratch.lines[0].reserve_lines(W, H);
    scratch.lines[1].reserve_lines(H, W);
    // Shared image: bands of columns, then bands of rows. Bands consist of whole vectors, so that no two threads write the same vector.
    const int64_t longer = std::max(H, W), band = share ? std::max<int64_t>(longer / threads / kLanes * kLanes, 64) : longer;
    const int64_t column_bands = (W + band - 1) / band, row_bands = (H + band - 1) / band;
    parallel_for(share ? column_bands + row_bands : 1, threads, [&](int64_t n) {
      T* grad_row = reserve(thread_scratch<RowScratch<T>>().grad_row, W + kLanes);
      const auto part = [band](int64_t k, int64_t lines) { return std::min(k * band, lines); };
      const int64_t k = n - column_bands;  // number of a band of rows
      const LineRange range = !share ? LineRange{0, H, 0, W}
                              : k < 0 ? LineRange{0, 0, part(n, W), part(n + 1, W)}
                                      : LineRange{part(k, H), part(k + 1, H), 0, 0};
      collect(image, range, grad_row);
    });
    VisibleFaces& visible = scratch.visible;
    visible.reserve_for(image.num_faces, std::min(2 * image.num_faces, raster.pixels()));
    find_visible(image.owner, raster.pixels(), image.num_faces, visible);
    FaceGradients<T>& gradients = scratch.gradients;
    gradients.count = visible.count - 1;
    gradients.ids.assign(visible.ids.begin() + 1, visible.ids.begin() + visible.count);
    T* grad = reserve(gradients.values, 9 * gradients.count);
    const int64_t chunk = share ? 256 : std::max<int64_t>(gradients.count, 1);
    parallel_for((gradients.count + chunk - 1) / chunk, threads, [&](int64_t n) {
      Sweep<T>* sweeps = reserve(thread_scratch<SweepScratch<T>>().sweeps, kSweeps + 1);
      sweep(image, gradients.ids.data(), n * chunk, std::min((n + 1) * chunk, gradients.count), sweeps, grad);
    });
    T* grad_vertices = args.grad_vertices + 3 * args.mesh.vertex_start(b);
    std::fill_n(grad_vertices, 3 * args.mesh.vertex_count(b), T(0));
    scatter_face_gradients(gradients, image.faces, image.num_faces, grad_vertices);
  });
}

template void silhouette_forward(const SilhouetteForward<float>&);
template void silhouette_forward(const SilhouetteForward<double>&);
template void silhouette_backward(const SilhouetteBackward<float>&);
template void silhouette_backward(const SilhouetteBackward<double>&);

}  // namespace nmr
