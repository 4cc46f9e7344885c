// Weights, depth and signed squared distance of the faces around each pixel (soft_layers), and
// their derivatives.
//
// With v_k of SoftWeights and q = sum_k v_k / z_k: depth z = 1 / q and weights b_k = z v_k / z_k;
// without perspective z = sum_k v_k z_k and b_k = v_k. A clamped weight has no derivative. Moving
// corner k by e changes the weight w_m on the screen by -w_k (gradient of w_m at the pixel) . e.
// soft.cpp has the derivative of the distance.
#include <algorithm>
#include <cmath>
#include <limits>

#include "corner_values.h"
#include "soft_weights.h"

namespace nmr {
namespace {

// A face at the centre of one pixel of a raster [H, W K], in units of half the shorter side.
template <class T>
struct SoftFragment {
  const int64_t* face;
  T x[3], y[3], z[3], px, py, scale_x, scale_y;

  SoftFragment(const SoftFragments<T>& args, int64_t b, int64_t id, int64_t row, int64_t column) {
    const Size raster = args.raster;
    const T shorter = static_cast<T>(std::min(raster.height, raster.width));
    scale_x = static_cast<T>(raster.width) / shorter,
    scale_y = static_cast<T>(raster.height) / shorter;
    face = args.mesh.image_faces(b) + 3 * face_of(id, args.mesh.face_rows.count(b));
    for (int k = 0; k < 3; ++k) {
      const T* v = args.mesh.image_vertices(b) + 3 * face[k];
      x[k] = v[0] * scale_x, y[k] = v[1] * scale_y, z[k] = v[2];
    }
    px = pixel_centre<T>(column, raster.width) * scale_x;
    py = pixel_centre<T>(raster.height - 1 - row, raster.height) * scale_y;
  }
};

// The nearest point of the border.
template <class T>
struct Nearest {
  T square, away_x, away_y, share;  // share: of corner `side` + 1; the other end has 1 - share
  int side;

  explicit Nearest(const SoftFragment<T>& f)
      : square(std::numeric_limits<T>::max()), away_x(0), away_y(0), share(0), side(0) {
    for (int k = 0; k < 3; ++k) {
      const int q = (k + 1) % 3;
      const T sx = f.x[q] - f.x[k], sy = f.y[q] - f.y[k], dx = f.px - f.x[k], dy = f.py - f.y[k];
      const T length = sx * sx + sy * sy;
      const T t = length > std::numeric_limits<T>::min()
                      ? clamp_weight((dx * sx + dy * sy) / length)
                      : T(0);
      const T ax = dx - t * sx, ay = dy - t * sy, d = ax * ax + ay * ay;
      if (d < square) square = d, away_x = ax, away_y = ay, share = t, side = k;
    }
  }
};

template <class T>
bool inside(const SoftWeights<T>& weights) {
  return weights.w[0] > 0 && weights.w[1] > 0 && weights.w[2] > 0;
}

// Adds the gradient of one fragment to the corners of its face, [3, 3].
template <class T>
NMR_INLINE void fragment_backward(const SoftFragment<T>& f, bool perspective, const T* grad_weights,
                                  T grad_depth, T grad_distance, T* grads) {
  const SoftWeights<T> weights(f.x, f.y, f.px, f.py);
  const T *v = weights.v, *z = f.z;
  T grad_v[3], mean = 0;
  if (perspective) {
    const T depth = weights.depth(z, true);
    T by_depth = grad_depth;
    for (int k = 0; k < 3; ++k) by_depth += grad_weights[k] * v[k] / z[k];
    for (int k = 0; k < 3; ++k) {
      grad_v[k] = (grad_weights[k] - depth * by_depth) * depth / z[k];
      grads[3 * k + 2] -= grad_v[k] * v[k] / z[k];
    }
  } else {
    for (int k = 0; k < 3; ++k) {
      grad_v[k] = grad_weights[k] + grad_depth * z[k];
      grads[3 * k + 2] += grad_depth * v[k];
    }
  }
  for (int k = 0; k < 3; ++k) mean += grad_v[k] * v[k];
  T by_x = 0, by_y = 0;  // gradient of the pixel, through the weights on the screen
  for (int k = 0; k < 3; ++k) {
    if (!(weights.w[k] > 0 && weights.w[k] < 1)) continue;
    const int q = (k + 1) % 3, r = (k + 2) % 3;
    const T grad_w = (grad_v[k] - mean) / weights.sum / weights.area;
    by_x += grad_w * (f.y[q] - f.y[r]);
    by_y += grad_w * (f.x[r] - f.x[q]);
  }
  const Nearest<T> nearest(f);
  const T strength = (inside(weights) ? 2 : -2) * grad_distance;
  for (int k = 0; k < 3; ++k) {
    const T share = k == nearest.side             ? 1 - nearest.share
                    : k == (nearest.side + 1) % 3 ? nearest.share
                                                  : T(0);
    const T w =
        std::isfinite(weights.w[k]) ? weights.w[k] : T(0);  // not finite if the face has no area
    grads[3 * k] += (strength * share * nearest.away_x - w * by_x) * f.scale_x;
    grads[3 * k + 1] += (strength * share * nearest.away_y - w * by_y) * f.scale_y;
  }
}

}  // namespace

template <class T>
void soft_fragments_forward(const SoftFragments<T>& args) {
  const int64_t H = args.raster.height, wide = args.raster.width * args.layers;
  parallel_for(args.mesh.batch * H, args.num_threads, [&](int64_t line) {
    for (int64_t n = line * wide; n < (line + 1) * wide; ++n) {
      T* weights = args.weights + 3 * n;
      std::fill_n(weights, 3, T(0));
      args.depth[n] = args.far;
      args.distances[n] = 0;
      if (args.face_index[n] < 0) continue;
      const SoftFragment<T> f(args, line / H, args.face_index[n], line % H, n % wide / args.layers);
      const SoftWeights<T> screen(f.x, f.y, f.px, f.py);
      const T square = Nearest<T>(f).square;
      args.depth[n] = screen.depth(f.z, args.perspective);
      for (int k = 0; k < 3; ++k)
        weights[k] = args.perspective ? args.depth[n] * screen.v[k] / f.z[k] : screen.v[k];
      args.distances[n] = inside(screen) ? -square : square;
    }
  });
}

template <class T>
void soft_fragments_backward(const SoftFragments<T>& args) {
  const MeshBatch<T>& mesh = args.mesh;
  const int64_t H = args.raster.height, wide = args.raster.width * args.layers;
  std::fill_n(args.grad_vertices, 3 * mesh.vertex_rows.total(mesh.batch), T(0));
  sum_blocks<FaceSums<T>>(
      mesh.batch, {H, wide}, false, args.num_threads, mesh.face_rows,
      [&](const RowBlock& block, FaceSums<T>& sums) {
        const int64_t first = block.begin(), last = block.end();
        sums.start(args.face_index + first, last - first, block.blocks.num_faces, 9);
        T* values = sums.values.data();
        for (int64_t n = first; n < last; ++n) {
          const int64_t id = args.face_index[n];
          if (id < 0) continue;
          const SoftFragment<T> f(args, block.b, id, n / wide % H, n % wide / args.layers);
          fragment_backward(f, args.perspective, args.grad_weights + 3 * n, args.grad_depth[n],
                            args.grad_distances[n], values + 9 * sums.visible.slots[id + 1]);
        }
      },
      [&](int64_t b, const FaceSums<T>& sums) {
        scatter_corner_sums<3>(sums, image_attributes(mesh, b), 3, args.grad_vertices);
      });
}

NMR_FLOAT_AND_DOUBLE(soft_fragments_forward, SoftFragments)
NMR_FLOAT_AND_DOUBLE(soft_fragments_backward, SoftFragments)

}  // namespace nmr
