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

#include "blocks.h"
#include "soft_faces.h"

#define NMR_LEVEL_V4
#define NMR_LEVEL_FILE "soft_lanes.h"
#include "levels.h"

namespace nmr {

constexpr int64_t kFaceChunk = 64;  // faces per task, backward

template <class T>
void soft_forward(const SoftForward<T>& args) {
  const Size raster = args.settings.raster.raster;
  const std::vector<T> columns = scaled_columns<T>(raster);
  const auto fill = [&](int64_t b, int64_t first, int64_t last) {
    T* transmittance = args.transmittance + b * raster.pixels();
    std::fill_n(transmittance + (raster.height - last) * raster.width,
                (last - first) * raster.width, T(1));
    const SoftImage<T> image = soft_image(args.mesh, args.settings, b, columns.data());
    NMR_AT_BEST_LEVEL(soft_forward_band, image, first, last, transmittance);
  };
  for_bands(args.mesh.batch, raster.height, kBandRows, args.num_threads, fill);
}

template <class T>
void soft_backward(const SoftBackward<T>& args) {
  const MeshBatch<T>& mesh = args.mesh;
  const Size raster = args.settings.raster.raster;
  const std::vector<T> columns = scaled_columns<T>(raster);
  std::fill_n(args.grad_vertices, 3 * mesh.vertex_rows.total(mesh.batch), T(0));
  std::vector<T> pull(mesh.batch * raster.pixels());
  std::vector<int64_t> chunks{0};  // number of chunks of faces before each image
  std::vector<int64_t> first_face{0};
  for (int64_t b = 0; b < mesh.batch; ++b) {
    chunks.push_back(chunks[b] + (mesh.face_rows.count(b) + kFaceChunk - 1) / kFaceChunk);
    first_face.push_back(first_face[b] + mesh.face_rows.count(b));
  }
  parallel_for(mesh.batch, args.num_threads, [&](int64_t b) {
    for (int64_t n = b * raster.pixels(); n < (b + 1) * raster.pixels(); ++n)
      pull[n] = -args.grad_transmittance[n] * args.transmittance[n];
  });
  std::vector<T> grads(kSoftSums * first_face.back());
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
      T grad[kSoftSums];
      NMR_AT_BEST_LEVEL(soft_backward_face, image, face, pull.data() + b * raster.pixels(), grad);
      for (int k = 0; k < 3; ++k) {  // in the face's own order
        const int own = face.corner[k] == image.faces[3 * f + k] ? k : 2 - k;
        std::copy_n(grad + 2 * k, 2, grads.data() + kSoftSums * (first_face[b] + f) + 2 * own);
      }
      grads[kSoftSums * (first_face[b] + f) + 6] = grad[6];
    }
  });
  parallel_for(mesh.batch, args.num_threads, [&](int64_t b) {
    T *grad_vertices = args.grad_vertices + 3 * mesh.vertex_rows.first(b), grad_sigma = 0;
    for (int64_t f = 0; f < mesh.face_rows.count(b); ++f) {
      if (!drawn[first_face[b] + f]) continue;
      for (int k = 0; k < 3; ++k) {
        T* grad = grad_vertices + 3 * mesh.image_faces(b)[3 * f + k];
        const T* own = grads.data() + kSoftSums * (first_face[b] + f) + 2 * k;
        grad[0] += own[0];
        grad[1] += own[1];
      }
      grad_sigma += grads[kSoftSums * (first_face[b] + f) + 6];
    }
    args.grad_sigma[b] = grad_sigma;
  });
}

NMR_FLOAT_AND_DOUBLE(soft_forward, SoftForward)
NMR_FLOAT_AND_DOUBLE(soft_backward, SoftBackward)

}  // namespace nmr
