// Cameras: vertices to renderer space.
#include "camera.h"

namespace nmr {
namespace {

// A parameter of cameras and its gradient; None if it is not given. It has `size` numbers if there
// is one for all.
template <class P>
Parameter<P> read_parameter(Call& call, std::string_view text, int64_t size) {
  Parameter<P> parameter{};
  const Argument& values = call.read(text, parameter.values);
  parameter.each = parameter.values && values.count() != size;
  call.gradient(text.substr(0, text.find('?')), parameter.grad);
  return parameter;
}

}  // namespace

template <class T>
Project<T> read_project(Call& call, bool drawn) {
  Project<T> args{};
  const bool packed = call.has("starts");
  const int64_t* starts = nullptr;
  call.read("starts? [B + 1, 2]", starts);
  const auto& shape =
      call.read(packed ? "vertices [V, 3]" : "vertices [1|B, V, 3]", args.vertices).shape;
  args.vertex_rows = {call["V"], packed || shape[0] != 1, starts};
  args.cameras = call.read("camera [1|B, 22]", args.camera).shape[0];
  const Argument& distortion = call.read("distortion? [1|B, 4|5|8]", args.distortion.values);
  const char* points = packed ? "points [V, 3]" : "points [B, V, 3]";
  if (drawn) {
    call.read(points, args.points);
  } else {
    if (call.backward && !call.has("grad_points")) call.let("B", 1);  // if it is not known by now
    call.result(points, args.points, args.grad_points);
  }
  args.batch = call["B"];
  if (packed) require_starts(starts, args.batch, args.vertex_rows.size, starts[2 * args.batch + 1]);
  call.gradient("vertices", args.grad_vertices);
  call.let("n", args.cameras);
  args.perspective = call.flag("perspective");

  args.eye = read_parameter<double>(call, "eye? [3] or [1|n, 3]", 3);
  args.at = read_parameter<double>(call, "at? [3] or [1|n, 3]", 3);
  args.up = read_parameter<double>(call, "up? [3] or [1|n, 3]", 3);
  args.view = read_parameter<double>(call, "view? [] or [1|n]", 1);
  args.along = call.flag("along");
  args.right_handed = call.flag("right_handed");
  args.matrix = read_parameter<T>(call, "matrix? [1|n, 3, 4]", 12);
  args.intrinsics = read_parameter<T>(call, "intrinsics? [1|n, 2, 3]", 6);
  args.origin = read_parameter<T>(call, "origin? [1|n, 3]", 3);
  args.extent = read_parameter<T>(call, "extent? [1|n]", 1);
  args.across = static_cast<T>(call.number("across"));
  args.down = static_cast<T>(call.number("down"));
  const bool posed = call.has("eye") && call.has("at") && call.has("up") && call.has("view");
  require(posed || (!call.has("eye") && call.has("matrix") && call.has("intrinsics")),
          "a camera is a pose (eye, at, up, view), or has a matrix and intrinsics");

  call.gradient("distortion", args.distortion.grad);
  args.distortion.each = args.distortion.values && distortion.shape[0] == args.batch;
  args.coefficients = args.distortion.values ? distortion.shape[1] : 0;
  if (!drawn && call.backward) {
    call.read("grad_camera? [n, 22]", args.grad_camera);
    call.skip("nearest");
  } else if (!drawn) {
    call.read("nearest []", args.nearest);
  }
  args.num_threads = num_threads(call);
  return args;
}

template Project<float> read_project(Call& call, bool drawn);
template Project<double> read_project(Call& call, bool drawn);

void add_camera(Kernels& kernels) { NMR_ADD_STAGE(kernels, project); }

}  // namespace nmr
