// The gradient of Kato and Harada 2019, which reaches one pixel: if a surface ends between two
// pixels, the loss decides whether its border should move, and the point seen in the pixel of the
// surface moves.
//
// I is the coverage (0 or 1) or a colour [C] (products are sums over its channels), g the gradient
// of the loss with respect to I, both on the raster H x W; i and j are neighbours in a row, j to
// the right. If the content moves right by a pixel (2 / W), I_j becomes I_i, and the loss falls at
// the rate
//     right = -(I_i - I_j) g_j W / 2;      if it moves left, I_i becomes I_j:      left = -(I_j -
//     I_i) g_i W / 2.
// A covered pixel sums both rates over its pairs with neighbours before which its surface ends, and
// takes the better direction, or none. The result is distributed to the corners of its face by
// their weights at its centre, which are treated as constants. y is treated in the same way,
// upwards and with H. z gets nothing.
//
// A surface ends before the background. In colours it also ends before another surface behind it:
// see is_in_front.
#include <algorithm>
#include <cmath>
#include <vector>

#include "average.h"
#include "blocks.h"
#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

// One image at raster resolution; row 0 = top.
template <class T>
struct LocalRaster {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  Size raster, size;  // H x W, and that of the image
  bool anti_aliasing, perspective;
  T eps;
  const int32_t* face_index;

  int32_t id(int64_t row, int64_t column) const { return face_index[row * raster.width + column]; }
  // The triangle of a face; a reversed copy is the same surface.
  Triangle<T> triangle(int32_t id) const {
    return load_triangle(vertices, faces + 3 * face_of(id, num_faces), false);
  }
  int64_t image_pixel(int64_t row, int64_t column) const {
    return anti_aliasing ? row / 2 * size.width + column / 2 : row * size.width + column;
  }
};

template <class T>
struct LocalCoverage : LocalRaster<T> {
  const T* grad_alpha;  // [h, w]

  bool ends(int64_t, int64_t, int64_t r, int64_t c) const { return this->id(r, c) < 0; }
  // (I - I of the neighbour) times the gradients of the pixel and of its neighbour.
  void products(int64_t row, int64_t column, int64_t r, int64_t c, T& own, T& other) const {
    own = grad_alpha[this->image_pixel(row, column)] * share_of_pixel<T>(this->anti_aliasing);
    other = grad_alpha[this->image_pixel(r, c)] * share_of_pixel<T>(this->anti_aliasing);
  }
};

// 1 / z of the plane of a face at (x, y), -z without perspective: affine on the screen, and larger
// if it is nearer.
template <class T>
double nearness(const Triangle<T>& t, double x, double y, bool perspective) {
  const auto at = [&](int k) {
    return perspective ? 1 / static_cast<double>(t.z[k]) : -static_cast<double>(t.z[k]);
  };
  const double x1 = double(t.x[1]) - t.x[0], y1 = double(t.y[1]) - t.y[0],
               x2 = double(t.x[2]) - t.x[0], y2 = double(t.y[2]) - t.y[0], det = x1 * y2 - y1 * x2;
  x -= t.x[0], y -= t.y[0];
  return at(0) + ((x * y2 - y * x2) * (at(1) - at(0)) + (x1 * y - y1 * x) * (at(2) - at(0))) / det;
}

// Whether face f, seen in pixel (row, column), ends in front of face g, seen in the neighbour (r,
// c). Faces with a common corner (by place: a seam may have doubled its vertices) belong to one
// surface. Other faces may, too, if whole faces are between the two pixels; their planes then cross
// between the pixels, or almost coincide.
template <class T>
bool is_in_front(const LocalRaster<T>& image, const Triangle<T>& f, const Triangle<T>& g,
                 int64_t row, int64_t column, int64_t r, int64_t c) {
  for (int k = 0; k < 3; ++k)
    for (int m = 0; m < 3; ++m)
      if (f.x[k] == g.x[m] && f.y[k] == g.y[m] && f.z[k] == g.z[m]) return false;
  const auto gap = [&](int64_t at_row, int64_t at_column) {
    const double x = pixel_centre<double>(at_column, image.raster.width),
                 y = -pixel_centre<double>(at_row, image.raster.height),
                 of_f = nearness(f, x, y, image.perspective);
    return of_f - nearness(g, x, y, image.perspective) - 1e-4 * std::abs(of_f);
  };
  return gap(row, column) > 0 && gap(r, c) > 0;
}

template <class T>
struct LocalColors : LocalRaster<T> {
  const T *pixels, *background, *grad_resolved;  // [H, W, C]; [C] or nullptr; [h, w, C]
  int64_t channels;

  const T* color(int64_t row, int64_t column) const {
    return background && this->id(row, column) < 0
               ? background
               : pixels + (row * this->raster.width + column) * channels;
  }
  bool ends(int64_t row, int64_t column, int64_t r, int64_t c) const {
    const int32_t f = this->id(row, column), g = this->id(r, c);
    return g < 0 ||
           (f != g && is_in_front(*this, this->triangle(f), this->triangle(g), row, column, r, c));
  }
  void products(int64_t row, int64_t column, int64_t r, int64_t c, T& own, T& other) const {
    const T *a = color(row, column), *b = color(r, c),
            *of_a = grad_resolved + this->image_pixel(row, column) * channels,
            *of_b = grad_resolved + this->image_pixel(r, c) * channels;
    own = other = 0;
    for (int64_t k = 0; k < channels; ++k) {
      own += (a[k] - b[k]) * of_a[k];
      other += (a[k] - b[k]) * of_b[k];
    }
    own *= share_of_pixel<T>(this->anti_aliasing), other *= share_of_pixel<T>(this->anti_aliasing);
  }
};

// Rates at which the loss falls if the point of a pixel moves up or down an axis.
template <class T>
struct Rates {
  T up = 0, down = 0;

  // The surface ends before the upper (lower) neighbour. `own` and `other` are (I - I of the
  // neighbour) times the gradients of the pixel and of that neighbour.
  void add_upper_end(T own, T other) {
    up -= other;
    down += own;
  }
  void add_lower_end(T own, T other) {
    up += own;
    down -= other;
  }

  // d loss / d coordinate of the better direction, or 0 if it does not lower the loss or is not
  // clearly better. NaN is kept.
  T gradient(T per_pixel, T eps) const {
    const T u = up * per_pixel, d = down * per_pixel;
    if (!(u - d == u - d)) return u - d;
    if (std::max(u, d) <= 0 || std::abs(u - d) < eps) return 0;
    return u > d ? -u : d;
  }
};

// The gradient of the point seen in a pixel.
template <class T>
struct Pull {
  int32_t row, column;
  T x, y;
};

// Of one block of rows.
template <class T>
struct Pulls {
  std::vector<Pull<T>> list;
  int64_t count;
};

// Image: LocalCoverage or LocalColors.
template <class Image, class T>
void find_pull(const Image& image, int64_t row, int64_t column, Pulls<T>& pulls) {
  const Size raster = image.raster;
  const int32_t id = image.id(row, column);
  if (id < 0) return;
  Rates<T> x, y;
  bool at_end = false;
  const auto neighbour = [&](int64_t r, int64_t c, auto add) {
    // No gradient across the border of the image.
    if (r < 0 || r >= raster.height || c < 0 || c >= raster.width || image.id(r, c) == id) return;
    if (!image.ends(row, column, r, c)) return;
    at_end = true;
    T own, other;
    image.products(row, column, r, c, own, other);
    add(own, other);
  };
  neighbour(row, column + 1, [&](T own, T other) { x.add_upper_end(own, other); });
  neighbour(row, column - 1, [&](T own, T other) { x.add_lower_end(own, other); });
  neighbour(row - 1, column, [&](T own, T other) { y.add_upper_end(own, other); });
  neighbour(row + 1, column, [&](T own, T other) { y.add_lower_end(own, other); });
  if (!at_end) return;
  const T grad_x = x.gradient(static_cast<T>(raster.width) / 2, image.eps);
  const T grad_y = y.gradient(static_cast<T>(raster.height) / 2, image.eps);
  if (grad_x != 0 || grad_y != 0)
    pulls.list[pulls.count++] = {static_cast<int32_t>(row), static_cast<int32_t>(column), grad_x,
                                 grad_y};
}

// Adds them to the corners of their faces, in the order of the pixels.
template <class T>
void add_pulls(const LocalRaster<T>& image, const Pulls<T>& pulls, T* grad_vertices) {
  const T width = static_cast<T>(image.raster.width), height = static_cast<T>(image.raster.height);
  for (int64_t n = 0; n < pulls.count; ++n) {
    const Pull<T>& pull = pulls.list[n];
    const int32_t id = image.id(pull.row, pull.column);
    const bool reversed = id >= image.num_faces;
    const int64_t* face = image.faces + 3 * face_of(id, image.num_faces);
    T w[3];
    weights_at(barycentric_matrix(load_triangle(image.vertices, face, reversed), width, height),
               static_cast<T>(pull.column), height - 1 - static_cast<T>(pull.row), w);
    if (std::isnan(w[0])) continue;  // the rasterizer never draws such a face
    for (int k = 0; k < 3; ++k) {
      T* grad = grad_vertices + 3 * face[reversed ? 2 - k : k];
      grad[0] += w[k] * pull.x;
      grad[1] += w[k] * pull.y;
    }
  }
}

// grad_vertices of all images; image_of(b) describes one of them.
template <class T, class ImageOf>
void local_pulls(const MeshBatch<T>& mesh, Size raster, T* grad_vertices, int num_threads,
                 const ImageOf& image_of) {
  std::fill_n(grad_vertices, 3 * mesh.vertex_rows.total(mesh.batch), T(0));
  sum_blocks<Pulls<T>>(
      mesh.batch, raster, false, num_threads, Rows{},
      [&](const RowBlock& block, Pulls<T>& pulls) {
        const auto image = image_of(block.b);
        reserve(pulls.list, block.blocks.rows * raster.width);
        pulls.count = 0;
        for (int64_t row = block.first(); row < block.last(); ++row)
          for (int64_t column = 0; column < raster.width; ++column)
            find_pull(image, row, column, pulls);
      },
      [&](int64_t b, const Pulls<T>& pulls) {
        add_pulls<T>(image_of(b), pulls, grad_vertices + 3 * mesh.vertex_rows.first(b));
      });
}

template <class T>
LocalRaster<T> raster_of_image(const MeshBatch<T>& mesh, Size size, bool anti_aliasing,
                               bool perspective, T eps, const int32_t* face_index, int64_t b) {
  const Size raster = raster_of(size, anti_aliasing);
  return {mesh.image_vertices(b),
          mesh.image_faces(b),
          mesh.face_rows.count(b),
          raster,
          size,
          anti_aliasing,
          perspective,
          eps,
          face_index + b * raster.pixels()};
}

}  // namespace

template <class T>
void local_gradient(const SilhouetteBackward<T>& args) {
  const Size raster = raster_of(args.image, args.anti_aliasing);
  local_pulls(args.mesh, raster, args.grad_vertices, args.num_threads, [&](int64_t b) {
    return LocalCoverage<T>{raster_of_image(args.mesh, args.image, args.anti_aliasing, true,
                                            args.eps, args.face_index, b),
                            args.grad_alpha + b * args.image.pixels()};
  });
}

template <class T>
void local_edges_backward(const EdgesBackward<T>& args) {
  const Size raster = raster_of(args.image, args.anti_aliasing);
  const int64_t C = args.channels;
  local_pulls(args.mesh, raster, args.grad_vertices, args.num_threads, [&](int64_t b) {
    return LocalColors<T>{raster_of_image(args.mesh, args.image, args.anti_aliasing,
                                          args.perspective, args.eps, args.face_index, b),
                          args.pixels + b * raster.pixels() * C, args.background.of(b, C),
                          args.grad_resolved + b * args.image.pixels() * C, C};
  });
}

NMR_FLOAT_AND_DOUBLE(local_edges_backward, EdgesBackward)
NMR_FLOAT_AND_DOUBLE(local_gradient, SilhouetteBackward)

}  // namespace nmr
