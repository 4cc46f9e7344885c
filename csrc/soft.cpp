// The soft silhouette of SoftRas (Liu et al. 2019) and its derivative.
//
// At pixel centre p, face j has the probability D_j = 1 / (1 + exp(-x_j)) with x_j = +-d^2 / sigma:
// d is the distance from p to the border of the triangle, + inside and - outside. Faces outside
// with d^2 >= reach are left out. alpha = 1 - transmittance with transmittance = prod_j (1 - D_j).
// The derivative needs no division: d alpha / d x_j = transmittance D_j. That of sigma is the sum
// of -x_j / sigma times this.
//
// Distances are measured in units of half the shorter side of the raster. The nearest point of the
// border is on one of the three sides, at p_a + t (p_b - p_a); the derivative of d^2 with respect
// to p_a is -2 (1 - t) (p - nearest), and with respect to p_b -2 t (p - nearest), because the
// nearest point itself is stationary.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

#include "insert_sorted.h"
#include "parallel.h"
#include "soft_weights.h"
#include "stages.h"

namespace nmr {
namespace {

constexpr int64_t kGroup = 16;      // pixels evaluated together
constexpr int64_t kBandRows = 32;   // rows per task, forward
constexpr int64_t kFaceChunk = 64;  // faces per task, backward
constexpr int64_t kSums = 7;        // x and y of three corners, sigma

// A face ready to be evaluated: corners counter-clockwise, and the pixels that it can reach.
template <class T>
struct SoftFace {
  T x[3], y[3], side_x[3], side_y[3];  // corner k; side k leads to corner k + 1
  T inverse[3];                        // 1 / squared length of side k, 0 if it has none
  int64_t corner[3];                   // vertices
  bool back;                           // seen from behind
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

// Pixels with centres in [lo, hi] (in [-1, 1] across `size` pixels), or one more at each end.
template <class T>
NMR_INLINE void reached(T lo, T hi, int64_t size, int64_t& first, int64_t& last) {
  const T n = static_cast<T>(size), from = to_pixel(lo, n), to = to_pixel(hi, n);
  first = static_cast<int64_t>(from > 0 ? (from < n ? from : n) : T(0));
  last = std::min<int64_t>(size - 1, static_cast<int64_t>(to > -1 ? (to < n ? to : n) : T(-2)) + 1);
}

// Whether face f is drawn. It is not if its corners are all one vertex, if one of them is not
// finite, if all are nearer than `near` or all farther than `far`, or, without fill_back, if it is
// seen from behind.
template <class T>
NMR_INLINE bool set_up_face(const SoftImage<T>& image, int64_t f, SoftFace<T>& face) {
  const T largest =
      std::sqrt(std::sqrt(std::numeric_limits<T>::max()));  // squares of squares stay finite
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
  const bool listed =
      face.corner[0] != face.corner[1] || face.corner[1] != face.corner[2];  // else padding
  if (!listed || !usable || !beyond_near || !before_far) return false;
  T *x = face.x, *y = face.y;
  face.back = (y[2] - y[0]) * (x[1] - x[0]) < (y[1] - y[0]) * (x[2] - x[0]);  // clockwise
  if (face.back) {
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
  reached((min3(x[0], x[1], x[2]) - margin) / image.scale_x,
          (max3(x[0], x[1], x[2]) + margin) / image.scale_x, image.settings.raster.width,
          face.column_first, face.column_last);
  reached((min3(y[0], y[1], y[2]) - margin) / image.scale_y,
          (max3(y[0], y[1], y[2]) + margin) / image.scale_y, image.settings.raster.height,
          face.row_first, face.row_last);
  return face.column_first <= face.column_last && face.row_first <= face.row_last;
}

// Rows [first, last] of one image, from the bottom, and the faces that reach each pixel, nearest
// first.
template <class T>
struct SoftBand {
  int64_t layers, first, last;
  T* depth;             // [rows, W, K]; `far` without a face
  int32_t* face_index;  // [H, W, K] of the image, row 0 = top
};

}  // namespace
}  // namespace nmr

#define NMR_LEVEL_V4
#define NMR_LEVEL_FILE "soft_faces.h"
#include "levels.h"

namespace nmr {
namespace {

// Scaled centres of the columns, padded.
template <class T>
std::vector<T> scaled_columns(Size raster) {
  const T scale =
      static_cast<T>(raster.width) / static_cast<T>(std::min(raster.height, raster.width));
  std::vector<T> columns(raster.width + kGroup);
  for (int64_t i = 0; i < raster.width + kGroup; ++i)
    columns[i] = pixel_centre<T>(i, raster.width) * scale;
  return columns;
}

template <class T>
SoftImage<T> soft_image(const MeshBatch<T>& mesh, const SoftSettings<T>& soft, int64_t b,
                        const T* columns) {
  const Size raster = soft.raster.raster;
  const T shorter = static_cast<T>(std::min(raster.height, raster.width));
  return {mesh.image_vertices(b),
          mesh.image_faces(b),
          mesh.face_count(b),
          soft.raster,
          soft.sigma,
          soft.reach,
          static_cast<T>(raster.width) / shorter,
          static_cast<T>(raster.height) / shorter,
          columns};
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
    T* transmittance = args.transmittance + b * raster.pixels();
    std::fill_n(transmittance + (raster.height - 1 - last) * raster.width,
                (last - first + 1) * raster.width, T(1));
    const SoftImage<T> image = soft_image(args.mesh, args.settings, b, columns.data());
    NMR_AT_BEST_LEVEL(soft_forward_band, image, first, last, transmittance);
  });
}

template <class T>
void soft_backward(const SoftBackward<T>& args) {
  const MeshBatch<T>& mesh = args.mesh;
  const Size raster = args.settings.raster.raster;
  const std::vector<T> columns = scaled_columns<T>(raster);
  std::fill_n(args.grad_vertices, 3 * mesh.num_vertices * (mesh.starts ? 1 : mesh.batch), T(0));
  std::vector<T> pull(mesh.batch * raster.pixels());
  std::vector<int64_t> chunks{0};  // number of chunks of faces before each image
  std::vector<int64_t> first_face{0};
  for (int64_t b = 0; b < mesh.batch; ++b) {
    chunks.push_back(chunks[b] + (mesh.face_count(b) + kFaceChunk - 1) / kFaceChunk);
    first_face.push_back(first_face[b] + mesh.face_count(b));
  }
  parallel_for(mesh.batch, args.num_threads, [&](int64_t b) {
    for (int64_t n = b * raster.pixels(); n < (b + 1) * raster.pixels(); ++n)
      pull[n] = -args.grad_transmittance[n] * args.transmittance[n];
  });
  std::vector<T> grads(kSums * first_face.back());
  std::vector<unsigned char> drawn(first_face.back());
  parallel_for(chunks.back(), args.num_threads, [&](int64_t task) {
    const int64_t b = std::upper_bound(chunks.begin(), chunks.end(), task) - chunks.begin() - 1;
    const SoftImage<T> image = soft_image(mesh, args.settings, b, columns.data());
    const int64_t first = (task - chunks[b]) * kFaceChunk,
                  last = std::min(first + kFaceChunk, image.num_faces);
    for (int64_t f = first; f < last; ++f) {
      SoftFace<T> face;
      drawn[first_face[b] + f] = set_up_face(image, f, face);
      if (!drawn[first_face[b] + f]) continue;
      T grad[kSums];
      NMR_AT_BEST_LEVEL(soft_backward_face, image, face, pull.data() + b * raster.pixels(), grad);
      for (int k = 0; k < 3; ++k) {  // in the face's own order
        const int own = face.corner[k] == image.faces[3 * f + k] ? k : 2 - k;
        std::copy_n(grad + 2 * k, 2, grads.data() + kSums * (first_face[b] + f) + 2 * own);
      }
      grads[kSums * (first_face[b] + f) + 6] = grad[6];
    }
  });
  parallel_for(mesh.batch, args.num_threads, [&](int64_t b) {
    T *grad_vertices = args.grad_vertices + 3 * mesh.vertex_start(b), grad_sigma = 0;
    for (int64_t f = 0; f < mesh.face_count(b); ++f) {
      if (!drawn[first_face[b] + f]) continue;
      for (int k = 0; k < 3; ++k) {
        T* grad = grad_vertices + 3 * mesh.image_faces(b)[3 * f + k];
        const T* own = grads.data() + kSums * (first_face[b] + f) + 2 * k;
        grad[0] += own[0];
        grad[1] += own[1];
      }
      grad_sigma += grads[kSums * (first_face[b] + f) + 6];
    }
    args.grad_sigma[b] = grad_sigma;
  });
}

template <class T>
void soft_layers(const SoftLayers<T>& args) {
  const Size raster = args.settings.raster.raster;
  const std::vector<T> columns = scaled_columns<T>(raster);
  const int64_t K = args.layers, bands = (raster.height + kBandRows - 1) / kBandRows;
  parallel_for(args.mesh.batch * bands, args.num_threads, [&](int64_t task) {
    const int64_t b = task / bands, first = task % bands * kBandRows,
                  last = std::min(first + kBandRows, raster.height) - 1,
                  count = (last - first + 1) * raster.width * K;
    std::vector<T> depth(count, args.settings.raster.far);
    int32_t* face_index = args.face_index + b * raster.pixels() * K;
    std::fill_n(face_index + (raster.height - 1 - last) * raster.width * K, count, -1);
    const SoftImage<T> image = soft_image(args.mesh, args.settings, b, columns.data());
    const SoftBand<T> band{K, first, last, depth.data(), face_index};
    NMR_AT_BEST_LEVEL(soft_layers_band, image, band);
  });
}

template void soft_forward(const SoftForward<float>&);
template void soft_forward(const SoftForward<double>&);
template void soft_backward(const SoftBackward<float>&);
template void soft_backward(const SoftBackward<double>&);
template void soft_layers(const SoftLayers<float>&);
template void soft_layers(const SoftLayers<double>&);

}  // namespace nmr
