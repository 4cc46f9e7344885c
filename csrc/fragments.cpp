// Barycentric weights and depth of the owner at each pixel. They are computed from the owner map, by the same expressions as in the
// rasterizer.
//
// With w_k the normalised screen weights and q = sum_k w_k / z_k: depth z = 1 / q, perspective-correct weights b_k = z w_k / z_k.
// Moving corner k by (dX, dY) pixels changes the weights at a fixed pixel by dw_m = -w_k (M_m0 dX + M_m1 dY), M as in geometry.h.
#include <algorithm>
#include <cmath>
#include <limits>
#include <type_traits>

#include "blocks.h"
#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

constexpr int64_t kWidth = 16;  // faces set up together
constexpr int64_t kEntry = 16;  // numbers per face in the table: columns 0, 1, 2 of M and the depths, each padded to four

// Values of the covered pixels of one row, from the first covered pixel on. Rows are padded to whole vectors.
template <class T>
struct PixelRow {
  T* raw;      // [W + kWidth, 8] clamped weights and depths of the corners, each padded to four
  T *w[3], *z; // [W + kWidth] normalised weights, depth
  T* spare;    // [W + kWidth] a row of the image
};

template <class T>
struct FragmentScratch {
  VisibleFaces visible;
  std::vector<T> table;  // [visible, kEntry]
  std::vector<T> row;    // [13, W + kWidth] PixelRow
  std::vector<T> terms;  // [W, 12] contribution of each pixel to its face
  std::vector<T> sums;   // [visible, 12]

  void reserve_for(int64_t num_faces, const RowBlocks& blocks) {
    const int64_t most = blocks.most_visible(num_faces);
    visible.reserve_for(num_faces, most);
    reserve(table, (most + 1 + kWidth) * kEntry);
    reserve(row, 13 * (blocks.raster.width + kWidth));
  }
  void reserve_for_backward(int64_t num_faces, const RowBlocks& blocks) {
    reserve_for(num_faces, blocks);
    reserve(terms, blocks.raster.width * 12);
    reserve(sums, (blocks.most_visible(num_faces) + 1) * 12);
  }
  NMR_INLINE PixelRow<T> pixel_row(int64_t width) {
    const int64_t stride = width + kWidth;
    T* r = row.data();
    return {r, {r + 8 * stride, r + 9 * stride, r + 10 * stride}, r + 11 * stride, r + 12 * stride};
  }
};

// One block of rows of one image.
template <class T>
struct Block {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  Size raster;
  const int32_t* owner;  // [H, W], row 0 = top
  int64_t first, last;   // rows
};

template <class T>
Block<T> make_block(const MeshBatch<T>& mesh, const int32_t* owner, const RowBlocks& blocks, int64_t b, int64_t block) {
  return {mesh.image_vertices(b), mesh.image_faces(b), mesh.face_count(b), blocks.raster,
          owner + b * blocks.raster.pixels(), blocks.first(block), blocks.last(block)};
}

// The table of the block's visible faces; entry 0 (background) has weights (1, 0, 0) and depth 1.
template <class T>
NMR_INLINE void set_up_faces(const Block<T>& block, FragmentScratch<T>& scratch) {
  VisibleFaces& visible = scratch.visible;
  const int64_t W = block.raster.width;
  visible.find(block.owner + block.first * W, (block.last - block.first) * W, block.num_faces);
  T* table = scratch.table.data();
  const T width = static_cast<T>(W), height = static_cast<T>(block.raster.height);
  T corner[9][kWidth], matrix[9][kWidth];
  for (int64_t start = 0; start < visible.count; start += kWidth) {
    const int64_t lanes = std::min(kWidth, visible.count - start);
    for (int64_t n = 0; n < kWidth; ++n) {
      const int32_t id = n < lanes ? visible.ids[start + n] : -1;
      const bool reversed = id >= block.num_faces;
      const int64_t* face = block.faces + 3 * (id < 0 ? 0 : reversed ? id - block.num_faces : id);
      const Triangle<T> t = id < 0 ? Triangle<T>{{0, 1, 0}, {0, 0, 1}, {1, 1, 1}} : load_triangle(block.vertices, face, reversed);
      for (int k = 0; k < 3; ++k) {
        corner[k][n] = t.x[k];
        corner[3 + k][n] = t.y[k];
        corner[6 + k][n] = t.z[k];
      }
    }
    for (int64_t n = 0; n < kWidth; ++n) {
      const Triangle<T> t{{corner[0][n], corner[1][n], corner[2][n]}, {corner[3][n], corner[4][n], corner[5][n]}, {1, 1, 1}};
      const BarycentricMatrix<T> m = barycentric_matrix(t, width, height);
      for (int k = 0; k < 3; ++k)
        for (int c = 0; c < 3; ++c) matrix[3 * c + k][n] = m.m[k][c];
    }
    for (int64_t n = 0; n < lanes; ++n) {
      T* entry = table + (start + n) * kEntry;
      for (int k = 0; k < 3; ++k) {
        for (int c = 0; c < 3; ++c) entry[4 * c + k] = matrix[3 * c + k][n];
        entry[12 + k] = corner[6 + k][n];
      }
      for (int c = 0; c < 3; ++c) entry[4 * c + 3] = 0;
      entry[15] = 1;
    }
  }
  for (int64_t n = 0; n < kEntry; ++n) table[n] = n == 8 || n >= 12 ? T(1) : T(0);
}

// Weights and depth of the pixels [first, last) of raster row j (from the top).
template <class T>
NMR_INLINE void evaluate_row(const Block<T>& block, int64_t j, int64_t first, int64_t last, const FragmentScratch<T>& scratch,
                             const PixelRow<T>& row) {
  const int32_t* owner = block.owner + j * block.raster.width;
  const int32_t* slots = scratch.visible.slots.data() + 1;
  const T* table = scratch.table.data();
  const T y = static_cast<T>(block.raster.height - 1 - j);
  T* raw = row.raw;
  for (int64_t i = first; i < last; ++i, raw += 8) {
    const T* entry = table + slots[owner[i]] * kEntry;
    const T x = static_cast<T>(i);
    T pixel[8];  // a local array cannot overlap others, so the compiler can use vectors of four
    for (int k = 0; k < 4; ++k) pixel[k] = clamp_weight(entry[k] * x + entry[4 + k] * y + entry[8 + k]);
    for (int k = 0; k < 4; ++k) pixel[4 + k] = entry[12 + k];
    for (int k = 0; k < 8; ++k) raw[k] = pixel[k];
  }
  raw = row.raw;
  for (int64_t start = 0; start < last - first; start += kWidth, raw += 8 * kWidth) {
    T w[3][kWidth], z[kWidth];
    for (int64_t n = 0; n < kWidth; ++n) {
      const T sum = raw[8 * n] + raw[8 * n + 1] + raw[8 * n + 2];
      w[0][n] = raw[8 * n] / sum;
      w[1][n] = raw[8 * n + 1] / sum;
      w[2][n] = raw[8 * n + 2] / sum;
      z[n] = 1 / (w[0][n] / raw[8 * n + 4] + w[1][n] / raw[8 * n + 5] + w[2][n] / raw[8 * n + 6]);
    }
    for (int k = 0; k < 3; ++k) std::copy_n(w[k], kWidth, row.w[k] + start);
    std::copy_n(z, kWidth, row.z + start);
  }
}

// --- forward

template <class T>
NMR_INLINE void depth_block_body(const DepthImage<T>& args, const Block<T>& block, int64_t b, FragmentScratch<T>& scratch) {
  const int64_t W = block.raster.width, w = args.image.width;
  set_up_faces(block, scratch);
  T* image = args.depth + b * args.image.pixels();
  const PixelRow<T> row = scratch.pixel_row(W);
  for (int64_t j = block.first; j < block.last; ++j) {
    const int32_t* owner = block.owner + j * W;
    int64_t first, last;
    covered_range(owner, W, first, last);
    evaluate_row(block, j, first, last, scratch, row);
    T* out = args.anti_aliasing ? row.spare : image + j * w;
    std::fill_n(out, first, args.far);
    for (int64_t i = first; i < last; ++i) out[i] = owner[i] < 0 ? args.far : row.z[i - first];
    std::fill_n(out + last, W - last, args.far);
    if (!args.anti_aliasing) continue;
    T* mean = image + j / 2 * w;
    if (j % 2 == 0)
      for (int64_t i = 0; i < w; ++i) mean[i] = out[2 * i] + out[2 * i + 1];
    else
      for (int64_t i = 0; i < w; ++i) mean[i] = (mean[i] + out[2 * i] + out[2 * i + 1]) / 4;
  }
}

template <class T>
NMR_INLINE void fragments_block_body(const Fragments<T>& args, const Block<T>& block, int64_t b, FragmentScratch<T>& scratch) {
  const int64_t W = block.raster.width;
  set_up_faces(block, scratch);
  const PixelRow<T> row = scratch.pixel_row(W);
  for (int64_t j = block.first; j < block.last; ++j) {
    const int32_t* owner = block.owner + j * W;
    T* depth = args.depth + b * block.raster.pixels() + j * W;
    T* weights = args.weights + 3 * (b * block.raster.pixels() + j * W);
    int64_t first, last;
    covered_range(owner, W, first, last);
    evaluate_row(block, j, first, last, scratch, row);
    std::fill_n(depth, W, args.far);
    std::fill_n(weights, 3 * W, T(0));
    depth += first;
    weights += 3 * first;
    owner += first;
    for (int64_t n = 0; n < last - first; ++n) {
      const T *z = row.z, *corner_z = row.raw + 8 * n + 4;
      const T b0 = row.w[0][n] * z[n] / corner_z[0], b1 = row.w[1][n] * z[n] / corner_z[1], b2 = row.w[2][n] * z[n] / corner_z[2];
      const bool drawn = owner[n] >= 0, reversed = owner[n] >= block.num_faces;
      depth[n] = drawn ? z[n] : args.far;
      weights[3 * n] = drawn ? (reversed ? b2 : b0) : T(0);
      weights[3 * n + 1] = drawn ? b1 : T(0);
      weights[3 * n + 2] = drawn ? (reversed ? b0 : b2) : T(0);
    }
  }
}

// --- backward

// dq/d(X, Y, z) of a face's corners, without the weight of the pixel: 1 / z_m^2 and M_m / z_m. Values close to an overflow count as
// 0: a corner in the plane of the eye gets no gradient, and does not change others.
template <class T>
NMR_INLINE T moderate_or_zero(T value) {
  return std::abs(value) < std::sqrt(std::numeric_limits<T>::max()) ? value : T(0);
}

// The square of a depth, as a factor of a gradient: 0 beyond the depth up to which sums of squares cannot overflow.
template <class T> constexpr T kDeepest = T(1e100);
template <> constexpr float kDeepest<float> = 1e15f;
template <class T>
NMR_INLINE T depth_or_zero(T z) {
  return std::abs(z) < kDeepest<T> ? z : T(0);
}

// grad z_k = S_k / z_k^2, grad X_k = S_k sum_m M_m0 / z_m with S_k = sum over pixels of g z^2 w_k.
template <class T>
NMR_INLINE void depth_gradients(const FragmentScratch<T>& scratch, Size raster, FaceGradients<T>& result) {
  const T half_width = static_cast<T>(raster.width) / 2, half_height = static_cast<T>(raster.height) / 2;
  T* out = result.values.data();
  result.count = scratch.visible.count - 1;
  for (int64_t n = 1; n <= result.count; ++n, out += 9) {
    const T *entry = scratch.table.data() + n * kEntry, *sum = scratch.sums.data() + 4 * n;
    result.ids[n - 1] = scratch.visible.ids[n];
    const T *mx = entry, *my = entry + 4, *z = entry + 12;
    const T slope_x = moderate_or_zero(mx[0] / z[0] + mx[1] / z[1] + mx[2] / z[2]) * half_width;
    const T slope_y = moderate_or_zero(my[0] / z[0] + my[1] / z[1] + my[2] / z[2]) * half_height;
    for (int k = 0; k < 3; ++k) {
      out[3 * k] = sum[k] * slope_x;
      out[3 * k + 1] = sum[k] * slope_y;
      out[3 * k + 2] = sum[k] * moderate_or_zero(1 / (z[k] * z[k]));
    }
  }
}

template <class T>
NMR_INLINE void depth_gradient_block_body(const DepthImage<T>& args, const Block<T>& block, int64_t b,
                                          FragmentScratch<T>& scratch, FaceGradients<T>& result) {
  const int64_t W = block.raster.width, w = args.image.width;
  set_up_faces(block, scratch);
  const PixelRow<T> row = scratch.pixel_row(W);
  T *grad = row.spare, *terms = scratch.terms.data(), *sums = scratch.sums.data();
  const int32_t* slots = scratch.visible.slots.data() + 1;
  std::fill_n(sums, 4 * scratch.visible.count, T(0));
  for (int64_t j = block.first; j < block.last; ++j) {
    const int32_t* owner = block.owner + j * W;
    int64_t first, last;
    covered_range(owner, W, first, last);
    if (first == last) continue;
    evaluate_row(block, j, first, last, scratch, row);
    if (args.anti_aliasing) {
      const T* quarter = args.grad_depth + b * args.image.pixels() + j / 2 * w;
      for (int64_t i = 0; i < w; ++i) grad[2 * i] = grad[2 * i + 1] = quarter[i] / 4;
    } else {
      std::copy_n(args.grad_depth + b * args.image.pixels() + j * w, w, grad);
    }
    for (int64_t n = 0; n < last - first; ++n) {
      const T z = depth_or_zero(row.z[n]), c = grad[first + n] * z * z;
      for (int k = 0; k < 3; ++k) terms[4 * n + k] = c * row.w[k][n];
      terms[4 * n + 3] = 0;
    }
    const T* term = terms;
    for (int64_t i = first; i < last; ++i, term += 4) {
      T* sum = sums + 4 * slots[owner[i]];
      for (int k = 0; k < 4; ++k) sum[k] += term[k];
    }
  }
  depth_gradients(scratch, block.raster, result);
}

// With u_m = dL/db_m, g = dL/dz and h_m = z (u_m - sum_k u_k b_k) - g z^2:  dL = sum_m h_m d(w_m / z_m), so that
// grad z_m = -H_mm / z_m^2 and grad X_k = -sum_m H_mk M_m0 / z_m with H_mk = sum over pixels of h_m w_k.
template <class T>
NMR_INLINE void fragment_gradients(const FragmentScratch<T>& scratch, Size raster, FaceGradients<T>& result) {
  const T half_width = static_cast<T>(raster.width) / 2, half_height = static_cast<T>(raster.height) / 2;
  T* out = result.values.data();
  result.count = scratch.visible.count - 1;
  for (int64_t n = 1; n <= result.count; ++n, out += 9) {
    const T *entry = scratch.table.data() + n * kEntry, *sum = scratch.sums.data() + 12 * n, *z = entry + 12;
    result.ids[n - 1] = scratch.visible.ids[n];
    T slope_x[3], slope_y[3];
    for (int m = 0; m < 3; ++m) {
      slope_x[m] = moderate_or_zero(entry[m] / z[m]) * half_width;
      slope_y[m] = moderate_or_zero(entry[4 + m] / z[m]) * half_height;
    }
    for (int k = 0; k < 3; ++k) {
      out[3 * k] = -(sum[k] * slope_x[0] + sum[4 + k] * slope_x[1] + sum[8 + k] * slope_x[2]);
      out[3 * k + 1] = -(sum[k] * slope_y[0] + sum[4 + k] * slope_y[1] + sum[8 + k] * slope_y[2]);
      out[3 * k + 2] = -sum[5 * k] * moderate_or_zero(1 / (z[k] * z[k]));
    }
  }
}

template <class T>
NMR_INLINE void fragments_gradient_block_body(const Fragments<T>& args, const Block<T>& block, int64_t b,
                                              FragmentScratch<T>& scratch, FaceGradients<T>& result) {
  const int64_t W = block.raster.width;
  set_up_faces(block, scratch);
  const PixelRow<T> row = scratch.pixel_row(W);
  T *sums = scratch.sums.data(), *terms = scratch.terms.data();
  const int32_t* slots = scratch.visible.slots.data() + 1;
  std::fill_n(sums, 12 * scratch.visible.count, T(0));
  for (int64_t j = block.first; j < block.last; ++j) {
    const int32_t* owner = block.owner + j * W;
    int64_t first, last;
    covered_range(owner, W, first, last);
    if (first == last) continue;
    evaluate_row(block, j, first, last, scratch, row);
    const int64_t at = b * block.raster.pixels() + j * W;
    const T* grad_depth = args.grad_depth ? args.grad_depth + at : nullptr;
    const T* grad_weights = args.grad_weights ? args.grad_weights + 3 * at : nullptr;
    for (int64_t n = 0; n < last - first; ++n) {
      const int64_t i = first + n;
      const T w[4] = {row.w[0][n], row.w[1][n], row.w[2][n], 0}, z = row.z[n];
      T h[3];
      const T deep = depth_or_zero(z), pull = grad_depth ? -grad_depth[i] * deep * deep : T(0);
      for (int m = 0; m < 3; ++m) h[m] = pull;
      if (grad_weights) {
        const bool reversed = owner[i] >= block.num_faces;
        T u[3], mean = 0;
        for (int m = 0; m < 3; ++m) {
          u[m] = grad_weights[3 * i + (reversed ? 2 - m : m)];
          mean += u[m] * (w[m] * z / row.raw[8 * n + 4 + m]);
        }
        for (int m = 0; m < 3; ++m) h[m] += z * (u[m] - mean);
      }
      for (int m = 0; m < 3; ++m)
        for (int k = 0; k < 4; ++k) terms[12 * n + 4 * m + k] = h[m] * w[k];
    }
    const T* term = terms;
    for (int64_t i = first; i < last; ++i, term += 12) {
      T* sum = sums + 12 * slots[owner[i]];
      for (int k = 0; k < 12; ++k) sum[k] += term[k];
    }
  }
  fragment_gradients(scratch, block.raster, result);
}

#define NMR_DEFINE_BLOCKS(T)                                                                                              \
  NMR_CLONES void forward_block(const DepthImage<T>& args, const Block<T>& block, int64_t b, FragmentScratch<T>& scratch) { \
    depth_block_body(args, block, b, scratch);                                                                            \
  }                                                                                                                       \
  NMR_CLONES void forward_block(const Fragments<T>& args, const Block<T>& block, int64_t b, FragmentScratch<T>& scratch) { \
    fragments_block_body(args, block, b, scratch);                                                                        \
  }                                                                                                                       \
  NMR_CLONES void backward_block(const DepthImage<T>& args, const Block<T>& block, int64_t b, FragmentScratch<T>& scratch, \
                                 FaceGradients<T>& result) {                                                              \
    depth_gradient_block_body(args, block, b, scratch, result);                                                           \
  }                                                                                                                       \
  NMR_CLONES void backward_block(const Fragments<T>& args, const Block<T>& block, int64_t b, FragmentScratch<T>& scratch,  \
                                 FaceGradients<T>& result) {                                                              \
    fragments_gradient_block_body(args, block, b, scratch, result);                                                       \
  }
NMR_DEFINE_BLOCKS(float)
NMR_DEFINE_BLOCKS(double)
#undef NMR_DEFINE_BLOCKS

// The blocks of an image depend only on its own number of faces, so that results do not depend on other images of a packed batch.
template <class Args, class T = std::remove_pointer_t<decltype(Args::depth)>>
void forward(const Args& args, Size raster) {
  const MeshBatch<T>& mesh = args.mesh;
  int64_t most_blocks = 1;
  for (int64_t b = 0; b < mesh.batch; ++b) most_blocks = std::max(most_blocks, RowBlocks(raster, mesh.face_count(b)).count);
  parallel_for(mesh.batch * most_blocks, args.num_threads, [&](int64_t task) {
    const int64_t b = task / most_blocks, block = task % most_blocks, F = mesh.face_count(b);
    const RowBlocks blocks(raster, F);
    if (block >= blocks.count) return;
    FragmentScratch<T>& scratch = thread_scratch<FragmentScratch<T>>();
    scratch.reserve_for(F, blocks);
    forward_block(args, make_block(mesh, args.owner, blocks, b, block), b, scratch);
  });
}

template <class Args, class T = std::remove_pointer_t<decltype(Args::grad_vertices)>>
void backward(const Args& args, Size raster) {
  const MeshBatch<T>& mesh = args.mesh;
  std::fill_n(args.grad_vertices, 3 * mesh.num_vertices * (mesh.starts ? 1 : mesh.batch), T(0));
  sum_blocks<FaceGradients<T>>(
      mesh.batch, false, args.num_threads, [&](int64_t b) { return RowBlocks(raster, mesh.face_count(b)).count; },
      [&](int64_t b, int64_t block, FaceGradients<T>& result) {
        const int64_t F = mesh.face_count(b);
        const RowBlocks blocks(raster, F);
        FragmentScratch<T>& scratch = thread_scratch<FragmentScratch<T>>();
        scratch.reserve_for_backward(F, blocks);
        reserve(result.ids, blocks.most_visible(F));
        reserve(result.values, 9 * blocks.most_visible(F));
        backward_block(args, make_block(mesh, args.owner, blocks, b, block), b, scratch, result);
      },
      [&](int64_t b, const FaceGradients<T>& result) {
        scatter_face_gradients(result, mesh.image_faces(b), mesh.face_count(b), args.grad_vertices + 3 * mesh.vertex_start(b));
      });
}

}  // namespace

template <class T>
void fragments_forward(const Fragments<T>& args) {
  forward(args, args.raster);
}

template <class T>
void fragments_backward(const Fragments<T>& args) {
  backward(args, args.raster);
}

template <class T>
void depth_forward(const DepthImage<T>& args) {
  forward(args, raster_of(args.image, args.anti_aliasing));
}

template <class T>
void depth_backward(const DepthImage<T>& args) {
  backward(args, raster_of(args.image, args.anti_aliasing));
}

template void fragments_forward(const Fragments<float>&);
template void fragments_forward(const Fragments<double>&);
template void fragments_backward(const Fragments<float>&);
template void fragments_backward(const Fragments<double>&);
template void depth_forward(const DepthImage<float>&);
template void depth_forward(const DepthImage<double>&);
template void depth_backward(const DepthImage<float>&);
template void depth_backward(const DepthImage<double>&);

}  // namespace nmr
