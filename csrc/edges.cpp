// NMR's gradient of an image with any number of channels. For every edge of a visible face and every raster line that crosses it, let
// c be the crossing, `in` the pixel just inside and `out` the pixel just outside:
//   outside: if the face owns `in`, each pixel m from `out` to the border would become I(in) if the edge moved out to it;
//   inside:  each pixel m of the face would become I(out) if the edge moved in past it.
// If this lowers the loss, D = sum over channels of (I(m) - I(in or out)) g(m) > 0, then m pulls both ends of the edge with
// D / (distance they must travel). Lines of constant x (axis 0) move y, lines of constant y (axis 1) move x.
#include <algorithm>
#include <cmath>

#include "blocks.h"
#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

template <class T>
void resolve_forward(const Resolve<T>& args) {
  const int64_t h = args.image.height, w = args.image.width, C = args.channels, scale = args.anti_aliasing ? 2 : 1;
  parallel_for(args.batch * h, args.num_threads, [&](int64_t n) {  // n: image b, row y
    const T* upper = args.pixels + n * scale * scale * w * C;
    T* out = args.resolved + n * w * C;
    if (!args.anti_aliasing) {
      std::copy_n(upper, w * C, out);
      return;
    }
    const T* lower = upper + 2 * w * C;
    for (int64_t x = 0; x < w; ++x, upper += 2 * C, lower += 2 * C, out += C)
      for (int64_t c = 0; c < C; ++c) out[c] = (upper[c] + upper[C + c] + lower[c] + lower[C + c]) / 4;
  });
}

template <class T>
void resolve_backward(const Resolve<T>& args) {
  const int64_t h = args.image.height, w = args.image.width, C = args.channels, scale = args.anti_aliasing ? 2 : 1;
  parallel_for(args.batch * scale * h, args.num_threads, [&](int64_t n) {  // n: image b, raster row
    const T* grad = args.grad_resolved + n / scale * w * C;
    T* out = args.grad_pixels + n * scale * w * C;
    if (!args.anti_aliasing) {
      std::copy_n(grad, w * C, out);
      return;
    }
    for (int64_t x = 0; x < w; ++x, grad += C, out += 2 * C)
      for (int64_t c = 0; c < C; ++c) out[c] = out[C + c] = grad[c] / 4;
  });
}

namespace {

constexpr int64_t kWidth = 16;      // pixels processed together
constexpr int64_t kTile = 16;       // lines listed together
constexpr int64_t kFaceChunk = 32;  // faces swept together

// The pixels with a non-zero gradient on every line of one axis, in ascending order. Others cannot pull.
template <class T>
struct LineLists {
  std::vector<T> values;        // [lines, 1 + 2 C, stride] position on the line; image; gradient
  std::vector<int32_t> owner;   // [lines, stride]
  std::vector<int32_t> before;  // [lines, length + 1] number of listed pixels of the line before each pixel
};

template <class T>
struct EdgeScratch {
  VisibleFaces visible;
  LineLists<T> lists;
  FaceGradients<T> gradients;
};

// Input of the sweeps along one axis for one image. Pixel m of line n is column n, row m from the bottom for axis 0, and
// column m, row n from the bottom for axis 1.
template <class T>
struct Lines {
  Size raster;             // H x W
  int64_t C, stride;
  int axis;
  int64_t first, last;     // all lines with a covered pixel lie in [first, last)
  T eps;
  const int32_t* owner;    // [H, W], row 0 = top
  const T *image, *grad;   // [H, W, C]
  LineLists<T>* lists;

  NMR_INLINE int64_t count() const { return axis == 0 ? raster.width : raster.height; }
  NMR_INLINE int64_t length() const { return axis == 0 ? raster.height : raster.width; }
  NMR_INLINE int64_t pixel(int64_t n, int64_t m) const {
    return axis == 0 ? (raster.height - 1 - m) * raster.width + n : (raster.height - 1 - n) * raster.width + m;
  }
};

// Adds pixel m of line n to the list, as number `count` of its line, if it can pull.
template <int64_t kChannels, class T>
NMR_INLINE void list_pixel(const Lines<T>& lines, int64_t n, int64_t m, int32_t& count) {
  const int64_t C = kChannels ? kChannels : lines.C, stride = lines.stride, pixel = lines.pixel(n, m);
  const T *image = lines.image + pixel * C, *grad = lines.grad + pixel * C;
  T* out = lines.lists->values.data() + n * (1 + 2 * C) * stride + count;
  T magnitude = 0;
  out[0] = static_cast<T>(m);
  for (int64_t c = 0; c < C; ++c) {
    magnitude += std::abs(grad[c]);
    out[(1 + c) * stride] = image[c];
    out[(1 + C + c) * stride] = grad[c];
  }
  lines.lists->owner[n * stride + count] = lines.owner[pixel];
  count += magnitude != 0;
  lines.lists->before[n * (lines.length() + 1) + m + 1] = count;
}

// kChannels is the number of channels, or 0 if it is known only at run time.
template <int64_t kChannels, class T>
NMR_INLINE void list_lines(const Lines<T>& lines, int64_t first) {
  const int64_t length = lines.length(), last = std::min(first + kTile, lines.last);
  int32_t count[kTile] = {};
  for (int64_t n = first; n < last; ++n) lines.lists->before[n * (length + 1)] = 0;
  if (lines.axis == 0) {  // a tile of columns, row by row
    for (int64_t m = 0; m < length; ++m)
      for (int64_t n = first; n < last; ++n) list_pixel<kChannels>(lines, n, m, count[n - first]);
  } else {
    for (int64_t n = first; n < last; ++n)
      for (int64_t m = 0; m < length; ++m) list_pixel<kChannels>(lines, n, m, count[n - first]);
  }
}

template <class T>
NMR_INLINE void list_tile_body(const Lines<T>& lines, int64_t first) {
  switch (lines.C) {
    case 1: return list_lines<1>(lines, first);
    case 3: return list_lines<3>(lines, first);
    case 4: return list_lines<4>(lines, first);
    default: return list_lines<0>(lines, first);
  }
}

// How the crossing c of an edge P-Q and line n moves with each end of the edge.
template <class T>
struct Lever {
  T crossing;         // c
  T p, q;             // distance in [-1, 1] that P must travel to move c by one pixel: 2 / length (Qs - Ps) / (Qs - n); the same of Q
  bool p_acts, q_acts;  // false if the line passes through the other end, or p or q overflows
};

// Pulls of an edge on its ends, in lanes.
template <class T>
struct Pulls {
  T p[kWidth], q[kWidth];
};

// Adds the pulls of the listed pixels [first, last) of line n (if kOwn, only those that face `id` owns), given the reference colour.
template <class T, bool kOwn>
NMR_INLINE void pull_listed(const Lines<T>& lines, int64_t n, int32_t first, int32_t last, int32_t id, const T* reference,
                            const Lever<T>& lever, Pulls<T>& pulls) {
  const int64_t C = lines.C, stride = lines.stride;
  const T* position = lines.lists->values.data() + n * (1 + 2 * C) * stride;
  const int32_t* owner = lines.lists->owner.data() + n * stride;
  for (int32_t start = first; start < last; start += kWidth) {
    T gain[kWidth];
    for (int k = 0; k < kWidth; ++k) gain[k] = 0;
    for (int64_t c = 0; c < C; ++c) {
      const T *image = position + (1 + c) * stride + start, *grad = image + C * stride;
      for (int k = 0; k < kWidth; ++k) gain[k] += (image[k] - reference[c]) * grad[k];
    }
    const int32_t lanes = last - start;
    for (int k = 0; k < kWidth; ++k) {
      const bool counts = (k < lanes) & (gain[k] > 0) & (!kOwn | (owner[start + k] == id));
      // Loads without a condition, or else compilers do not vectorize this loop; beyond the list there may be anything.
      const T distance = position[start + k] - lever.crossing, offset = k < lanes ? distance : T(1);
      const T h_p = lever.p * offset, h_q = lever.q * offset;
      pulls.p[k] -= (counts & lever.p_acts ? gain[k] : T(0)) / (h_p + (h_p > 0 ? lines.eps : -lines.eps));
      pulls.q[k] -= (counts & lever.q_acts ? gain[k] : T(0)) / (h_q + (h_q > 0 ? lines.eps : -lines.eps));
    }
  }
}

template <class T>
NMR_INLINE T sum_pulls(const T* lanes) {
  T sum[kWidth];
  std::copy_n(lanes, kWidth, sum);
  for (int64_t width = kWidth / 2; width > 0; width /= 2)
    for (int64_t k = 0; k < width; ++k) sum[k] += sum[k + width];
  return sum[0];
}

// Both sweeps of edge P-Q (O is the third corner). s is the scan coordinate, t the sweep coordinate, in pixels.
template <class T>
NMR_INLINE void sweep_edge(const Lines<T>& lines, int32_t id, T ps, T pt, T qs, T qt, T os, T ot, T& grad_p, T& grad_q) {
  if (ps == qs) return;  // the edge is parallel to the scan line: neither end can move a crossing
  const int64_t length = lines.length();
  const T last_line = static_cast<T>(lines.count() - 1), top = static_cast<T>(length - 1), scale = 2 / static_cast<T>(length);
  const int64_t d = ((ps < qs) == (lines.axis == 0)) ? -1 : 1;  // outward
  const T low = std::max(std::min(ps, qs), T(0)), high = std::min(std::max(ps, qs), last_line);
  if (!(low <= last_line)) return;
  const int64_t n_first = std::max(static_cast<int64_t>(std::ceil(low)), lines.first);
  // Truncation towards zero, as published: an edge that ends in (-1, 0) is extrapolated to line 0.
  const int64_t n_last = std::min(high > -1 ? static_cast<int64_t>(high) : -1, lines.last - 1);
  if (n_first > n_last) return;
  const T slope = (qt - pt) / (qs - ps);
  Pulls<T> pulls;
  for (int k = 0; k < kWidth; ++k) pulls.p[k] = pulls.q[k] = 0;

  for (int64_t n = n_first; n <= n_last; ++n) {
    const T line = static_cast<T>(n);
    const int32_t* before = lines.lists->before.data() + n * (length + 1);
    Lever<T> lever;
    lever.crossing = slope * (line - ps) + pt;
    const T rounded = d > 0 ? std::floor(lever.crossing) : std::ceil(lever.crossing);
    if (!(rounded >= 0 && rounded <= top)) continue;  // also NaN
    const int64_t in = static_cast<int64_t>(rounded), out = in + d;
    if (out < 0 || out >= length) continue;

    lever.p = (qs - ps) / (qs - line) * scale;
    lever.q = (qs - ps) / (line - ps) * scale;
    lever.p_acts = std::isfinite(lever.p);
    lever.q_acts = std::isfinite(lever.q);
    if (!lever.p_acts) lever.p = 0;
    if (!lever.q_acts) lever.q = 0;

    const int64_t in_pixel = lines.pixel(n, in);
    if (lines.owner[in_pixel] == id) {
      const int32_t first = d > 0 ? before[out] : 0, last = d > 0 ? before[length] : before[out + 1];
      pull_listed<T, false>(lines, n, first, last, id, lines.image + in_pixel * lines.C, lever, pulls);
    }
    const bool beyond_p = (line - ps) * (line - os) < 0;
    const T far_side = beyond_p ? line_height(ps, pt, os, ot, line) : line_height(qs, qt, os, ot, line);
    const int64_t limit = sweep_limit(far_side, d, length);
    const int64_t m_first = std::max<int64_t>(std::min(in, limit), 0), m_last = std::min(std::max(in, limit), length - 1);
    const T* beyond = lines.image + lines.pixel(n, out) * lines.C;
    pull_listed<T, true>(lines, n, before[m_first], before[m_last + 1], id, beyond, lever, pulls);
  }
  grad_p += sum_pulls(pulls.p);
  grad_q += sum_pulls(pulls.q);
}

// Visible faces [first, last).
template <class T>
NMR_INLINE void sweep_faces_body(const Lines<T>& lines, const T* vertices, const int64_t* faces, int64_t num_faces, int64_t first,
                                 int64_t last, FaceGradients<T>& gradients) {
  const T along_s = static_cast<T>(lines.count()), along_u = static_cast<T>(lines.length());
  for (int64_t n = first; n < last; ++n) {
    const int32_t id = gradients.ids[n];
    const bool reversed = id >= num_faces;
    const Triangle<T> t = load_triangle(vertices, faces + 3 * (reversed ? id - num_faces : id), reversed);
    T s[3], u[3], grad[3] = {0, 0, 0};
    for (int k = 0; k < 3; ++k) {
      s[k] = to_pixel(lines.axis == 0 ? t.x[k] : t.y[k], along_s);
      u[k] = to_pixel(lines.axis == 0 ? t.y[k] : t.x[k], along_u);
    }
    for (int p = 0; p < 3; ++p) {
      const int q = (p + 1) % 3, o = (p + 2) % 3;
      sweep_edge(lines, id, s[p], u[p], s[q], u[q], s[o], u[o], grad[p], grad[q]);
    }
    for (int k = 0; k < 3; ++k) gradients.values[9 * n + 3 * k + 1 - lines.axis] = grad[k];
  }
}

#define NMR_DEFINE_SWEEPS(T)                                                                                         \
  NMR_CLONES void list_tile(const Lines<T>& lines, int64_t first) { list_tile_body(lines, first); }                  \
  NMR_CLONES void sweep_faces(const Lines<T>& lines, const T* vertices, const int64_t* faces, int64_t num_faces,     \
                              int64_t first, int64_t last, FaceGradients<T>& gradients) {                            \
    sweep_faces_body(lines, vertices, faces, num_faces, first, last, gradients);                                     \
  }
NMR_DEFINE_SWEEPS(float)
NMR_DEFINE_SWEEPS(double)
#undef NMR_DEFINE_SWEEPS

// Columns [first[0], last[0]) and rows, from the bottom, [first[1], last[1]) that hold all covered pixels.
NMR_INLINE void covered_box(const int32_t* owner, Size raster, int64_t first[2], int64_t last[2]) {
  const int64_t H = raster.height, W = raster.width;
  first[0] = W;
  first[1] = H;
  last[0] = last[1] = 0;
  for (int64_t row = 0; row < H; ++row) {
    int64_t i_first, i_last;
    covered_range(owner + row * W, W, i_first, i_last);
    if (i_first == i_last) continue;
    first[0] = std::min(first[0], i_first);
    last[0] = std::max(last[0], i_last);
    first[1] = H - 1 - row;
    last[1] = std::max(last[1], H - row);
  }
}

template <class T>
void edges_backward_image(const EdgesBackward<T>& args, int64_t b, int num_threads) {
  const int64_t H = args.raster.height, W = args.raster.width, C = args.channels, F = args.mesh.face_count(b);
  const T* vertices = args.mesh.image_vertices(b);
  const int64_t* faces = args.mesh.image_faces(b);
  T* grad_vertices = args.grad_vertices + 3 * args.mesh.vertex_start(b);
  std::fill_n(grad_vertices, 3 * args.mesh.vertex_count(b), T(0));

  EdgeScratch<T>& scratch = thread_scratch<EdgeScratch<T>>();
  const int32_t* owner = args.owner + b * H * W;
  VisibleFaces& visible = scratch.visible;
  visible.reserve_for(F, std::min(2 * F, H * W));
  visible.find(owner, H * W, F);
  FaceGradients<T>& gradients = scratch.gradients;
  gradients.count = visible.count - 1;
  std::copy_n(visible.ids.data() + 1, gradients.count, reserve(gradients.ids, gradients.count));
  std::fill_n(reserve(gradients.values, 9 * gradients.count), 9 * gradients.count, T(0));

  int64_t first_line[2], last_line[2];
  covered_box(owner, args.raster, first_line, last_line);

  // Both axes use the same memory, one after the other.
  const T *image = args.image + b * H * W * C, *grad = args.grad_image + b * H * W * C;
  const int64_t most = std::max(H * (W + kWidth), W * (H + kWidth));  // pixels of all lines, padded
  reserve(scratch.lists.values, (1 + 2 * C) * most);
  reserve(scratch.lists.owner, most);
  reserve(scratch.lists.before, most);
  for (int axis = 0; axis < 2 && gradients.count > 0; ++axis) {
    const int64_t stride = (axis == 0 ? H : W) + kWidth;
    const Lines<T> lines{args.raster, C,     stride, axis, first_line[axis], last_line[axis], args.eps,
                         owner,       image, grad,   &scratch.lists};
    const int64_t tiles = (lines.last - lines.first + kTile - 1) / kTile;
    parallel_for(tiles, num_threads, [&](int64_t tile) { list_tile(lines, lines.first + tile * kTile); });
    parallel_for((gradients.count + kFaceChunk - 1) / kFaceChunk, num_threads, [&](int64_t chunk) {
      const int64_t first = chunk * kFaceChunk;
      sweep_faces(lines, vertices, faces, F, first, std::min(first + kFaceChunk, gradients.count), gradients);
    });
  }
  scatter_face_gradients(gradients, faces, F, grad_vertices);
}

}  // namespace

template <class T>
void edges_backward(const EdgesBackward<T>& args) {
  // Few images: all threads share the lines and faces of one image. Each face has its own sum, so the result is the same.
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
