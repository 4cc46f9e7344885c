// The inner loops of the silhouette gradient; included by levels.h for every instruction set.
//
// For axis 0 the lines are columns: s is the scan coordinate x and t the sweep coordinate y. For axis 1 they are rows:
// s is y, t is x. A sweep goes outward, up or down its line. In the coordinate of its direction (t or -t, see
// ScanlineGrads) it always goes up.
//
// An edge of a small face crosses three or four lines only. So edges are first written out as crossings, of all edges
// with one axis and direction, and then crossings are worked on in full vectors.

#include "crossings.h"

// --- coverage

// alpha [h, w]: the covered share of each pixel of an image whose face index map has twice its size.
template <class T>
void average_coverage(const int32_t* face_index, Size image, T* alpha) {
  for (int64_t y = 0; y < image.height; ++y, alpha += image.width) {
    const int32_t *upper = face_index + 4 * y * image.width, *lower = upper + 2 * image.width;
    for (int64_t x = 0; x < image.width; ++x) {
      const int upper_covered = (upper[2 * x] >= 0) + (upper[2 * x + 1] >= 0);
      const int lower_covered = (lower[2 * x] >= 0) + (lower[2 * x + 1] >= 0);
      alpha[x] = T(0.25) * static_cast<T>(upper_covered + lower_covered);
    }
  }
}

// --- which pixels can pull

// Gradients of raster pixels [first, last) of a row (counted from the bottom), followed by lanes of zeros.
template <class T>
NMR_INLINE void expand_row(const SweepImage<T>& image, int64_t j, int64_t first, int64_t last, T* row) {
  const int64_t w = image.size.width;
  if (image.anti_aliasing) {
    const T* grad = image.grad_alpha + (image.size.height - 1 - j / 2) * w;
    for (int64_t x = first / 2; x < last / 2; ++x) row[2 * x] = row[2 * x + 1] = grad[x] / 4;
  } else {
    std::copy_n(image.grad_alpha + (image.size.height - 1 - j) * w + first, last - first, row + first);
  }
  std::fill_n(row + last, kLanes, T(0));
}

// Adds pixel m to the list at `start`, which has `count` pixels.
template <class T>
NMR_INLINE void append_pull(ScanlineGrads<T>& lines, int64_t start, int32_t& count, int64_t m, T weight) {
  const int64_t at = start + kPad + count++;
  lines.position[at] = static_cast<T>(m);
  lines.weight[at] = weight;
}

// Bounds and padding of lines [first, last), when all their pixels have been seen.
template <class T>
NMR_INLINE void finish_lines(ScanlineGrads<T>& lines, int64_t first, int64_t last) {
  const T infinity = std::numeric_limits<T>::infinity(), length = static_cast<T>(lines.stride - 2 * kPad);
  for (int64_t n = first; n < last; ++n) {
    const int32_t count = lines.count[n];
    T* position = lines.position.data() + n * lines.stride + kPad;
    lines.outer_end[0][n] = count ? position[count - 1] : -infinity;
    lines.outer_end[1][n] = count ? -position[0] : -infinity;
    lines.inner_start[1][n] = std::max(T(1) - length, -lines.inner_start[1][n]);
    store_lanes(position - kPad, splat(T(-1)));
    store_lanes(position + count, splat(length));
  }
}

// Fills the columns of a part of the image, and the pieces of rows in it. join_rows joins and finishes the rows, unless
// the part is the whole image. grad_row: [W + lanes] of scratch.
template <class T>
void collect_lines(const SweepImage<T>& image, const ColumnPart& part, T* grad_row) {
  const int64_t H = image.raster.height, W = image.raster.width;
  const int64_t first = part.number * part.width, last = std::min(first + part.width, W);
  ScanlineGrads<T>&columns = image.lines[0], &rows = image.lines[1];
  start_lines(columns, first, last);
  start_lines(rows, part.number * H, (part.number + 1) * H);
  int32_t* row_count = rows.count.data() + part.number * H;
  T* row_gain_first = rows.inner_start[0].data() + part.number * H;
  T* row_gain_last = rows.inner_start[1].data() + part.number * H;
  for (int64_t j = 0; j < H; ++j) {
    const int32_t* face_index = image.face_index + (H - 1 - j) * W;
    if (!image.anti_aliasing || j % 2 == 0) expand_row(image, j, first, last, grad_row);
    for (int64_t start = first; start < last; start += kLanes) {
      const Lanes<T> g = load_lanes<Lanes<T>>(grad_row + start);
      Lanes32 id = splat(int32_t(-1));
      if (start + kLanes <= W)
        id = load_lanes<Lanes32>(face_index + start);
      else
        std::memcpy(&id, face_index + start, (W - start) * sizeof(int32_t));
      const Lanes32 background = id < splat(int32_t(0));
      uint32_t bits = lane_bits(narrow_mask(g < splat(T(0))) & background);
      const uint32_t gain_bits = lane_bits(g > splat(T(0))) & ~lane_bits(background);
      for (; bits; bits &= bits - 1) {
        const int64_t i = start + lowest_bit(bits);
        append_pull(rows, j * rows.stride + first, row_count[j], i, -grad_row[i]);
        append_pull(columns, i * columns.stride, columns.count[i], j, -grad_row[i]);
      }
      if (!gain_bits) continue;
      row_gain_first[j] = std::min(row_gain_first[j], static_cast<T>(start));  // at least that
      row_gain_last[j] = static_cast<T>(start + kLanes - 1);                   // at most that
      const LaneMask<T> here = (g > splat(T(0))) & widen_mask<T>(id >= splat(int32_t(0)));
      T *gain_first = columns.inner_start[0].data() + start, *gain_last = columns.inner_start[1].data() + start;
      const Lanes<T> line_first = load_lanes<Lanes<T>>(gain_first), at = splat(static_cast<T>(j));
      store_lanes(gain_first, select(here & (line_first > at), at, line_first));
      store_lanes(gain_last, select(here, at, load_lanes<Lanes<T>>(gain_last)));
    }
  }
  finish_lines(columns, first, last);
  if (part.width >= W) finish_lines(rows, 0, H);
}

// Joins the pieces of rows [first, last), and finishes them. width: pixels of a part along each row.
template <class T>
void join_rows(const SweepImage<T>& image, int64_t width, int64_t first, int64_t last) {
  const int64_t H = image.raster.height, W = image.raster.width;
  ScanlineGrads<T>& rows = image.lines[1];
  for (int64_t j = first; j < last; ++j) {
    T *position = rows.position.data() + j * rows.stride + kPad, *weight = rows.weight.data() + j * rows.stride + kPad;
    for (int64_t part = 1; part * width < W; ++part) {
      const int64_t n = part * H + j, count = rows.count[n], from = part * width, to = rows.count[j];
      std::memmove(position + to, position + from, count * sizeof(T));
      std::memmove(weight + to, weight + from, count * sizeof(T));
      rows.count[j] += static_cast<int32_t>(count);
      rows.inner_start[0][j] = std::min(rows.inner_start[0][j], rows.inner_start[0][n]);
      rows.inner_start[1][j] = std::max(rows.inner_start[1][j], rows.inner_start[1][n]);
    }
  }
  finish_lines(rows, first, last);
}

// --- the pulls

// Adds the pulls of the listed pixels beyond the crossing: above it if kUp, else below. A pixel of weight w pulls P
// with w / h_p and Q with w / h_q, h the travel. The quotients share one division: w / (h_p h_q) times h_q and h_p.
template <bool kUp, class T>
NMR_INLINE void pull_listed(const T* position, const T* weight, int32_t count, const EdgeDerivative<T>& derivative,
                            T* pulls) {
  // All offsets have the same sign, so the signs of both distances are constant.
  const T eps = kUp ? derivative.eps : -derivative.eps;
  const Lanes<T> crossing = splat(derivative.crossing), factor_p = splat(derivative.factor_p),
                 factor_q = splat(derivative.factor_q);
  const Lanes<T> eps_p = splat(derivative.factor_p > 0 ? eps : -eps),
                 eps_q = splat(derivative.factor_q > 0 ? eps : -eps);
  Lanes<T> pulls_p = splat(T(0)), pulls_q = splat(T(0));
  int64_t n = kUp ? count - kLanes : 0;  // from the border of the image inwards
  bool more;
  do {
    const Lanes<T> offset = load_lanes<Lanes<T>>(position + n) - crossing;
    const LaneMask<T> beyond = kUp ? offset > splat(T(0)) : offset < splat(T(0));
    const Lanes<T> h_p = offset * factor_p + eps_p, h_q = offset * factor_q + eps_q;
    const Lanes<T> share = keep(beyond, load_lanes<Lanes<T>>(weight + n) / (h_p * h_q));
    pulls_p = pulls_p + share * h_q;
    pulls_q = pulls_q + share * h_p;
    more = kUp ? position[n] > derivative.crossing : position[n + kLanes - 1] < derivative.crossing;
    n += kUp ? -kLanes : kLanes;
  } while (more);
  add_lane_sums<T>(pulls_p, pulls_q, pulls);
}

// Pulls of the pixels inside the face that should be background: the loss falls if the edge moves in past them.
template <class T>
void pull_inside(const SweepImage<T>& image, const SweepScratch<T>& block, int axis, int32_t edge, int64_t n,
                 int64_t inner, int64_t d, const EdgeDerivative<T>& derivative, T* pulls) {
  const int64_t H = image.raster.height, W = image.raster.width, face = edge % kSweptFaces, p = edge / kSweptFaces;
  const int64_t q = p < 2 ? p + 1 : 0, o = p > 0 ? p - 1 : 2;
  // pixel m of line n: face_index[m * step]
  const int32_t* face_index = axis == 0 ? image.face_index + (H - 1) * W + n : image.face_index + (H - 1 - n) * W;
  const int64_t step = axis == 0 ? -W : 1, length = axis == 0 ? H : W;
  const auto s = [&](int64_t k) { return block.corner[axis][k][face]; };
  const auto t = [&](int64_t k) { return block.corner[1 - axis][k][face]; };
  const T line = static_cast<T>(n);
  const int64_t end = (line - s(p)) * (line - s(o)) < 0 ? p : q;
  const T far_side = line_height(s(end), t(end), s(o), t(o), line);
  const int64_t limit = sweep_limit(far_side, d, length);
  const int64_t m_first = std::max<int64_t>(std::min(inner, limit), 0);
  const int64_t m_last = std::min(std::max(inner, limit), length - 1);
  for (int64_t m = m_first; m <= m_last; ++m) {
    if (face_index[m * step] != block.id[face]) continue;
    const T g = axis == 0 ? image.grad(n, m) : image.grad(m, n);
    if (g > 0) pull(g, static_cast<T>(m) - derivative.crossing, derivative, pulls);
  }
}

// --- the sweeps

// Sweeps all crossings of one axis and direction, and empties them.
template <bool kUp, class T>
void run_crossings(const SweepImage<T>& image, int axis, SweepScratch<T>& block) {
  const int64_t H = image.raster.height, W = image.raster.width;
  const ScanlineGrads<T>& lines = image.lines[axis];
  Crossings<T>& crossings = block.crossings[axis][kUp ? 0 : 1];
  const int32_t d = kUp ? 1 : -1;
  const T top = static_cast<T>((axis == 0 ? H : W) - 1);  // the last pixel of a line
  // The inner pixel is floor(c) in the coordinate of the direction. It and the next one lie on the line if start <= c
  // < end.
  const Lanes<T> start = splat(kUp ? T(0) : -top), end = splat(kUp ? top : T(0));
  // pixel m of line n: face_index[origin + n * step_n + m * step_m]
  const int32_t across = static_cast<int32_t>(-W), step = axis == 0 ? across * d : d;
  const Lanes32 origin = splat(static_cast<int32_t>((H - 1) * W));
  const Lanes32 step_n = splat(axis == 0 ? int32_t(1) : across), step_m = splat(step);
  const Lanes32 all = splat(static_cast<int32_t>(crossings.count));
  const Lanes32 face_of = splat(static_cast<int32_t>(kSweptFaces - 1));
  int64_t num_outer = 0, num_inner = 0;
  for (int64_t i = 0; i < crossings.count; i += kLanes) {
    const Lanes<T> at = load_lanes<Lanes<T>>(crossings.at + i);
    const Lanes32 number = lane_numbers() + splat(static_cast<int32_t>(i)), used = number < all;
    const Lanes32 maybe_outer =
        used & narrow_mask((at >= start) & (at < load_lanes<Lanes<T>>(crossings.outer_end + i)));
    const Lanes32 maybe_inner =
        used & narrow_mask((at >= load_lanes<Lanes<T>>(crossings.inner_start + i)) & (at < end));
    const Lanes32 wanted = maybe_outer | maybe_inner;
    const Lanes32 inner = truncate(floor_lanes<T>(keep(widen_mask<T>(wanted), at)));
    const Lanes32 pixel = origin + load_lanes<Lanes32>(crossings.line + i) * step_n + inner * step_m;
    const Lanes32 face = load_lanes<Lanes32>(crossings.edge + i) & face_of;
    const Lanes32 id = gather_lanes(block.id, keep(used, face));
    const Lanes32 inner_face_index = gather_lanes(image.face_index, keep(wanted, pixel));
    const Lanes32 outer_face_index = gather_lanes(image.face_index, keep(wanted, pixel + step_m));
    num_outer += compress_lanes(number, lane_bits(maybe_outer & (inner_face_index == id)), crossings.outer + num_outer);
    const uint32_t gain_bits = lane_bits(maybe_inner & (outer_face_index < splat(int32_t(0))));
    if (gain_bits) num_inner += compress_lanes(number, gain_bits, crossings.inner + num_inner);
  }
  crossings.count = 0;

  const auto derivative_of = [&](int32_t i) {
    const T line = static_cast<T>(crossings.line[i]), reach = block.reach[axis][crossings.edge[i]];
    return EdgeDerivative<T>{kUp ? crossings.at[i] : -crossings.at[i],
                             reach / (block.qs[axis][crossings.edge[i]] - line),
                             reach / (line - block.ps[axis][crossings.edge[i]]), image.eps};
  };
  // Outside: pixels from the outer one to the border that should be covered. The loss falls if the edge moves out to
  // them.
  for (int64_t k = 0; k < num_outer; ++k) {
    const int32_t i = crossings.outer[k], n = crossings.line[i];
    const EdgeDerivative<T> derivative = derivative_of(i);
    T* pulls = block.pulls[axis][crossings.edge[i]];
    const T *position = lines.positions(n), *weight = lines.weights(n);
    const T largest = image.largest_factor;
    if (std::abs(derivative.factor_p) < largest && std::abs(derivative.factor_q) < largest) {
      pull_listed<kUp>(position, weight, lines.count[n], derivative, pulls);
    } else {
      for (int32_t m = 0; m < lines.count[n]; ++m)
        if (kUp ? position[m] > derivative.crossing : position[m] < derivative.crossing)
          pull(weight[m], position[m] - derivative.crossing, derivative, pulls);
    }
  }
  for (int64_t k = 0; k < num_inner; ++k) {
    const int32_t i = crossings.inner[k];
    const int64_t inner = d * static_cast<int64_t>(std::floor(crossings.at[i]));
    const int32_t edge = crossings.edge[i];
    pull_inside(image, block, axis, edge, crossings.line[i], inner, d, derivative_of(i), block.pulls[axis][edge]);
  }
}

// Gradients [3, 2] of x and y of the corners of visible faces [first, last) of the list, in the order in which they are
// drawn.
template <class T>
void sweep_faces(const SweepImage<T>& image, const int32_t* ids, int64_t first, int64_t last, SweepScratch<T>& block,
                 T* grad) {
  const auto run = [](const SweepImage<T>& image, int axis, int direction, SweepScratch<T>& block) {
    direction == 0 ? run_crossings<true>(image, axis, block) : run_crossings<false>(image, axis, block);
  };
  for (int64_t n = first; n < last; n += kSweptFaces)
    sweep_block(image, ids + n, std::min(kSweptFaces, last - n), block, grad + 6 * n, run);
}
