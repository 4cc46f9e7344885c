// Which face is nearest at each pixel of each image.
#include <algorithm>
#include <cstring>
#include <vector>

#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

constexpr int64_t kLanes = 8;  // pixels handled together

// Working memory of one image; rows are padded so that a vector of pixels may reach past the last column.
template <class T>
struct RasterScratch {
  std::vector<T> centres;           // [stride] pixel centres in [-1, 1]
  std::vector<T> columns;           // [stride] column numbers
  std::vector<T> depth;             // [R, stride] depth of the nearest face so far
  std::vector<int32_t> owner;       // [R, stride]
  std::vector<int32_t> back_faces;  // faces whose reversed copy faces the camera
};

template <class T>
struct Raster {
  int64_t size, stride;
  const T* centres;
  const T* columns;
  T near, far;
  T* depth;
  int32_t* owner;
};

// First pixel whose centre is >= lo and last whose centre is <= hi, within the raster: a face covers no centre outside its
// bounding box. (NMR itself tests every pixel, and paints stray ones for slivers that are collinear up to rounding.)
template <class T>
NMR_INLINE void pixel_range(T lo, T hi, const Raster<T>& r, int64_t& first, int64_t& last) {
  const T size = static_cast<T>(r.size);
  const T from = std::min(std::max(to_pixel(lo, size), T(-1)), size);
  const T to = std::min(std::max(to_pixel(hi, size), T(-1)), size);
  first = std::max<int64_t>(static_cast<int64_t>(from) - 1, 0);
  last = std::min<int64_t>(static_cast<int64_t>(to) + 1, r.size - 1);
  while (first <= last && r.centres[first] < lo) ++first;
  while (first <= last && r.centres[last] > hi) --last;
}

// Draws one face into the depth buffer and the index map.
template <class T>
NMR_INLINE void draw_triangle(const Triangle<T>& t, int32_t id, const Raster<T>& r) {
  int64_t i_first, i_last, j_first, j_last;
  pixel_range(min3(t.x[0], t.x[1], t.x[2]), max3(t.x[0], t.x[1], t.x[2]), r, i_first, i_last);
  if (i_first > i_last) return;
  pixel_range(min3(t.y[0], t.y[1], t.y[2]), max3(t.y[0], t.y[1], t.y[2]), r, j_first, j_last);
  if (j_first > j_last) return;

  const BarycentricMatrix<T> w = barycentric_matrix(t, static_cast<T>(r.size));
  const T dx0 = t.x[1] - t.x[0], dx1 = t.x[2] - t.x[1], dx2 = t.x[0] - t.x[2];
  const T dy0 = t.y[1] - t.y[0], dy1 = t.y[2] - t.y[1], dy2 = t.y[0] - t.y[2];

  for (int64_t j = j_first; j <= j_last; ++j) {
    const T yp = r.centres[j];
    const T row = r.columns[j];
    const T e0 = (yp - t.y[0]) * dx0, e1 = (yp - t.y[1]) * dx1, e2 = (yp - t.y[2]) * dx2;
    for (int64_t i = i_first; i <= i_last; i += kLanes) {
      const T* xp = r.centres + i;
      const T* column = r.columns + i;
      const int32_t lanes = static_cast<int32_t>(i_last - i + 1);
      int32_t inside[kLanes];
      int32_t any = 0;
      for (int32_t k = 0; k < kLanes; ++k) {
        inside[k] = !(e0 < (xp[k] - t.x[0]) * dy0) & !(e1 < (xp[k] - t.x[1]) * dy1) & !(e2 < (xp[k] - t.x[2]) * dy2) &
                    (k < lanes);
        any |= inside[k];
      }
      if (!any) continue;
      T* depth = r.depth + j * r.stride + i;
      int32_t* index = r.owner + j * r.stride + i;
      for (int32_t k = 0; k < kLanes; ++k) {
        T w0 = clamp_weight(w.m[0][0] * column[k] + w.m[0][1] * row + w.m[0][2]);
        T w1 = clamp_weight(w.m[1][0] * column[k] + w.m[1][1] * row + w.m[1][2]);
        T w2 = clamp_weight(w.m[2][0] * column[k] + w.m[2][1] * row + w.m[2][2]);
        const T sum = w0 + w1 + w2;
        w0 /= sum;
        w1 /= sum;
        w2 /= sum;
        const T z = 1 / (w0 / t.z[0] + w1 / t.z[1] + w2 / t.z[2]);
        // depth starts at far, so z < depth also tests the far plane; a NaN z fails every comparison
        const bool nearest = inside[k] & (z > r.near) & (z < depth[k]);
        depth[k] = nearest ? z : depth[k];
        index[k] = nearest ? id : index[k];
      }
    }
  }
}

template <class T>
NMR_INLINE void rasterize_image_body(const Rasterize<T>& args, int64_t b) {
  const T* vertices = args.mesh.image_vertices(b);
  const int64_t* faces = args.mesh.image_faces(b);
  const int64_t num_faces = args.mesh.face_count(b);
  RasterScratch<T>& scratch = thread_scratch<RasterScratch<T>>();
  Raster<T> r;
  r.size = args.settings.raster_size;
  r.stride = r.size + kLanes;
  r.near = args.settings.near;
  r.far = args.settings.far;
  if (static_cast<int64_t>(scratch.centres.size()) != r.stride) {
    scratch.centres.resize(r.stride);
    scratch.columns.resize(r.stride);
    for (int64_t i = 0; i < r.stride; ++i) {
      scratch.centres[i] = pixel_centre<T>(i, r.size);
      scratch.columns[i] = static_cast<T>(i);
    }
  }
  r.centres = scratch.centres.data();
  r.columns = scratch.columns.data();
  r.depth = reserve(scratch.depth, r.size * r.stride);
  r.owner = reserve(scratch.owner, r.size * r.stride);
  int32_t* back_faces = reserve(scratch.back_faces, num_faces);
  std::fill_n(r.depth, r.size * r.stride, r.far);
  std::fill_n(r.owner, r.size * r.stride, -1);

  // All originals before all copies, so that an original wins a tie with any copy. Both vertex orders are tested: for slivers
  // the test is not antisymmetric in floating point.
  int64_t num_back = 0;
  for (int64_t f = 0; f < num_faces; ++f) {
    const Triangle<T> t = load_triangle(vertices, faces + 3 * f, false);
    if (!is_drawable(t)) continue;
    if (faces_camera(t)) draw_triangle(t, static_cast<int32_t>(f), r);
    if (args.settings.fill_back && faces_camera(load_triangle(vertices, faces + 3 * f, true)))
      back_faces[num_back++] = static_cast<int32_t>(f);
  }
  for (int64_t n = 0; n < num_back; ++n) {
    const int64_t f = back_faces[n];
    draw_triangle(load_triangle(vertices, faces + 3 * f, true), static_cast<int32_t>(num_faces + f), r);
  }
  int32_t* owner = args.owner + b * r.size * r.size;
  for (int64_t j = 0; j < r.size; ++j)
    std::memcpy(owner + (r.size - 1 - j) * r.size, r.owner + j * r.stride, r.size * sizeof(int32_t));
}

NMR_CLONES void rasterize_image(const Rasterize<float>& args, int64_t b) { rasterize_image_body(args, b); }
NMR_CLONES void rasterize_image(const Rasterize<double>& args, int64_t b) { rasterize_image_body(args, b); }

}  // namespace

template <class T>
void rasterize(const Rasterize<T>& args) {
  parallel_for(args.mesh.batch, args.num_threads, [&](int64_t b) { rasterize_image(args, b); });
}

template void rasterize(const Rasterize<float>&);
template void rasterize(const Rasterize<double>&);

}  // namespace nmr
