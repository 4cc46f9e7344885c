// Anti-aliasing: the mean of 2x2 raster pixels, and the share that each of them has in it.
#pragma once

#include "parallel.h"

namespace nmr {

template <class T>
NMR_INLINE T average(T a, T b, T c, T d) {
  return (a + b + c + d) / 4;
}

// A power of two, so that products with it are exact.
template <class T>
NMR_INLINE T share_of_pixel(bool anti_aliasing) {
  return anti_aliasing ? T(0.25) : T(1);
}

}  // namespace nmr
