// The inner loops of fragments and depth images (fragments.cpp).
#include "fragment_table.h"
#include "level_lanes.h"

namespace nmr::NMR_LEVEL {
namespace {

// --- the faces of a block

// Numbers the block's visible faces and fills in the table. Entry 0, of the background, has weights
// (1, 0, 0) and depth 1.
template <class T>
NMR_INLINE void set_up_faces(const FragmentBlock<T>& block, FragmentScratch<T>& scratch) {
  const int64_t W = block.raster.width, F = block.num_faces;
  scratch.visible->find(block.face_index + block.first * W, (block.last - block.first) * W, F);
  const int32_t* ids = scratch.visible->ids.data() + 1;
  const int64_t count = scratch.visible->count - 1;
  T* table = scratch.table.data();
  for (int64_t n = 0; n < kFaceEntry; ++n) table[n] = n == 8 || n >= 12 ? T(1) : T(0);
  const Lanes<T> width = splat(static_cast<T>(W)),
                 height = splat(static_cast<T>(block.raster.height));
  for (int64_t start = 0; start < count; start += kLanes) {
    const int64_t last = count - 1;
    T corner[3][3][kLanes];  // x, y, z of the corners
    for (int64_t n = 0; n < kLanes; ++n) {
      const int64_t at = std::min(start + n, last);  // the last face fills the vector
      const int32_t id = ids[at];
      const bool reversed = id >= F;
      const int64_t* face = block.faces + 3 * (reversed ? id - F : id);
      for (int k = 0; k < 3; ++k)
        for (int c = 0; c < 3; ++c)
          corner[c][k][n] = block.vertices[3 * face[reversed ? 2 - k : k] + c];
    }
    Lanes<T> X[3], Y[3];
    for (int k = 0; k < 3; ++k) {
      X[k] = pixel_coordinates<T>(load_lanes<Lanes<T>>(corner[0][k]), width);
      Y[k] = pixel_coordinates<T>(load_lanes<Lanes<T>>(corner[1][k]), height);
    }
    // barycentric_matrix of geometry.h
    const Lanes<T> det = X[2] * (Y[0] - Y[1]) + X[0] * (Y[1] - Y[2]) + X[1] * (Y[2] - Y[0]);
    Lanes<T> column[4][4];  // [quad of the entry][k]
    for (int k = 0; k < 3; ++k) {
      const int p = (k + 1) % 3, q = (k + 2) % 3;
      column[0][k] = (Y[p] - Y[q]) / det;
      column[1][k] = (X[q] - X[p]) / det;
      column[2][k] = (X[p] * Y[q] - X[q] * Y[p]) / det;
      column[3][k] = load_lanes<Lanes<T>>(corner[2][k]);
    }
    for (int quad = 0; quad < 4; ++quad) {
      column[quad][3] = splat(quad < 3 ? T(0) : T(1));
      T rows[kLanes][4];
      store_quads<T>(column[quad], rows);
      for (int64_t n = 0; n < kLanes; ++n)
        std::copy_n(rows[n], 4, table + (start + 1 + n) * kFaceEntry + 4 * quad);
    }
  }
}

// --- eight pixels

template <class T>
struct FragmentPixels {
  Lanes<T> w[3];         // normalised weights
  Lanes<T> corner_z[3];  // depths of the corners
  Lanes<T> z;            // depth
  int64_t slot[kLanes];
};

// Weights and depths of the pixels [i, i + 8) with these face indices, in the row of pixel
// coordinate y.
template <class T>
NMR_INLINE FragmentPixels<T> evaluate(const FragmentScratch<T>& scratch, Lanes32 ids, int64_t i,
                                      Lanes<T> y) {
  FragmentPixels<T> p;
  const LaneArray<int32_t, Lanes32> slots(gather_values(scratch.visible->slots.data() + 1, ids));
  const T* entry[kLanes];
  for (int64_t n = 0; n < kLanes; ++n) {
    p.slot[n] = slots.lane[n];
    entry[n] = scratch.table.data() + p.slot[n] * kFaceEntry;
  }
  Lanes<T> column[4][4];
  for (int quad = 0; quad < 4; ++quad) {
    load_quads<T>(entry, column[quad]);
    for (int64_t n = 0; n < kLanes; ++n) entry[n] += 4;
  }
  const Lanes<T> x = to_values<T>(lane_numbers() + splat(static_cast<int32_t>(i)));
  for (int k = 0; k < 3; ++k) {
    p.w[k] = column[0][k] * x + column[1][k] * y + column[2][k];
    p.corner_z[k] = column[3][k];
  }
  normalize_weights(p.w, splat(T(0)), splat(T(1)));
  p.z = lane_depths(p.w, p.corner_z, splat(T(1)), scratch.perspective);
  return p;
}

// Calls visit(i, ids, y) for every eight pixels [i, i + 8) of row j (from the top) with a covered
// one among them, and background(i) for the others.
template <class T, class Visit, class Background>
NMR_INLINE void for_covered(const FragmentBlock<T>& block, int64_t j, const Visit& visit,
                            const Background& background) {
  const int64_t W = block.raster.width;
  const Lanes<T> y = splat(static_cast<T>(block.raster.height - 1 - j));
  for (int64_t i = 0; i < W; i += kLanes) {
    const Lanes32 ids = load_face_indices(block.face_index + j * W, i, W);
    if (lane_bits(ids >= splat(int32_t(0))))
      visit(i, ids, y);
    else
      background(i);
  }
}

// --- forward

// Writes weights and depths of eight pixels: w at those of the face's own corners, 0 on background.
template <class T>
NMR_INLINE void store_weights(const FragmentPixels<T>& p, Lanes32 ids, int64_t num_faces,
                              bool perspective, int64_t count, T* weights) {
  const LaneMask<T> drawn = widen_mask<T>(ids >= splat(int32_t(0)));
  const LaneMask<T> reversed = widen_mask<T>(ids >= splat(static_cast<int32_t>(num_faces)));
  Lanes<T> at[3];
  for (int k = 0; k < 3; ++k)
    at[k] = choose(drawn, perspective ? p.w[k] * p.z / p.corner_z[k] : p.w[k], splat(T(0)));
  T value[3][kLanes];
  store_lanes(value[0], choose(reversed, at[2], at[0]));
  store_lanes(value[1], at[1]);
  store_lanes(value[2], choose(reversed, at[0], at[2]));
  for (int64_t n = 0; n < count; ++n)
    for (int k = 0; k < 3; ++k) weights[3 * n + k] = value[k][n];
}

// Fills the block's rows of depths and, if they are wanted, of weights.
template <class T>
void forward_block(const Fragments<T>& args, const FragmentBlock<T>& block,
                   FragmentScratch<T>& scratch) {
  const int64_t W = block.raster.width, w = args.image.width, scale = args.anti_aliasing ? 2 : 1;
  set_up_faces(block, scratch);
  T *upper = scratch.rows.data(), *lower = upper + W + kLanes;
  const Lanes<T> far = splat(args.far);
  for (int64_t j = block.first; j < block.last; ++j) {
    T* row = j % scale ? lower : upper;  // blocks begin with an even row
    T* weights =
        args.weights ? args.weights + 3 * (block.b * block.raster.pixels() + j * W) : nullptr;
    for_covered(
        block, j,
        [&](int64_t i, Lanes32 ids, Lanes<T> y) {
          const FragmentPixels<T> p = evaluate<T>(scratch, ids, i, y);
          store_lanes(row + i, choose(widen_mask<T>(ids >= splat(int32_t(0))), p.z, far));
          if (weights)
            store_weights(p, ids, block.num_faces, scratch.perspective, std::min(kLanes, W - i),
                          weights + 3 * i);
        },
        [&](int64_t i) {
          store_lanes(row + i, far);
          if (weights) std::fill_n(weights + 3 * i, 3 * std::min(kLanes, W - i), T(0));
        });
    T* depth = args.depth + block.b * args.image.pixels() + j / scale * w;
    if (!args.anti_aliasing) {
      std::copy_n(upper, w, depth);
    } else if (j % 2) {
      for (int64_t i = 0; i < w; ++i)
        depth[i] = average(upper[2 * i], upper[2 * i + 1], lower[2 * i], lower[2 * i + 1]);
    }
  }
}

// --- backward

// Values close to an overflow count as 0: a corner in the plane of the eye gets no gradient, and
// does not change others.
template <class T>
NMR_INLINE Lanes<T> moderate_or_zero(Lanes<T> value) {
  return keep(absolute<T>(value) < splat(std::sqrt(std::numeric_limits<T>::max())), value);
}

// A depth whose square is a factor of a gradient: 0 beyond the depth up to which sums of squares
// cannot overflow.
template <class T>
NMR_INLINE Lanes<T> depth_or_zero(Lanes<T> z) {
  return keep(absolute<T>(z) < splat(sizeof(T) == sizeof(double) ? T(1e100) : T(1e15)), z);
}

// Adds four numbers per pixel to those of its face, of which there are `stride` per face.
template <class T>
NMR_INLINE void add_to_faces(const Lanes<T> (&column)[4], const FragmentPixels<T>& p,
                             int64_t stride, T* sums) {
  T* at[kLanes];
  for (int64_t n = 0; n < kLanes; ++n) at[n] = sums + stride * p.slot[n];
  add_quads<T>(column, at);
}

// Columns of the numbers of the faces [slot, slot + 8) in an array with `stride` numbers per face.
template <class T>
NMR_INLINE void load_face_quads(const T* values, int64_t slot, int64_t stride,
                                Lanes<T> (&column)[4]) {
  const T* row[kLanes];
  for (int64_t n = 0; n < kLanes; ++n) row[n] = values + (slot + n) * stride;
  load_quads<T>(row, column);
}

// Writes the gradients of the faces [slot, slot + 8): grad[3 k + c] of coordinate c of corner k in
// drawing order.
template <class T>
NMR_INLINE void store_face_gradients(const Lanes<T> (&grad)[9], int64_t slot, int64_t num_faces,
                                     FaceSums<T>& sums) {
  T value[9][kLanes];
  for (int c = 0; c < 9; ++c) store_lanes(value[c], grad[c]);
  const int64_t count = std::min(kLanes, sums.visible.count - slot);
  for (int64_t n = 0; n < count; ++n) {
    const bool reversed = sums.visible.ids[slot + n] >= num_faces;
    for (int k = 0; k < 3; ++k)
      for (int c = 0; c < 3; ++c)
        sums.values[9 * (slot + n) + 3 * (reversed ? 2 - k : k) + c] = value[3 * k + c][n];
  }
}

// The values of eight faces in the table: M_k0 and M_k1, and the depths of the corners.
template <class T>
struct FaceLanes {
  Lanes<T> mx[4], my[4], z[4];
};

// Sums kNumbers numbers per face over its pixels: add(j, i, ids, pixels, sums) adds those of the
// eight pixels from (j, i) on, start_row(j) is called before. gradients(sums, slot, faces, out)
// then computes the gradients of eight faces: out[3 k + c] is that of coordinate c of corner k.
template <int64_t kNumbers, class T, class StartRow, class Add, class Gradients>
NMR_INLINE void backward_block(const FragmentBlock<T>& block, FragmentScratch<T>& scratch,
                               FaceSums<T>& result, const StartRow& start_row, const Add& add,
                               const Gradients& gradients) {
  set_up_faces(block, scratch);
  T* sums = scratch.sums.data();
  std::fill_n(sums, kNumbers * (scratch.visible->count + kLanes), T(0));
  for (int64_t j = block.first; j < block.last; ++j) {
    start_row(j);
    for_covered(
        block, j,
        [&](int64_t i, Lanes32 ids, Lanes<T> y) {
          add(j, i, ids, evaluate<T>(scratch, ids, i, y), sums);
        },
        [](int64_t) {});
  }
  const T* table = scratch.table.data();
  for (int64_t slot = 1; slot < scratch.visible->count; slot += kLanes) {
    FaceLanes<T> faces;
    load_face_quads<T>(table, slot, kFaceEntry, faces.mx);
    load_face_quads<T>(table + 4, slot, kFaceEntry, faces.my);
    load_face_quads<T>(table + 12, slot, kFaceEntry, faces.z);
    Lanes<T> out[9];
    gradients(sums, slot, faces, out);
    store_face_gradients<T>(out, slot, block.num_faces, result);
  }
}

// With u_m = dL/db_m, g = dL/dz and h_m = z (u_m - sum_k u_k b_k) - g z^2:  dL = sum_m h_m d(w_m /
// z_m), so that grad z_m = -H_mm / z_m^2 and grad X_k = -sum_m H_mk M_m0 / z_m with H_mk = sum over
// pixels of h_m w_k. Without perspective h_m = u_m + g z_m:  grad z_m = sum over pixels of g w_m,
// grad X_k = -sum_m H_mk M_m0.
//
// Without u four sums do. With c = g z^2, or c = g without perspective, and C_k = sum over pixels
// of c w_k:  H_mk = -C_k, or z_m C_k.
template <class T>
void backward_rows(const Fragments<T>& args, const FragmentBlock<T>& block,
                   FragmentScratch<T>& scratch, FaceSums<T>& result) {
  const int64_t W = block.raster.width, w = args.image.width;
  const bool perspective = scratch.perspective;
  const Lanes<T> zero = splat(T(0)), one = splat(T(1));
  const Lanes<T> half_width = splat(static_cast<T>(W) / 2),
                 half_height = splat(static_cast<T>(block.raster.height) / 2);

  T* grad_row = scratch.rows.data();  // g
  std::fill_n(grad_row, W + kLanes, T(0));
  const auto start_row = [&](int64_t j) {
    if (!args.grad_depth) return;
    const T* upstream =
        args.grad_depth + block.b * args.image.pixels() + (args.anti_aliasing ? j / 2 : j) * w;
    if (!args.anti_aliasing) {
      std::copy_n(upstream, w, grad_row);
    } else if (j % 2 == 0) {  // blocks begin with an even row
      for (int64_t i = 0; i < w; ++i)
        grad_row[2 * i] = grad_row[2 * i + 1] = upstream[i] * share_of_pixel<T>(true);
    }
  };
  // M_m0 / z_m and M_m1 / z_m, or M_m0 and M_m1, in units of the vertices
  const auto slopes = [&](const FaceLanes<T>& faces, Lanes<T>(&x)[3], Lanes<T>(&y)[3]) {
    const auto& [mx, my, z] = faces;
    for (int m = 0; m < 3; ++m) {
      x[m] = moderate_or_zero<T>(perspective ? mx[m] / z[m] : mx[m]) * half_width;
      y[m] = moderate_or_zero<T>(perspective ? my[m] / z[m] : my[m]) * half_height;
    }
  };
  const auto inverse_square = [&](Lanes<T> z) { return moderate_or_zero<T>(one / (z * z)); };

  if (!args.grad_weights) {
    const auto add = [&](int64_t, int64_t i, Lanes32, const FragmentPixels<T>& p, T* sums) {
      const Lanes<T> z = perspective ? depth_or_zero<T>(p.z) : one;
      const Lanes<T> c = load_lanes<Lanes<T>>(grad_row + i) * z * z;
      add_to_faces<T>({c * p.w[0], c * p.w[1], c * p.w[2], zero}, p, 4, sums);
    };
    return backward_block<4>(
        block, scratch, result, start_row, add,
        [&](const T* sums, int64_t slot, const FaceLanes<T>& faces, Lanes<T>(&out)[9]) {
          Lanes<T> sum[4], slope_x[3], slope_y[3], x = zero, y = zero;
          load_face_quads<T>(sums, slot, 4, sum);
          slopes(faces, slope_x, slope_y);
          for (int m = 0; m < 3; ++m) {
            const Lanes<T> factor = perspective ? one : zero - depth_or_zero<T>(faces.z[m]);
            x = x + factor * slope_x[m];
            y = y + factor * slope_y[m];
          }
          for (int k = 0; k < 3; ++k) {
            out[3 * k] = sum[k] * x;
            out[3 * k + 1] = sum[k] * y;
            out[3 * k + 2] = perspective ? sum[k] * inverse_square(faces.z[k]) : sum[k];
          }
        });
  }
  const auto add = [&](int64_t j, int64_t i, Lanes32 ids, const FragmentPixels<T>& p, T* sums) {
    const int64_t at = block.b * block.raster.pixels() + j * W + i, count = std::min(kLanes, W - i);
    const Lanes<T> g = load_lanes<Lanes<T>>(grad_row + i), deep = depth_or_zero<T>(p.z);
    T grad[3][kLanes] = {};
    for (int64_t n = 0; n < count; ++n)
      for (int m = 0; m < 3; ++m) grad[m][n] = args.grad_weights[3 * (at + n) + m];
    const LaneMask<T> reversed = widen_mask<T>(ids >= splat(static_cast<int32_t>(block.num_faces)));
    const Lanes<T> first = load_lanes<Lanes<T>>(grad[0]), last = load_lanes<Lanes<T>>(grad[2]);
    const Lanes<T> u[3] = {choose(reversed, last, first), load_lanes<Lanes<T>>(grad[1]),
                           choose(reversed, first, last)};
    Lanes<T> mean = zero;
    if (perspective)
      for (int m = 0; m < 3; ++m) mean = mean + u[m] * (p.w[m] * p.z / p.corner_z[m]);
    const Lanes<T> scale = perspective ? p.z : one;
    for (int m = 0; m < 3; ++m) {
      const Lanes<T> by_depth =
          perspective ? (zero - g) * deep * deep : g * depth_or_zero<T>(p.corner_z[m]);
      const Lanes<T> h = by_depth + scale * (u[m] - mean);
      add_to_faces<T>({h * p.w[0], h * p.w[1], h * p.w[2], g * p.w[m]}, p, 12, sums + 4 * m);
    }
  };
  backward_block<12>(
      block, scratch, result, start_row, add,
      [&](const T* sums, int64_t slot, const FaceLanes<T>& faces, Lanes<T>(&out)[9]) {
        Lanes<T> sum[3][4], slope_x[3], slope_y[3];
        for (int m = 0; m < 3; ++m) load_face_quads<T>(sums + 4 * m, slot, 12, sum[m]);
        slopes(faces, slope_x, slope_y);
        for (int k = 0; k < 3; ++k) {
          out[3 * k] =
              zero - (sum[0][k] * slope_x[0] + sum[1][k] * slope_x[1] + sum[2][k] * slope_x[2]);
          out[3 * k + 1] =
              zero - (sum[0][k] * slope_y[0] + sum[1][k] * slope_y[1] + sum[2][k] * slope_y[2]);
          out[3 * k + 2] =
              perspective ? (zero - sum[k][k]) * inverse_square(faces.z[k]) : sum[k][3];
        }
      });
}

}  // namespace
}  // namespace nmr::NMR_LEVEL
