// Shared by the stages that read values at the corners of faces: loops over pixels, the rows of an
// image's values, and sums per corner.
#pragma once

#include <algorithm>
#include <type_traits>
#include <vector>

#include "blocks.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

constexpr int64_t kRows = 8;  // raster rows processed together in forward passes

// Calls body(b, row) for every row of every raster.
template <class Body>
void for_rows(int64_t batch, int64_t height, int num_threads, const Body& body) {
  for_bands(batch, height, kRows, num_threads, [&](int64_t b, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) body(b, row);
  });
}

// Calls body(set, first, last) for ranges of the texels of every set, of which a set has
// count(set): every texel is summed on one thread, over images and pixels in ascending order. If
// there are fewer sets than threads, several threads share a set: each reads all pixels, and uses
// those of its own range.
template <class Count, class Body>
void for_texels(int64_t sets, int num_threads, const Count& count, const Body& body) {
  const int64_t parts = sets >= num_threads ? 1 : 2 * static_cast<int64_t>(num_threads);
  parallel_for(sets * parts, num_threads, [&](int64_t task) {
    const int64_t set = task / parts, part = task % parts, texels = count(set);
    body(set, part * texels / parts, (part + 1) * texels / parts);
  });
}

// Whether loops over 1, 3 and 4 channels are compiled for these numbers. Not for double, which
// gains nothing from it.
template <class T>
constexpr bool kOwnChannels = std::is_same_v<T, float>;

// Calls body(c) with c the number of channels as a compile-time constant if it is 1, 3 or 4 and T
// has such copies, and with c = 0 otherwise.
template <class T, class Body>
void with_channels(int64_t channels, const Body& body) {
  if constexpr (kOwnChannels<T>) {
    switch (channels) {
      case 1:
        return body(std::integral_constant<int64_t, 1>());
      case 3:
        return body(std::integral_constant<int64_t, 3>());
      case 4:
        return body(std::integral_constant<int64_t, 4>());
    }
  }
  body(std::integral_constant<int64_t, 0>());
}

// The attribute rows and corners of image b.
struct ImageAttributes {
  int64_t first_row;       // first row of attributes
  const int64_t* corners;  // [F, 3]
  int64_t num_faces;

  // Those of the face with this face index.
  NMR_INLINE const int64_t* corners_of(int64_t id) const {
    return corners + 3 * face_of(id, num_faces);
  }
};

template <class T>
ImageAttributes image_attributes(const Interpolate<T>& args, int64_t b) {
  return {args.rows.first(b), args.corners + 3 * args.face_rows.first(b), args.face_rows.count(b)};
}

template <class T>
ImageAttributes image_attributes(const MeshBatch<T>& mesh, int64_t b) {
  return {mesh.vertex_rows.first(b), mesh.image_faces(b), mesh.face_rows.count(b)};
}

// Adds sums [count, 3, C] of the corners of faces to the rows of attributes at these corners.
// kChannels: C, or 0 if it is known only at run time.
template <int64_t kChannels, class T>
void scatter_corner_sums(const FaceSums<T>& sums, const ImageAttributes& image, int64_t channels,
                         T* grad_attributes) {
  const int64_t C = kChannels ? kChannels : channels;
  const T* value = sums.values.data() + 3 * C;  // skips the background's
  for (int64_t n = 1; n < sums.visible.count; ++n) {
    const int64_t* corners = image.corners_of(sums.visible.ids[n]);
    for (int k = 0; k < 3; ++k, value += C) {
      T* grad = grad_attributes + (image.first_row + corners[k]) * C;
      for (int64_t c = 0; c < C; ++c) grad[c] += value[c];
    }
  }
}

}  // namespace nmr
