// The inner loops of the colour gradient; included by levels.h for every instruction set. Lines, directions and
// coordinates are those of the silhouette gradient (sweep.h).

#include "crossings.h"

// --- which pixels can pull

// Gradients of one row of raster pixels (counted from the bottom), a plane [W + pad] for each channel. With a 2x2
// mean each pixel gets a quarter of the image's gradient.
template <class T>
NMR_INLINE void expand_color_row(const ColorImage<T>& image, int64_t j, T* row) {
  const int64_t w = image.size.width, W = image.raster.width, C = image.channels;
  const int64_t from_bottom = image.anti_aliasing ? j / 2 : j;
  const T* grad = image.grad_resolved + (image.size.height - 1 - from_bottom) * w * C;
  for (int64_t c = 0; c < C; ++c, row += W + kPad) {
    if (image.anti_aliasing)
      for (int64_t x = 0; x < w; ++x) row[2 * x] = row[2 * x + 1] = grad[x * C + c] / 4;
    else
      for (int64_t x = 0; x < w; ++x) row[x] = grad[x * C + c];
    std::fill_n(row + W, kPad, T(0));
  }
}

// Writes pixel m as number `at` of line n. grad: its gradients, `grad_stride` apart.
template <int64_t kChannels, class T>
NMR_INLINE void put_color(ScanlineColors<T>& lines, int64_t n, int64_t at, int64_t m, int32_t face_index,
                          const T* color, const T* grad, int64_t grad_stride) {
  const int64_t C = kChannels ? kChannels : lines.channels;
  T* out = lines.values.data() + (n * lines.stride + at / kLanes * kLanes) * (1 + 2 * C) + at % kLanes;
  out[0] = static_cast<T>(m);
  for (int64_t c = 0; c < C; ++c) {
    out[(1 + c) * kLanes] = color[c];
    out[(1 + C + c) * kLanes] = grad[c * grad_stride];
  }
  lines.face_indices(n)[at] = face_index;
}

// Bounds, padding and numbers of lines [first, last), when all their pixels have been seen.
template <class T>
NMR_INLINE void finish_color_lines(ScanlineColors<T>& lines, int64_t first, int64_t last, int64_t length) {
  const T infinity = std::numeric_limits<T>::infinity();
  for (int64_t n = first; n < last; ++n) {
    const int64_t count = lines.count[n], rest = count % kLanes;
    lines.outer_end[0][n] = count ? lines.position(n, count - 1) : -infinity;
    lines.outer_end[1][n] = count ? -lines.position(n, 0) : -infinity;
    lines.inner_start[1][n] = std::max(static_cast<T>(1 - length), -lines.inner_start[1][n]);
    T* block = lines.at(n, count / kLanes);
    for (int64_t k = 0; rest && k < 1 + 2 * lines.channels; ++k)
      std::fill(block + k * kLanes + rest, block + (k + 1) * kLanes, T(0));
  }
}

// Writes how many of the pixels of line n before pixel m, ..., m + 7 are listed. bits: which of these eight are;
// count: those before them.
template <class T>
NMR_INLINE void count_before(ScanlineColors<T>& lines, int64_t n, int64_t m, int64_t count, uint32_t bits) {
  // Byte k of `each` is bit k, and byte k of `below` the sum of the bytes before it.
  const uint64_t apart = bits * UINT64_C(0x0101010101010101) & UINT64_C(0x8040201008040201);
  const uint64_t each = (apart + UINT64_C(0x7f7f7f7f7f7f7f7f)) >> 7 & UINT64_C(0x0101010101010101);
  const uint64_t below = each * UINT64_C(0x0101010101010100);
  store_lanes(lines.before.data() + n * lines.step_n + m, splat(static_cast<int32_t>(count)) + byte_lanes(below));
}

// Fills the lines of a range: of columns, of rows, or of all. Columns come in groups of eight. grad_row: [C, W +
// pad] of scratch.
template <int64_t kChannels, class T>
NMR_INLINE void collect_colors_of(const ColorImage<T>& image, const LineRange& range, T* grad_row) {
  const int64_t H = image.raster.height, W = image.raster.width, C = kChannels ? kChannels : image.channels,
                plane = W + kPad;
  const bool in_rows = range.row_first < range.row_last, in_columns = range.column_first < range.column_last;
  ScanlineColors<T>&columns = image.lines[0], &rows = image.lines[1];
  start_lines(columns, range.column_first, range.column_last);
  start_lines(rows, range.row_first, range.row_last);
  const Lanes<T> zero = splat(T(0));
  const int64_t j_first = in_columns ? 0 : range.row_first, j_last = in_columns ? H : range.row_last;
  for (int64_t j = j_first; j < j_last; ++j) {
    const int64_t row = (H - 1 - j) * W;
    if (j == j_first || !image.anti_aliasing || j % 2 == 0) expand_color_row(image, j, grad_row);
    if (in_columns)
      std::copy(columns.count.begin() + range.column_first, columns.count.begin() + range.column_last,
                columns.before.begin() + j * columns.step_m + range.column_first);
    int64_t in_row = 0;  // number of listed pixels
    const int64_t i_last = in_rows ? W : range.column_last;
    for (int64_t start = in_rows ? 0 : range.column_first; start < i_last; start += kLanes) {
      LaneMask<T> listed = zero < zero;
      for (int64_t c = 0; c < C; ++c) {
        const Lanes<T> g = load_lanes<Lanes<T>>(grad_row + c * plane + start);
        listed = listed | (g < zero) | (g > zero);
      }
      const uint32_t bits = lane_bits(listed);
      if (in_rows) count_before(rows, j, start, in_row, bits);
      if (!bits) continue;
      Lanes32 id = splat(int32_t(-1));
      if (start + kLanes <= W)
        id = load_lanes<Lanes32>(image.face_index + row + start);
      else
        std::memcpy(&id, image.face_index + row + start, (W - start) * sizeof(int32_t));
      const Lanes32 on_face = id > splat(int32_t(-1));
      for (uint32_t rest = bits; rest; rest &= rest - 1) {
        const int64_t i = start + lowest_bit(rest);
        const T* color = image.color(row + i);
        const int32_t face_index = image.face_index[row + i];
        if (in_rows) put_color<kChannels>(rows, j, in_row++, i, face_index, color, grad_row + i, plane);
        if (in_columns) put_color<kChannels>(columns, i, columns.count[i], j, face_index, color, grad_row + i, plane);
      }
      if (in_rows) {
        const uint32_t gains = bits & lane_bits(on_face);
        T &first = rows.inner_start[0][j], &last = rows.inner_start[1][j];
        if (gains) {
          first = std::min(first, static_cast<T>(start));  // at least that
          last = static_cast<T>(start + kLanes - 1);       // at most that
        }
      }
      if (in_columns) {
        const LaneMask<T> gains = listed & widen_mask<T>(on_face);
        T *first = columns.inner_start[0].data() + start, *last = columns.inner_start[1].data() + start;
        const Lanes<T> line_first = load_lanes<Lanes<T>>(first), at = splat(static_cast<T>(j));
        store_lanes(first, select(gains & (line_first > at), at, line_first));
        store_lanes(last, select(gains, at, load_lanes<Lanes<T>>(last)));
        int32_t* count = columns.count.data() + start;
        store_lanes(count, load_lanes<Lanes32>(count) - narrow_mask(listed));
      }
    }
    if (in_rows) rows.count[j] = static_cast<int32_t>(in_row), rows.before[j * rows.step_n + W] = rows.count[j];
  }
  for (int64_t n = range.column_first; n < range.column_last; ++n)
    columns.before[H * columns.step_m + n] = columns.count[n];
  finish_color_lines(columns, range.column_first, range.column_last, H);
  finish_color_lines(rows, range.row_first, range.row_last, W);
}

// --- the pulls

// What eight pixels of a list gain if they take the reference colour: sum over channels of (colour - reference)
// gradient.
template <int64_t kChannels, class T>
NMR_INLINE Lanes<T> color_gains(const T* block, int64_t channels, const T* reference) {
  const int64_t C = kChannels ? kChannels : channels;
  const auto term = [&](int64_t c) {
    const Lanes<T> color = load_lanes<Lanes<T>>(block + (1 + c) * kLanes);
    return (color - splat(reference[c])) * load_lanes<Lanes<T>>(block + (1 + C + c) * kLanes);
  };
  Lanes<T> gain = term(0);
  for (int64_t c = 1; c < C; ++c) gain = gain + term(c);
  return gain;
}

// Adds the pulls of eight pixels at these offsets from the crossing, if the mask is set. The quotients w / h_p
// and w / h_q share one division: w / (h_p h_q) times h_q and h_p.
template <class T>
NMR_INLINE void pull_lanes(LaneMask<T> mask, Lanes<T> weight, Lanes<T> offset, const EdgeDerivative<T>& derivative,
                           Lanes<T>& pulls_p, Lanes<T>& pulls_q) {
  const Lanes<T> eps = splat(derivative.eps), zero = splat(T(0));
  const Lanes<T> p = offset * splat(derivative.factor_p), q = offset * splat(derivative.factor_q);
  const Lanes<T> h_p = p + select(p > zero, eps, zero - eps), h_q = q + select(q > zero, eps, zero - eps);
  const Lanes<T> share = keep(mask, weight / (h_p * h_q));
  pulls_p = pulls_p + keep(mask, share * h_q);
  pulls_q = pulls_q + keep(mask, share * h_p);
}

// The pulls of the listed pixels [first, last) of a line, if kOwn those of one face alone, for factors of extreme size.
template <bool kOwn, class T>
void pull_one_by_one(const ScanlineColors<T>& lines, int64_t n, int64_t first, int64_t last, int32_t id,
                     const T* reference, const EdgeDerivative<T>& derivative, T* pulls) {
  const int64_t C = lines.channels;
  const int32_t* face_index = lines.face_indices(n);
  for (int64_t k = first; k < last; ++k) {
    const T* pixel = lines.at(n, k / kLanes) + k % kLanes;
    T gain = 0;
    for (int64_t c = 0; c < C; ++c) gain += (pixel[(1 + c) * kLanes] - reference[c]) * pixel[(1 + C + c) * kLanes];
    if (gain > 0 && (!kOwn || face_index[k] == id)) pull(gain, pixel[0] - derivative.crossing, derivative, pulls);
  }
}

// Outside: every listed pixel beyond the crossing, from the outer one to the border, takes the colour of the inner
// one if the edge moves out to it.
template <bool kUp, int64_t kChannels, class T>
NMR_INLINE void pull_outside(const ScanlineColors<T>& lines, int64_t n, int64_t blocks, const T* reference,
                             const EdgeDerivative<T>& derivative, T* pulls) {
  // All offsets have the same sign, so the signs of both distances are constant.
  const T eps = kUp ? derivative.eps : -derivative.eps;
  const Lanes<T> crossing = splat(derivative.crossing), factor_p = splat(derivative.factor_p),
                 factor_q = splat(derivative.factor_q);
  const Lanes<T> eps_p = splat(derivative.factor_p > 0 ? eps : -eps),
                 eps_q = splat(derivative.factor_q > 0 ? eps : -eps);
  Lanes<T> pulls_p = splat(T(0)), pulls_q = splat(T(0));
  const int64_t C = kChannels ? kChannels : lines.channels, entry = kLanes * (1 + 2 * C);  // numbers of a block
  T near_color[kChannels ? kChannels : 1];  // a local copy: kept in registers
  if (kChannels) std::copy_n(reference, C, near_color), reference = near_color;
  const T* block = lines.at(n, kUp ? (lines.count[n] - 1) / kLanes : 0);  // from the border of the image inwards
  for (int64_t k = 0; k < blocks; ++k, block += kUp ? -entry : entry) {
    const Lanes<T> offset = load_lanes<Lanes<T>>(block) - crossing;
    const LaneMask<T> beyond = kUp ? offset > splat(T(0)) : offset < splat(T(0));
    const Lanes<T> gain = color_gains<kChannels>(block, C, reference);
    const LaneMask<T> acts = beyond & (gain > splat(T(0)));
    // The quotients w / h_p and w / h_q share one division: w / (h_p h_q) times h_q and h_p.
    const Lanes<T> h_p = offset * factor_p + eps_p, h_q = offset * factor_q + eps_q;
    const Lanes<T> share = keep(acts, gain / (h_p * h_q));
    pulls_p = pulls_p + share * h_q;
    pulls_q = pulls_q + share * h_p;
  }
  add_lane_sums<T>(pulls_p, pulls_q, pulls);
}

// Inside: the listed pixels [first, last) that face `id` owns take the colour of the outer one if the edge moves in
// past them.
template <int64_t kChannels, class T>
NMR_INLINE void pull_own(const ScanlineColors<T>& lines, int64_t n, int64_t first, int64_t last, int32_t id,
                         const T* reference, const EdgeDerivative<T>& derivative, T* pulls) {
  const int32_t* face_index = lines.face_indices(n);
  const int64_t C = kChannels ? kChannels : lines.channels;
  T far_color[kChannels ? kChannels : 1];  // a local copy: kept in registers
  if (kChannels) std::copy_n(reference, C, far_color), reference = far_color;
  Lanes<T> pulls_p = splat(T(0)), pulls_q = splat(T(0));
  const Lanes32 begin = splat(static_cast<int32_t>(first - 1)), end = splat(static_cast<int32_t>(last)),
                own = splat(id);
  for (int64_t k = first / kLanes * kLanes; k < last; k += kLanes) {
    const Lanes32 number = lane_numbers() + splat(static_cast<int32_t>(k));
    const Lanes32 here = (number > begin) & (number < end) & (load_lanes<Lanes32>(face_index + k) == own);
    const T* block = lines.at(n, k / kLanes);
    const Lanes<T> gain = color_gains<kChannels>(block, C, reference);
    const LaneMask<T> acts = widen_mask<T>(here) & (gain > splat(T(0)));
    pull_lanes<T>(acts, gain, load_lanes<Lanes<T>>(block) - splat(derivative.crossing), derivative, pulls_p, pulls_q);
  }
  add_lane_sums<T>(pulls_p, pulls_q, pulls);
}

// --- the sweeps

// Crossings of one axis and direction, before their pixels are pulled.
template <class T>
struct PlacedCrossings {
  // Inner pixel; listed pixels [first, last) inside; face; start (up) or end (down) of those outside; size of the list.
  int32_t pixel_at[kCrossings + kPad], first_at[kCrossings + kPad], last_at[kCrossings + kPad],
      id_at[kCrossings + kPad], outer_at[kCrossings + kPad], count_at[kCrossings + kPad];
  int32_t extreme[2][kCrossings + kPad];  // as Crossings::outer and ::inner, if a factor has extreme size
  T factor_p[kCrossings + kPad], factor_q[kCrossings + kPad];
  int64_t num_outer, num_inner, num_extreme[2];
};

// Places all crossings, and empties them; this does not depend on the channels.
template <bool kUp, class T>
void place_crossings(const ColorImage<T>& image, int axis, SweepScratch<T>& block, PlacedCrossings<T>& placed) {
  const int64_t H = image.raster.height, W = image.raster.width, length = axis == 0 ? H : W;
  const ScanlineColors<T>& lines = image.lines[axis];
  Crossings<T>& crossings = block.crossings[axis][kUp ? 0 : 1];
  const int32_t d = kUp ? 1 : -1;
  const T top = static_cast<T>(length - 1);  // the last pixel of a line
  // The inner pixel is floor(c) in the coordinate of the direction. It and the next one lie on the line if
  // start <= c < end.
  const Lanes<T> start = splat(kUp ? T(0) : -top), end = splat(kUp ? top : T(0)), zero = splat(T(0));
  // pixel m of line n: origin + n * step_n + m * step_m
  const int32_t across = static_cast<int32_t>(-W), step = axis == 0 ? across * d : d;
  const Lanes32 origin = splat(static_cast<int32_t>((H - 1) * W)), step_n = splat(axis == 0 ? int32_t(1) : across);
  const Lanes32 step_m = splat(step), all = splat(static_cast<int32_t>(crossings.count));
  const Lanes32 face_of = splat(static_cast<int32_t>(kSweptFaces - 1)), sign = splat(d);
  const Lanes32 last_pixel = splat(static_cast<int32_t>(length - 1)), none = splat(int32_t(0)), one = splat(int32_t(1));
  const Lanes32 before_n = splat(static_cast<int32_t>(lines.step_n)),
                before_m = splat(static_cast<int32_t>(lines.step_m));
  const Lanes<T> largest = splat(image.largest_factor);
  const int32_t* before = lines.before.data();
  int64_t num_outer = 0, num_inner = 0, num_extreme[2] = {0, 0};
  for (int64_t i = 0; i < crossings.count; i += kLanes) {
    const Lanes<T> at = load_lanes<Lanes<T>>(crossings.at + i);
    const Lanes32 number = lane_numbers() + splat(static_cast<int32_t>(i)), used = number < all;
    const LaneMask<T> on_line = (at >= start) & (at < end);
    const Lanes32 maybe_outer = used & narrow_mask(on_line & (at < load_lanes<Lanes<T>>(crossings.outer_end + i)));
    const Lanes32 maybe_inner = used & narrow_mask(on_line & (at >= load_lanes<Lanes<T>>(crossings.inner_start + i)));
    const Lanes32 wanted = maybe_outer | maybe_inner;
    if (!lane_bits(wanted)) continue;
    const Lanes32 line = keep(wanted, load_lanes<Lanes32>(crossings.line + i));
    const Lanes32 inner = truncate(floor_lanes<T>(keep(widen_mask<T>(wanted), at)));
    const Lanes32 pixel = keep(wanted, origin + line * step_n + inner * step_m);
    const Lanes32 edge = keep(used, load_lanes<Lanes32>(crossings.edge + i));
    const Lanes32 id = gather_lanes(block.id, edge & face_of);
    const Lanes32 inner_face_index = gather_lanes(image.face_index, pixel);
    // The pixels inside: from the inner one to the far side, at most one pixel beyond the line, as sweep_limit rounds.
    const Lanes<T> far_side = load_lanes<Lanes<T>>(crossings.far_side + i);
    Lanes<T> far = keep(far_side == far_side, far_side);
    far = select(far > splat(T(-1)), far, splat(T(-1)));
    far = select(far < splat(top + 1), far, splat(top + 1));
    const Lanes32 limit = truncate(kUp ? zero - floor_lanes<T>(zero - far) : floor_lanes<T>(far)), from = inner * sign;
    const Lanes32 low = select(from < limit, from, limit), high = select(from < limit, limit, from);
    // In the list of the line.
    const Lanes32 origin_n = line * before_n;
    const Lanes32 first = gather_lanes(before, origin_n + select(low < none, none, low) * before_m);
    const Lanes32 last =
        gather_lanes(before, origin_n + (select(high < last_pixel, high, last_pixel) + one) * before_m);
    const Lanes<T> reach = gather_values<T>(block.reach[axis], edge), scan = to_values<T>(line);
    const Lanes<T> by_p = reach / (gather_values<T>(block.qs[axis], edge) - scan);
    const Lanes<T> by_q = reach / (scan - gather_values<T>(block.ps[axis], edge));
    const LaneMask<T> moderate =
        (by_p < largest) & (by_p > zero - largest) & (by_q < largest) & (by_q > zero - largest);
    // Outside: from the outer pixel on, eight at a time, the first or the last eight together.
    const Lanes32 outer =
        gather_lanes(before, origin_n + (inner * sign + splat(kUp ? int32_t(1) : int32_t(0))) * before_m);
    store_lanes(placed.outer_at + i, outer);
    if (kUp) store_lanes(placed.count_at + i, gather_lanes(lines.count.data(), line));
    store_lanes(placed.pixel_at + i, pixel);
    store_lanes(placed.first_at + i, first);
    store_lanes(placed.last_at + i, last);
    store_lanes(placed.id_at + i, id);
    store_lanes(placed.factor_p + i, by_p);
    store_lanes(placed.factor_q + i, by_q);
    const uint32_t regular = lane_bits(moderate);
    const uint32_t pulls = lane_bits(maybe_outer & (inner_face_index == id)),
                   gains = lane_bits(maybe_inner & (first < last));
    num_outer += compress_lanes(number, pulls & regular, crossings.outer + num_outer);
    num_inner += compress_lanes(number, gains & regular, crossings.inner + num_inner);
    if (!((pulls | gains) & ~regular)) continue;
    num_extreme[0] += compress_lanes(number, pulls & ~regular, placed.extreme[0] + num_extreme[0]);
    num_extreme[1] += compress_lanes(number, gains & ~regular, placed.extreme[1] + num_extreme[1]);
  }
  crossings.count = 0;
  placed.num_outer = num_outer, placed.num_inner = num_inner;
  placed.num_extreme[0] = num_extreme[0], placed.num_extreme[1] = num_extreme[1];
}

// Sweeps all crossings of one axis and direction, and empties them.
template <bool kUp, int64_t kChannels, class T>
void sweep_crossings(const ColorImage<T>& image, int axis, SweepScratch<T>& block) {
  PlacedCrossings<T> placed;
  place_crossings<kUp>(image, axis, block, placed);
  const ScanlineColors<T>& lines = image.lines[axis];
  const Crossings<T>& crossings = block.crossings[axis][kUp ? 0 : 1];
  const int32_t* before = lines.before.data();
  const int32_t d = kUp ? 1 : -1, step = axis == 0 ? static_cast<int32_t>(-image.raster.width) * d : d;
  const auto derivative_of = [&](int32_t i) {
    return EdgeDerivative<T>{kUp ? crossings.at[i] : -crossings.at[i], placed.factor_p[i], placed.factor_q[i],
                             image.eps};
  };
  const auto pulls_of = [&](int32_t i) { return block.pulls[axis][crossings.edge[i]]; };
  for (int64_t k = 0; k < placed.num_outer; ++k) {
    const int32_t i = crossings.outer[k];
    const T* reference = image.pixels + placed.pixel_at[i] * image.channels;  // colour of the face
    const int64_t blocks = kUp ? (placed.count_at[i] + 7) / 8 - placed.outer_at[i] / 8 : (placed.outer_at[i] + 7) / 8;
    pull_outside<kUp, kChannels>(lines, crossings.line[i], blocks, reference, derivative_of(i), pulls_of(i));
  }
  for (int64_t k = 0; k < placed.num_extreme[0]; ++k) {
    const int32_t i = placed.extreme[0][k], n = crossings.line[i];
    const int64_t outer = d * static_cast<int64_t>(std::floor(crossings.at[i])) + d;
    const int64_t first = kUp ? before[n * lines.step_n + outer * lines.step_m] : 0;
    const int64_t last = kUp ? lines.count[n] : before[n * lines.step_n + (outer + 1) * lines.step_m];
    pull_one_by_one<false>(lines, n, first, last, 0, image.color(placed.pixel_at[i]), derivative_of(i), pulls_of(i));
  }
  for (int64_t k = 0; k < placed.num_inner; ++k) {
    const int32_t i = crossings.inner[k];
    const T* reference = image.color(placed.pixel_at[i] + step);
    pull_own<kChannels>(lines, crossings.line[i], placed.first_at[i], placed.last_at[i], placed.id_at[i], reference,
                        derivative_of(i), pulls_of(i));
  }
  for (int64_t k = 0; k < placed.num_extreme[1]; ++k) {
    const int32_t i = placed.extreme[1][k];
    const T* reference = image.color(placed.pixel_at[i] + step);
    pull_one_by_one<true>(lines, crossings.line[i], placed.first_at[i], placed.last_at[i], placed.id_at[i], reference,
                          derivative_of(i), pulls_of(i));
  }
}

// --- for any number of channels: 1, 3 and 4 are compiled in

template <class T>
void collect_colors(const ColorImage<T>& image, const LineRange& range, T* grad_row) {
  if constexpr (kOwnChannels<T>) {
    switch (image.channels) {
      case 1: return collect_colors_of<1>(image, range, grad_row);
      case 3: return collect_colors_of<3>(image, range, grad_row);
      case 4: return collect_colors_of<4>(image, range, grad_row);
    }
  }
  collect_colors_of<0>(image, range, grad_row);
}

template <bool kUp, class T>
NMR_INLINE void sweep_colors(const ColorImage<T>& image, int axis, SweepScratch<T>& block) {
  if constexpr (kOwnChannels<T>) {
    switch (image.channels) {
      case 1: return sweep_crossings<kUp, 1>(image, axis, block);
      case 3: return sweep_crossings<kUp, 3>(image, axis, block);
      case 4: return sweep_crossings<kUp, 4>(image, axis, block);
    }
  }
  sweep_crossings<kUp, 0>(image, axis, block);
}

// Gradients [3, 2] of x and y of the corners of visible faces [first, last) of the list.
template <class T>
void sweep_color_faces(const ColorImage<T>& image, const int32_t* ids, int64_t first, int64_t last,
                       SweepScratch<T>& block, T* grad) {
  const auto run = [](const ColorImage<T>& image, int axis, int direction, SweepScratch<T>& block) {
    direction == 0 ? sweep_colors<true>(image, axis, block) : sweep_colors<false>(image, axis, block);
  };
  for (int64_t n = first; n < last; n += kSweptFaces)
    sweep_block(image, ids + n, std::min(kSweptFaces, last - n), block, grad + 6 * n, run);
}
