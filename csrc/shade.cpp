// Colours from texture cubes, and interpolation of values given at the corners of faces. Both read
// the face index map and the perspective-correct weights, in the vertex order of the original face,
// so that reversed copies are not special.
#include <algorithm>
#include <vector>

#include "corner_values.h"

namespace nmr {
namespace {

// The texels around one pixel: texture = sum over the 8 corners c of weight[c] texel[offset[c]],
// trilinear at t_k = b_k (ts - 1) clamped to [0, ts - 1 - eps].
template <class T>
struct Texels {
  int64_t offset[8];  // offsets of texels within one face's cube
  T weight[8];
};

template <class T>
NMR_INLINE Texels<T> texels_of(const T* weights, int64_t texture_size, T eps) {
  const int64_t ts = texture_size, next = ts > 1 ? 1 : 0;  // a cube of one texel is constant
  const T last = static_cast<T>(ts - 1), limit = std::max(last - eps, T(0));
  int64_t cell[3];
  T fraction[3];
  for (int k = 0; k < 3; ++k) {
    T t = weights[k] * last;
    t = t > 0 ? t : T(0);  // NaN becomes 0
    t = t < limit ? t : limit;
    cell[k] = std::max(std::min(static_cast<int64_t>(t), ts - 2),
                       int64_t(0));  // ts - 1 - eps may round to ts - 1
    fraction[k] = t - static_cast<T>(cell[k]);
  }
  Texels<T> texels;
  for (int c = 0; c < 8; ++c) {
    const int bit[3] = {c >> 2 & 1, c >> 1 & 1, c & 1};
    texels.offset[c] =
        ((cell[0] + next * bit[0]) * ts + cell[1] + next * bit[1]) * ts + cell[2] + next * bit[2];
    texels.weight[c] = (bit[0] ? fraction[0] : 1 - fraction[0]) *
                       (bit[1] ? fraction[1] : 1 - fraction[1]) *
                       (bit[2] ? fraction[2] : 1 - fraction[2]);
  }
  return texels;
}

// color = sum over the corners of weight texel; kChannels is the number of channels, or 0 if it is
// known only at run time.
template <int64_t kChannels, class T>
NMR_INLINE void blend(const Texels<T>& texels, const T* texture, int64_t channels, T* color) {
  if constexpr (kChannels > 0) {
    T sum[kChannels] = {};
    for (int c = 0; c < 8; ++c)
      for (int64_t k = 0; k < kChannels; ++k)
        sum[k] += texels.weight[c] * texture[texels.offset[c] * kChannels + k];
    for (int64_t k = 0; k < kChannels; ++k) color[k] = sum[k];
  } else {
    for (int64_t k = 0; k < channels; ++k) color[k] = 0;
    for (int c = 0; c < 8; ++c)
      for (int64_t k = 0; k < channels; ++k)
        color[k] += texels.weight[c] * texture[texels.offset[c] * channels + k];
  }
}

}  // namespace

template <class T>
void texture_cubes_forward(const TextureCubes<T>& args) {
  with_channels<T>(args.channels, [&](auto known) {
    constexpr int64_t kChannels = known();
    const int64_t W = args.raster.width, C = kChannels ? kChannels : args.channels,
                  ts = args.texture_size, cube = ts * ts * ts * C;
    for_rows(args.batch, args.raster.height, args.num_threads, [&](int64_t b, int64_t row) {
      const int64_t start = (b * args.raster.height + row) * W, F = args.cubes.count(b);
      const T* textures = args.textures + args.cubes.first(b) * cube;
      T* color = args.colors + start * C;
      for (int64_t n = start; n < start + W; ++n, color += C) {
        const int64_t id = args.face_index[n];
        if (id >= 0)
          blend<kChannels>(texels_of(args.weights + 3 * n, ts, args.eps),
                           textures + face_of(id, F) * cube, C, color);
        else
          for (int64_t k = 0; k < C; ++k) color[k] = 0;
      }
    });
  });
}

namespace {

// Adds the gradients of the pixels of image b whose face is in [first_face, last_face) to its
// cubes.
template <int64_t kChannels, class T>
void add_texture_gradients(const TextureCubes<T>& args, int64_t b, int64_t first_face,
                           int64_t last_face) {
  const int64_t C = kChannels ? kChannels : args.channels, ts = args.texture_size,
                cube = ts * ts * ts * C;
  const int64_t F = args.cubes.count(b), pixels = args.raster.pixels();
  T* grad_textures = args.grad_textures + args.cubes.first(b) * cube;
  for (int64_t n = b * pixels; n < (b + 1) * pixels; ++n) {
    const int64_t f = face_of(args.face_index[n], F);
    if (f < first_face || f >= last_face) continue;  // background as well
    const Texels<T> texels = texels_of(args.weights + 3 * n, ts, args.eps);
    const T* grad = args.grad_colors + n * C;
    T* texture = grad_textures + f * cube;
    for (int c = 0; c < 8; ++c)
      for (int64_t k = 0; k < C; ++k)
        texture[texels.offset[c] * C + k] += texels.weight[c] * grad[k];
  }
}

}  // namespace

// The ranges are those of faces.
template <class T>
void texture_cubes_backward(const TextureCubes<T>& args) {
  const int64_t ts = args.texture_size, cube = ts * ts * ts * args.channels;
  const int64_t sets = args.cubes.each ? args.batch : 1,
                images = args.cubes.each ? 1 : args.batch;  // of each set
  for_texels(
      sets, args.num_threads, [&](int64_t set) { return args.cubes.count(set); },
      [&](int64_t set, int64_t first, int64_t last) {
        std::fill_n(args.grad_textures + (args.cubes.first(set) + first) * cube,
                    (last - first) * cube, T(0));
        with_channels<T>(args.channels, [&](auto known) {
          for (int64_t b = set; b < set + images; ++b)
            add_texture_gradients<known()>(args, b, first, last);
        });
      });
}

namespace {

// grad_weights of a block's pixels, and its sums of b_k g.
template <int64_t kChannels, class T>
void interpolate_block_backward(const Interpolate<T>& args, const RowBlock& block,
                                FaceSums<T>& sums) {
  const ImageAttributes image = image_attributes(args, block.b);
  const int64_t C = kChannels ? kChannels : args.channels, begin = block.begin(), end = block.end();
  if (args.grad_attributes)
    sums.start(args.face_index + begin, end - begin, image.num_faces, 3 * C);
  for (int64_t n = begin; n < end; ++n) {
    const int64_t id = args.face_index[n];
    const T *grad = args.grad_values + n * C, *weights = args.weights + 3 * n;
    if (args.grad_weights && id < 0) std::fill_n(args.grad_weights + 3 * n, 3, T(0));
    if (id < 0) continue;
    const int64_t* corners = image.corners_of(id);
    for (int k = 0; k < 3; ++k) {
      if (args.grad_weights) {
        const T* row = args.attributes + (image.first_row + corners[k]) * C;
        T dot = 0;
        for (int64_t c = 0; c < C; ++c) dot += row[c] * grad[c];
        args.grad_weights[3 * n + k] = dot;
      }
      if (args.grad_attributes) {
        T* sum = sums.of(id, 3 * C) + k * C;
        for (int64_t c = 0; c < C; ++c) sum[c] += weights[k] * grad[c];
      }
    }
  }
}

}  // namespace

template <class T>
void interpolate_forward(const Interpolate<T>& args) {
  with_channels<T>(args.channels, [&](auto known) {
    const int64_t W = args.raster.width, C = known ? known() : args.channels;
    for_rows(args.batch, args.raster.height, args.num_threads, [&](int64_t b, int64_t row) {
      const ImageAttributes image = image_attributes(args, b);
      const T* attributes = args.attributes + image.first_row * C;
      const int64_t start = (b * args.raster.height + row) * W;
      T* value = args.values + start * C;
      for (int64_t n = start; n < start + W; ++n, value += C) {
        const int64_t id = args.face_index[n];
        if (id < 0) {
          for (int64_t c = 0; c < C; ++c) value[c] = 0;
          continue;
        }
        const int64_t* corners = image.corners_of(id);
        const T* w = args.weights + 3 * n;
        const T *p = attributes + corners[0] * C, *q = attributes + corners[1] * C,
                *r = attributes + corners[2] * C;
        for (int64_t c = 0; c < C; ++c) value[c] = w[0] * p[c] + w[1] * q[c] + w[2] * r[c];
      }
    });
  });
}

template <class T>
void interpolate_backward(const Interpolate<T>& args) {
  if (args.grad_attributes)
    std::fill_n(args.grad_attributes, args.rows.total(args.batch) * args.channels, T(0));
  sum_blocks<FaceSums<T>>(
      args.batch, args.raster, !args.rows.each, args.num_threads, args.face_rows,
      [&](const RowBlock& block, FaceSums<T>& sums) {
        with_channels<T>(args.channels, [&](auto known) {
          interpolate_block_backward<known()>(args, block, sums);
        });
      },
      [&](int64_t b, const FaceSums<T>& sums) {
        if (args.grad_attributes)
          scatter_corner_sums<0>(sums, image_attributes(args, b), args.channels,
                                 args.grad_attributes);
      });
}

NMR_FLOAT_AND_DOUBLE(texture_cubes_forward, TextureCubes)
NMR_FLOAT_AND_DOUBLE(texture_cubes_backward, TextureCubes)
NMR_FLOAT_AND_DOUBLE(interpolate_forward, Interpolate)
NMR_FLOAT_AND_DOUBLE(interpolate_backward, Interpolate)

}  // namespace nmr
