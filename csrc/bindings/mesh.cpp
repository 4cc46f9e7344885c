// Losses, and voxels.
#include <cstdio>

#include "read.h"

namespace nmr {
namespace {

template <class T>
Smoothness<T> read_smoothness(Call& call) {
  Smoothness<T> args{};
  call.read("vertices [B, V, 3]", args.vertices);
  call.read("edges [E, 4]", args.edges);
  args.batch = call["B"];
  args.num_vertices = call["V"];
  args.num_edges = call["E"];
  args.num_threads = num_threads(call);
  require_indices(args.edges, 4 * args.num_edges, args.num_vertices, "edges", "vertex", "vertices");
  call.result("loss [B]", args.loss, args.grad_loss);
  call.only_gradient("vertices", args.grad_vertices);
  return args;
}

// The target must lie in [0, 1] or a little outside, as resampling makes it; not in 0 .. 255.
template <class T>
void require_mask(const SoftIou<T>& args) {
  if (args.target_range[0] >= T(-0.5) && args.target_range[1] <= T(1.5)) return;
  const auto [least, most] =
      std::minmax_element(args.target, args.target + args.batch * args.count);
  char text[120];
  std::snprintf(
      text, sizeof text,
      "target must lie in [0, 1], got values from %.4g to %.4g; divide a mask of 0..255 by 255",
      static_cast<double>(*least), static_cast<double>(*most));
  throw std::invalid_argument(text);
}

template <class T>
SoftIou<T> read_soft_iou(Call& call) {
  SoftIou<T> args{};
  const Argument& prediction = call.read("prediction [B, ...]", args.prediction);
  call.read_like("prediction", "target", args.target);
  args.batch = call["B"];
  args.count = args.batch ? prediction.count() / args.batch : 0;
  args.num_threads = num_threads(call);
  call.read("areas [B, 2]", args.areas);
  call.gradient("prediction", args.grad_prediction);
  call.gradient("target", args.grad_target);
  return args;
}

// 1 - the mean of I / U, and its gradient, which is the same for every pair.
template <class T>
void mean_of_iou(Call& call) {
  SoftIou<T> args = read_soft_iou<T>(call);
  T* loss = nullptr;
  const T* grad_loss = nullptr;
  call.result("loss []", loss, grad_loss);
  std::vector<T> iou(args.batch);
  if (call.backward) {
    std::fill(iou.begin(), iou.end(), -*grad_loss / static_cast<T>(args.batch));
    args.grad_iou = iou.data();
    return soft_iou_backward(args);
  }
  T range[2];
  args.iou = iou.data();
  args.target_range = range;
  soft_iou_forward(args);
  require_mask(args);
  double sum = 0;
  for (T value : iou) sum += value;
  *loss = static_cast<T>(1 - sum / static_cast<double>(args.batch));
}

Voxelize read_voxelize(Call& call) {
  Voxelize args{};
  args.mesh = read_mesh<float>(call);
  args.size = static_cast<int64_t>(call.number("size"));
  require(args.size >= 1 && args.size <= 1024,
          "size must lie in 1..1024, got " + std::to_string(args.size));
  call.let("s", args.size);
  args.touched = call.flag("touched");
  args.num_threads = num_threads(call);
  call.read("grid [B, s, s, s]", args.voxels);
  return args;
}

}  // namespace

void add_mesh(Kernels& kernels) {
  NMR_ADD_STAGE(kernels, smoothness);
  kernels.add_with_backward("soft_iou_loss",
                            [](auto zero, Call& call) { mean_of_iou<decltype(zero)>(call); });
  kernels.add("voxels", [](auto, Call& call) { voxelize(read_voxelize(call)); });
}

}  // namespace nmr
