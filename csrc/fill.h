// The inner loops of the rasterizer (rasterize.cpp).
#include "face_table.h"
#include "level_lanes.h"

namespace nmr::NMR_LEVEL {
namespace {

// --- set-up

// The first and the last of `size` pixels along one axis whose centres lie in [lo, hi]: a face
// covers no centre outside its bounding box. (The published kernels test every pixel, and draw
// wrong pixels for very thin faces.)
template <class T>
NMR_INLINE void pixel_range(Lanes<T> lo, Lanes<T> hi, T size, Lanes32& first, Lanes32& last) {
  const Lanes<T> length = splat(size), below = splat(T(-2)), above = splat(size + 1);
  const Lanes<T> from = pixel_coordinates<T>(lo, length), to = pixel_coordinates<T>(hi, length);
  const Lanes32 f = truncate(select(from > below, select(from < above, from, above), below));
  const Lanes32 l = truncate(select(to > below, select(to < above, to, above), below));
  const Lanes32 one = splat(int32_t(1)), n = splat(static_cast<int32_t>(size));
  // The error of pixel_coordinates is much less than one pixel: compare the two centres around it.
  // A mask is -1 where it is set.
  const Lanes32 from_left = f + f + one - n, to_left = l + l + one - n, two = splat(int32_t(2));
  const Lanes32 a = f - narrow_mask(to_values<T>(from_left) / length < lo) -
                    narrow_mask(to_values<T>(from_left + two) / length < lo);
  const Lanes32 b = l - one - narrow_mask(to_values<T>(to_left) / length <= hi) -
                    narrow_mask(to_values<T>(to_left + two) / length <= hi);
  first = max_of(a, splat(int32_t(0)));
  last = min_of(b, n - one);
}

// Bounds of q = 1 / depth, or -depth without perspective: level + slope_x i + slope_y j +- margin
// at any pixel (i, j) inside a face, and `nearest`, the largest q.
template <class T>
struct DepthBound {
  Lanes<T> slope_x, slope_y, level, margin, nearest;
};

// For faces with corners (x, y, z), whose depths lie in [lo, hi], lo > 0, on a raster of width x
// height pixels.
//
// The published weights come from the inverse of a matrix, clamped and normalised: q' = sum w_k /
// z_k. Let u be the unit roundoff, D twice the area in pixels and M the largest pixel coordinate
// (half the longer side at least). To first order, the errors are:
// - of the determinant 12 u M L, with L <= 2 M the longest side, the same for all three weights; of
// each weight
//   32 u M^2 / D more;
// - a pixel that passes the edge test may be outside by 48 u M^2 / D in terms of weights;
// - so each weight before normalisation is off by at most E = 110 u M^2 / D, and all weights
// together after it by
//   7.1 E (if E is small);
// - q' is off by half of that times the range of q at the corners, and by 8 u q for its own
// rounding;
// - the plane below adds 80 u M^2 / D times the range and 8 u q, because its coefficients are
// computed in double and
//   rounded.
// Without perspective q is -z, and the same holds with the largest |q| of the face for q.
// The margin is larger than the sum: 640 u M^2 / D times the range, and 32 u q. If the bounds of
// two faces are disjoint, their depths differ even after rounding. If E could be large, and for
// double, the bounds are those of the corners: q' is a weighted mean of their q.
template <class T>
NMR_INLINE DepthBound<T> bound_depth(const Lanes<T> (&x)[3], const Lanes<T> (&y)[3],
                                     const Lanes<T> (&z)[3], Lanes<T> lo, Lanes<T> hi, T width,
                                     T height, bool perspective) {
  constexpr T eps = std::numeric_limits<T>::epsilon();
  const Lanes<T> zero = splat(T(0)), most = perspective ? splat(T(1)) / lo : zero - lo;
  const Lanes<T> least = perspective ? splat(T(1)) / hi : zero - hi, range = most - least;
  const Lanes<T> rounding = splat(16 * eps) * (perspective ? most : hi), half = splat(T(0.5));
  DepthBound<T> bound{zero, zero, (most + least) * half, range * half + rounding, most + rounding};
  if constexpr (sizeof(T) < sizeof(double)) {
    using Wide = Lanes<double>;
    Wide X[3], Y[3], q[3];
    Lanes<T> M = splat((width > height ? width : height) /
                       2);  // even small pixel coordinates come from sums of this size
    for (int k = 0; k < 3; ++k) {
      const Lanes<T> px = pixel_coordinates<T>(x[k], splat(width)),
                     py = pixel_coordinates<T>(y[k], splat(height));
      M = max_of(M, max_of(absolute<T>(px), absolute<T>(py)));
      X[k] = convert_lanes<Wide>(px);
      Y[k] = convert_lanes<Wide>(py);
      const Wide depth = convert_lanes<Wide>(z[k]);
      q[k] = perspective ? splat(1.0) / depth : splat(0.0) - depth;
    }
    const Wide x1 = X[1] - X[0], x2 = X[2] - X[0], y1 = Y[1] - Y[0], y2 = Y[2] - Y[0],
               q1 = q[1] - q[0], q2 = q[2] - q[0];
    const Wide D = x1 * y2 - x2 * y1, M2 = convert_lanes<Wide>(M) * convert_lanes<Wide>(M),
               unit = splat(double(eps)) * M2;
    const auto is_wide = absolute<double>(D) > splat(2048.0) * unit;
    const Wide scale = select(is_wide, splat(1.0), splat(0.0)) / select(is_wide, D, splat(1.0));
    const Wide slope_x = (q1 * y2 - q2 * y1) * scale, slope_y = (x1 * q2 - x2 * q1) * scale;
    const Lanes<T> share = convert_lanes<Lanes<T>>(splat(320.0) * unit * absolute<double>(scale));
    const LaneMask<T> wide = share > zero;
    bound.slope_x = convert_lanes<Lanes<T>>(slope_x);
    bound.slope_y = convert_lanes<Lanes<T>>(slope_y);
    bound.level =
        select(wide, convert_lanes<Lanes<T>>(q[0] - slope_x * X[0] - slope_y * Y[0]), bound.level);
    bound.margin = select(wide, share * range + rounding, bound.margin);
  }
  return bound;
}

// Stores the bounds of the depths of eight faces, and returns the largest q of each. They are
// infinite for faces close to the limits of T or of depth. Those of the corners hold for the
// thinnest face, but all three of its weights could round to 0, and then it has no depth: it wins a
// pixel by its exact depth alone. largest: the largest coordinate of each, at least 1.
template <class T>
NMR_INLINE Lanes<T> store_bounds(const RasterSettings<T>& settings, const Lanes<T> (&x)[3],
                                 const Lanes<T> (&y)[3], const Lanes<T> (&z)[3], LaneMask<T> usable,
                                 Lanes<T> largest, FaceBlock<T>& block) {
  const T width = static_cast<T>(settings.raster.width),
          height = static_cast<T>(settings.raster.height);
  const T longer = width > height ? width : height, shorter = width > height ? height : width;
  const T near = settings.near, far = settings.far;
  const T moderate = std::sqrt(std::numeric_limits<T>::max()) /
                     4;  // products of two pixel coordinates stay finite
  const T eps = std::numeric_limits<T>::epsilon(), resolution = 288 * eps * (longer / shorter);
  const T smallest = std::sqrt(std::numeric_limits<T>::min()) /
                     eps;  // 1 / depth and its slopes stay ordinary numbers
  const Lanes<T> infinity = splat(std::numeric_limits<T>::infinity()), zero = splat(T(0)),
                 one = splat(T(1));
  const Lanes<T> lo = min_of(min_of(z[0], z[1]), z[2]), hi = max_of(max_of(z[0], z[1]), z[2]);
  const Lanes<T> det = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
  const LaneMask<T> bounded =
      usable & (splat(near) >= zero) & (largest * splat(longer) < splat(moderate)) &
      (lo * splat(1 - 16 * eps) > splat(near)) & (hi * splat(1 + 16 * eps) < splat(far)) &
      (lo > splat(smallest)) & (hi < splat(1 / smallest));
  const LaneMask<T> has_depth =
      bounded & (absolute<T>(det) >= splat(resolution) * largest * largest);
  // For faces without bounds, those of an ordinary triangle are computed and not used.
  const Lanes<T> ordinary_x[3] = {zero, one, zero}, ordinary_y[3] = {zero, zero, one};
  Lanes<T> bx[3], by[3], bz[3];
  for (int k = 0; k < 3; ++k) {
    bx[k] = select(bounded, x[k], ordinary_x[k]);
    by[k] = select(bounded, y[k], ordinary_y[k]);
    bz[k] = select(bounded, z[k], one);
  }
  const DepthBound<T> bound =
      bound_depth<T>(bx, by, bz, select(bounded, lo, one), select(bounded, hi, one), width, height,
                     settings.perspective);
  const Lanes<T> nearest = select(bounded, bound.nearest, infinity);
  store_lanes(block.slope_x, bound.slope_x);
  store_lanes(block.slope_y, bound.slope_y);
  store_lanes(block.level, bound.level);
  store_lanes(block.margin, select(bounded, bound.margin, infinity));
  store_lanes(block.win_margin, select(has_depth, bound.margin, infinity));
  store_lanes(block.nearest, nearest);
  return nearest;
}

// Sets up the faces of a chunk and lists those that are drawn.
template <class T>
void set_up_faces(const Image<T>& image, int64_t chunk) {
  FaceTable<T>& table = *image.table;
  const int64_t first = chunk * kFaceChunk, last = std::min(first + kFaceChunk, image.num_faces);
  const T width = static_cast<T>(image.settings.raster.width),
          height = static_cast<T>(image.settings.raster.height);
  const T* vertices = image.vertices;
  const Lanes<T> infinity = splat(std::numeric_limits<T>::infinity()), zero = splat(T(0)),
                 one = splat(T(1));
  int64_t num_front = 0, num_back = 0;
  Lanes<T> front_sum = zero, back_sum = zero;
  const Lanes32 most = splat(std::numeric_limits<int32_t>::max()), least = splat(int32_t(-1));
  Lanes32 column_first = most, column_last = least, row_first = most, row_last = least;
  int32_t *front = table.front.data() + first, *back = table.back.data() + first;

  for (int64_t f = first; f < last; f += kLanes) {
    int32_t corner[3][kLanes];
    const int64_t lanes = std::min(kLanes, last - f);
    for (int64_t n = 0; n < kLanes; ++n) {
      const int64_t* face = image.faces + 3 * (f + (n < lanes ? n : 0));
      for (int k = 0; k < 3; ++k) corner[k][n] = static_cast<int32_t>(3 * face[k]);
    }
    Lanes<T> x[3], y[3], z[3];
    for (int k = 0; k < 3; ++k) {
      x[k] = gather_values(vertices, corner[k]);
      y[k] = gather_values(vertices + 1, corner[k]);
      z[k] = gather_values(vertices + 2, corner[k]);
    }
    FaceBlock<T>& block = table.blocks[f / kLanes];
    for (int k = 0; k < 3; ++k) {
      store_lanes(block.x[k], x[k]);
      store_lanes(block.y[k], y[k]);
    }
    // Both orders are tested: for very thin faces, rounding can make both or neither
    // counter-clockwise.
    const LaneMask<T> not_ccw = (y[2] - y[0]) * (x[1] - x[0]) < (y[1] - y[0]) * (x[2] - x[0]);
    const LaneMask<T> not_cw = (y[0] - y[2]) * (x[1] - x[2]) < (y[1] - y[2]) * (x[0] - x[2]);
    Lanes<T> largest = one;
    LaneMask<T> usable = (z[0] == z[0]) & (z[1] == z[1]) & (z[2] == z[2]);
    for (int k = 0; k < 3; ++k) {
      const Lanes<T> ax = absolute<T>(x[k]), ay = absolute<T>(y[k]);
      usable = usable & (ax < infinity) & (ay < infinity);
      largest = max_of(max_of(ax, ay), largest);
    }
    const Lanes<T> nearest = store_bounds(image.settings, x, y, z, usable, largest, block);
    Lanes32 i0, i1, j0, j1;
    pixel_range<T>(min_of(min_of(x[0], x[1]), x[2]), max_of(max_of(x[0], x[1]), x[2]), width, i0,
                   i1);
    pixel_range<T>(min_of(min_of(y[0], y[1]), y[2]), max_of(max_of(y[0], y[1]), y[2]), height, j0,
                   j1);
    store_lanes(block.column_first, i0);
    store_lanes(block.column_last, i1);
    store_lanes(block.row_first, j0);
    store_lanes(block.row_last, j1);
    column_first = min_of(column_first, i0);
    column_last = max_of(column_last, i1);
    row_first = min_of(row_first, j0);
    row_last = max_of(row_last, j1);

    const uint32_t drawn =
        lane_bits(narrow_mask(usable) & (i0 <= i1) & (j0 <= j1)) & (0xffu >> (kLanes - lanes));
    const uint32_t front_bits = drawn & ~lane_bits(not_ccw);
    const uint32_t back_bits = image.settings.fill_back ? drawn & ~lane_bits(not_cw) : 0;
    const Lanes32 numbers = lane_numbers() + splat(static_cast<int32_t>(f));
    num_front += compress_lanes(numbers, front_bits, front + num_front);
    num_back += compress_lanes(numbers, back_bits, back + num_back);
    const Lanes<T> known = keep(nearest < infinity, nearest);
    front_sum = front_sum + select(not_ccw, zero, known);
    back_sum = back_sum + select(not_cw, zero, known);
  }
  const LaneArray<T, Lanes<T>> fronts(front_sum), backs(back_sum);
  table.front_sum[chunk] = table.back_sum[chunk] = 0;
  for (int64_t k = 0; k < kLanes; ++k) {
    table.front_sum[chunk] += fronts.lane[k];
    table.back_sum[chunk] += backs.lane[k];
  }
  table.num_front[chunk] = static_cast<int32_t>(num_front);
  table.num_back[chunk] = static_cast<int32_t>(num_back);
  const Lanes32 none = splat(int32_t(0));
  table.boxes[chunk] = {least_lane<int32_t>(column_first), -least_lane<int32_t>(none - column_last),
                        least_lane<int32_t>(row_first), -least_lane<int32_t>(none - row_last)};
}

// --- fill

// Depths at eight pixels of a row, as published.
template <class T>
NMR_INLINE Lanes<T> exact_depths(const FacePlane<T>& plane, Lanes<T> column, T row,
                                 bool perspective) {
  const auto& m = plane.weights.m;
  Lanes<T> w[3], z[3];
  for (int k = 0; k < 3; ++k) {
    w[k] = column * splat(m[k][0]) + splat(m[k][1] * row) + splat(m[k][2]);
    z[k] = splat(plane.z[k]);
  }
  normalize_weights(w, splat(T(0)), splat(T(1)));
  return lane_depths(w, z, splat(T(1)), perspective);
}

constexpr int32_t kBits[kLanes] = {1, 2, 4, 8, 16, 32, 64, 128};

// Which of the contested pixels among (i .. i + 7, j) face `id` wins: it is nearer there, by exact
// depth, than the face stored so far. Of equally near faces the one with the smaller index wins, in
// whichever order they are filled.
template <class T>
LaneMask<T> contest(const Image<T>& image, const FacePlane<T>& plane, int32_t id,
                    uint32_t contested_bits, int64_t i, int64_t j, const int32_t* face_index_at) {
  const Lanes<T> column = to_values<T>(lane_numbers() + splat(static_cast<int32_t>(i)));
  const T row = static_cast<T>(j);
  const bool perspective = image.settings.perspective;
  const Lanes<T> z = exact_depths(plane, column, row, perspective);
  const Lanes32 bit = load_lanes<Lanes32>(kBits),
                among = splat(static_cast<int32_t>(contested_bits)) & bit;
  const LaneMask<T> contested = widen_mask<T>(among > splat(int32_t(0))) &
                                (z > splat(image.settings.near)) &
                                (z < splat(image.settings.far));  // false for NaN
  const Lanes32 face_index = load_lanes<Lanes32>(face_index_at);
  LaneMask<T> wins = contested & widen_mask<T>(face_index < splat(int32_t(0))),
              open = without(contested, wins);
  for (uint32_t bits = lane_bits(open); bits; bits = lane_bits(open)) {
    const int32_t rival = face_index_at[lowest_bit(bits)];
    const LaneMask<T> here = open & widen_mask<T>(face_index == splat(rival));
    const Lanes<T> theirs = exact_depths(face_plane(image, rival), column, row, perspective);
    wins = wins | (here & (id < rival ? z <= theirs : z < theirs));
    open = without(open, here);
  }
  return wins;
}

// Fills one face into a band.
template <class T>
NMR_INLINE void fill_face(const Image<T>& image, int32_t f, bool reversed, const Band<T>& band) {
  const FaceBlock<T>& block = image.table->blocks[f / kLanes];
  const int64_t n = f % kLanes, i_first = block.column_first[n], i_last = block.column_last[n];
  const int64_t j_first = std::max<int64_t>(block.row_first[n], band.row_first);
  const int64_t j_last = std::min<int64_t>(block.row_last[n], band.row_last);
  if (j_first > j_last) return;
  const bool has_depth = block.win_margin[n] < std::numeric_limits<T>::infinity();
  if (!has_depth && !is_drawable(load_triangle(image.vertices, image.faces + 3 * f, false))) return;
  const int32_t id = reversed ? f + static_cast<int32_t>(image.num_faces) : f;
  const int k0 = reversed ? 2 : 0, k2 = reversed ? 0 : 2;
  const T x0 = block.x[k0][n], x1 = block.x[1][n], x2 = block.x[k2][n];
  const T y0 = block.y[k0][n], y1 = block.y[1][n], y2 = block.y[k2][n];
  const Lanes<T> margin = splat(block.margin[n]), win_margin = splat(block.win_margin[n]);
  const Lanes32 ids = splat(id);
  const Lanes<T> x0s = splat(x0), x1s = splat(x1), x2s = splat(x2);
  const Lanes<T> dy0 = splat(y1 - y0), dy1 = splat(y2 - y1), dy2 = splat(y0 - y2);
  const Lanes<T> slope_x = splat(block.slope_x[n]), level = splat(block.level[n]);
  const int64_t stride = band.stride;
  for (int64_t top = j_first; top <= j_last; top += kLanes) {
    // What depends on the row alone: of eight rows at a time.
    T row_terms[4][kLanes];
    const Lanes<T> yp = load_lanes<Lanes<T>>(band.rows + top);
    store_lanes(row_terms[0], (yp - splat(y0)) * splat(x1 - x0));
    store_lanes(row_terms[1], (yp - splat(y1)) * splat(x2 - x1));
    store_lanes(row_terms[2], (yp - splat(y2)) * splat(x0 - x2));
    store_lanes(row_terms[3], to_values<T>(lane_numbers() + splat(static_cast<int32_t>(top))) *
                                  splat(block.slope_y[n]));
    const int64_t rows = std::min(kLanes, j_last - top + 1);
    for (int64_t i = i_first; i <= i_last; i += kLanes) {
      const Lanes<T> xp = load_lanes<Lanes<T>>(band.columns + i);
      const Lanes<T> c0 = (xp - x0s) * dy0, c1 = (xp - x1s) * dy1, c2 = (xp - x2s) * dy2;
      const Lanes32 number = lane_numbers() + splat(static_cast<int32_t>(i));
      const LaneMask<T> off_box = widen_mask<T>(number > splat(static_cast<int32_t>(i_last)));
      const Lanes<T> q_column = to_values<T>(number) * slope_x + level;
      const int64_t start = (top - band.row_first) * stride + i;
      T *most = band.most + start, *least = band.least + start;
      int32_t* face_index = band.face_index + start;
      uint8_t contested[kLanes];
      uint32_t any_contested = 0;
      for (int64_t r = 0; r < rows; ++r, most += stride, least += stride, face_index += stride) {
        const LaneMask<T> outside = (splat(row_terms[0][r]) < c0) | (splat(row_terms[1][r]) < c1) |
                                    (splat(row_terms[2][r]) < c2);
        const Lanes<T> q = q_column + splat(row_terms[3][r]), q_most = q + margin,
                       q_least = q - win_margin;
        const Lanes<T> pixel_most = load_lanes<Lanes<T>>(most),
                       pixel_least = load_lanes<Lanes<T>>(least);
        const LaneMask<T> unsettled = without(q_most >= pixel_least, outside | off_box),
                          clear = q_least > pixel_most;
        const LaneMask<T> wins = unsettled & clear;
        const uint32_t bits = lane_bits(without(unsettled, clear));
        contested[r] = static_cast<uint8_t>(bits);
        any_contested |= bits;
        store_lanes(most, choose(wins, q_most, pixel_most));
        store_lanes(least, choose(wins, q_least, pixel_least));
        store_lanes(face_index, choose(narrow_mask(wins), ids, load_lanes<Lanes32>(face_index)));
      }
      if (!any_contested) continue;
      const FacePlane<T> plane = face_plane(image, id);
      for (int64_t r = 0; r < rows; ++r) {
        if (!contested[r]) continue;
        const int64_t at = start + r * stride;
        const LaneMask<T> wins =
            contest<T>(image, plane, id, contested[r], i, top + r, band.face_index + at);
        const Lanes<T> q = q_column + splat(row_terms[3][r]);
        store_lanes(band.most + at, choose(wins, q + margin, load_lanes<Lanes<T>>(band.most + at)));
        store_lanes(band.least + at,
                    choose(wins, q - margin, load_lanes<Lanes<T>>(band.least + at)));
        store_lanes(band.face_index + at,
                    choose(narrow_mask(wins), ids, load_lanes<Lanes32>(band.face_index + at)));
      }
    }
  }
}

// The part of a band that faces can reach, in whole blocks of pixels. Columns and rows count from
// the band's first; the last ones are excluded. The rest of the band stays background, and its
// memory is not touched.
struct Window {
  int64_t column_first, column_last, row_first, row_last;
};

template <class T>
Window find_window(const FaceTable<T>& table, int64_t chunks, const Band<T>& band) {
  PixelBox box{std::numeric_limits<int32_t>::max(), -1, std::numeric_limits<int32_t>::max(), -1};
  for (int64_t c = 0; c < chunks; ++c) {
    const PixelBox& part = table.boxes[c];
    box = {std::min(box.column_first, part.column_first),
           std::max(box.column_last, part.column_last), std::min(box.row_first, part.row_first),
           std::max(box.row_last, part.row_last)};
  }
  const int64_t rows = band.row_last - band.row_first + 1;
  const int64_t first = std::max<int64_t>(box.row_first - band.row_first, 0);
  const int64_t last = std::min<int64_t>(box.row_last - band.row_first, rows - 1);
  if (first > last || box.column_first > box.column_last) return {0, 0, 0, 0};
  return {box.column_first / kLanes * kLanes, (box.column_last / kLanes + 1) * kLanes,
          first / kLanes * kLanes, std::min((last / kLanes + 1) * kLanes, rows)};
}

// The least q in each block of pixels of the window.
template <class T>
NMR_INLINE void bound_blocks(const Band<T>& band, const Window& window, int64_t blocks,
                             T* block_least) {
  for (int64_t j = window.row_first; j < window.row_last; j += kLanes)
    for (int64_t n = window.column_first / kLanes; n < window.column_last / kLanes; ++n) {
      const T* row = band.least + j * band.stride + n * kLanes;
      Lanes<T> least = load_lanes<Lanes<T>>(row);
      for (int64_t r = j + 1; r < std::min(j + kLanes, window.row_last); ++r) {
        row += band.stride;
        least = min_of(load_lanes<Lanes<T>>(row), least);
      }
      block_least[(j / kLanes) * blocks + n] = least_lane<T>(least);
    }
}

// True if every pixel of the face's box already has a nearer face.
template <class T>
NMR_INLINE bool is_hidden(const FaceTable<T>& table, int32_t f, const Band<T>& band, int64_t blocks,
                          const T* block_least) {
  constexpr uint32_t kSide = kLanes;  // unsigned, so that divisions are shifts
  const FaceBlock<T>& block = table.blocks[f / kLanes];
  const int64_t lane = f % kLanes;
  const int32_t band_first = static_cast<int32_t>(band.row_first),
                band_last = static_cast<int32_t>(band.row_last);
  const int32_t j_first = std::max(block.row_first[lane], band_first) - band_first;
  const int32_t j_last = std::min(block.row_last[lane], band_last) - band_first;
  if (j_first > j_last) return true;  // outside the band
  const uint32_t n_first = static_cast<uint32_t>(block.column_first[lane]) / kSide;
  const uint32_t n_last = static_cast<uint32_t>(block.column_last[lane]) / kSide,
                 last = static_cast<uint32_t>(j_last) / kSide;
  const T nearest = block.nearest[lane];
  const uint32_t first = static_cast<uint32_t>(j_first) / kSide;
  if (last - first <= 1 &&
      n_last - n_first <= 1) {  // most faces; the processor could not foresee when a loop ends
    const T *low = block_least + first * blocks, *high = block_least + last * blocks;
    return nearest <
           std::min(std::min(low[n_first], low[n_last]), std::min(high[n_first], high[n_last]));
  }
  for (uint32_t j = first; j <= last; ++j) {
    const T* least = block_least + j * blocks;
    for (uint32_t n = n_first; n <= n_last; ++n)
      if (!(nearest < least[n])) return false;
  }
  return true;
}

// Fills all faces into one band of rows, and copies the reached pixels to the image's face index
// map.
template <class T>
void fill_band(const Image<T>& image, const Band<T>& args, int64_t blocks, T* block_least,
               int32_t* face_index) {
  const Band<T> band = args;  // a copy that no store of pixels can change
  const FaceTable<T>& table = *image.table;
  const int64_t rows = band.row_last - band.row_first + 1, H = band.raster.height,
                W = band.raster.width;
  const int64_t chunks = (image.num_faces + kFaceChunk - 1) / kFaceChunk;
  const Window window = find_window(table, chunks, band);
  const Lanes<T> nothing = splat(-std::numeric_limits<T>::infinity());
  const Lanes32 background = splat(int32_t(-1));
  for (int64_t j = window.row_first; j < window.row_last; ++j)
    // One vector more, as a vector that starts in the last block may reach beyond it.
    for (int64_t i = window.column_first; i <= window.column_last; i += kLanes) {
      store_lanes(band.most + j * band.stride + i, nothing);
      store_lanes(band.least + j * band.stride + i, nothing);
      store_lanes(band.face_index + j * band.stride + i, background);
    }
  // Draw the nearer of the two lists first, so that most faces of the other one are hidden.
  T front_sum = 0, back_sum = 0;
  int64_t num_front = 0, num_back = 0;
  for (int64_t c = 0; c < chunks; ++c) {
    front_sum += table.front_sum[c];
    back_sum += table.back_sum[c];
    num_front += table.num_front[c];
    num_back += table.num_back[c];
  }
  const bool back_first =
      back_sum * static_cast<T>(num_front) > front_sum * static_cast<T>(num_back);
  for (int pass = 0; pass < 2; ++pass) {
    const bool reversed = (pass == 0) == back_first;
    if (pass == 1) bound_blocks(band, window, blocks, block_least);
    for (int64_t c = 0; c < chunks; ++c) {
      if (table.boxes[c].row_last < band.row_first || table.boxes[c].row_first > band.row_last)
        continue;
      const int32_t* list = (reversed ? table.back : table.front).data() + c * kFaceChunk;
      const int32_t count = (reversed ? table.num_back : table.num_front)[c];
      for (int32_t n = 0; n < count; ++n)
        if (pass == 0 || !is_hidden(table, list[n], band, blocks, block_least))
          fill_face(image, list[n], reversed, band);
    }
  }
  const int64_t first = window.column_first, last = std::min(window.column_last, W);
  for (int64_t j = 0; j < rows; ++j) {
    int32_t* row = face_index + (H - 1 - band.row_first - j) * W;
    if (j < window.row_first || j >= window.row_last) {
      std::fill_n(row, W, -1);
      continue;
    }
    std::fill_n(row, first, -1);
    std::memcpy(row + first, band.face_index + j * band.stride + first,
                (last - first) * sizeof(int32_t));
    std::fill_n(row + last, W - last, -1);
  }
}

// alpha [w]: the covered shares of the pixels of a row, from the rows of the face index map.
template <class T>
NMR_INLINE void cover_row(const int32_t* face_index, int64_t w, bool anti_aliasing, T* alpha) {
  if (!anti_aliasing) {
    for (int64_t x = 0; x < w; ++x) alpha[x] = face_index[x] >= 0 ? T(1) : T(0);
    return;
  }
  const int32_t *upper = face_index, *lower = face_index + 2 * w;
  for (int64_t x = 0; x < w; ++x) {
    const int upper_covered = (upper[2 * x] >= 0) + (upper[2 * x + 1] >= 0);
    const int lower_covered = (lower[2 * x] >= 0) + (lower[2 * x + 1] >= 0);
    alpha[x] = share_of_pixel<T>(true) * static_cast<T>(upper_covered + lower_covered);
  }
}

// The band's part of the silhouette.
template <class T>
void cover_band(const Band<T>& band, const int32_t* face_index, bool anti_aliasing, T* alpha) {
  const int64_t scale = anti_aliasing ? 2 : 1, w = band.raster.width / scale;
  const int64_t last = (band.raster.height - band.row_first) / scale;
  for (int64_t y = (band.raster.height - 1 - band.row_last) / scale; y < last; ++y)
    cover_row(face_index + y * scale * band.raster.width, w, anti_aliasing, alpha + y * w);
}

}  // namespace
}  // namespace nmr::NMR_LEVEL
