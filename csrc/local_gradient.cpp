// The silhouette gradient of Kato and Harada 2019, which reaches one pixel: where the object ends between two pixels,
// the loss decides whether the border should move, and the point seen in the covered pixel moves.
//
// I is the coverage (0 or 1), g the gradient of the loss with respect to I, both on the raster H x W; i and j are
// neighbours in a row, j to the right. If the content moves right by a pixel (2 / W), I_j becomes I_i, and the loss
// falls at the rate
//     right = -(I_i - I_j) g_j W / 2;      if it moves left, I_i becomes I_j:      left = -(I_j - I_i) g_i W / 2.
// A covered pixel sums both rates over its two pairs and takes the better direction, or none. The result is
// distributed to the corners of its face by their weights at its centre, which are treated as constants. y is treated
// in the same way, upwards and with H. z gets nothing.
#include <algorithm>
#include <cmath>

#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

// One image at raster resolution; row 0 = top.
template <class T>
struct LocalImage {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  Size raster, size;  // H x W, and that of the image
  bool anti_aliasing;
  T eps;
  const int32_t* face_index;
  const T* grad_alpha;

  bool covered(int64_t row, int64_t column) const { return face_index[row * raster.width + column] >= 0; }

  // With a 2x2 mean each raster pixel gets a quarter of the image's gradient.
  T grad(int64_t row, int64_t column) const {
    return anti_aliasing ? grad_alpha[row / 2 * size.width + column / 2] / 4 : grad_alpha[row * size.width + column];
  }
};

// Rates at which the loss falls if the point of a pixel moves up or down an axis.
template <class T>
struct Rates {
  T up = 0, down = 0;

  // A border of the object: the upper (lower) neighbour is background. `own` and `other` are the gradients of the two
  // pixels.
  void add_upper_end(T own, T other) {
    up -= other;
    down += own;
  }
  void add_lower_end(T own, T other) {
    up += own;
    down -= other;
  }

  // d loss / d coordinate of the better direction, or 0 if it does not lower the loss or is not clearly better. NaN is
  // kept.
  T gradient(T per_pixel, T eps) const {
    const T u = up * per_pixel, d = down * per_pixel;
    if (!(u - d == u - d)) return u - d;
    if (std::max(u, d) <= 0 || std::abs(u - d) < eps) return 0;
    return u > d ? -u : d;
  }
};

// Screen weights of a face's corners at the centre of a pixel, in the order in which it is drawn, computed as in the
// rasterizer. False if they are not defined; the rasterizer never draws such a face.
template <class T>
bool screen_weights(const Triangle<T>& t, int64_t row, int64_t column, Size raster, T (&w)[3]) {
  const T width = static_cast<T>(raster.width), height = static_cast<T>(raster.height);
  const BarycentricMatrix<T> matrix = barycentric_matrix(t, width, height);
  const T x = static_cast<T>(column), y = static_cast<T>(raster.height - 1 - row);
  for (int k = 0; k < 3; ++k) w[k] = clamp_weight(matrix.m[k][0] * x + matrix.m[k][1] * y + matrix.m[k][2]);
  const T sum = w[0] + w[1] + w[2];
  for (T& weight : w) weight /= sum;
  return sum > 0;
}

// Adds the gradient of one covered pixel to the corners of its face.
template <class T>
void pull_pixel(const LocalImage<T>& image, int64_t row, int64_t column, T* grad_vertices) {
  const Size raster = image.raster;
  const T own = image.grad(row, column);
  Rates<T> x, y;
  bool at_end = false;
  const auto neighbour = [&](int64_t r, int64_t c, auto add) {
    // No gradient across the border of the image.
    if (r < 0 || r >= raster.height || c < 0 || c >= raster.width || image.covered(r, c)) return;
    at_end = true;
    add(image.grad(r, c));
  };
  neighbour(row, column + 1, [&](T other) { x.add_upper_end(own, other); });
  neighbour(row, column - 1, [&](T other) { x.add_lower_end(own, other); });
  neighbour(row - 1, column, [&](T other) { y.add_upper_end(own, other); });
  neighbour(row + 1, column, [&](T other) { y.add_lower_end(own, other); });
  if (!at_end) return;
  const T grad_x = x.gradient(static_cast<T>(raster.width) / 2, image.eps);
  const T grad_y = y.gradient(static_cast<T>(raster.height) / 2, image.eps);
  if (grad_x == 0 && grad_y == 0) return;
  const int32_t id = image.face_index[row * raster.width + column];
  const bool reversed = id >= image.num_faces;
  const int64_t* face = image.faces + 3 * (reversed ? id - image.num_faces : id);
  T w[3];
  if (!screen_weights(load_triangle(image.vertices, face, reversed), row, column, raster, w)) return;
  for (int k = 0; k < 3; ++k) {
    T* grad = grad_vertices + 3 * face[reversed ? 2 - k : k];
    grad[0] += w[k] * grad_x;
    grad[1] += w[k] * grad_y;
  }
}

}  // namespace

// Images in parallel; the pixels of an image in a fixed order, because they share vertices.
template <class T>
void local_gradient(const SilhouetteBackward<T>& args) {
  const Size raster = raster_of(args.image, args.anti_aliasing);
  parallel_for(args.mesh.batch, args.num_threads, [&](int64_t b) {
    const LocalImage<T> image{args.mesh.image_vertices(b),
                              args.mesh.image_faces(b),
                              args.mesh.face_count(b),
                              raster,
                              args.image,
                              args.anti_aliasing,
                              args.eps,
                              args.face_index + b * raster.pixels(),
                              args.grad_alpha + b * args.image.pixels()};
    T* grad_vertices = args.grad_vertices + 3 * args.mesh.vertex_start(b);
    std::fill_n(grad_vertices, 3 * args.mesh.vertex_count(b), T(0));
    for (int64_t row = 0; row < raster.height; ++row)
      for (int64_t column = 0; column < raster.width; ++column)
        if (image.covered(row, column)) pull_pixel(image, row, column, grad_vertices);
  });
}

template void local_gradient(const SilhouetteBackward<float>&);
template void local_gradient(const SilhouetteBackward<double>&);

}  // namespace nmr
