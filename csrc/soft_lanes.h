// The loops of the soft silhouette over pixels.
#include "soft_pixels.h"

namespace nmr::NMR_LEVEL {
namespace {

// Multiplies the rows first, ..., last - 1 (from the bottom) of `transmittance [H, W]`, row 0 =
// top, by 1 - D of every face.
template <class T>
void soft_forward_band(const SoftImage<T>& image, int64_t first, int64_t last, T* transmittance) {
  const Size raster = image.settings.raster;
  for (int64_t f = 0; f < image.num_faces; ++f) {
    SoftFace<T> face;
    if (!set_up_face(image, f, face)) continue;
    for (int64_t j = std::max(face.row_first, first); j < std::min(face.row_last + 1, last); ++j) {
      const T py = image.row(j);
      T* row = transmittance + (raster.height - 1 - j) * raster.width;
      for (int64_t i = face.column_first; i <= face.column_last; i += kGroup) {
        T clears[kGroup];
        for (int64_t n = 0; n < kGroup; ++n)
          clears[n] =
              evaluate<T, false>(face, image.columns[i + n], py, image.sigma, image.reach).clears;
        const int64_t lanes = std::min(kGroup, face.column_last - i + 1);
        for (int64_t n = 0; n < lanes; ++n) row[i + n] *= clears[n];
      }
    }
  }
}

// The gradient of one face: x and y of its corners, and sigma. pull [H, W] is grad_alpha *
// transmittance: the gradient of x_j (soft.cpp) without its factor D_j.
template <class T>
void soft_backward_face(const SoftImage<T>& image, const SoftFace<T>& face, const T* pull,
                        T* grad) {
  const Size raster = image.settings.raster;
  T sums[kSoftSums][kGroup] = {};
  for (int64_t j = face.row_first; j <= face.row_last; ++j) {
    const T py = image.row(j);
    const T* row = pull + (raster.height - 1 - j) * raster.width;
    for (int64_t i = face.column_first; i <= face.column_last; i += kGroup) {
      T g[kGroup] = {};
      const int64_t lanes = std::min(kGroup, face.column_last - i + 1);
      for (int64_t n = 0; n < lanes; ++n) g[n] = row[i + n];
      for (int64_t n = 0; n < kGroup; ++n) {
        const SoftPixel<T> p =
            evaluate<T, true>(face, image.columns[i + n], py, image.sigma, image.reach);
        const T strength = g[n] * p.covers * p.sign * (T(-2) / image.sigma);
        sums[6][n] += strength * p.square;
        for (int k = 0; k < 3; ++k) {
          sums[2 * k][n] += strength * p.share[k] * p.away_x;
          sums[2 * k + 1][n] += strength * p.share[k] * p.away_y;
        }
      }
    }
  }
  for (int64_t k = 0; k < kSoftSums; ++k) {
    T sum = 0;
    for (int64_t n = 0; n < kGroup; ++n) sum += sums[k][n];
    grad[k] = sum * (k == 6 ? 1 / (2 * image.sigma) : k % 2 ? image.scale_y : image.scale_x);
  }
}

}  // namespace
}  // namespace nmr::NMR_LEVEL
