// Fragments and depth images of a face index map.
#include "read.h"

namespace nmr {
namespace {

template <class T>
Fragments<T> read_fragments(Call& call) {
  Fragments<T> args{};
  args.mesh = read_mesh<T>(call);
  args.num_threads = num_threads(call);
  read_face_index(call, "face_index [B, H, W]", args.face_index, args.mesh, args.num_threads);
  args.raster = raster_size(call);
  args.far = static_cast<T>(call.number("far"));
  args.perspective = call.flag("perspective");
  call.result("weights? [B, H, W, 3]", args.weights, args.grad_weights);
  call.result("depth? [B, H, W]", args.depth, args.grad_depth);
  call.only_gradient("vertices", args.grad_vertices);
  return args;
}

template <class T>
DepthImage<T> read_depth(Call& call) {
  DepthImage<T> args{};
  args.mesh = read_mesh<T>(call);
  args.num_threads = num_threads(call);
  read_face_index(call, "face_index [B, H, W]", args.face_index, args.mesh, args.num_threads);
  args.anti_aliasing = call.flag("anti_aliasing");
  args.image = image_size(call, args.anti_aliasing);
  args.far = static_cast<T>(call.number("far"));
  args.perspective = call.flag("perspective");
  call.result("depth [B, h, w]", args.depth, args.grad_depth);
  call.only_gradient("vertices", args.grad_vertices);
  return args;
}

}  // namespace

void add_fragments(Kernels& kernels) {
  kernels.add_with_backward("fragments", [](auto zero, Call& call) {
    const auto args = read_fragments<decltype(zero)>(call);
    call.backward ? fragments_backward(args) : fragments_forward(args);
  });
  kernels.add_with_backward("depth_image", [](auto zero, Call& call) {
    const auto args = read_depth<decltype(zero)>(call);
    call.backward ? depth_backward(args) : depth_forward(args);
  });
}

}  // namespace nmr
