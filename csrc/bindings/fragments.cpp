// Fragments and depth images of a face index map.
#include "read.h"

namespace nmr {
namespace {

// What both have. `depth` is the text of that result.
template <class T>
Fragments<T> read(Call& call, const char* depth, bool anti_aliasing) {
  Fragments<T> args{};
  args.mesh = read_mesh<T>(call);
  args.num_threads = num_threads(call);
  read_face_index(call, "face_index [B, H, W]", args.face_index, args.mesh.face_rows,
                  args.num_threads);
  args.anti_aliasing = anti_aliasing;
  args.image = image_size(call, anti_aliasing);
  args.far = static_cast<T>(call.number("far"));
  args.perspective = call.flag("perspective");
  call.result(depth, args.depth, args.grad_depth);
  call.only_gradient("vertices", args.grad_vertices);
  return args;
}

template <class T>
Fragments<T> read_fragments(Call& call) {
  Fragments<T> args = read<T>(call, "depth? [B, H, W]", false);
  call.result("weights? [B, H, W, 3]", args.weights, args.grad_weights);
  return args;
}

template <class T>
Fragments<T> read_depth(Call& call) {
  return read<T>(call, "depth [B, h, w]", call.flag("anti_aliasing"));
}

}  // namespace

void add_fragments(Kernels& kernels) {
  NMR_ADD_STAGE(kernels, fragments);
  kernels.add_with_backward("depth_image", [](auto zero, Call& call) {
    const auto args = read_depth<decltype(zero)>(call);
    call.backward ? fragments_backward(args) : fragments_forward(args);
  });
}

}  // namespace nmr
