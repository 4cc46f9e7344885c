// The soft silhouette of SoftRas (Liu et al. 2019) and its derivative.
//
// At pixel centre p, face j has the probability D_j = 1 / (1 + exp(-x_j)) with x_j = +-d^2 / sigma: d is the distance
// from p to the border of the triangle, + inside and - outside. Faces outside with d^2 >= reach are left out. alpha =
// 1 - clear, where clear = prod_j (1 - D_j). The derivative needs no division: d alpha / d x_j = clear D_j.
//
// Distances are measured in units of half the shorter side of the raster. The nearest point of the border lies on one
// of the three sides, at p_a + t (p_b - p_a); the derivative of d^2 with respect to p_a is -2 (1 - t) (p - nearest),
// and with respect to p_b -2 t (p - nearest), because the nearest point itself is stationary.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

constexpr int64_t kGroup = 16;      // pixels evaluated together
constexpr int64_t kBandRows = 32;   // rows per task, forward
constexpr int64_t kFaceChunk = 64;  // faces per task, backward
constexpr int64_t kSums = 6;        // x and y of three corners

// exp(-x) for x >= 0: 2^-n times the Taylor series of exp on [-ln 2 / 2, ln 2 / 2]. Written out because the library's
// function is not the same on all processors, and the compiler does not vectorize it. Values below 1e-37 become 1e-37
// (double: 1e-300).
NMR_INLINE float exp_negative(float x) {
  x = x < 85 ? x : 85;
  const float n = static_cast<float>(static_cast<int32_t>(x * 1.44269504f + 0.5f));
  const float r = n * 0.693359375f - x + n * -2.12194440e-4f;
  float sum = 1.f / 5040;
  for (const float c : {1.f / 720, 1.f / 120, 1.f / 24, 1.f / 6, 0.5f, 1.f, 1.f}) sum = sum * r + c;
  const uint32_t bits = static_cast<uint32_t>(127 - static_cast<int32_t>(n)) << 23;
  float scale;
  std::memcpy(&scale, &bits, sizeof scale);
  return sum * scale;
}

NMR_INLINE double exp_negative(double x) {
  x = x < 690 ? x : 690;
  const double n = static_cast<double>(static_cast<int64_t>(x * 1.4426950408889634 + 0.5));
  const double r = n * 0.693145751953125 - x + n * 1.42860682030941723212e-6;
  double sum = 1.0 / 6227020800;
  for (const double c : {1.0 / 479001600, 1.0 / 39916800, 1.0 / 3628800, 1.0 / 362880, 1.0 / 40320, 1.0 / 5040,
                         1.0 / 720, 1.0 / 120, 1.0 / 24, 1.0 / 6, 0.5, 1.0, 1.0})
    sum = sum * r + c;
  const uint64_t bits = static_cast<uint64_t>(1023 - static_cast<int64_t>(n)) << 52;
  double scale;
  std::memcpy(&scale, &bits, sizeof scale);
  return sum * scale;
}

// A face ready to be evaluated: corners counter-clockwise, and the pixels that it can reach.
template <class T>
struct SoftFace {
  T x[3], y[3], side_x[3], side_y[3];  // corner k; side k leads to corner k + 1
  T inverse[3];                        // 1 / squared length of side k, 0 if it has none
  int64_t corner[3];                   // vertices
  int64_t column_first, column_last, row_first, row_last;  // rows from the bottom
};

// One image, with the scale from [-1, 1] to units of half the shorter side.
template <class T>
struct SoftImage {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  RasterSettings<T> settings;
  T sigma, reach, scale_x, scale_y;
  const T* columns;  // pixel centres, scaled, padded to whole groups

  NMR_INLINE T row(int64_t j) const { return pixel_centre<T>(j, settings.raster.height) * scale_y; }
};

// Pixels whose centres lie in [lo, hi] (in [-1, 1] across `size` pixels), or one more at each end.
template <class T>
NMR_INLINE void reached(T lo, T hi, int64_t size, int64_t& first, int64_t& last) {
  const T n = static_cast<T>(size), from = to_pixel(lo, n), to = to_pixel(hi, n);
  first = static_cast<int64_t>(from > 0 ? (from < n ? from : n) : T(0));
  last = std::min<int64_t>(size - 1, static_cast<int64_t>(to > -1 ? (to < n ? to : n) : T(-2)) + 1);
}

// Whether face f is drawn. It is not if its corners are all one vertex, if one of them is not finite, if all lie in front
// of `near` or all behind `far`, or, without fill_back, if it is seen from behind.
template <class T>
NMR_INLINE bool set_up_face(const SoftImage<T>& image, int64_t f, SoftFace<T>& face) {
  const T largest = std::sqrt(std::sqrt(std::numeric_limits<T>::max()));  // squares of squares stay finite
  const T limit = largest < T(1e9) ? largest : T(1e9);
  bool usable = true, beyond_near = false, before_far = false;
  for (int k = 0; k < 3; ++k) {
    face.corner[k] = image.faces[3 * f + k];
    const T* v = image.vertices + 3 * face.corner[k];
    face.x[k] = v[0] * image.scale_x;
    face.y[k] = v[1] * image.scale_y;
    usable = usable && std::abs(face.x[k]) < limit && std::abs(face.y[k]) < limit && v[2] == v[2];
    beyond_near = beyond_near || v[2] > image.settings.near;
    before_far = before_far || v[2] < image.settings.far;
  }
  const bool listed = face.corner[0] != face.corner[1] || face.corner[1] != face.corner[2];  // not the padding of a list
  if (!listed || !usable || !beyond_near || !before_far) return false;
  T *x = face.x, *y = face.y;
  if ((y[2] - y[0]) * (x[1] - x[0]) < (y[1] - y[0]) * (x[2] - x[0])) {  // clockwise
    if (!image.settings.fill_back) return false;
    std::swap(x[0], x[2]), std::swap(y[0], y[2]), std::swap(face.corner[0], face.corner[2]);
  }
  for (int k = 0; k < 3; ++k) {
    const int q = (k + 1) % 3;
    face.side_x[k] = x[q] - x[k];
    face.side_y[k] = y[q] - y[k];
    const T square = face.side_x[k] * face.side_x[k] + face.side_y[k] * face.side_y[k];
    face.inverse[k] = square > std::numeric_limits<T>::min() ? 1 / square : T(0);
  }
  const T margin = std::sqrt(image.reach);
  reached((min3(x[0], x[1], x[2]) - margin) / image.scale_x, (max3(x[0], x[1], x[2]) + margin) / image.scale_x,
          image.settings.raster.width, face.column_first, face.column_last);
  reached((min3(y[0], y[1], y[2]) - margin) / image.scale_y, (max3(y[0], y[1], y[2]) + margin) / image.scale_y,
          image.settings.raster.height, face.row_first, face.row_last);
  return face.column_first <= face.column_last && face.row_first <= face.row_last;
}

// What a face means for a pixel.
template <class T>
struct SoftPixel {
  T covers, clears;  // D and 1 - D; 0 and 1 if the pixel is out of reach
  T sign;            // +1 inside, -1 outside
  T away_x, away_y;  // from the nearest point of the border to the pixel
  T share[3];        // of the corners in that point
};

template <class T, bool kWithGradient>
NMR_INLINE SoftPixel<T> evaluate(const SoftFace<T>& face, T px, T py, T sigma, T reach) {
  SoftPixel<T> p;
  T least = std::numeric_limits<T>::max();
  bool inside = true;
  p.away_x = p.away_y = p.share[0] = p.share[1] = p.share[2] = 0;
  for (int k = 0; k < 3; ++k) {
    const T dx = px - face.x[k], dy = py - face.y[k], sx = face.side_x[k], sy = face.side_y[k];
    inside = inside & (sx * dy > sy * dx);
    const T t = clamp_weight((dx * sx + dy * sy) * face.inverse[k]);
    const T away_x = dx - t * sx, away_y = dy - t * sy, square = away_x * away_x + away_y * away_y;
    const bool nearer = square < least;
    least = nearer ? square : least;
    if (kWithGradient) {
      p.away_x = nearer ? away_x : p.away_x;
      p.away_y = nearer ? away_y : p.away_y;
      p.share[k] = nearer ? 1 - t : p.share[k];
      p.share[(k + 1) % 3] = nearer ? t : p.share[(k + 1) % 3];
      p.share[(k + 2) % 3] = nearer ? T(0) : p.share[(k + 2) % 3];
    }
  }
  const T e = exp_negative(least / sigma), large = 1 / (1 + e), small = e / (1 + e);
  const T outside_clears = least < reach ? large : T(1), outside_covers = least < reach ? small : T(0);
  p.covers = inside ? large : outside_covers;
  p.clears = inside ? small : outside_clears;
  p.sign = inside ? T(1) : T(-1);
  return p;
}

// Multiplies the rows [first, last] (from the bottom) of `clear [H, W]`, row 0 = top, by 1 - D of every face.
template <class T>
NMR_INLINE void forward_body(const SoftImage<T>& image, int64_t first, int64_t last, T* clear) {
  const Size raster = image.settings.raster;
  for (int64_t f = 0; f < image.num_faces; ++f) {
    SoftFace<T> face;
    if (!set_up_face(image, f, face)) continue;
    for (int64_t j = std::max(face.row_first, first); j <= std::min(face.row_last, last); ++j) {
      const T py = image.row(j);
      T* row = clear + (raster.height - 1 - j) * raster.width;
      for (int64_t i = face.column_first; i <= face.column_last; i += kGroup) {
        T clears[kGroup];
        for (int64_t n = 0; n < kGroup; ++n)
          clears[n] = evaluate<T, false>(face, image.columns[i + n], py, image.sigma, image.reach).clears;
        const int64_t lanes = std::min(kGroup, face.column_last - i + 1);
        for (int64_t n = 0; n < lanes; ++n) row[i + n] *= clears[n];
      }
    }
  }
}

// The gradient of one face, x and y of its corners; pull [H, W] is the gradient of x_j without the factor D_j: grad
// alpha * clear.
template <class T>
NMR_INLINE void backward_body(const SoftImage<T>& image, const SoftFace<T>& face, const T* pull, T* grad) {
  const Size raster = image.settings.raster;
  T sums[kSums][kGroup] = {};
  for (int64_t j = face.row_first; j <= face.row_last; ++j) {
    const T py = image.row(j);
    const T* row = pull + (raster.height - 1 - j) * raster.width;
    for (int64_t i = face.column_first; i <= face.column_last; i += kGroup) {
      T g[kGroup] = {};
      const int64_t lanes = std::min(kGroup, face.column_last - i + 1);
      for (int64_t n = 0; n < lanes; ++n) g[n] = row[i + n];
      for (int64_t n = 0; n < kGroup; ++n) {
        const SoftPixel<T> p = evaluate<T, true>(face, image.columns[i + n], py, image.sigma, image.reach);
        const T strength = g[n] * p.covers * p.sign * (T(-2) / image.sigma);
        for (int k = 0; k < 3; ++k) {
          sums[2 * k][n] += strength * p.share[k] * p.away_x;
          sums[2 * k + 1][n] += strength * p.share[k] * p.away_y;
        }
      }
    }
  }
  for (int64_t k = 0; k < kSums; ++k) {
    T sum = 0;
    for (int64_t n = 0; n < kGroup; ++n) sum += sums[k][n];
    grad[k] = sum * (k % 2 ? image.scale_y : image.scale_x);
  }
}

#define NMR_DEFINE_SOFT(T)                                                                                           \
  NMR_CLONES void soft_forward_band(const SoftImage<T>& image, int64_t first, int64_t last, T* clear) {              \
    forward_body(image, first, last, clear);                                                                         \
  }                                                                                                                  \
  NMR_CLONES void soft_backward_face(const SoftImage<T>& image, const SoftFace<T>& face, const T* pull, T* grad) {   \
    backward_body(image, face, pull, grad);                                                                          \
  }
NMR_DEFINE_SOFT(float)
NMR_DEFINE_SOFT(double)
#undef NMR_DEFINE_SOFT

// Scaled centres of the columns, padded.
template <class T>
std::vector<T> scaled_columns(Size raster) {
  const T scale = static_cast<T>(raster.width) / static_cast<T>(std::min(raster.height, raster.width));
  std::vector<T> columns(raster.width + kGroup);
  for (int64_t i = 0; i < raster.width + kGroup; ++i) columns[i] = pixel_centre<T>(i, raster.width) * scale;
  return columns;
}

template <class T>
SoftImage<T> soft_image(const MeshBatch<T>& mesh, const SoftSettings<T>& soft, int64_t b, const T* columns) {
  const Size raster = soft.raster.raster;
  const T shorter = static_cast<T>(std::min(raster.height, raster.width));
  return {mesh.image_vertices(b), mesh.image_faces(b), mesh.face_count(b), soft.raster, soft.sigma, soft.reach,
          static_cast<T>(raster.width) / shorter, static_cast<T>(raster.height) / shorter, columns};
}

}  // namespace

template <class T>
void soft_forward(const SoftForward<T>& args) {
  const Size raster = args.settings.raster.raster;
  const std::vector<T> columns = scaled_columns<T>(raster);
  const int64_t bands = (raster.height + kBandRows - 1) / kBandRows;
  parallel_for(args.mesh.batch * bands, args.num_threads, [&](int64_t task) {
    const int64_t b = task / bands, first = task % bands * kBandRows,
                  last = std::min(first + kBandRows, raster.height) - 1;
    T* clear = args.clear + b * raster.pixels();
    std::fill_n(clear + (raster.height - 1 - last) * raster.width, (last - first + 1) * raster.width, T(1));
    soft_forward_band(soft_image(args.mesh, args.settings, b, columns.data()), first, last, clear);
  });
}

template <class T>
void soft_backward(const SoftBackward<T>& args) {
  const MeshBatch<T>& mesh = args.mesh;
  const Size raster = args.settings.raster.raster;
  const std::vector<T> columns = scaled_columns<T>(raster);
  std::fill_n(args.grad_vertices, 3 * mesh.num_vertices * (mesh.starts ? 1 : mesh.batch), T(0));
  std::vector<T> pull(mesh.batch * raster.pixels());
  std::vector<int64_t> chunks{0};  // of faces, before each image
  std::vector<int64_t> first_face{0};
  for (int64_t b = 0; b < mesh.batch; ++b) {
    chunks.push_back(chunks[b] + (mesh.face_count(b) + kFaceChunk - 1) / kFaceChunk);
    first_face.push_back(first_face[b] + mesh.face_count(b));
  }
  parallel_for(mesh.batch, args.num_threads, [&](int64_t b) {
    for (int64_t n = b * raster.pixels(); n < (b + 1) * raster.pixels(); ++n)
      pull[n] = -args.grad_clear[n] * args.clear[n];
  });
  std::vector<T> grads(kSums * first_face.back());
  std::vector<unsigned char> drawn(first_face.back());
  parallel_for(chunks.back(), args.num_threads, [&](int64_t task) {
    const int64_t b = std::upper_bound(chunks.begin(), chunks.end(), task) - chunks.begin() - 1;
    const SoftImage<T> image = soft_image(mesh, args.settings, b, columns.data());
    const int64_t first = (task - chunks[b]) * kFaceChunk, last = std::min(first + kFaceChunk, image.num_faces);
    for (int64_t f = first; f < last; ++f) {
      SoftFace<T> face;
      drawn[first_face[b] + f] = set_up_face(image, f, face);
      if (!drawn[first_face[b] + f]) continue;
      T grad[kSums];
      soft_backward_face(image, face, pull.data() + b * raster.pixels(), grad);
      for (int k = 0; k < 3; ++k) {  // in the face's own order
        const int own = face.corner[k] == image.faces[3 * f + k] ? k : 2 - k;
        std::copy_n(grad + 2 * k, 2, grads.data() + kSums * (first_face[b] + f) + 2 * own);
      }
    }
  });
  parallel_for(mesh.batch, args.num_threads, [&](int64_t b) {
    T* grad_vertices = args.grad_vertices + 3 * mesh.vertex_start(b);
    for (int64_t f = 0; f < mesh.face_count(b); ++f) {
      if (!drawn[first_face[b] + f]) continue;
      for (int k = 0; k < 3; ++k) {
        T* grad = grad_vertices + 3 * mesh.image_faces(b)[3 * f + k];
        const T* own = grads.data() + kSums * (first_face[b] + f) + 2 * k;
        grad[0] += own[0];
        grad[1] += own[1];
      }
    }
  });
}

template void soft_forward(const SoftForward<float>&);
template void soft_forward(const SoftForward<double>&);
template void soft_backward(const SoftBackward<float>&);
template void soft_backward(const SoftBackward<double>&);

}  // namespace nmr
