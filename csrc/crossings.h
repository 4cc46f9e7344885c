// What the sweeps of silhouettes (sweep.h) and of colours (color_sweep.h) share: visible faces, the crossings of their
// edges with the lines of an image, and the derivatives of edges. Part of a level file (levels.h).

#include "visible.h"

// Whether all values are finite.
template <class T>
bool all_finite(const T* values, int64_t count) {
  Lanes<T> zeros = splat(T(0));
  int64_t n = 0;
  for (; n + kLanes <= count; n += kLanes) zeros = zeros + load_lanes<Lanes<T>>(values + n) * splat(T(0));
  T zero = 0;
  for (; n < count; ++n) zero += values[n] * T(0);
  return zero == T(0) && lane_bits(zeros == splat(T(0))) == 0xff;
}

// Empties lines [first, last) (ScanlineGrads or ScanlineColors). Until they are finished, inner_start holds the first
// and the last pixel that gains.
template <template <class> class Lines, class T>
NMR_INLINE void start_lines(Lines<T>& lines, int64_t first, int64_t last) {
  const T infinity = std::numeric_limits<T>::infinity();
  std::fill(lines.count.begin() + first, lines.count.begin() + last, 0);
  std::fill(lines.inner_start[0].begin() + first, lines.inner_start[0].begin() + last, infinity);
  std::fill(lines.inner_start[1].begin() + first, lines.inner_start[1].begin() + last, -infinity);
}

// --- how an edge follows a pull

// How the crossing c of an edge P-Q and a line n of M pixels moves with each end of the edge.
template <class T>
struct EdgeDerivative {
  T crossing;  // c
  T factor_p;  // 2 / M (Qs - Ps) / (Qs - n): travel of P, in [-1, 1] coordinates, that moves the crossing by one pixel
  T factor_q;  // 2 / M (Qs - Ps) / (n - Ps): the same of Q
  T eps;
};

// How far the end must travel to move the crossing by `offset` pixels; eps keeps it away from zero.
template <class T>
NMR_INLINE T travel(T factor, T offset, T eps) {
  const T h = factor * offset;
  return h > 0 ? h + eps : h - eps;
}

// The pull of one pixel, for pixels inside the face and for factors of extreme size. An end without a finite factor
// does not move.
template <class T>
NMR_INLINE void pull(T weight, T offset, const EdgeDerivative<T>& derivative, T* pulls) {
  if (std::isfinite(derivative.factor_p)) pulls[0] += weight / travel(derivative.factor_p, offset, derivative.eps);
  if (std::isfinite(derivative.factor_q)) pulls[1] += weight / travel(derivative.factor_q, offset, derivative.eps);
}

// --- the crossings of edges and lines

// Finds the crossings of the edges k, k + 1 of eight faces, from number `first` of the block, and the lines of an axis.
// Calls run(image, axis, direction, block) when a list of crossings is full.
template <class T, class Image, class Run>
NMR_INLINE void cross_edges(const Image& image, int axis, int k, int64_t first, SweepScratch<T>& block,
                            const Run& run) {
  const auto& lines = image.lines[axis];
  const T num_lines = static_cast<T>(axis == 0 ? image.raster.width : image.raster.height);
  const T length = static_cast<T>(axis == 0 ? image.raster.height : image.raster.width);
  const int64_t edge = k * kSweptFaces + first, q = k < 2 ? k + 1 : 0;
  const Lanes<T> ps = load_lanes<Lanes<T>>(block.corner[axis][k] + first);
  const Lanes<T> qs = load_lanes<Lanes<T>>(block.corner[axis][q] + first);
  const Lanes<T> pt = load_lanes<Lanes<T>>(block.corner[1 - axis][k] + first);
  const Lanes<T> qt = load_lanes<Lanes<T>>(block.corner[1 - axis][q] + first);
  const Lanes<T> zero = splat(T(0)), one = splat(T(1)), top = splat(num_lines - 1);
  const LaneMask<T> ascending = ps < qs;
  const Lanes<T> least = select(ascending, ps, qs), most = select(ascending, qs, ps);
  const Lanes<T> low = select(least > zero, least, zero), high = select(most < top, most, top);
  // Edges parallel to the scan line (least == most) are left out: neither end can move a crossing.
  const LaneMask<T> in_reach = (least < most) & (low <= top) & (high > splat(T(-1)));
  const Lanes<T> from = select(in_reach, low, one), to = select(in_reach, high, zero);
  const Lanes<T> whole = to_values<T>(truncate(from));
  const Lanes32 first_line = truncate(select(whole < from, whole + one, whole));
  // Truncation towards zero, as published: an edge that ends in (-1, 0) is extrapolated to line 0.
  const Lanes32 last_line = truncate(to);
  const Lanes<T> slope = (qt - pt) / (qs - ps);
  store_lanes(block.ps[axis] + edge, ps);
  store_lanes(block.qs[axis] + edge, qs);
  store_lanes(block.reach[axis] + edge, (qs - ps) * splat(T(2)) / splat(length));
  const uint32_t found = lane_bits(first_line <= last_line);
  const uint32_t up = axis == 0 ? ~lane_bits(ascending) : lane_bits(ascending);  // outward is towards larger t
  const LaneArray<int32_t, Lanes32> first_at(first_line), last_at(last_line);
  const LaneArray<int32_t, Lanes32> edge_at(lane_numbers() + splat(static_cast<int32_t>(edge)));

  // The far side is on edge P-O if the line crosses it, else on Q-O.
  const int64_t o = k > 0 ? k - 1 : 2;
  const Lanes<T> os = load_lanes<Lanes<T>>(block.corner[axis][o] + first);
  const Lanes<T> ot = load_lanes<Lanes<T>>(block.corner[1 - axis][o] + first);
  const LaneArray<T, Lanes<T>> os_at(os), pt_at(pt), qs_at(qs), qt_at(qt);
  const LaneArray<T, Lanes<T>> slope_po((ot - pt) / (os - ps)), slope_qo((ot - qt) / (os - qs));

  for (int direction = 0; direction < 2; ++direction) {
    Crossings<T>& crossings = block.crossings[axis][direction];
    const T *outer_end = lines.outer_end[direction].data(), *inner_start = lines.inner_start[direction].data();
    const LaneArray<T, Lanes<T>> slope_at(direction ? zero - slope : slope), height_at(direction ? zero - pt : pt);
    int64_t count = crossings.count;
    for (uint32_t bits = found & (direction ? ~up : up); bits; bits &= bits - 1) {
      const int64_t lane = lowest_bit(bits);
      const Lanes<T> scan = splat(block.ps[axis][edge + lane]);
      const Lanes<T> slopes = splat(slope_at.lane[lane]), height = splat(height_at.lane[lane]);
      const int32_t last = last_at.lane[lane];
      for (int32_t start = first_at.lane[lane]; start <= last; start += kLanes) {
        if (count > kCrossings - kLanes) {
          crossings.count = count;
          run(image, axis, direction, block);
          count = 0;
        }
        const Lanes32 line = lane_numbers() + splat(start);
        store_lanes(crossings.at + count, (to_values<T>(line) - scan) * slopes + height);
        store_lanes(crossings.outer_end + count, load_lanes<Lanes<T>>(outer_end + start));
        store_lanes(crossings.inner_start + count, load_lanes<Lanes<T>>(inner_start + start));
        store_lanes(crossings.line + count, line);
        if constexpr (Image::kFarSides) {
          const Lanes<T> n = to_values<T>(line);
          const auto of = [lane](const LaneArray<T, Lanes<T>>& values) { return splat(values.lane[lane]); };
          const LaneMask<T> before_p = (n - scan) * (n - of(os_at)) < zero;
          store_lanes(crossings.far_side + count, select(before_p, of(slope_po) * (n - scan) + of(pt_at),
                                                         of(slope_qo) * (n - of(qs_at)) + of(qt_at)));
        }
        store_lanes(crossings.edge + count, splat(edge_at.lane[lane]));
        count += std::min<int64_t>(last - start + 1, kLanes);  // lanes beyond the count are overwritten or ignored
      }
    }
    crossings.count = count;
  }
}

// Gradients [3, 2] of x and y of the corners of up to kSweptFaces visible faces, in the order in which they are drawn.
template <class T, class Image, class Run>
NMR_INLINE void sweep_block(const Image& image, const int32_t* ids, int64_t count, SweepScratch<T>& block, T* grad,
                            const Run& run) {
  for (int64_t n = 0; n < count; ++n) {
    const bool reversed = ids[n] >= image.num_faces;
    const int64_t* face = image.faces + 3 * (reversed ? ids[n] - image.num_faces : ids[n]);
    block.id[n] = ids[n];
    for (int k = 0; k < 3; ++k) {
      const T* vertex = image.vertices + 3 * face[reversed ? 2 - k : k];
      block.corner[0][k][n] = vertex[0];
      block.corner[1][k][n] = vertex[1];
    }
  }
  const int64_t padded = (count + kLanes - 1) / kLanes * kLanes;
  for (int axis = 0; axis < 2; ++axis) {
    const Lanes<T> size = splat(static_cast<T>(axis == 0 ? image.raster.width : image.raster.height));
    for (int k = 0; k < 3; ++k) {
      T* corner = block.corner[axis][k];
      std::fill(corner + count, corner + padded, T(0));
      for (int64_t n = 0; n < padded; n += kLanes) {  // to_pixel
        const Lanes<T> x = load_lanes<Lanes<T>>(corner + n);
        store_lanes(corner + n, (x * size + size - splat(T(1))) * splat(T(0.5)));
      }
      std::fill_n(block.pulls[axis][k * kSweptFaces], 2 * count, T(0));
    }
  }
  for (int axis = 0; axis < 2; ++axis) {
    for (Crossings<T>& crossings : block.crossings[axis]) crossings.count = 0;
    // A crossing is between two pixels of its line.
    const bool crossable = (axis == 0 ? image.raster.height : image.raster.width) > 1;
    for (int64_t n = 0; crossable && n < padded; n += kLanes)
      for (int k = 0; k < 3; ++k) cross_edges(image, axis, k, n, block, run);
    for (int direction = 0; direction < 2; ++direction) run(image, axis, direction, block);
    // Corner k is the start of edge k and the end of the one before. Axis 0 moves y, axis 1 moves x.
    for (int64_t n = 0; n < count; ++n)
      for (int k = 0; k < 3; ++k)
        grad[6 * n + 2 * k + 1 - axis] =
            0 - (block.pulls[axis][k * kSweptFaces + n][0] + block.pulls[axis][(k + 2) % 3 * kSweptFaces + n][1]);
  }
}
