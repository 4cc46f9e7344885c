// From the pixels of the raster to those of the image.
#include <algorithm>
#include <cstdint>
#include <vector>

#include "average.h"
#include "corner_values.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

namespace {

// A row of the image, w pixels wide, from the raster rows `pixels` [2 or 1, W, C]. behind: the
// background and the mean of four background pixels [2, C], or nullptr. kChannels: C, or 0 if it is
// known only at run time.
template <int64_t kChannels, class T>
NMR_INLINE void resolve_row(const int32_t* face_index, const T* pixels, const T* behind, int64_t w,
                            bool anti_aliasing, int64_t channels, T* out) {
  const int64_t C = kChannels ? kChannels : channels, W = 2 * w;
  if (!anti_aliasing) {
    for (int64_t x = 0; x < w; ++x)
      for (int64_t c = 0; c < C; ++c)
        out[x * C + c] = behind && face_index[x] < 0 ? behind[c] : pixels[x * C + c];
    return;
  }
  for (int64_t x = 0; x < w; ++x, out += C) {
    const T *upper = pixels + 2 * x * C, *lower = upper + W * C;
    const int32_t* corner = behind ? face_index + 2 * x : nullptr;
    if (!behind || (corner[0] | corner[1] | corner[W] | corner[W + 1]) >= 0) {
      for (int64_t c = 0; c < C; ++c)
        out[c] = average(upper[c], upper[C + c], lower[c], lower[C + c]);
    } else if ((corner[0] & corner[1] & corner[W] & corner[W + 1]) < 0) {
      for (int64_t c = 0; c < C; ++c) out[c] = behind[C + c];
    } else {
      const T *a = corner[0] < 0 ? behind : upper, *b = corner[1] < 0 ? behind : upper + C;
      const T *d = corner[W] < 0 ? behind : lower, *e = corner[W + 1] < 0 ? behind : lower + C;
      for (int64_t c = 0; c < C; ++c) out[c] = average(a[c], b[c], d[c], e[c]);
    }
  }
}

// Its gradient for one raster row [W, C]: `grad` is that of the image row, face_index nullptr if no
// background is mixed in.
template <int64_t kChannels, class T>
NMR_INLINE void resolve_row_backward(const int32_t* face_index, const T* grad, int64_t w,
                                     bool anti_aliasing, int64_t channels, T* out) {
  const int64_t C = kChannels ? kChannels : channels, scale = anti_aliasing ? 2 : 1;
  const T share = share_of_pixel<T>(anti_aliasing);
  for (int64_t x = 0; x < w; ++x, grad += C)
    for (int64_t k = 0; k < scale; ++k, out += C) {
      const bool drawn = !face_index || face_index[scale * x + k] >= 0;
      for (int64_t c = 0; c < C; ++c) out[c] = drawn ? grad[c] * share : T(0);
    }
}

}  // namespace

// The mean of 2x2 pixels, or a copy; pixels without a face have the background's colour, if it is
// given.
template <class T>
void resolve_forward(const Resolve<T>& args) {
  const int64_t h = args.image.height, w = args.image.width, C = args.channels,
                scale = args.anti_aliasing ? 2 : 1, W = scale * w;
  std::vector<T> behind;  // colour of each background, as resolve_row takes it
  const bool mixed = args.background.values;
  for (int64_t b = 0; mixed && b < (args.background.each ? args.batch : 1); ++b) {
    const T* color = args.background.of(b, C);
    behind.insert(behind.end(), color, color + C);
    for (int64_t c = 0; c < C; ++c)
      behind.push_back(average(color[c], color[c], color[c], color[c]));
  }
  with_channels<T>(C, [&](auto known) {
    constexpr int64_t kChannels = known();
    parallel_for(args.batch * h, args.num_threads, [&](int64_t n) {  // n: image b, row y
      const T* background =
          mixed ? behind.data() + (args.background.each ? n / h * 2 * C : 0) : nullptr;
      const int32_t* face_index = mixed ? args.face_index + n * scale * W : nullptr;
      resolve_row<kChannels>(face_index, args.pixels + n * scale * W * C, background, w,
                             args.anti_aliasing, C, args.resolved + n * w * C);
    });
  });
}

// Gradients of the pixels and of the background. Each image is summed in the order of its pixels.
template <class T>
void resolve_backward(const Resolve<T>& args) {
  const int64_t h = args.image.height, w = args.image.width, C = args.channels,
                scale = args.anti_aliasing ? 2 : 1;
  const int64_t H = scale * h, W = scale * w;
  const T share = share_of_pixel<T>(args.anti_aliasing);
  if (args.grad_pixels)
    with_channels<T>(C, [&](auto known) {
      constexpr int64_t kChannels = known();
      parallel_for(args.batch * H, args.num_threads, [&](int64_t n) {  // n: image b, raster row
        resolve_row_backward<kChannels>(args.background.values ? args.face_index + n * W : nullptr,
                                        args.grad_resolved + n / scale * w * C, w,
                                        args.anti_aliasing, C, args.grad_pixels + n * W * C);
      });
    });
  if (args.grad_background)
    parallel_for(args.batch, args.num_threads, [&](int64_t b) {
      T* sum = args.grad_background + b * C;
      std::fill_n(sum, C, T(0));
      const int32_t* face_index = args.face_index + b * H * W;
      const T* grad = args.grad_resolved + b * h * w * C;
      for (int64_t y = 0; y < H; ++y)
        for (int64_t x = 0; x < W; ++x)
          for (int64_t c = 0; c < C && face_index[y * W + x] < 0; ++c)
            sum[c] += grad[(y / scale * w + x / scale) * C + c] * share;
    });
}

NMR_FLOAT_AND_DOUBLE(resolve_forward, Resolve)
NMR_FLOAT_AND_DOUBLE(resolve_backward, Resolve)

}  // namespace nmr
