// Barycentric weights of a pixel that may be outside its face, as SoftRas takes them.
#pragma once

#include "geometry.h"

namespace nmr {

// w_k are the weights on the screen, v_k these clamped to [0, 1] and divided by their sum (at least
// 1): those of the pixel if it is inside, and of a point of the border if not. NaN if the face has
// no area.
template <class T>
struct SoftWeights {
  T w[3], v[3], sum, area;

  NMR_INLINE SoftWeights(const T* x, const T* y, T px, T py) {
    const T dx[3] = {x[0] - px, x[1] - px, x[2] - px}, dy[3] = {y[0] - py, y[1] - py, y[2] - py};
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
    for (int k = 0; k < 3; ++k) {
      const int q = (k + 1) % 3, r = (k + 2) % 3;
      w[k] = (dx[q] * dy[r] - dx[r] * dy[q]) / area;
      v[k] = clamp_weight(w[k]);
    }
    sum = v[0] + v[1] + v[2];
    for (int k = 0; k < 3; ++k) v[k] /= sum;
  }
  NMR_INLINE T depth(const T* z, bool perspective) const { return depth_at(v, z, perspective); }
};

}  // namespace nmr
