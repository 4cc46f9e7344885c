// Images of any channels: the mean of 2x2 pixels, and the gradients of edges.
#include "read.h"

namespace nmr {
namespace {

// The colour of pixels without a face.
template <class T>
Parameter<T> read_background(Call& call) {
  Parameter<T> background{};
  const Argument& given = call.read("background? [1|B, C]", background.values);
  background.each = background.values && given.shape[0] != 1;
  return background;
}

template <class T>
Resolve<T> read_resolve(Call& call) {
  Resolve<T> args{};
  call.read("face_index [B, H, W]", args.face_index);
  args.anti_aliasing = call.flag("anti_aliasing");
  args.image = image_size(call, args.anti_aliasing);
  call.read("image [B, H, W, C]", args.pixels);
  args.batch = call["B"];
  args.channels = call["C"];
  require(args.channels >= 1,
          "image must have at least one channel, got " + call("image").shape_text());
  args.background = read_background<T>(call);
  args.num_threads = num_threads(call);
  call.result("resolved [B, h, w, C]", args.resolved, args.grad_resolved);
  call.gradient("image", args.grad_pixels);
  call.gradient("background", args.grad_background);
  return args;
}

// The gradient of the edges; the arguments of the mean have been read.
template <class T>
void pull_edges(Call& call, const Resolve<T>& mean) {
  EdgesBackward<T> args{};
  args.mesh = read_mesh<T>(call);
  args.num_threads = mean.num_threads;
  read_face_index(call, "face_index [B, H, W]", args.face_index, args.mesh.face_rows,
                  args.num_threads);
  args.image = mean.image;
  args.anti_aliasing = mean.anti_aliasing;
  args.eps = static_cast<T>(call.number("eps"));
  args.pixels = mean.pixels;
  args.channels = mean.channels;
  args.background = mean.background;
  args.grad_resolved = mean.grad_resolved;
  args.perspective = call.flag("perspective");
  call.gradient("vertices", args.grad_vertices);
  if (!args.grad_vertices) return;
  call.flag("local") ? local_edges_backward(args) : edges_backward(args);
}

// One background for all images gets the sum of their gradients.
template <class T>
void resolve_gradients(Call& call) {
  Resolve<T> args = read_resolve<T>(call);
  T* of_shared = args.background.each ? nullptr : args.grad_background;
  std::vector<T> rows(of_shared ? args.batch * args.channels : 0);
  if (of_shared) args.grad_background = rows.data();
  if (args.grad_pixels || args.grad_background) resolve_backward(args);
  for (int64_t c = 0; of_shared && c < args.channels; ++c) {
    of_shared[c] = 0;
    for (int64_t b = 0; b < args.batch; ++b) of_shared[c] += rows[b * args.channels + c];
  }
  pull_edges(call, args);
}

}  // namespace

void add_edges(Kernels& kernels) {
  kernels.add_with_backward("resolve", [](auto zero, Call& call) {
    using T = decltype(zero);
    if (call.backward) return resolve_gradients<T>(call);
    for (const char* name : {"vertices", "faces", "starts"}) call.skip(name);
    resolve_forward(read_resolve<T>(call));
  });
}

}  // namespace nmr
