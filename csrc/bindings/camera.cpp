// Cameras, and the projection of vertices.
#include "read.h"

namespace nmr {
namespace {

// One for all images, or one for each.
template <class P>
bool read_each(Call& call, std::string_view text, P*& field, size_t axes_of_one) {
  const std::vector<int64_t>& shape = call.read(text, field).shape;
  return shape.size() > axes_of_one && shape[0] == call["B"];
}

template <class T>
LookAt<T> read_look_at(Call& call) {
  LookAt<T> args{};
  call.result("camera [B, 22]", args.camera, args.grad_camera);
  args.batch = call["B"];
  args.eye_each = read_each(call, "eye [3] or [1|B, 3]", args.eye, 1);
  args.at_each = read_each(call, "at [3] or [1|B, 3]", args.at, 1);
  args.up_each = read_each(call, "up [3] or [1|B, 3]", args.up, 1);
  args.view_each = read_each(call, "view [] or [1|B]", args.view, 0);
  args.along = call.flag("along");
  args.right_handed = call.flag("right_handed");
  args.perspective = call.flag("perspective");
  call.gradient("eye", args.grad_eye);
  call.gradient("at", args.grad_at);
  call.gradient("up", args.grad_up);
  call.gradient("view", args.grad_view);
  return args;
}

template <class T>
Project<T> read_project(Call& call) {
  Project<T> args{};
  const bool packed = call.has("starts");
  call.read("starts? [B + 1, 2]", args.starts);
  call.result(packed ? "points [V, 3]" : "points [B, V, 3]", args.points, args.grad_points);
  args.batch = call["B"];
  args.num_vertices = call["V"];
  args.vertex_batch =
      call.read(packed ? "vertices [V, 3]" : "vertices [1|B, V, 3]", args.vertices).shape[0];
  args.camera_each = call.read("camera [1|B, 22]", args.camera).shape[0] == args.batch;
  const Argument& distortion = call.read("distortion? [1|B, 4|5|8]", args.distortion);
  args.distortion_each = args.distortion && distortion.shape[0] == args.batch;
  args.coefficients = args.distortion ? distortion.shape[1] : 0;
  if (packed)
    require_starts(args.starts, args.batch, args.num_vertices, args.starts[2 * args.batch + 1]);
  args.perspective = call.flag("perspective");
  args.num_threads = num_threads(call);
  call.gradient("vertices", args.grad_vertices);
  call.gradient("camera", args.grad_camera);
  call.gradient("distortion", args.grad_distortion);
  return args;
}

}  // namespace

void add_camera(Kernels& kernels) {
  kernels.add_with_backward(
      "look_at",
      [](auto zero, Call& call) {
        const auto args = read_look_at<decltype(zero)>(call);
        call.backward ? look_at_backward(args) : look_at_forward(args);
      },
      "camera");
  NMR_ADD_STAGE(kernels, project);
}

}  // namespace nmr
