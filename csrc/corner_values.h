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
  const int64_t tiles = (height + kRows - 1) / kRows;
  parallel_for(batch * tiles, num_threads, [&](int64_t n) {
    const int64_t first = n % tiles * kRows;
    for (int64_t row = first; row < std::min(first + kRows, height); ++row) body(n / tiles, row);
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
template <class T>
struct ImageAttributes {
  int64_t first_row;       // first row of attributes
  const int64_t* corners;  // [F, 3]
  int64_t num_faces;
};

template <class T>
ImageAttributes<T> image_attributes(const Interpolate<T>& args, int64_t b) {
  if (args.starts) {
    const int64_t* s = args.starts + 2 * b;
    return {s[0], args.corners + 3 * s[1], s[3] - s[1]};
  }
  return {args.attribute_batch == 1 ? 0 : b * args.num_attributes,
          args.corners + (args.corners_per_image ? 3 * b * args.num_faces : 0), args.num_faces};
}

// Sums per visible face of a block: [count, 3, C] over its corners.
template <class T>
struct CornerSums {
  VisibleFaces visible;
  std::vector<T> values;
};

// Adds these sums to the rows of attributes at the corners.
template <class T>
void scatter_corner_sums(const CornerSums<T>& sums, const ImageAttributes<T>& image,
                         int64_t channels, T* grad_attributes) {
  const int64_t C = channels, F = image.num_faces;
  const T* value = sums.values.data() + 3 * C;  // skips the background's
  for (int64_t n = 1; n < sums.visible.count; ++n) {
    const int64_t id = sums.visible.ids[n];
    const int64_t* corners = image.corners + 3 * (id < F ? id : id - F);
    for (int k = 0; k < 3; ++k, value += C) {
      T* grad = grad_attributes + (image.first_row + corners[k]) * C;
      for (int64_t c = 0; c < C; ++c) grad[c] += value[c];
    }
  }
}

}  // namespace nmr
