// The sorted list of the K nearest faces at a pixel.
#pragma once
#include "geometry.h"

namespace nmr {

// Puts a face that is nearer than the last of K into the list, behind those that are equally near.
template <class T>
NMR_INLINE void insert_sorted(T depth, int32_t id, int64_t K, T* depths, int32_t* face_indices) {
  int64_t k = K - 1;
  for (; k > 0 && depth < depths[k - 1]; --k)
    depths[k] = depths[k - 1], face_indices[k] = face_indices[k - 1];
  depths[k] = depth;
  face_indices[k] = id;
}

}  // namespace nmr
