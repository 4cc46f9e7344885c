// NMR's gradient of an image with any number of channels. For every edge of a visible face and every raster line that
// crosses it, let c be the crossing, `in` the pixel just inside and `out` the pixel just outside:
//   outside: if the face owns `in`, each pixel m from `out` to the border would become I(in) if the edge moved out
//            to it;
//   inside:  each pixel m of the face would become I(out) if the edge moved in past it.
// If this lowers the loss, D = sum over channels of (I(m) - I(in or out)) g(m) > 0, then m pulls both ends of the edge
// with D / (distance they must travel). Lines of constant x (axis 0) move y, lines of constant y (axis 1) move x. If a
// gradient of an image is not finite, those of the corners of all its visible faces are NaN.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "scanline_colors.h"
#include "corner_values.h"
#include "geometry.h"
#include "parallel.h"
#include "scanline_grads.h"
#include "stages.h"
#include "swept_image.h"

#define NMR_LEVEL_FILE "color_sweep.h"
#include "levels.h"

namespace nmr {

namespace {

// A row of the image, w pixels wide, from the raster rows `pixels` [2 or 1, W, C]. behind: the background and the
// mean of four background pixels [2, C], or nullptr. kChannels: C, or 0 if it is known only at run time.
template <int64_t kChannels, class T>
NMR_INLINE void resolve_row(const int32_t* face_index, const T* pixels, const T* behind, int64_t w, bool anti_aliasing,
                            int64_t channels, T* out) {
  const int64_t C = kChannels ? kChannels : channels, W = 2 * w;
  if (!anti_aliasing) {
    for (int64_t x = 0; x < w; ++x)
      for (int64_t c = 0; c < C; ++c) out[x * C + c] = behind && face_index[x] < 0 ? behind[c] : pixels[x * C + c];
    return;
  }
  for (int64_t x = 0; x < w; ++x, out += C) {
    const T *upper = pixels + 2 * x * C, *lower = upper + W * C;
    const int32_t* corner = behind ? face_index + 2 * x : nullptr;
    if (!behind || (corner[0] | corner[1] | corner[W] | corner[W + 1]) >= 0) {
      for (int64_t c = 0; c < C; ++c) out[c] = (upper[c] + upper[C + c] + lower[c] + lower[C + c]) / 4;
    } else if ((corner[0] & corner[1] & corner[W] & corner[W + 1]) < 0) {
      for (int64_t c = 0; c < C; ++c) out[c] = behind[C + c];
    } else {
      const T *a = corner[0] < 0 ? behind : upper, *b = corner[1] < 0 ? behind : upper + C;
      const T *d = corner[W] < 0 ? behind : lower, *e = corner[W + 1] < 0 ? behind : lower + C;
      for (int64_t c = 0; c < C; ++c) out[c] = (a[c] + b[c] + d[c] + e[c]) / 4;
    }
  }
}

// Its gradient for one raster row [W, C]: `grad` is that of the image row, face_index nullptr if no background is mixed
// in.
template <int64_t kChannels, class T>
NMR_INLINE void resolve_row_backward(const int32_t* face_index, const T* grad, int64_t w, bool anti_aliasing,
                                     int64_t channels, T* out) {
  const int64_t C = kChannels ? kChannels : channels, scale = anti_aliasing ? 2 : 1;
  const T share = T(1) / static_cast<T>(scale * scale);  // a power of two: exact
  for (int64_t x = 0; x < w; ++x, grad += C)
    for (int64_t k = 0; k < scale; ++k, out += C) {
      const bool drawn = !face_index || face_index[scale * x + k] >= 0;
      for (int64_t c = 0; c < C; ++c) out[c] = drawn ? grad[c] * share : T(0);
    }
}

}  // namespace

// The mean of 2x2 pixels, or a copy; pixels without a face have the background's colour, if it is given.
template <class T>
void resolve_forward(const Resolve<T>& args) {
  const int64_t h = args.image.height, w = args.image.width, C = args.channels, scale = args.anti_aliasing ? 2 : 1,
                W = scale * w;
  std::vector<T> behind;  // colour of each background, as resolve_row takes it
  for (int64_t b = 0; args.background && b < args.background_batch; ++b) {
    const T* color = args.background + b * C;
    behind.insert(behind.end(), color, color + C);
    for (int64_t c = 0; c < C; ++c) behind.push_back((color[c] + color[c] + color[c] + color[c]) / 4);
  }
  with_channels<T>(C, [&](auto known) {
    constexpr int64_t kChannels = known();
    parallel_for(args.batch * h, args.num_threads, [&](int64_t n) {  // n: image b, row y
      const T* background =
          args.background ? behind.data() + (args.background_batch == 1 ? 0 : n / h * 2 * C) : nullptr;
      const int32_t* face_index = args.background ? args.face_index + n * scale * W : nullptr;
      resolve_row<kChannels>(face_index, args.pixels + n * scale * W * C, background, w, args.anti_aliasing, C,
                             args.resolved + n * w * C);
    });
  });
}

// Gradients of the pixels and of the background. Each image is summed in the order of its pixels.
template <class T>
void resolve_backward(const Resolve<T>& args) {
  const int64_t h = args.image.height, w = args.image.width, C = args.channels, scale = args.anti_aliasing ? 2 : 1;
  const int64_t H = scale * h, W = scale * w;
  const T share = T(1) / static_cast<T>(scale * scale);  // a power of two: exact
  if (args.grad_pixels)
    with_channels<T>(C, [&](auto known) {
      constexpr int64_t kChannels = known();
      parallel_for(args.batch * H, args.num_threads, [&](int64_t n) {  // n: image b, raster row
        resolve_row_backward<kChannels>(args.background ? args.face_index + n * W : nullptr,
                                        args.grad_resolved + n / scale * w * C, w, args.anti_aliasing, C,
                                        args.grad_pixels + n * W * C);
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

namespace {

template <class T>
struct EdgeLines {
  ScanlineColors<T> lines[2];  // [0] columns: lines of constant x, swept along y; [1] rows
};

template <class T>
void edges_backward_image(const EdgesBackward<T>& args, int64_t b, int num_threads) {
  const Size raster = raster_of(args.image, args.anti_aliasing);
  const int64_t H = raster.height, W = raster.width, C = args.channels;
  ScanlineColors<T>* lines = thread_scratch<EdgeLines<T>>().lines;
  const ColorImage<T> image{args.mesh.image_vertices(b),
                            args.mesh.image_faces(b),
                            args.mesh.face_count(b),
                            raster,
                            args.image,
                            args.anti_aliasing,
                            args.eps,
                            args.face_index + b * raster.pixels(),
                            args.pixels + b * raster.pixels() * C,
                            args.background ? args.background + (args.background_batch == 1 ? 0 : b * C) : nullptr,
                            args.grad_resolved + b * args.image.pixels() * C,
                            C,
                            lines,
                            args.eps > T(1e-15) ? T(1e15) : T(0)};
  T* grad_vertices = args.grad_vertices + 3 * args.mesh.vertex_start(b);
  std::fill_n(grad_vertices, 3 * args.mesh.vertex_count(b), T(0));
  lines[0].reserve_lines(0, W, H, C);
  lines[1].reserve_lines(1, H, W, C);
  sweep_image(
      image, num_threads,
      [&](int64_t first, int64_t last, uint8_t* seen) {
        NMR_AT_BEST_LEVEL(mark_visible, image.face_index + first, last - first, image.num_faces, seen);
      },
      [&](uint8_t* seen, int32_t* ids) { return NMR_AT_BEST_LEVEL(list_visible, image.num_faces, seen, ids); },
      [&] { return NMR_AT_BEST_LEVEL(all_finite, image.grad_resolved, args.image.pixels() * C); },
      [&] {  // on several threads: bands of columns, then bands of rows
        const int64_t band = band_width(std::max(H, W), num_threads), column_bands = (W + band - 1) / band;
        const auto part = [band](int64_t k, int64_t lines) { return std::min(k * band, lines); };
        parallel_for(num_threads > 1 ? column_bands + (H + band - 1) / band : 1, num_threads, [&](int64_t n) {
          T* grad_row = reserve(thread_scratch<SweepTask<T>>().grad_row, C * (W + kPad));
          const int64_t k = n - column_bands;  // number of a band of rows
          const LineRange range = num_threads <= 1 ? LineRange{0, H, 0, W}
                                  : k < 0          ? LineRange{0, 0, part(n, W), part(n + 1, W)}
                                                   : LineRange{part(k, H), part(k + 1, H), 0, 0};
          NMR_AT_BEST_LEVEL(collect_colors, image, range, grad_row);
        });
      },
      [&](const int32_t* ids, int64_t first, int64_t last, SweepScratch<T>& block, T* grad) {
        NMR_AT_BEST_LEVEL(sweep_color_faces, image, ids, first, last, block, grad);
      },
      grad_vertices);
}

}  // namespace

template <class T>
void edges_backward(const EdgesBackward<T>& args) {
  // Few images: all threads share the lines and faces of one image. Each face has its own sum, so the result is the
  // same.
  const bool share_images = args.mesh.batch < args.num_threads;
  parallel_for(args.mesh.batch, share_images ? 1 : args.num_threads,
               [&](int64_t b) { edges_backward_image(args, b, share_images ? args.num_threads : 1); });
}

template void resolve_forward(const Resolve<float>&);
template void resolve_forward(const Resolve<double>&);
template void resolve_backward(const Resolve<float>&);
template void resolve_backward(const Resolve<double>&);
template void edges_backward(const EdgesBackward<float>&);
template void edges_backward(const EdgesBackward<double>&);

}  // namespace nmr
