// The inner loops of NMR's gradient (edge_gradient.cpp).
#include "edge_lines.h"
#include "level_lanes.h"

namespace nmr::NMR_LEVEL {
namespace {

// Whether all values are finite: only then is the sum of their products with 0 a number.
template <class T>
bool all_finite(const T* values, int64_t count) {
  Lanes<T> zeros = splat(T(0));
  int64_t n = 0;
  for (; n + kLanes <= count; n += kLanes)
    zeros = zeros + load_lanes<Lanes<T>>(values + n) * splat(T(0));
  T zero = 0;
  for (; n < count; ++n) zero += values[n] * T(0);
  return zero == T(0) && lane_bits(zeros == splat(T(0))) == 0xff;
}

constexpr int64_t kVectors = 4;  // of runs, whose crossings are found before their pulls

// --- lines

constexpr int64_t kRowsAhead = 4 * kLanes;  // processors foresee no columns of a large image

// Row c of `to` gets column c of an array whose rows are `step` values apart; a negative step turns
// it upside down. Vectors must not reach beyond `end`. Writes up to kLanes - 1 more values to each
// row of `to`.
template <class E>
NMR_INLINE void transpose(const E* from, int64_t rows, int64_t step, int64_t columns, const E* end,
                          E* to, int64_t stride) {
  for (int64_t j = 0; j < rows; j += kLanes) {
    const E* row[kLanes];
    for (int64_t k = 0; k < kLanes; ++k) {
      row[k] = from + std::min(j + k, rows - 1) * step;
      __builtin_prefetch(from + std::min(j + k + kRowsAhead, rows - 1) * step);
    }
    const E* last = std::max(row[0], row[kLanes - 1]);
    for (int64_t i = 0; i < columns; i += 4) {
      const int64_t count = std::min<int64_t>(4, columns - i);
      if (end - last >= i + 4) {
        const E* at[kLanes];
        for (int64_t k = 0; k < kLanes; ++k) at[k] = row[k] + i;
        Lanes<E> column[4];
        load_quads<E>(at, column);
        for (int64_t c = 0; c < count; ++c) store_lanes(to + (i + c) * stride + j, column[c]);
      } else {
        for (int64_t c = i; c < i + count; ++c)
          for (int64_t k = 0; k < kLanes; ++k) to[c * stride + j + k] = row[k][c];
      }
    }
  }
}

// Transposes columns, or the channels of each row. `lines` are those of the array.
template <class E>
NMR_INLINE void load_planes(const E* image, Size size, int64_t channels, const LineRange& lines,
                            E* to, int64_t stride) {
  const int64_t row = size.width * channels;
  const E* end = image + size.height * row;
  const int64_t length = lines.columns ? size.height : size.width;
  if (lines.columns)
    transpose(image + (size.height - 1) * row + lines.first * channels, length, -row,
              lines.count * channels, end, to, stride);
  for (int64_t n = 0; n < lines.count && !lines.columns; ++n) {
    const E* from = image + (lines.first + n) * row;
    if (channels == 1)
      std::copy_n(from, length, to + n * stride);
    else
      transpose(from, length, channels, channels, end, to + n * channels * stride, stride);
  }
  for (int64_t n = 0; n < lines.count * channels; ++n)
    std::fill_n(to + n * stride + length, kLanes, E(0));
}

// Colours and gradients of the group.
template <class T>
NMR_INLINE void load_pixels(const EdgeImage<T>& image, const LineGroup<T>& group) {
  const LineRange& lines = group.lines;
  const int64_t C = image.channels, M = group.length, stride = group.stride;
  if (image.pixels) {
    load_planes(image.pixels, image.raster, C, lines, group.colors, stride);
    for (int64_t n = 0; n < lines.count * C && image.background; ++n) {
      const int32_t* face_index = group.face_index + n / C * group.face_stride;
      const T behind = image.background[n % C];
      T* color = group.colors + n * stride;
      for (int64_t m = 0; m < M; ++m) color[m] = face_index[m] < 0 ? behind : color[m];
    }
  }
  if (!image.anti_aliasing) {
    load_planes(image.grad, image.size, C, lines, group.grads, stride);
    return;
  }
  const LineRange halves{lines.first / 2, lines.count / 2, lines.columns};
  load_planes(image.grad, image.size, C, halves, group.half_grads, stride);
  for (int64_t n = 0; n < halves.count * C; ++n) {
    const T* half = group.half_grads + n * stride;
    T* grad = group.grads + n * stride;
    for (int64_t m = 0; m < M / 2; ++m)
      grad[2 * m] = grad[2 * m + 1] = half[m] * share_of_pixel<T>(true);
    std::fill_n(grad + M, kLanes, T(0));
  }
}

// --- runs

// Lists the runs of a line in `window` behind `count` runs; returns the new number, filled up to a
// multiple of kLanes.
NMR_INLINE int64_t find_runs(const int32_t* face_index, int64_t length, const PixelRange& window,
                             const RunList& runs, int64_t count) {
  int64_t ended = count;
  uint32_t carry = 0;  // whether the pixel before has the same face
  const auto find = [&](int64_t m, Lanes32 id, Lanes32 next) {
    const uint32_t covered = lane_bits(id >= splat(int32_t(0)));
    if (!covered) return;
    const uint32_t same = lane_bits(id == next) & covered;
    const uint32_t starts = covered & ~(same << 1 | carry), ends = covered & ~same;
    carry = same >> (kLanes - 1);
    const Lanes32 at = lane_numbers() + splat(static_cast<int32_t>(m));
    compress_lanes(id, starts, runs.face + count);
    count += compress_lanes(at, starts, runs.first + count);
    ended += compress_lanes(at, ends, runs.last + ended);
  };
  int64_t m = window.first;
  for (; m < std::min(window.last, length - kLanes); m += kLanes)
    find(m, load_lanes<Lanes32>(face_index + m), load_lanes<Lanes32>(face_index + m + 1));
  if (m < window.last)
    find(m, load_face_indices(face_index, m, length), load_face_indices(face_index, m + 1, length));
  store_lanes(runs.face + count, splat(int32_t(-1)));
  return (count + kLanes - 1) / kLanes * kLanes;
}

// Transposes the face indices of columns, and lists the runs of all lines.
template <class T>
void find_group_runs(const EdgeImage<T>& image, LineGroup<T>& group) {
  const int64_t W = image.raster.width, M = group.length, count = group.lines.count;
  const PixelRange& window = group.window;
  group.face_index = image.face_index + group.lines.first * W;
  group.face_stride = W;
  if (group.lines.columns) {
    const int64_t last = std::min(window.last, M);
    transpose(image.face_index + (M - 1 - window.first) * W + group.lines.first,
              last - window.first, -W, count, image.face_index + M * W,
              group.transposed + window.first, group.stride);
    for (int64_t n = 0; n < count; ++n) {
      int32_t* line = group.transposed + n * group.stride;
      std::fill_n(line, window.first, -1);
      std::fill(line + last, line + group.stride, -1);
    }
    group.face_index = group.transposed;
    group.face_stride = group.stride;
  }
  int64_t runs = 0;
  for (int64_t k = 0; k < count; ++k) {
    runs = find_runs(group.face_index + k * group.face_stride, M, window, group.runs, runs);
    group.runs_end[k] = runs;
  }
}

// --- the pixels that pull

// Lists the pixels that can pull an edge from outside: background with a negative gradient in a
// silhouette, else all with a gradient. `gains` tells whether pixels of a face can pull an edge
// inwards.
template <int64_t kChannels, class T>
NMR_INLINE void list_pixels(EdgeLine<T>& line, const PixelList<T>& list) {
  const Lanes<T> zero = splat(T(0));
  int64_t count = 0;
  LaneMask<T> gains = zero < zero;
  for (int64_t m = 0; m < line.length; m += kLanes) {
    const LaneMask<T> background =
        widen_mask<T>(load_face_indices(line.face_index, m, line.length) < splat(int32_t(0)));
    const Lanes32 pixels = lane_numbers() + splat(static_cast<int32_t>(m));
    if constexpr (kChannels == kCoverage) {
      const Lanes<T> grad = load_lanes<Lanes<T>>(line.grads + m);
      gains = gains | without(grad > zero, background);
      const uint32_t pulls = lane_bits((grad < zero) & background);
      if (!pulls) continue;
      compress_lanes(zero - grad, pulls, list.weight + count);
      count += compress_lanes(to_values<T>(pixels), pulls, list.position + count);
    } else {
      const int64_t C = kChannels ? kChannels : line.channels;
      LaneMask<T> acts = zero < zero;
      for (int64_t c = 0; c < C; ++c) {
        const Lanes<T> grad = load_lanes<Lanes<T>>(line.grads + c * line.stride + m);
        acts = acts | (grad < zero) | (grad > zero);
      }
      gains = gains | without(acts, background);
      const uint32_t pulls = lane_bits(acts);
      if (!pulls) continue;
      compress_lanes(pixels, pulls, list.pixel + count);
      count += compress_lanes(to_values<T>(pixels), pulls, list.position + count);
    }
  }
  list.position[-1] = -std::numeric_limits<T>::max();
  list.position[count] = std::numeric_limits<T>::max();
  line.pulling = count;
  line.gains = lane_bits(gains) != 0;
}

// --- eight runs and one of their edges

// The faces of eight runs of a line: scan and sweep coordinates of their corners, first and last
// pixels of the runs.
template <class T>
struct RunLanes {
  Lanes<T> s[4], t[4];
  Lanes32 first, last;
};

// Where the line crosses one edge P-Q of each face.
template <class T>
struct EdgeLanes {
  LaneMask<T> edge[3];      // whether it is edge k
  Lanes<T> at;              // place of the crossing
  LaneMask<T> on_line;      // the pixels on both sides of it are pixels of the line
  Lanes32 inner;            // the pixel inside; 0 if not on_line
  Lanes<T> rate_p, rate_q;  // pixels that the crossing moves if P, or Q, moves by 1
  Lanes<T> eps_p, eps_q;    // least distances of a pixel
};

// P (k = 0), Q (1) or the opposite corner (2) of the edges.
template <class T>
NMR_INLINE Lanes<T> corner_of(const EdgeLanes<T>& x, const Lanes<T> (&corners)[4], int k) {
  return choose(x.edge[0], corners[k],
                choose(x.edge[1], corners[(k + 1) % 3], corners[(k + 2) % 3]));
}

// The first of the edges in `hits`. Outward is up the line, or down.
template <bool kUp, class T>
NMR_INLINE EdgeLanes<T> cross_edges(const EdgeLine<T>& line, const RunLanes<T>& run,
                                    const LaneMask<T> (&hits)[3]) {
  EdgeLanes<T> x;
  x.edge[0] = hits[0];
  x.edge[1] = without(hits[1], hits[0]);
  x.edge[2] = without(without(hits[2], hits[0]), hits[1]);
  const Lanes<T> n = splat(line.number), zero = splat(T(0)),
                 top = splat(static_cast<T>(line.length - 1));
  const Lanes<T> ps = corner_of(x, run.s, 0), qs = corner_of(x, run.s, 1);
  const Lanes<T> pt = corner_of(x, run.t, 0), qt = corner_of(x, run.t, 1);
  const Lanes<T> length = qs - ps, half = splat(static_cast<T>(line.length) / 2);
  x.at = (qt - pt) / length * (n - ps) + pt;
  x.on_line = x.edge[0] | x.edge[1] | x.edge[2];
  x.on_line = x.on_line & (kUp ? (x.at >= zero) & (x.at < top) : (x.at > zero) & (x.at <= top));
  const Lanes<T> at = keep(x.on_line, x.at);
  x.inner = truncate(kUp ? floor_lanes<T>(at) : zero - floor_lanes<T>(zero - at));
  const Lanes<T> scale = half / length, eps = splat(line.eps);
  const Lanes<T> least =
      splat(sizeof(T) == 4 ? T(1e-15) : T(1e-150));  // a product of distances must not underflow
  x.rate_p = (qs - n) * scale;
  x.rate_q = (n - ps) * scale;
  x.eps_p = eps * absolute<T>(x.rate_p) + least;
  x.eps_q = eps * absolute<T>(x.rate_q) + least;
  return x;
}

// The last pixel inside, before the line leaves the face on its far side: on edge P-O if the line
// crosses it, else on Q-O. As published, NaN becomes 0.
template <bool kUp, class T>
NMR_INLINE Lanes32 inner_limit(const EdgeLine<T>& line, const RunLanes<T>& run,
                               const EdgeLanes<T>& x) {
  const Lanes<T> n = splat(line.number), zero = splat(T(0)),
                 end = splat(static_cast<T>(line.length));
  const Lanes<T> ps = corner_of(x, run.s, 0), os = corner_of(x, run.s, 2),
                 ot = corner_of(x, run.t, 2);
  const LaneMask<T> crosses_po = (n - ps) * (n - os) < zero;
  const Lanes<T> es = choose(crosses_po, ps, corner_of(x, run.s, 1));
  const Lanes<T> et = choose(crosses_po, corner_of(x, run.t, 0), corner_of(x, run.t, 1));
  Lanes<T> far = (ot - et) / (os - es) * (n - es) + et;
  far = min_of(max_of(keep(far == far, far), splat(T(-1))), end);
  return truncate(kUp ? zero - floor_lanes<T>(zero - far) : floor_lanes<T>(far));
}

// Sums of the pulls on P and Q, before they are multiplied by the rates.
template <class T>
struct Pulls {
  Lanes<T> p, q;
};

// A pixel of weight w at a distance d from the crossing pulls with w / d. Both quotients share one
// division.
template <class T>
NMR_INLINE void add_pull(LaneMask<T> acts, Lanes<T> weight, Lanes<T> distance_p,
                         Lanes<T> distance_q, Pulls<T>& pulls) {
  const Lanes<T> share = keep(acts, weight / (distance_p * distance_q));
  pulls.p = pulls.p + share * distance_q;
  pulls.q = pulls.q + share * distance_p;
}

// Outside: each listed pixel beyond the crossing, if the face owns the pixel inside.
template <bool kUp, int64_t kChannels, class T>
NMR_INLINE Pulls<T> pull_outside(const EdgeLine<T>& line, const PixelList<T>& list,
                                 const EdgeLanes<T>& x, LaneMask<T> owned) {
  const int64_t C = kChannels ? kChannels : line.channels;
  Lanes<T> near_color[kChannels > 0 ? kChannels : 1];
  T* any_colors = list.near_colors;  // of more channels than are compiled in
  for (int64_t c = 0; c < C; ++c) {
    const Lanes<T> color =
        gather_values(line.colors + c * line.stride, keep(narrow_mask(owned), x.inner));
    if constexpr (kChannels > 0)
      near_color[c] = color;
    else
      store_lanes(any_colors + c * kLanes, color);
  }
  // No pixel is beyond the crossing of a lane that is not owned.
  const Lanes<T> at = choose(owned, x.at, splat(kUp ? T(1e30) : T(-1e30))), zero = splat(T(0));
  const T nearest = kUp ? least_lane<T>(at) : -least_lane<T>(zero - at);
  const Lanes<T> eps_p = kUp ? x.eps_p : zero - x.eps_p, eps_q = kUp ? x.eps_q : zero - x.eps_q;
  Pulls<T> pulls{zero, zero};
  // From the border of the image inwards. The list ends with positions that are beyond no crossing.
  for (int64_t k = kUp ? line.pulling - 1 : 0;
       kUp ? list.position[k] > nearest : list.position[k] < nearest; k += kUp ? -1 : 1) {
    const Lanes<T> offset = splat(list.position[k]) - at;
    const LaneMask<T> beyond = kUp ? offset > zero : offset < zero;
    if constexpr (kChannels == kCoverage) {
      add_pull<T>(beyond, splat(list.weight[k]), offset + eps_p, offset + eps_q, pulls);
    } else {
      const T *color = line.colors + list.pixel[k], *grad = line.grads + list.pixel[k];
      const auto term = [&](int64_t c) {
        const Lanes<T> near =
            kChannels ? near_color[c] : load_lanes<Lanes<T>>(any_colors + c * kLanes);
        return (splat(color[c * line.stride]) - near) * splat(grad[c * line.stride]);
      };
      Lanes<T> gain = term(0);
      for (int64_t c = 1; c < C; ++c) gain = gain + term(c);
      add_pull<T>(beyond & (gain > zero), gain, offset + eps_p, offset + eps_q, pulls);
    }
  }
  return pulls;
}

// Inside: the pixels [first, last] of a run, which belong to its face. Adds the sums to pulls[0]
// and pulls[1].
template <int64_t kChannels, class T>
NMR_INLINE void pull_inside(const EdgeLine<T>& line, int64_t first, int64_t last, int64_t outer,
                            T at, T eps_p, T eps_q, T* sums) {
  const int64_t C = kChannels ? kChannels : line.channels;
  const Lanes<T> zero = splat(T(0)), p = splat(eps_p), q = splat(eps_q);
  Pulls<T> pulls{zero, zero};
  for (int64_t m = first; m <= last; m += kLanes) {
    const Lanes32 number = lane_numbers() + splat(static_cast<int32_t>(m));
    Lanes<T> gain;
    if constexpr (kChannels == kCoverage) {
      gain = load_lanes<Lanes<T>>(line.grads + m);
    } else {
      const auto term = [&](int64_t c) {
        const Lanes<T> color = load_lanes<Lanes<T>>(line.colors + c * line.stride + m);
        return (color - splat(line.colors[c * line.stride + outer])) *
               load_lanes<Lanes<T>>(line.grads + c * line.stride + m);
      };
      gain = term(0);
      for (int64_t c = 1; c < C; ++c) gain = gain + term(c);
    }
    const LaneMask<T> acts =
        widen_mask<T>(number <= splat(static_cast<int32_t>(last))) & (gain > zero);
    const Lanes<T> offset = to_values<T>(number) - splat(at);
    const LaneMask<T> above = offset > zero;
    add_pull<T>(acts, gain, offset + choose(above, p, zero - p),
                offset + choose(above, q, zero - q), pulls);
  }
  add_lane_sums<T>(pulls.p, pulls.q, sums);
}

// Inside, for eight edges. In a silhouette, only if the pixel outside is background.
template <bool kUp, int64_t kChannels, class T>
NMR_INLINE void pull_all_inside(const EdgeLine<T>& line, const RunLanes<T>& run,
                                const EdgeLanes<T>& x, Pulls<T>& pulls) {
  const Lanes32 outer = x.inner + splat(kUp ? int32_t(1) : int32_t(-1));
  uint32_t bits = lane_bits(x.on_line);
  if constexpr (kChannels == kCoverage)
    bits &= lane_bits(gather_values(line.face_index, keep(narrow_mask(x.on_line), outer)) <
                      splat(int32_t(0)));
  if (!bits) return;
  const Lanes32 limit = inner_limit<kUp>(line, run, x);
  const LaneArray<int32_t, Lanes32> outer_at(outer),
      first(max_of(run.first, min_of(x.inner, limit)));
  const LaneArray<int32_t, Lanes32> last(min_of(run.last, max_of(x.inner, limit)));
  const LaneArray<T, Lanes<T>> at(x.at), eps_p(x.eps_p), eps_q(x.eps_q);
  T sums[kLanes][2] = {};
  for (; bits; bits &= bits - 1) {
    const int64_t l = lowest_bit(bits);
    pull_inside<kChannels>(line, first.lane[l], last.lane[l], outer_at.lane[l], at.lane[l],
                           eps_p.lane[l], eps_q.lane[l], sums[l]);
  }
  T p[kLanes], q[kLanes];
  for (int64_t l = 0; l < kLanes; ++l) p[l] = sums[l][0], q[l] = sums[l][1];
  pulls.p = pulls.p + load_lanes<Lanes<T>>(p);
  pulls.q = pulls.q + load_lanes<Lanes<T>>(q);
}

// The pulls on these edges.
template <bool kUp, int64_t kChannels, class T>
NMR_INLINE Pulls<T> pull_edges(const EdgeLine<T>& line, const PixelList<T>& list,
                               const RunLanes<T>& run, const EdgeLanes<T>& x) {
  const LaneMask<T> owned =
      x.on_line & widen_mask<T>((x.inner >= run.first) & (x.inner <= run.last));
  Pulls<T> pulls = pull_outside<kUp, kChannels>(line, list, x, owned);
  pulls.p = keep(owned, pulls.p);
  pulls.q = keep(owned, pulls.q);
  if (line.gains) pull_all_inside<kUp, kChannels>(line, run, x, pulls);
  return pulls;
}

// Adds the gradients of the faces' corners.
template <class T>
NMR_INLINE void add_edges(const EdgeLanes<T>& x, const Pulls<T>& pulls, Lanes<T> (&grads)[4]) {
  const Lanes<T> p = pulls.p * x.rate_p, q = pulls.q * x.rate_q;
  for (int k = 0; k < 3; ++k)
    grads[k] = grads[k] - (keep(x.edge[k], p) + keep(x.edge[(k + 2) % 3], q));
}

// Eight runs and two edges of each of their faces, with outward directions up and down the line.
template <class T>
struct CrossedRuns {
  RunLanes<T> run;
  LaneMask<T> up_hits[3], down_hits[3];  // whether the line crosses edge k
  EdgeLanes<T> up, down;
  T* sums[kLanes];
};

// Runs [r, r + 8).
template <class T>
NMR_INLINE void cross_runs(const EdgeLine<T>& line, const RunList& runs, int64_t r, T* entries,
                           CrossedRuns<T>& x) {
  const T* corners[kLanes];
  for (int64_t l = 0; l < kLanes; ++l) {
    T* entry = entries + kEdgeEntry * runs.face[r + l];
    corners[l] = entry;
    x.sums[l] = entry + (line.columns ? 12 : 8);
  }
  RunLanes<T>& run = x.run;
  load_quads<T>(corners, line.columns ? run.s : run.t);
  for (const T*& corner : corners) corner += 4;
  load_quads<T>(corners, line.columns ? run.t : run.s);
  run.first = load_lanes<Lanes32>(runs.first + r);
  run.last = load_lanes<Lanes32>(runs.last + r);
  const Lanes<T> n = splat(line.number), before = splat(T(-1));
  LaneMask<T> below[3], above[3];
  for (int k = 0; k < 3; ++k) {
    below[k] = run.s[k] <= n;
    // Rounded towards zero, as published: an edge that ends in (-1, 0) is extrapolated to line 0.
    above[k] = line.number == 0 ? run.s[k] > before : run.s[k] >= n;
  }
  for (int k = 0; k < 3;
       ++k) {  // edges parallel to the line are left out: neither end can move a crossing
    const int q = (k + 1) % 3;
    (line.columns ? x.down_hits : x.up_hits)[k] = below[k] & above[q] & (run.s[k] < run.s[q]);
    (line.columns ? x.up_hits : x.down_hits)[k] = below[q] & above[k] & (run.s[q] < run.s[k]);
  }
  x.up = cross_edges<true>(line, run, x.up_hits);
  x.down = cross_edges<false>(line, run, x.down_hits);
}

// Adds the gradients of the faces' corners.
template <int64_t kChannels, class T>
NMR_INLINE void pull_runs(const EdgeLine<T>& line, const PixelList<T>& list, CrossedRuns<T>& x) {
  const Lanes<T> zero = splat(T(0));
  Lanes<T> grads[4] = {zero, zero, zero, zero};
  while (true) {
    add_edges(x.up, pull_edges<true, kChannels>(line, list, x.run, x.up), grads);
    add_edges(x.down, pull_edges<false, kChannels>(line, list, x.run, x.down), grads);
    LaneMask<T> any = zero < zero;
    for (int k = 0; k < 3; ++k) {
      x.up_hits[k] = without(x.up_hits[k], x.up.edge[k]);
      x.down_hits[k] = without(x.down_hits[k], x.down.edge[k]);
      any = any | x.up_hits[k] | x.down_hits[k];
    }
    if (!lane_bits(any)) break;
    // The line runs through a corner, and so crosses two edges with one outward direction.
    x.up = cross_edges<true>(line, x.run, x.up_hits);
    x.down = cross_edges<false>(line, x.run, x.down_hits);
  }
  add_quads<T>(grads, x.sums);
}

// The gradients of the corners of faces that come from a group of lines: of y from columns, of x
// from rows.
template <int64_t kChannels, class T>
void pull_group(const EdgeImage<T>& image, const LineGroup<T>& group, const PixelList<T>& list,
                T* entries) {
  load_pixels(image, group);
  const int64_t C = image.channels,
                share = image.anti_aliasing ? 2 : 1;  // lines that share their gradients
  int64_t first = 0;
  for (int64_t k = 0; k < group.lines.count; ++k) {
    const int64_t last = group.runs_end[k], number = group.lines.first + k;
    EdgeLine<T> line{
        group.face_index + k * group.face_stride,
        image.pixels ? group.colors + k * C * group.stride : nullptr,
        group.grads + k / share * C * group.stride,
        group.length,
        group.stride,
        C,
        group.lines.columns,
        static_cast<T>(group.lines.columns ? number : image.raster.height - 1 - number),
        std::min(image.eps, T(1e15)),
        0,
        false};
    if (first < last) list_pixels<kChannels>(line, list);
    // First all crossings of some runs: the number of pixels beyond one is only known when it is
    // there.
    CrossedRuns<T> crossed[kVectors];
    for (int64_t r = first; r < last && (line.pulling || line.gains); r += kVectors * kLanes) {
      const int64_t count = std::min(kVectors, (last - r) / kLanes);
      for (int64_t n = 0; n < count; ++n)
        cross_runs(line, group.runs, r + n * kLanes, entries, crossed[n]);
      for (int64_t n = 0; n < count; ++n) pull_runs<kChannels>(line, list, crossed[n]);
    }
    first = last;
  }
}

}  // namespace
}  // namespace nmr::NMR_LEVEL
