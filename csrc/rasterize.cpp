// Which face is nearest at each pixel of each image.
//
// Three steps per image. Set-up: for each face, the vertex orders that face the camera, its box of pixels, bounds of its depth. Fill:
// for each face (all originals, then all reversed copies), mark the pixels inside. Copy: to the owner map. The published depth needs
// sixteen divisions per pixel, and its rounding decides which face is nearer; it is computed only where the bounds do not decide.
// Several threads can share one image: set-up by chunks of faces, fill by bands of rows.
//
// The bounds are those of q = 1 / depth, which is linear on the screen: at a pixel (i, j) inside a face, q differs from
// slope_x i + slope_y j + level by at most `margin`. See `bound_depth`.
#include <algorithm>
#include <cstring>
#include <limits>
#include <vector>

#include "geometry.h"
#include "lanes.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

constexpr int64_t kChunk = 2048;    // faces that one thread sets up together
constexpr int64_t kBlock = 8;       // pixels per side of a block; the second pass knows the farthest depth of each block

// Data of each face for the fill; arrays over faces.
template <class T>
struct FaceTable {
  std::vector<T> x[3], y[3];                     // corners, in the face's own order
  std::vector<T> slope_x, slope_y, level;        // of q = 1 / depth
  std::vector<T> margin;                         // infinity: no bounds
  std::vector<T> nearest;                        // largest q at any pixel
  std::vector<int32_t> column_first, column_last, row_first, row_last;  // pixels inside the bounding box
  std::vector<int32_t> front, back;              // per chunk: faces drawn in their own order, and reversed; ascending
  std::vector<int32_t> num_front, num_back;      // [chunks]
  std::vector<T> front_sum, back_sum;            // [chunks] sums of `nearest` over them

  void reserve_faces(int64_t num_faces) {
    const size_t size = static_cast<size_t>(num_faces + kLanes * 2);
    for (int k = 0; k < 3; ++k) {
      reserve(x[k], size);
      reserve(y[k], size);
    }
    for (std::vector<T>* v : {&slope_x, &slope_y, &level, &margin, &nearest}) reserve(*v, size);
    for (std::vector<int32_t>* v : {&column_first, &column_last, &row_first, &row_last, &front, &back}) reserve(*v, size);
    for (std::vector<int32_t>* v : {&num_front, &num_back}) reserve(*v, size / kChunk + 1);
    for (std::vector<T>* v : {&front_sum, &back_sum}) reserve(*v, size / kChunk + 1);
  }
};

// Rows of one band of an image, padded so that a vector of pixels may reach past the last column.
template <class T>
struct BandScratch {
  std::vector<T> columns, rows;  // [W + lanes] and [H] pixel centres in [-1, 1]
  Size raster{0, 0};             // for which they are computed
  std::vector<T> most, least;    // [rows, W + lanes] bounds of the owner's q = 1 / depth; -infinity on background
  std::vector<int32_t> owner;    // [rows, W + lanes]
  std::vector<T> block_least;    // [rows / block, W / block] the smallest of `least` in a block
};

template <class T>
struct Image {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  RasterSettings<T> settings;
  FaceTable<T>* table;
};

// The numbers from which the depth of a face is computed at any pixel.
template <class T>
struct FacePlane {
  BarycentricMatrix<T> weights;
  T z[3];
};

// Those of face `id`, which is a reversed copy if id >= num_faces.
template <class T>
NMR_INLINE FacePlane<T> face_plane(const Image<T>& image, int32_t id) {
  const bool reversed = id >= image.num_faces;
  const Triangle<T> t = load_triangle(image.vertices, image.faces + 3 * (reversed ? id - image.num_faces : id), reversed);
  const Size raster = image.settings.raster;
  return {barycentric_matrix(t, static_cast<T>(raster.width), static_cast<T>(raster.height)), {t.z[0], t.z[1], t.z[2]}};
}

// Depths at eight pixels of a row, as published.
template <class T>
NMR_INLINE Lanes<T> exact_depths(const FacePlane<T>& plane, Lanes<T> column, T row) {
  const auto& m = plane.weights.m;
  Lanes<T> w[3];
  for (int k = 0; k < 3; ++k) {
    w[k] = column * m[k][0] + m[k][1] * row + m[k][2];
    w[k] = select(w[k] > T(0), w[k], splat(T(0)));
    w[k] = select(w[k] < T(1), w[k], splat(T(1)));
  }
  const Lanes<T> sum = w[0] + w[1] + w[2];
  return T(1) / (w[0] / sum / plane.z[0] + w[1] / sum / plane.z[1] + w[2] / sum / plane.z[2]);
}

// Pixels along one axis whose centres lie in [lo, hi]: a face covers no centre outside its bounding box. (The published kernels test
// every pixel, and draw wrong pixels for very thin faces.)
template <class T>
NMR_INLINE void pixel_range(T lo, T hi, T size, int32_t& first, int32_t& last) {
  const T from = to_pixel(lo, size), to = to_pixel(hi, size);
  const int32_t f = static_cast<int32_t>(from > -2 ? (from < size + 1 ? from : size + 1) : T(-2));
  const int32_t l = static_cast<int32_t>(to > -2 ? (to < size + 1 ? to : size + 1) : T(-2));
  const int32_t n = static_cast<int32_t>(size);
  // the error of to_pixel is much less than one pixel: compare the two centres around it
  const auto centre = [n, size](int32_t i) { return static_cast<T>(2 * i + 1 - n) / size; };
  const int32_t a = f + (centre(f) < lo) + (centre(f + 1) < lo);
  const int32_t b = l - 1 + (centre(l) <= hi) + (centre(l + 1) <= hi);
  first = a > 0 ? a : 0;
  last = b < n - 1 ? b : n - 1;
}

// Bounds of q = 1 / depth of one face: level + slope_x i + slope_y j +- margin at any pixel (i, j) inside it, and `nearest`.
template <class T>
struct DepthBound {
  T slope_x, slope_y, level, margin, nearest;
};

// For a face with corners (x, y, z), whose depths lie in [lo, hi], lo > 0, on a raster of width x height pixels.
//
// The published weights come from the inverse of a matrix, clamped and normalised: q' = sum w_k / z_k. Let u be the unit roundoff, D
// twice the area in pixels and M the largest pixel coordinate (half the longer side at least). To first order, the errors are:
// - of the determinant 12 u M L, with L <= 2 M the longest side, the same for all three weights; of each weight 32 u M^2 / D more;
// - a pixel that passes the edge test may lie outside by 48 u M^2 / D in terms of weights;
// - so each weight before normalisation is off by at most E = 110 u M^2 / D, and all weights together after it by 7.1 E (if E is small);
// - q' is off by half of that times the range of q at the corners, and by 8 u q for its own rounding;
// - the plane below adds 80 u M^2 / D times the range and 8 u q, because its coefficients are computed in double and rounded.
// The margin is larger than the sum: 640 u M^2 / D times the range, and 32 u q. If the bounds of two faces are disjoint, their depths
// differ even after rounding. If E could be large, and for double, the bounds are those of the corners: q' is a weighted mean of their q.
template <class T>
NMR_INLINE DepthBound<T> bound_depth(const T (&x)[3], const T (&y)[3], const T (&z)[3], T lo, T hi, T width, T height) {
  constexpr T eps = std::numeric_limits<T>::epsilon();
  const T most = 1 / lo, least = 1 / hi, range = most - least, rounding = 16 * eps * most;
  DepthBound<T> bound{0, 0, (most + least) / 2, range / 2 + rounding, most + rounding};
  if constexpr (sizeof(T) < sizeof(double)) {
    double X[3], Y[3], q[3];
    T M = std::max(width, height) / 2;  // even small pixel coordinates come from sums of this size
    for (int k = 0; k < 3; ++k) {
      const T px = to_pixel(x[k], width), py = to_pixel(y[k], height);
      M = max3(M, std::abs(px), std::abs(py));
      X[k] = px;
      Y[k] = py;
      q[k] = 1 / static_cast<double>(z[k]);
    }
    const double x1 = X[1] - X[0], x2 = X[2] - X[0], y1 = Y[1] - Y[0], y2 = Y[2] - Y[0], q1 = q[1] - q[0], q2 = q[2] - q[0];
    const double D = x1 * y2 - x2 * y1, unit = eps * static_cast<double>(M) * M;
    const bool wide = std::abs(D) > 2048 * unit;
    const double scale = (wide ? 1.0 : 0.0) / (wide ? D : 1.0);
    const double slope_x = (q1 * y2 - q2 * y1) * scale, slope_y = (x1 * q2 - x2 * q1) * scale;
    const T margin = static_cast<T>(320 * unit * std::abs(scale)) * range + rounding;
    bound.slope_x = wide ? static_cast<T>(slope_x) : T(0);
    bound.slope_y = wide ? static_cast<T>(slope_y) : T(0);
    bound.level = wide ? static_cast<T>(q[0] - slope_x * X[0] - slope_y * Y[0]) : bound.level;
    bound.margin = wide ? margin : bound.margin;
  }
  return bound;
}

// Sets up faces [first, last) and lists those that are drawn.
template <class T>
NMR_INLINE void set_up_faces(const Image<T>& image, int64_t chunk) {
  constexpr int64_t kGroup = 16;
  FaceTable<T>& table = *image.table;
  const int64_t first = chunk * kChunk, last = std::min(first + kChunk, image.num_faces);
  const T width = static_cast<T>(image.settings.raster.width), height = static_cast<T>(image.settings.raster.height);
  const T longer = std::max(width, height), shorter = std::min(width, height);
  const T near = image.settings.near, far = image.settings.far;
  const bool fill_back = image.settings.fill_back;
  const T* vertices = image.vertices;
  const T infinity = std::numeric_limits<T>::infinity();
  const T moderate = std::sqrt(std::numeric_limits<T>::max()) / 4;  // products of two pixel coordinates stay finite
  const T eps = std::numeric_limits<T>::epsilon(), resolution = 288 * eps * (longer / shorter);
  const T smallest = std::sqrt(std::numeric_limits<T>::min()) / eps;  // 1 / depth and its slopes stay ordinary numbers
  int32_t num_front = 0, num_back = 0;
  T front_sum = 0, back_sum = 0;
  int32_t *front = table.front.data() + first, *back = table.back.data() + first;

  for (int64_t f = first; f < last; f += kGroup) {
    int32_t corner[3][kGroup];
    const int64_t lanes = std::min(kGroup, last - f);
    for (int64_t n = 0; n < kGroup; ++n) {
      const int64_t* face = image.faces + 3 * (f + (n < lanes ? n : 0));
      for (int k = 0; k < 3; ++k) corner[k][n] = static_cast<int32_t>(3 * face[k]);
    }
    T x[3][kGroup], y[3][kGroup], z[3][kGroup];
    for (int k = 0; k < 3; ++k)
      for (int64_t n = 0; n < kGroup; ++n) {
        x[k][n] = vertices[corner[k][n]];
        y[k][n] = vertices[corner[k][n] + 1];
        z[k][n] = vertices[corner[k][n] + 2];
      }
    int32_t is_front[kGroup], is_back[kGroup];
    T slope_x[kGroup], slope_y[kGroup], level[kGroup], margin[kGroup], nearest[kGroup];
    int32_t i0[kGroup], i1[kGroup], j0[kGroup], j1[kGroup];
    for (int64_t n = 0; n < kGroup; ++n) {
      const T x0 = x[0][n], x1 = x[1][n], x2 = x[2][n], y0 = y[0][n], y1 = y[1][n], y2 = y[2][n];
      const T z0 = z[0][n], z1 = z[1][n], z2 = z[2][n];
      // Both orders are tested: for very thin faces, rounding can make both or neither counter-clockwise.
      const bool ccw = !((y2 - y0) * (x1 - x0) < (y1 - y0) * (x2 - x0));
      const bool cw = !((y0 - y2) * (x1 - x2) < (y1 - y2) * (x0 - x2));
      const T largest = max3(max3(std::abs(x0), std::abs(x1), std::abs(x2)), max3(std::abs(y0), std::abs(y1), std::abs(y2)), T(1));
      const bool usable = (std::abs(x0) < infinity) & (std::abs(x1) < infinity) & (std::abs(x2) < infinity) &
                          (std::abs(y0) < infinity) & (std::abs(y1) < infinity) & (std::abs(y2) < infinity) & (z0 == z0) &
                          (z1 == z1) & (z2 == z2);
      const T lo = min3(z0, z1, z2), hi = max3(z0, z1, z2);
      // No bounds for faces so thin that all three weights could round to 0, or close to the limits of T or of depth.
      const T det = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0);
      const bool bounded = (std::abs(det) >= resolution * largest * largest) & (largest * longer < moderate) & (near >= 0) &
                           (lo * (1 - 16 * eps) > near) & (hi * (1 + 16 * eps) < far) & (lo > smallest) & (hi < 1 / smallest);
      // For faces without bounds, those of an ordinary triangle are computed and not used.
      const auto checked = [bounded](T value, T ordinary) { return bounded ? value : ordinary; };
      const DepthBound<T> bound = bound_depth<T>({checked(x0, 0), checked(x1, 1), checked(x2, 0)},
                                                 {checked(y0, 0), checked(y1, 0), checked(y2, 1)},
                                                 {checked(z0, 1), checked(z1, 1), checked(z2, 1)}, checked(lo, 1), checked(hi, 1),
                                                 width, height);
      slope_x[n] = bound.slope_x;
      slope_y[n] = bound.slope_y;
      level[n] = bound.level;
      margin[n] = checked(bound.margin, infinity);
      nearest[n] = checked(bound.nearest, infinity);
      pixel_range(min3(x0, x1, x2), max3(x0, x1, x2), width, i0[n], i1[n]);
      pixel_range(min3(y0, y1, y2), max3(y0, y1, y2), height, j0[n], j1[n]);
      const bool drawn = usable & (i0[n] <= i1[n]) & (j0[n] <= j1[n]);
      is_front[n] = drawn & ccw;
      is_back[n] = drawn & cw & fill_back;
    }
    for (int k = 0; k < 3; ++k) {
      std::copy_n(x[k], kGroup, table.x[k].data() + f);
      std::copy_n(y[k], kGroup, table.y[k].data() + f);
    }
    std::copy_n(slope_x, kGroup, table.slope_x.data() + f);
    std::copy_n(slope_y, kGroup, table.slope_y.data() + f);
    std::copy_n(level, kGroup, table.level.data() + f);
    std::copy_n(margin, kGroup, table.margin.data() + f);
    std::copy_n(nearest, kGroup, table.nearest.data() + f);
    std::copy_n(i0, kGroup, table.column_first.data() + f);
    std::copy_n(i1, kGroup, table.column_last.data() + f);
    std::copy_n(j0, kGroup, table.row_first.data() + f);
    std::copy_n(j1, kGroup, table.row_last.data() + f);
    for (int64_t n = 0; n < lanes; ++n) {
      front[num_front] = static_cast<int32_t>(f + n);
      num_front += is_front[n];
      front_sum += is_front[n] && nearest[n] < infinity ? nearest[n] : 0;
      back[num_back] = static_cast<int32_t>(f + n);
      num_back += is_back[n];
      back_sum += is_back[n] && nearest[n] < infinity ? nearest[n] : 0;
    }
  }
  table.front_sum[chunk] = front_sum;
  table.back_sum[chunk] = back_sum;
  table.num_front[chunk] = num_front;
  table.num_back[chunk] = num_back;
}

// One band of rows of an image.
template <class T>
struct Band {
  int64_t row_first, row_last;  // inclusive, from the bottom
  Size raster;
  int64_t stride;
  const T *columns, *rows;      // pixel centres
  T *most, *least;
  int32_t* owner;
};

// For eight pixels of a row: which of the contested ones face `id` wins from their owners by exact depth. Of equally near faces the
// first one wins, in whichever order they are filled.
template <class T>
NMR_INLINE LaneMask<T> contest(const Image<T>& image, int32_t id, const FacePlane<T>& plane, LaneMask<T> contested, int64_t i, int64_t j,
                               const int32_t* owner_at) {
  const Lanes<T> column = to_values<T>(lane_numbers() + static_cast<int32_t>(i));
  const T row = static_cast<T>(j);
  const Lanes<T> z = exact_depths(plane, column, row);
  contested = contested & (z > image.settings.near) & (z < image.settings.far);  // not NaN either
  const Lanes32 owner = load_lanes<Lanes32>(owner_at);
  LaneMask<T> wins = contested & widen_mask<T>(owner < 0), open = contested & ~wins;
  for (uint32_t bits = lane_bits(open); bits; bits = lane_bits(open)) {
    const int32_t rival = owner_at[lowest_bit(bits)];
    const LaneMask<T> here = open & widen_mask<T>((owner >= rival) & (owner <= rival));
    const Lanes<T> theirs = exact_depths(face_plane(image, rival), column, row);
    wins = wins | (here & (id < rival ? z <= theirs : z < theirs));
    open = open & ~here;
  }
  return wins;
}

// Fills one face into a band.
template <class T>
NMR_INLINE void fill_face(const Image<T>& image, int32_t f, bool reversed, const Band<T>& band) {
  const FaceTable<T>& table = *image.table;
  const int64_t i_first = table.column_first[f], i_last = table.column_last[f];
  const int64_t j_first = std::max<int64_t>(table.row_first[f], band.row_first);
  const int64_t j_last = std::min<int64_t>(table.row_last[f], band.row_last);
  if (j_first > j_last) return;
  const int32_t id = reversed ? f + static_cast<int32_t>(image.num_faces) : f;
  const T slope_x = table.slope_x[f], slope_y = table.slope_y[f], level = table.level[f], margin = table.margin[f];
  const bool bounded = table.nearest[f] < std::numeric_limits<T>::infinity();
  if (!bounded && !is_drawable(load_triangle(image.vertices, image.faces + 3 * f, false))) return;
  const int k0 = reversed ? 2 : 0, k2 = reversed ? 0 : 2;
  const T x0 = table.x[k0][f], x1 = table.x[1][f], x2 = table.x[k2][f];
  const T y0 = table.y[k0][f], y1 = table.y[1][f], y2 = table.y[k2][f];
  const T dx0 = x1 - x0, dx1 = x2 - x1, dx2 = x0 - x2;
  const T dy0 = y1 - y0, dy1 = y2 - y1, dy2 = y0 - y2;
  FacePlane<T> plane;  // computed when first needed
  bool has_plane = false;
  const Lanes32 ids = splat32(id);

  for (int64_t i = i_first; i <= i_last; i += kLanes) {
    const LaneMask<T> in_box = widen_mask<T>(lane_numbers() <= static_cast<int32_t>(i_last - i));
    const Lanes<T> xp = load_lanes<Lanes<T>>(band.columns + i);
    const Lanes<T> c0 = (xp - x0) * dy0, c1 = (xp - x1) * dy1, c2 = (xp - x2) * dy2;
    const Lanes<T> q_column = to_values<T>(lane_numbers() + static_cast<int32_t>(i)) * slope_x + level;
    const int64_t first = (j_first - band.row_first) * band.stride + i;
    T *most_at = band.most + first, *least_at = band.least + first;
    int32_t* owner_at = band.owner + first;
    for (int64_t j = j_first; j <= j_last; ++j, most_at += band.stride, least_at += band.stride, owner_at += band.stride) {
      const T yp = band.rows[j];
      const T e0 = (yp - y0) * dx0, e1 = (yp - y1) * dx1, e2 = (yp - y2) * dx2;
      const LaneMask<T> inside = in_box & ~((e0 < c0) | (e1 < c1) | (e2 < c2));
      const Lanes<T> q = q_column + slope_y * static_cast<T>(j), q_most = q + margin, q_least = q - margin;
      const Lanes<T> pixel_most = load_lanes<Lanes<T>>(most_at), pixel_least = load_lanes<Lanes<T>>(least_at);
      const LaneMask<T> unsettled = inside & (q_most >= pixel_least);
      LaneMask<T> wins = unsettled & (q_least > pixel_most);
      const LaneMask<T> contested = unsettled & ~wins;
      if (lane_bits(contested)) {
        if (!has_plane) plane = face_plane(image, id);
        has_plane = true;
        wins = wins | contest(image, id, plane, contested, i, j, owner_at);
      }
      store_lanes(most_at, select(wins, q_most, pixel_most));
      store_lanes(least_at, select(wins, q_least, pixel_least));
      store_lanes(owner_at, select(narrow_mask(wins), ids, load_lanes<Lanes32>(owner_at)));
    }
  }
}

// The least 1 / depth in each block of pixels.
template <class T>
NMR_INLINE void bound_blocks(const Band<T>& band, int64_t blocks, T* block_least) {
  static_assert(kBlock == kLanes, "a row of a block is one vector");
  const int64_t rows = band.row_last - band.row_first + 1;
  for (int64_t j = 0; j < rows; j += kBlock)
    for (int64_t n = 0; n < blocks; ++n) {
      const T* row = band.least + j * band.stride + n * kBlock;
      Lanes<T> least = load_lanes<Lanes<T>>(row);
      for (int64_t r = j + 1; r < std::min(j + kBlock, rows); ++r) {
        row += band.stride;
        const Lanes<T> q = load_lanes<Lanes<T>>(row);
        least = select(q < least, q, least);
      }
      block_least[(j / kBlock) * blocks + n] = min_lanes(least);
    }
}

// True if every pixel of the face's box already has a nearer owner.
template <class T>
NMR_INLINE bool is_hidden(const FaceTable<T>& table, int32_t f, const Band<T>& band, int64_t blocks, const T* block_least) {
  const int64_t j_first = std::max<int64_t>(table.row_first[f], band.row_first) - band.row_first;
  const int64_t j_last = std::min<int64_t>(table.row_last[f], band.row_last) - band.row_first;
  const T nearest = table.nearest[f];
  for (int64_t j = j_first / kBlock; j <= j_last / kBlock; ++j)
    for (int64_t n = table.column_first[f] / kBlock; n <= table.column_last[f] / kBlock; ++n)
      if (!(nearest < block_least[j * blocks + n])) return false;
  return true;
}

template <class T>
NMR_INLINE void fill_band(const Image<T>& image, const Band<T>& band, int64_t blocks, T* block_least, int32_t* owner) {
  const FaceTable<T>& table = *image.table;
  const int64_t rows = band.row_last - band.row_first + 1, H = band.raster.height, W = band.raster.width;
  for (T* q : {band.most, band.least}) std::fill_n(q, rows * band.stride, -std::numeric_limits<T>::infinity());
  std::fill_n(band.owner, rows * band.stride, -1);
  const int64_t chunks = (image.num_faces + kChunk - 1) / kChunk;
  // Draw the nearer of the two lists first, so that most faces of the other one are hidden.
  T front_sum = 0, back_sum = 0;
  int64_t num_front = 0, num_back = 0;
  for (int64_t c = 0; c < chunks; ++c) {
    front_sum += table.front_sum[c];
    back_sum += table.back_sum[c];
    num_front += table.num_front[c];
    num_back += table.num_back[c];
  }
  const bool back_first = back_sum * static_cast<T>(num_front) > front_sum * static_cast<T>(num_back);
  for (int pass = 0; pass < 2; ++pass) {
    const bool reversed = (pass == 0) == back_first;
    if (pass == 1) bound_blocks(band, blocks, block_least);
    for (int64_t c = 0; c < chunks; ++c) {
      const int32_t* list = (reversed ? table.back : table.front).data() + c * kChunk;
      const int32_t count = (reversed ? table.num_back : table.num_front)[c];
      for (int32_t n = 0; n < count; ++n)
        if (pass == 0 || !is_hidden(table, list[n], band, blocks, block_least)) fill_face(image, list[n], reversed, band);
    }
  }
  for (int64_t j = 0; j < rows; ++j)
    std::memcpy(owner + (H - 1 - band.row_first - j) * W, band.owner + j * band.stride, W * sizeof(int32_t));
}

NMR_CLONES void set_up_chunk(const Image<float>& image, int64_t chunk) { set_up_faces(image, chunk); }
NMR_CLONES void set_up_chunk(const Image<double>& image, int64_t chunk) { set_up_faces(image, chunk); }
NMR_CLONES void fill(const Image<float>& image, const Band<float>& band, int64_t blocks, float* block_least, int32_t* owner) {
  fill_band(image, band, blocks, block_least, owner);
}
NMR_CLONES void fill(const Image<double>& image, const Band<double>& band, int64_t blocks, double* block_least, int32_t* owner) {
  fill_band(image, band, blocks, block_least, owner);
}

}  // namespace

template <class T>
void rasterize(const Rasterize<T>& args) {
  const Size raster = args.settings.raster;
  const int64_t H = raster.height, W = raster.width, batch = args.mesh.batch;
  // Many images: one thread per image. Few images: all threads share one image at a time.
  const bool share = batch < args.num_threads;
  const int64_t bands = share ? std::min<int64_t>(args.num_threads * 4, (H + 2 * kBlock - 1) / (2 * kBlock)) : 1;
  parallel_for(batch, share ? 1 : args.num_threads, [&](int64_t b) {
    FaceTable<T>& table = thread_scratch<FaceTable<T>>();
    const int64_t num_faces = args.mesh.face_count(b);
    table.reserve_faces(num_faces);
    const Image<T> image{args.mesh.image_vertices(b), args.mesh.image_faces(b), num_faces, args.settings, &table};
    const int threads = share ? args.num_threads : 1;
    parallel_for((num_faces + kChunk - 1) / kChunk, threads, [&](int64_t chunk) { set_up_chunk(image, chunk); });
    parallel_for(bands, threads, [&](int64_t n) {
      BandScratch<T>& scratch = thread_scratch<BandScratch<T>>();
      if (!(scratch.raster == raster)) {
        scratch.columns.resize(W + kLanes);
        scratch.rows.resize(H);
        for (int64_t i = 0; i < W + kLanes; ++i) scratch.columns[i] = pixel_centre<T>(i, W);
        for (int64_t j = 0; j < H; ++j) scratch.rows[j] = pixel_centre<T>(j, H);
        scratch.raster = raster;
      }
      Band<T> band{n * H / bands, (n + 1) * H / bands - 1, raster, W + kLanes, scratch.columns.data(), scratch.rows.data(),
                   nullptr, nullptr, nullptr};
      const int64_t rows = band.row_last - band.row_first + 1, blocks = (W + kBlock - 1) / kBlock;
      band.most = reserve(scratch.most, rows * band.stride);
      band.least = reserve(scratch.least, rows * band.stride);
      band.owner = reserve(scratch.owner, rows * band.stride);
      fill(image, band, blocks, reserve(scratch.block_least, (rows / kBlock + 1) * blocks), args.owner + b * H * W);
    });
  });
}

template void rasterize(const Rasterize<float>&);
template void rasterize(const Rasterize<double>&);

}  // namespace nmr
