// Barycentric weights of faces in clip space, with their derivatives on the screen, and the
// blending of pixels at silhouette edges (Laine et al. 2020, Modular Primitives for
// High-Performance Differentiable Rendering).
//
// From a pixel centre P = (X, Y) in [-1, 1]^2, a vertex (x, y, z, w) is at q = (x - X w, y - Y w).
// With e_k = q_i x q_j over the other two corners and S = e_0 + e_1 + e_2, the weights are b_k =
// e_k / S, whatever the signs of w. All geometry is computed in double.
#include <algorithm>
#include <cmath>
#include <limits>

#include "corner_values.h"
#include "geometry.h"

namespace nmr {
namespace {

// A corner as seen from a pixel centre.
struct Corner {
  double x, y, w;
};

// The image b of a batch, its faces and positions.
template <class T>
struct ClipImage {
  const T* positions;
  ImageAttributes attributes;
  Size raster;
  const int32_t* face_index;

  ClipImage(const ClipMesh<T>& mesh, int64_t b)
      : positions(mesh.positions + 4 * mesh.rows.first(b)),
        attributes{mesh.rows.first(b), mesh.faces, mesh.num_faces},
        raster(mesh.raster),
        face_index(mesh.face_index + b * mesh.raster.pixels()) {}

  double centre_x(int64_t n) const { return pixel_centre<double>(n % raster.width, raster.width); }
  double centre_y(int64_t n) const { return pixel_centre<double>(n / raster.width, raster.height); }
  const T* position(int64_t face, int k) const {
    return positions + 4 * attributes.corners[3 * face + k];
  }
  Corner corner(int64_t face, int k, double X, double Y) const {
    const T* p = position(face, k);
    const double w = p[3];
    return {p[0] - X * w, p[1] - Y * w, w};
  }
  int64_t face(int64_t n) const {  // -1 on background
    return face_of(face_index[n], attributes.num_faces);
  }
};

// e_k, its derivatives by X and Y, and their sums (index 3).
struct Areas {
  double e[4], by_x[4], by_y[4];

  // Whether the face is seen so nearly edge-on that S is below the rounding of its corners: 1 / S
  // means nothing then.
  template <class T>
  NMR_INLINE bool edge_on() const {
    return !(std::abs(e[3]) >
             std::numeric_limits<T>::epsilon() * (std::abs(by_x[3]) + std::abs(by_y[3])));
  }
};

NMR_INLINE Areas areas_of(const Corner* q) {
  Areas a{};
  for (int k = 0; k < 3; ++k) {
    const Corner &i = q[(k + 1) % 3], &j = q[(k + 2) % 3];
    a.e[3] += a.e[k] = i.x * j.y - i.y * j.x;
    a.by_x[3] += a.by_x[k] = i.y * j.w - i.w * j.y;
    a.by_y[3] += a.by_y[k] = i.w * j.x - i.x * j.w;
  }
  return a;
}

NMR_INLINE double unit(double x) { return x > 0 ? (x < 1 ? x : 1) : 0; }

// Sums of gradients per corner of the faces that are seen in pixels begin..end - 1 of an image:
// [count, 3, 4].
template <class T>
void start_sums(const ClipImage<T>& image, int64_t begin, int64_t end, FaceSums<T>& sums) {
  sums.start(image.face_index + begin, end - begin, image.attributes.num_faces, 12);
}

// Adds the gradient of a corner as seen from (X, Y) to that of its position.
template <class T>
NMR_INLINE void add_corner(const Corner& grad, double X, double Y, T* position) {
  position[0] += static_cast<T>(grad.x);
  position[1] += static_cast<T>(grad.y);
  position[3] += static_cast<T>(grad.w - X * grad.x - Y * grad.y);
}

template <class T, class Body>
void sum_positions(const ClipMesh<T>& mesh, T* grad_positions, const Body& body) {
  std::fill_n(grad_positions, 4 * mesh.rows.total(mesh.batch), T(0));
  sum_blocks<FaceSums<T>>(
      mesh.batch, mesh.raster, !mesh.rows.each, mesh.num_threads,
      Rows{mesh.num_faces, false, nullptr},
      [&](const RowBlock& block, FaceSums<T>& sums) {
        const int64_t W = mesh.raster.width;
        body(block.b, block.first() * W, block.last() * W, sums);
      },
      [&](int64_t b, const FaceSums<T>& sums) {
        scatter_corner_sums<4>(sums, ClipImage<T>(mesh, b).attributes, 4, grad_positions);
      });
}

}  // namespace

template <class T>
void clip_weights_forward(const ClipWeights<T>& args) {
  const ClipMesh<T>& mesh = args.mesh;
  const int64_t W = mesh.raster.width;
  for_rows(mesh.batch, mesh.raster.height, mesh.num_threads, [&](int64_t b, int64_t row) {
    const ClipImage<T> image(mesh, b);
    const int64_t start = b * mesh.raster.pixels();
    for (int64_t n = row * W; n < (row + 1) * W; ++n) {
      T *rast = args.rast + 4 * (start + n), *slopes = args.slopes + 4 * (start + n);
      std::fill_n(rast, 4, T(0));
      std::fill_n(slopes, 4, T(0));
      const int64_t face = image.face(n);
      if (face < 0) continue;
      const double X = image.centre_x(n), Y = image.centre_y(n);
      const Corner q[3] = {image.corner(face, 0, X, Y), image.corner(face, 1, X, Y),
                           image.corner(face, 2, X, Y)};
      const Areas a = areas_of(q);
      double z = 0, w = 0;
      for (int k = 0; k < 3; ++k) {
        z += a.e[k] * image.position(face, k)[2];
        w += a.e[k] * q[k].w;
      }
      const double weights[2] = {a.e[0] / a.e[3], a.e[1] / a.e[3]};
      for (int k = 0; k < 2; ++k) rast[k] = static_cast<T>(unit(weights[k]));
      rast[2] = static_cast<T>(std::min(std::max(z / w, -1.0), 1.0));
      rast[3] = static_cast<T>(face + 1);
      if (a.template edge_on<T>()) continue;
      for (int k = 0; k < 2; ++k) {
        slopes[2 * k] = static_cast<T>((a.by_x[k] - weights[k] * a.by_x[3]) / a.e[3] * 2 / W);
        slopes[2 * k + 1] =
            static_cast<T>((a.by_y[k] - weights[k] * a.by_y[3]) / a.e[3] * 2 / mesh.raster.height);
      }
    }
  });
}

template <class T>
void clip_weights_backward(const ClipWeights<T>& args) {
  const ClipMesh<T>& mesh = args.mesh;
  sum_positions(
      mesh, args.grad_positions, [&](int64_t b, int64_t begin, int64_t end, FaceSums<T>& sums) {
        const ClipImage<T> image(mesh, b);
        start_sums(image, begin, end, sums);
        const double scale_x = 2.0 / mesh.raster.width, scale_y = 2.0 / mesh.raster.height;
        const int64_t first = b * mesh.raster.pixels();
        for (int64_t n = begin; n < end; ++n) {
          const int64_t face = image.face(n);
          if (face < 0) continue;
          const double X = image.centre_x(n), Y = image.centre_y(n);
          const Corner q[3] = {image.corner(face, 0, X, Y), image.corner(face, 1, X, Y),
                               image.corner(face, 2, X, Y)};
          const Areas a = areas_of(q);
          if (a.template edge_on<T>()) continue;
          const double inverse = 1 / a.e[3];
          double of_e[4] = {}, of_x[4] = {}, of_y[4] = {};  // gradients of Areas
          for (int k = 0; k < 2; ++k) {
            double grad = args.grad_rast[4 * (first + n) + k];
            const double b_k = a.e[k] * inverse;
            if (args.grad_slopes) {
              const T* slopes = args.grad_slopes + 4 * (first + n) + 2 * k;
              const double x = slopes[0] * scale_x * inverse, y = slopes[1] * scale_y * inverse;
              of_x[k] += x;
              of_y[k] += y;
              of_x[3] -= b_k * x;
              of_y[3] -= b_k * y;
              of_e[3] -=
                  (x * (a.by_x[k] - b_k * a.by_x[3]) + y * (a.by_y[k] - b_k * a.by_y[3])) * inverse;
              grad -= x * a.by_x[3] + y * a.by_y[3];
            }
            grad *= inverse;
            of_e[k] += grad;
            of_e[3] -= b_k * grad;
          }
          Corner grads[3] = {};
          for (int k = 0; k < 3; ++k) {
            const double e = of_e[k] + of_e[3], x = of_x[k] + of_x[3], y = of_y[k] + of_y[3];
            const Corner &i = q[(k + 1) % 3], &j = q[(k + 2) % 3];
            Corner &to_i = grads[(k + 1) % 3], &to_j = grads[(k + 2) % 3];
            to_i.x += e * j.y - y * j.w;
            to_i.y += x * j.w - e * j.x;
            to_i.w += y * j.x - x * j.y;
            to_j.x += y * i.w - e * i.y;
            to_j.y += e * i.x - x * i.w;
            to_j.w += x * i.y - y * i.x;
          }
          T* sum = sums.of(image.face_index[n], 12);
          for (int k = 0; k < 3; ++k) add_corner(grads[k], X, Y, sum + 4 * k);
        }
      });
}

// --- antialias

namespace {

// Two neighbouring pixels with a silhouette edge of the nearer one's face between them.
struct EdgePair {
  int64_t front, other;  // pixels; the face is that of `front`
  double share;   // distance of the edge from the centre of `front`, minus half a pixel; 0: no edge
  int edge;       // opposite to this corner
  bool vertical;  // whether the pixels are one above the other

  int64_t blended() const {
    return share > 0 ? other : front;
  }  // the pixel that gets |share| of the other's colour
  int64_t source() const { return share > 0 ? front : other; }
};

// x along the pair and y across.
NMR_INLINE Corner along(const Corner& q, bool vertical) {
  return vertical ? Corner{q.y, q.x, q.w} : q;
}

// Whether no other face continues the surface on the far side of the edge.
template <class T>
bool is_silhouette(const ClipImage<T>& image, const int64_t* twins, int64_t face, int edge,
                   double X, double Y) {
  const Corner i = image.corner(face, (edge + 1) % 3, X, Y),
               j = image.corner(face, (edge + 2) % 3, X, Y);
  const auto side_of = [&](int64_t f, int k) {
    const Corner p = image.corner(f, k, X, Y);
    return p.w * (i.x * j.y - i.y * j.x) + p.x * (i.y * j.w - i.w * j.y) +
               p.y * (i.w * j.x - i.x * j.w) >
           0;
  };
  const bool side = side_of(face, edge);
  const int64_t own = 3 * face + edge;
  int64_t twin = twins[own];
  for (int64_t n = 0; twin != own && n < 3 * image.attributes.num_faces; ++n, twin = twins[twin])
    if (side_of(twin / 3, static_cast<int>(twin % 3)) != side) return false;
  return true;
}

// The pair of pixel n and the next one to the right or above; rast: of the image.
template <class T>
NMR_INLINE EdgePair pair_of(const ClipImage<T>& image, const T* rast, const int64_t* twins,
                            int64_t n, bool vertical) {
  const int64_t next = n + (vertical ? image.raster.width : 1);
  EdgePair pair{n, next, 0, 0, vertical};
  const int64_t id = image.face(n), next_id = image.face(next);
  if (id == next_id) return pair;
  if (id < 0 || (next_id >= 0 && rast[4 * next + 2] < rast[4 * n + 2]))
    std::swap(pair.front, pair.other);
  const int64_t face = image.face(pair.front);
  const double X = image.centre_x(pair.front), Y = image.centre_y(pair.front);
  const double size = static_cast<double>(vertical ? image.raster.height : image.raster.width);
  const double across = static_cast<double>(vertical ? image.raster.width : image.raster.height);
  for (int k = 0; k < 3; ++k) {
    const Corner i = along(image.corner(face, (k + 1) % 3, X, Y), vertical);
    const Corner j = along(image.corner(face, (k + 2) % 3, X, Y), vertical);
    if ((i.y < 0) == (j.y < 0)) continue;
    const double at = i.y / (i.y - j.y);
    if (!(i.w + at * (j.w - i.w) > 0)) continue;  // the crossing is behind the eye
    const double distance =
        (i.x * j.y - j.x * i.y) / (i.w * j.y - j.w * i.y) * size / 2 * (pair.front == n ? 1 : -1);
    if (!(distance >= 0 && distance <= 1)) continue;
    const double steep = std::abs(i.y * j.w - i.w * j.y) / size,
                 flat = std::abs(i.w * j.x - i.x * j.w) / across;
    if (vertical ? !(steep > flat) : !(steep >= flat)) continue;  // the other direction's
    if (!is_silhouette(image, twins, face, k, X, Y)) continue;
    pair.share = distance - 0.5;
    pair.edge = k;
    return pair;
  }
  return pair;
}

// Calls body(pair) for the up to four pairs that pixel n is part of.
template <class T, class Body>
NMR_INLINE void for_pairs(const ClipImage<T>& image, const T* rast, const int64_t* twins, int64_t n,
                          const Body& body) {
  const int64_t W = image.raster.width, x = n % W;
  const auto visit = [&](bool exists, int64_t first, bool vertical) {
    if (!exists) return;
    const EdgePair pair = pair_of(image, rast, twins, first, vertical);
    if (pair.share != 0) body(pair);
  };
  visit(x > 0, n - 1, false);
  visit(x + 1 < W, n, false);
  visit(n >= W, n - W, true);
  visit(n + W < image.raster.pixels(), n, true);
}

}  // namespace

template <class T>
void antialias_forward(const Antialias<T>& args) {
  const ClipMesh<T>& mesh = args.mesh;
  const int64_t W = mesh.raster.width, C = args.channels;
  for_rows(mesh.batch, mesh.raster.height, mesh.num_threads, [&](int64_t b, int64_t row) {
    const ClipImage<T> image(mesh, b);
    const int64_t start = b * mesh.raster.pixels();
    const T* colors = args.colors + start * C;
    for (int64_t n = row * W; n < (row + 1) * W; ++n) {
      T* blended = std::copy_n(colors + n * C, C, args.blended + (start + n) * C) - C;
      for_pairs(image, args.rast + 4 * start, args.twins, n, [&](const EdgePair& pair) {
        if (pair.blended() != n) return;
        const T share = static_cast<T>(std::abs(pair.share)), *source = colors + pair.source() * C;
        for (int64_t c = 0; c < C; ++c) blended[c] += share * (source[c] - colors[n * C + c]);
      });
    }
  });
}

template <class T>
void antialias_backward(const Antialias<T>& args) {
  const ClipMesh<T>& mesh = args.mesh;
  const int64_t W = mesh.raster.width, C = args.channels;
  if (args.grad_colors) {
    for_rows(mesh.batch, mesh.raster.height, mesh.num_threads, [&](int64_t b, int64_t row) {
      const ClipImage<T> image(mesh, b);
      const int64_t start = b * mesh.raster.pixels();
      const T* upstream = args.grad_blended + start * C;
      for (int64_t n = row * W; n < (row + 1) * W; ++n) {
        T* grad = std::copy_n(upstream + n * C, C, args.grad_colors + (start + n) * C) - C;
        for_pairs(image, args.rast + 4 * start, args.twins, n, [&](const EdgePair& pair) {
          const T share = static_cast<T>(std::abs(pair.share)),
                  *from = upstream + pair.blended() * C;
          for (int64_t c = 0; c < C; ++c)
            grad[c] += pair.blended() == n ? -share * from[c] : share * from[c];
        });
      }
    });
  }
  if (!args.grad_positions) return;
  sum_positions(
      mesh, args.grad_positions, [&](int64_t b, int64_t begin, int64_t end, FaceSums<T>& sums) {
        const ClipImage<T> image(mesh, b);
        const int64_t start = b * mesh.raster.pixels(), pixels = mesh.raster.pixels();
        start_sums(image, begin, std::min(end + W, pixels), sums);
        for (int64_t n = begin; n < end; ++n) {
          for (const bool vertical : {false, true}) {
            if (vertical ? n + W >= pixels : n % W + 1 == W) continue;
            const EdgePair pair = pair_of(image, args.rast + 4 * start, args.twins, n, vertical);
            if (pair.share == 0) continue;
            const T* grad = args.grad_blended + (start + pair.blended()) * C;
            const T *front = args.colors + (start + pair.front) * C,
                    *other = args.colors + (start + pair.other) * C;
            double sum = 0;  // dL/d share, then dL/d place with the place of the edge in [-1, 1]
            for (int64_t c = 0; c < C; ++c)
              sum += static_cast<double>(grad[c]) * (front[c] - other[c]);
            sum *= static_cast<double>(vertical ? mesh.raster.height : mesh.raster.width) / 2 *
                   (pair.front == n ? 1 : -1);
            const int64_t face = image.face(pair.front);
            const double X = image.centre_x(pair.front), Y = image.centre_y(pair.front);
            const int ki = (pair.edge + 1) % 3, kj = (pair.edge + 2) % 3;
            const Corner i = along(image.corner(face, ki, X, Y), vertical);
            const Corner j = along(image.corner(face, kj, X, Y), vertical);
            const double D = i.w * j.y - j.w * i.y, place = (i.x * j.y - j.x * i.y) / D;
            sum /= D;
            const Corner to_i{sum * j.y, sum * (place * j.w - j.x), -sum * place * j.y};
            const Corner to_j{-sum * i.y, sum * (i.x - place * i.w), sum * place * i.y};
            T* corners = sums.of(image.face_index[pair.front], 12);
            add_corner(along(to_i, vertical), X, Y, corners + 4 * ki);
            add_corner(along(to_j, vertical), X, Y, corners + 4 * kj);
          }
        }
      });
}

NMR_FLOAT_AND_DOUBLE(clip_weights_forward, ClipWeights)
NMR_FLOAT_AND_DOUBLE(clip_weights_backward, ClipWeights)
NMR_FLOAT_AND_DOUBLE(antialias_forward, Antialias)
NMR_FLOAT_AND_DOUBLE(antialias_backward, Antialias)

}  // namespace nmr
