// Colours from texture images: mipmaps, the level of each pixel, and sampling.
//
// A pixel with weights b has (u, v) = sum_k b_k (u_k, v_k). On a level of height x width texels its
// position is x = u width - 1/2, y = (1 - v) height - 1/2, with texel centres at the integers and
// row 0 at the top.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "corner_values.h"
#include "geometry.h"
#include "powers.h"

namespace nmr {
namespace {

// One level of one image: its texels start at `first`.
struct Grid {
  int64_t first, height, width;
};

NMR_INLINE Grid grid_of(const int64_t* grids, int64_t images, int64_t levels, int64_t b,
                        int64_t level) {
  const int64_t* g = grids + 3 * ((images == 1 ? 0 : b) * levels + level);
  return {g[0], g[1], g[2]};
}

// --- mipmaps

// The weights of the fine texels that texel i of a coarse row covers. The first is 2 i, or i if the
// sizes are equal.
template <class T>
struct Share {
  int64_t count;
  T share[3];
};

// An odd row of 2 m + 1 texels becomes m, each of which covers 2 + 1 / m of them.
template <class T>
Share<T> share_of(int64_t i, int64_t finer, int64_t size) {
  if (finer == size) return {1, {T(1), T(0), T(0)}};
  if (finer == 2 * size) return {2, {T(0.5), T(0.5), T(0)}};
  const T n = static_cast<T>(finer);
  return {3, {static_cast<T>(size - i) / n, static_cast<T>(size) / n, static_cast<T>(i + 1) / n}};
}

// Calls body(coarse texel, fine texel, weight) for all pairs of two levels, in a fixed order.
template <class T, class Body>
void for_pairs(const Grid& fine, const Grid& coarse, const Body& body) {
  for (int64_t row = 0; row < coarse.height; ++row) {
    const Share<T> down = share_of<T>(row, fine.height, coarse.height);
    const int64_t first_row = fine.height == coarse.height ? row : 2 * row;
    for (int64_t column = 0; column < coarse.width; ++column) {
      const Share<T> right = share_of<T>(column, fine.width, coarse.width);
      const int64_t first_column = fine.width == coarse.width ? column : 2 * column;
      for (int64_t j = 0; j < down.count; ++j)
        for (int64_t i = 0; i < right.count; ++i)
          body(coarse.first + row * coarse.width + column,
               fine.first + (first_row + j) * fine.width + first_column + i,
               down.share[j] * right.share[i]);
    }
  }
}

// First texel of image i in the concatenated images without their other levels.
template <class T>
int64_t first_texel(const Mipmaps<T>& args, int64_t i) {
  int64_t first = 0;
  for (int64_t n = 0; n < i; ++n) {
    const Grid g = grid_of(args.grids, args.images, args.levels, n, 0);
    first += g.height * g.width;
  }
  return first;
}

}  // namespace

template <class T>
void mipmaps_forward(const Mipmaps<T>& args) {
  const int64_t C = args.channels;
  parallel_for(args.images, args.num_threads, [&](int64_t i) {
    Grid fine = grid_of(args.grids, args.images, args.levels, i, 0);
    std::copy_n(args.texels + first_texel(args, i) * C, fine.height * fine.width * C,
                args.pyramid + fine.first * C);
    for (int64_t level = 1; level < args.levels; ++level) {
      const Grid coarse = grid_of(args.grids, args.images, args.levels, i, level);
      std::fill_n(args.pyramid + coarse.first * C, coarse.height * coarse.width * C, T(0));
      for_pairs<T>(fine, coarse, [&](int64_t to, int64_t from, T weight) {
        for (int64_t c = 0; c < C; ++c)
          args.pyramid[to * C + c] += weight * args.pyramid[from * C + c];
      });
      fine = coarse;
    }
  });
}

namespace {

// The gradients of one image's levels.
template <class T>
struct MipmapSums {
  Buffer<T> values;
};

}  // namespace

// The gradient of a level is its own plus that passed on by the coarser level.
template <class T>
void mipmaps_backward(const Mipmaps<T>& args) {
  const int64_t C = args.channels;
  parallel_for(args.images, args.num_threads, [&](int64_t i) {
    const Grid whole = grid_of(args.grids, args.images, args.levels, i, 0);
    const Grid last = grid_of(args.grids, args.images, args.levels, i, args.levels - 1);
    const int64_t begin = whole.first * C, end = (last.first + last.height * last.width) * C;
    T* sums = reserve(thread_scratch<MipmapSums<T>>().values, end - begin);
    std::copy_n(args.grad_pyramid + begin, end - begin, sums);
    T* sum = sums - begin;
    for (int64_t level = args.levels - 1; level > 0; --level) {
      const Grid fine = grid_of(args.grids, args.images, args.levels, i, level - 1);
      const Grid coarse = grid_of(args.grids, args.images, args.levels, i, level);
      for_pairs<T>(fine, coarse, [&](int64_t to, int64_t from, T weight) {
        for (int64_t c = 0; c < C; ++c) sum[from * C + c] += weight * sum[to * C + c];
      });
    }
    std::copy_n(sums, whole.height * whole.width * C, args.grad_texels + first_texel(args, i) * C);
  });
}

namespace {

// --- the place of a pixel

template <class T>
struct Place {
  T u, v;
  bool u_counts, v_counts;  // false: the coordinate is 0 because it is not finite, or too large
};

template <class T>
NMR_INLINE Place<T> place_of(const T* uv, const int64_t* corners, const T* weights) {
  const T *p = uv + 2 * corners[0], *q = uv + 2 * corners[1], *r = uv + 2 * corners[2];
  const T u = weights[0] * p[0] + weights[1] * q[0] + weights[2] * r[0];
  const T v = weights[0] * p[1] + weights[1] * q[1] + weights[2] * r[1];
  const bool u_counts = std::abs(u) < T(1e6), v_counts = std::abs(v) < T(1e6);
  return {u_counts ? u : T(0), v_counts ? v : T(0), u_counts, v_counts};
}

// --- levels

// Derivatives of (u, v) by the pixel coordinates (X, Y). With M the matrix of barycentric weights
// (geometry.h) and N_k = M_k / z_k, b_k = z (N_k0 X + N_k1 Y + N_k2) and 1 / z = sum_k N_k . (X, Y,
// 1), so that du/dX = z (sum_k N_k0 u_k - u sum_k N_k0).
template <class T>
struct Slopes {
  T u[2], v[2], one[2];  // sums over k of N_k0 and N_k1, times u_k, v_k and 1
  T z[3];                // depths of the corners
};

template <class T>
NMR_INLINE Slopes<T> slopes_of(const Triangle<T>& t, Size raster, const T* uv,
                               const int64_t* corners) {
  const BarycentricMatrix<T> M =
      barycentric_matrix(t, static_cast<T>(raster.width), static_cast<T>(raster.height));
  Slopes<T> s{};
  for (int k = 0; k < 3; ++k) {
    s.z[k] = t.z[k];
    for (int axis = 0; axis < 2; ++axis) {
      const T n = M.m[k][axis] / t.z[k];
      s.u[axis] += n * uv[2 * corners[k]];
      s.v[axis] += n * uv[2 * corners[k] + 1];
      s.one[axis] += n;
    }
  }
  return s;
}

template <class T>
NMR_INLINE T level_of(const Slopes<T>& s, const Place<T>& place, const T* weights, const Grid& grid,
                      int64_t levels) {
  const T z = weights[0] * s.z[0] + weights[1] * s.z[1] + weights[2] * s.z[2];
  T largest = 0;
  for (int axis = 0; axis < 2; ++axis) {
    const T x = z * (s.u[axis] - place.u * s.one[axis]) * static_cast<T>(grid.width);
    const T y = z * (s.v[axis] - place.v * s.one[axis]) * static_cast<T>(grid.height);
    largest = std::max(largest, x * x + y * y);
  }
  if (!(largest > 1)) return 0;  // NaN as well: a corner in the plane of the eye
  const double level =
      largest <= std::numeric_limits<T>::max() ? log2_of(static_cast<double>(largest)) / 2 : levels;
  return static_cast<T>(std::min(level, static_cast<double>(levels - 1)));
}

template <class T>
struct LevelScratch {
  VisibleFaces visible;
  std::vector<Slopes<T>> slopes;
};

}  // namespace

template <class T>
void uv_levels(const UVLevels<T>& args) {
  const Size raster = args.uv.raster;
  parallel_for(args.uv.batch, args.uv.num_threads, [&](int64_t b) {
    const ImageAttributes image = image_attributes(args.uv, b);
    const int64_t F = image.num_faces, begin = b * raster.pixels();
    const T* uv = args.uv.attributes + 2 * image.first_row;
    LevelScratch<T>& scratch = thread_scratch<LevelScratch<T>>();
    scratch.visible.list(args.uv.face_index + begin, raster.pixels(), F);
    Slopes<T>* slopes = reserve(scratch.slopes, scratch.visible.count);
    for (int64_t n = 1; n < scratch.visible.count; ++n) {
      const int64_t face = face_of(scratch.visible.ids[n], F);
      const Triangle<T> t =
          load_triangle(args.mesh.image_vertices(b), args.mesh.image_faces(b) + 3 * face, false);
      slopes[n] = slopes_of(t, raster, uv, image.corners + 3 * face);
    }
    const Grid grid = grid_of(args.grids, args.images, args.levels, b, 0);
    for (int64_t n = begin; n < begin + raster.pixels(); ++n) {
      const int64_t id = args.uv.face_index[n];
      args.level[n] = 0;
      if (id < 0) continue;
      const T* weights = args.uv.weights + 3 * n;
      const Place<T> place = place_of(uv, image.corners_of(id), weights);
      args.level[n] =
          level_of(slopes[scratch.visible.slots[id + 1]], place, weights, grid, args.levels);
    }
  });
}

namespace {

// --- sampling

// The index inside the image for a column or row outside it.
NMR_INLINE int64_t wrapped(int64_t n, int64_t size, Wrap wrap) {
  if (n >= 0 && n < size) return n;
  if (wrap == Wrap::clamp) return n < 0 ? 0 : size - 1;
  const int64_t period = wrap == Wrap::mirror ? 2 * size : size;
  n %= period;
  n += n < 0 ? period : 0;
  return n < size ? n : period - 1 - n;
}

// The four texels around a place on one level: upper left, upper right, lower left, lower right.
template <class T>
struct BilinearTaps {
  int64_t row[2];  // first texel of the upper and the lower row
  int64_t column[2];
  T right, down;  // position between the columns and the rows, in [0, 1)

  NMR_INLINE int64_t texel(int k) const { return row[k >> 1] + column[k & 1]; }
  NMR_INLINE T weight(int k) const {
    return (k >> 1 ? down : 1 - down) * (k & 1 ? right : 1 - right);
  }
};

template <class T>
NMR_INLINE BilinearTaps<T> taps_of(const Grid& grid, const Place<T>& place, Wrap wrap) {
  const T x = place.u * static_cast<T>(grid.width) - T(0.5),
          y = (1 - place.v) * static_cast<T>(grid.height) - T(0.5);
  int64_t column = static_cast<int64_t>(x), row = static_cast<int64_t>(y);
  column -= static_cast<T>(column) > x;  // floor
  row -= static_cast<T>(row) > y;
  BilinearTaps<T> taps;
  taps.right = x - static_cast<T>(column);
  taps.down = y - static_cast<T>(row);
  for (int k = 0; k < 2; ++k) {
    taps.column[k] = wrapped(column + k, grid.width, wrap);
    taps.row[k] = grid.first + wrapped(row + k, grid.height, wrap) * grid.width;
  }
  return taps;
}

// One or two levels that are blended: share of each.
template <class T>
struct MipBlend {
  int count;
  Grid grid[2];
  T share[2];
};

template <class T>
NMR_INLINE MipBlend<T> blend_of(const SampleUV<T>& args, int64_t b, int64_t n) {
  if (!args.level)
    return {1, {grid_of(args.grids, args.images, args.levels, b, 0), {}}, {T(1), T(0)}};
  const T level = args.level[n];
  const int64_t low = std::max(std::min(static_cast<int64_t>(level), args.levels - 1), int64_t(0));
  const T share = level - static_cast<T>(low);
  const Grid grid = grid_of(args.grids, args.images, args.levels, b, low);
  if (!(share > 0) || low + 1 >= args.levels) return {1, {grid, {}}, {T(1), T(0)}};
  return {2, {grid, grid_of(args.grids, args.images, args.levels, b, low + 1)}, {1 - share, share}};
}

// color (+)= share * sum over the taps of weight texel
template <int64_t kChannels, bool kAdd, class T>
NMR_INLINE void add_taps(const BilinearTaps<T>& taps, const T* texels, T share, int64_t C,
                         T* color) {
  const T *a = texels + taps.texel(0) * C, *b = texels + taps.texel(1) * C;
  const T *c = texels + taps.texel(2) * C, *d = texels + taps.texel(3) * C;
  const T wa = taps.weight(0), wb = taps.weight(1), wc = taps.weight(2), wd = taps.weight(3);
  for (int64_t k = 0; k < (kChannels ? kChannels : C); ++k) {
    const T sum = ((wa * a[k] + wb * b[k]) + wc * c[k]) + wd * d[k];
    color[k] = kAdd ? color[k] + share * sum : share * sum;
  }
}

// Adds the gradient of a color to the texels whose row begins in [first, last).
template <int64_t kChannels, class T>
NMR_INLINE void add_texel_gradients(const BilinearTaps<T>& taps, T share, const T* grad, int64_t C,
                                    int64_t first, int64_t last, T* grad_texels) {
  for (int k = 0; k < 4; ++k) {
    const int64_t row = taps.row[k >> 1];
    if (row < first || row >= last) continue;
    T* texel = grad_texels + taps.texel(k) * C;
    const T weight = share * taps.weight(k);
    for (int64_t c = 0; c < (kChannels ? kChannels : C); ++c) texel[c] += weight * grad[c];
  }
}

// Adds dL/du and dL/dv of one level.
template <int64_t kChannels, class T>
NMR_INLINE void add_place_gradient(const BilinearTaps<T>& taps, const Grid& grid, const T* texels,
                                   T share, const T* grad, int64_t C, T& grad_u, T& grad_v) {
  const T *a = texels + taps.texel(0) * C, *b = texels + taps.texel(1) * C;
  const T *c = texels + taps.texel(2) * C, *d = texels + taps.texel(3) * C;
  T by_x = 0, by_y = 0;
  for (int64_t k = 0; k < (kChannels ? kChannels : C); ++k) {
    by_x += grad[k] * ((1 - taps.down) * (b[k] - a[k]) + taps.down * (d[k] - c[k]));
    by_y += grad[k] * ((1 - taps.right) * (c[k] - a[k]) + taps.right * (d[k] - b[k]));
  }
  grad_u += share * static_cast<T>(grid.width) * by_x;
  grad_v -= share * static_cast<T>(grid.height) * by_y;
}

constexpr int64_t kNoRow = -1;

// The gradients of a block's pixels: those of weights, the sums of uv per corner, and, if `direct`,
// those of texels. Otherwise `rows` gets the first texel of the (up to four) rows of each pixel,
// from which scatter_texels continues.
template <int64_t kChannels, class T>
void sample_uv_block_backward(const SampleUV<T>& args, const RowBlock& block, bool direct,
                              int32_t* rows, FaceSums<T>& sums) {
  const Interpolate<T>& at = args.uv;
  const ImageAttributes image = image_attributes(at, block.b);
  const int64_t C = kChannels ? kChannels : args.channels, begin = block.begin(), end = block.end();
  const int64_t per_pixel = args.level ? 4 : 2;
  const T* uv = at.attributes + 2 * image.first_row;
  if (at.grad_attributes) sums.start(at.face_index + begin, end - begin, image.num_faces, 6);
  for (int64_t n = begin; n < end; ++n) {
    const int64_t id = at.face_index[n];
    if (rows) std::fill_n(rows + n * per_pixel, per_pixel, static_cast<int32_t>(kNoRow));
    if (id < 0) {
      if (at.grad_weights) std::fill_n(at.grad_weights + 3 * n, 3, T(0));
      continue;
    }
    const int64_t* corners = image.corners_of(id);
    const T *weights = at.weights + 3 * n, *grad = args.grad_colors + n * C;
    const Place<T> place = place_of(uv, corners, weights);
    const MipBlend<T> blend = blend_of(args, block.b, n);
    T grad_u = 0, grad_v = 0;
    for (int l = 0; l < blend.count; ++l) {
      const BilinearTaps<T> taps = taps_of(blend.grid[l], place, args.wrap);
      if (direct)
        add_texel_gradients<kChannels>(taps, blend.share[l], grad, C, 0, args.num_texels,
                                       args.grad_texels);
      if (rows)
        for (int k = 0; k < 2; ++k)
          rows[n * per_pixel + 2 * l + k] = static_cast<int32_t>(taps.row[k]);
      if (at.grad_attributes || at.grad_weights)
        add_place_gradient<kChannels>(taps, blend.grid[l], args.texels, blend.share[l], grad, C,
                                      grad_u, grad_v);
    }
    if (!place.u_counts) grad_u = 0;
    if (!place.v_counts) grad_v = 0;
    for (int k = 0; k < 3; ++k) {
      if (at.grad_weights) {
        const T* row = uv + 2 * corners[k];  // a coordinate that does not count may be NaN
        at.grad_weights[3 * n + k] =
            (place.u_counts ? row[0] * grad_u : T(0)) + (place.v_counts ? row[1] * grad_v : T(0));
      }
      if (at.grad_attributes) {
        T* sum = sums.of(id, 6) + 2 * k;
        sum[0] += weights[k] * grad_u;
        sum[1] += weights[k] * grad_v;
      }
    }
  }
}

// Adds the gradients of the pixels of all images to the texels whose row begins in [first, last).
template <int64_t kChannels, class T>
void scatter_texels(const SampleUV<T>& args, const int32_t* rows, int64_t first, int64_t last) {
  const Interpolate<T>& at = args.uv;
  const int64_t C = kChannels ? kChannels : args.channels, per_pixel = args.level ? 4 : 2,
                pixels = at.raster.pixels();
  for (int64_t b = 0; b < at.batch; ++b) {
    const ImageAttributes image = image_attributes(at, b);
    for (int64_t n = b * pixels; n < (b + 1) * pixels; ++n) {
      bool inside = false;
      for (int64_t k = 0; k < per_pixel; ++k)
        inside |= rows[n * per_pixel + k] >= first && rows[n * per_pixel + k] < last;
      if (!inside) continue;
      const Place<T> place = place_of(at.attributes + 2 * image.first_row,
                                      image.corners_of(at.face_index[n]), at.weights + 3 * n);
      const MipBlend<T> blend = blend_of(args, b, n);
      for (int l = 0; l < blend.count; ++l)
        add_texel_gradients<kChannels>(taps_of(blend.grid[l], place, args.wrap), blend.share[l],
                                       args.grad_colors + n * C, C, first, last, args.grad_texels);
    }
  }
}

}  // namespace

template <class T>
void sample_uv_forward(const SampleUV<T>& args) {
  const Interpolate<T>& at = args.uv;
  with_channels<T>(args.channels, [&](auto known) {
    constexpr int64_t kChannels = known();
    const int64_t W = at.raster.width, C = kChannels ? kChannels : args.channels;
    for_rows(at.batch, at.raster.height, at.num_threads, [&](int64_t b, int64_t row) {
      const ImageAttributes image = image_attributes(at, b);
      const T* uv = at.attributes + 2 * image.first_row;
      const int64_t start = (b * at.raster.height + row) * W;
      T* color = args.colors + start * C;
      for (int64_t n = start; n < start + W; ++n, color += C) {
        const int64_t id = at.face_index[n];
        if (id < 0) {
          for (int64_t c = 0; c < C; ++c) color[c] = 0;
          continue;
        }
        const Place<T> place = place_of(uv, image.corners_of(id), at.weights + 3 * n);
        const MipBlend<T> blend = blend_of(args, b, n);
        add_taps<kChannels, false>(taps_of(blend.grid[0], place, args.wrap), args.texels,
                                   blend.share[0], C, color);
        if (blend.count == 2)
          add_taps<kChannels, true>(taps_of(blend.grid[1], place, args.wrap), args.texels,
                                    blend.share[1], C, color);
      }
    });
  });
}

// On one thread, or if each image has its own texels and its own uv, the gradients of texels are
// summed together with those of uv; otherwise by for_texels.
template <class T>
void sample_uv_backward(const SampleUV<T>& args) {
  const Interpolate<T>& at = args.uv;
  const bool alone = at.num_threads <= 1 ||
                     (at.rows.each && args.images == at.batch && at.batch >= at.num_threads);
  const bool direct = args.grad_texels && alone, scatter = args.grad_texels && !alone;
  if (at.grad_attributes) std::fill_n(at.grad_attributes, 2 * at.rows.total(at.batch), T(0));
  if (args.grad_texels) std::fill_n(args.grad_texels, args.num_texels * args.channels, T(0));
  std::vector<int32_t> rows(scatter ? at.batch * at.raster.pixels() * (args.level ? 4 : 2) : 0);
  sum_blocks<FaceSums<T>>(
      at.batch, at.raster, !at.rows.each, at.num_threads, at.face_rows,
      [&](const RowBlock& block, FaceSums<T>& sums) {
        with_channels<T>(args.channels, [&](auto known) {
          sample_uv_block_backward<known()>(args, block, direct, scatter ? rows.data() : nullptr,
                                            sums);
        });
      },
      [&](int64_t b, const FaceSums<T>& sums) {
        if (at.grad_attributes)
          scatter_corner_sums<2>(sums, image_attributes(at, b), 2, at.grad_attributes);
      });
  if (!scatter) return;
  for_texels(
      1, at.num_threads, [&](int64_t) { return args.num_texels; },
      [&](int64_t, int64_t first, int64_t last) {
        with_channels<T>(args.channels, [&](auto known) {
          scatter_texels<known()>(args, rows.data(), first, last);
        });
      });
}

NMR_FLOAT_AND_DOUBLE(mipmaps_forward, Mipmaps)
NMR_FLOAT_AND_DOUBLE(mipmaps_backward, Mipmaps)
NMR_FLOAT_AND_DOUBLE(uv_levels, UVLevels)
NMR_FLOAT_AND_DOUBLE(sample_uv_forward, SampleUV)
NMR_FLOAT_AND_DOUBLE(sample_uv_backward, SampleUV)

}  // namespace nmr
