// Cameras: their poses, and the projection of vertices.
#include "arrays.h"

namespace nmr {
namespace {

template <class T>
Pose<T> pose_args(const Array<T>& forward, const Array<T>& up) {
  require(forward.ndim() == 2 && forward.shape(1) == 3, "forward must have shape [B, 3], got " + shape_of(forward));
  require_like(up, "up", forward);
  Pose<T> args{};
  args.forward = forward.data();
  args.up = up.data();
  args.batch = forward.shape(0);
  return args;
}

template <class T>
void pose_forward_py(const Array<T>& forward, const Array<T>& up, Array<T>& matrix) {
  Pose<T> args = pose_args(forward, up);
  require_shape(matrix, "matrix", {args.batch, 3, 4});
  args.matrix = matrix.mutable_data();
  pose_forward(args);
}

template <class T>
void pose_backward_py(const Array<T>& forward, const Array<T>& up, const Array<T>& grad_matrix, Array<T>& grad_forward,
                      Array<T>& grad_up) {
  Pose<T> args = pose_args(forward, up);
  require_shape(grad_matrix, "grad_matrix", {args.batch, 3, 4});
  require_like(grad_forward, "grad_forward", forward);
  require_like(grad_up, "grad_up", up);
  args.grad_matrix = grad_matrix.data();
  args.grad_forward = grad_forward.mutable_data();
  args.grad_up = grad_up.mutable_data();
  pose_backward(args);
}

template <class T>
using Optional = std::optional<Array<T>>;

template <class T>
Project<T> project_args(const Array<T>& vertices, const Array<T>& matrix, const Array<T>& intrinsics,
                        const Optional<T>& distortion, const Optional<T>& origin, const Optional<T>& extent,
                        const std::optional<Indices>& starts, bool perspective, int num_threads) {
  Project<T> args{};
  require(matrix.ndim() == 3 && matrix.shape(1) == 3 && matrix.shape(2) == 4,
          "matrix must have shape [B, 3, 4], got " + shape_of(matrix));
  args.batch = matrix.shape(0);
  require_shape(intrinsics, "intrinsics", {args.batch, 2, 3});
  if (distortion) {
    require(distortion->ndim() == 2 && distortion->shape(0) == args.batch &&
                (distortion->shape(1) == 4 || distortion->shape(1) == 5 || distortion->shape(1) == 8),
            "distortion must have shape [" + std::to_string(args.batch) + ", 4, 5 or 8], got " + shape_of(*distortion));
    args.coefficients = distortion->shape(1);
  }
  if (origin) require_shape(*origin, "origin", {args.batch, 3});
  if (extent) require_shape(*extent, "extent", {args.batch});
  if (starts) {
    require(vertices.ndim() == 2 && vertices.shape(1) == 3,
            "packed vertices must have shape [N, 3], got " + shape_of(vertices));
    require_starts(*starts, vertices.shape(0), starts->size() ? starts->data()[starts->size() - 1] : 0);
    require(starts->shape(0) - 1 == args.batch, "starts are those of " + std::to_string(starts->shape(0) - 1) +
                                                    " meshes, but matrix has shape " + shape_of(matrix));
    args.starts = starts->data();
    args.num_vertices = vertices.shape(0);
  } else {
    require(
        vertices.ndim() == 3 && vertices.shape(2) == 3 && (vertices.shape(0) == 1 || vertices.shape(0) == args.batch),
        "vertices must have shape [1, V, 3] or [B, V, 3] with the B of matrix " + shape_of(matrix) + ", got " +
            shape_of(vertices));
    args.vertex_batch = vertices.shape(0);
    args.num_vertices = vertices.shape(1);
  }
  args.vertices = vertices.data();
  args.matrix = matrix.data();
  args.intrinsics = intrinsics.data();
  args.distortion = distortion ? distortion->data() : nullptr;
  args.origin = origin ? origin->data() : nullptr;
  args.extent = extent ? extent->data() : nullptr;
  args.perspective = perspective;
  args.num_threads = num_threads;
  return args;
}

template <class T>
void require_points(const Array<T>& points, const char* name, const Project<T>& args) {
  if (args.starts)
    require_shape(points, name, {args.num_vertices, 3});
  else
    require_shape(points, name, {args.batch, args.num_vertices, 3});
}

template <class T>
void project_forward_py(const Array<T>& vertices, const Array<T>& matrix, const Array<T>& intrinsics,
                        const Optional<T>& distortion, const Optional<T>& origin, const Optional<T>& extent,
                        const std::optional<Indices>& starts, Array<T>& points, bool perspective, int num_threads) {
  Project<T> args =
      project_args(vertices, matrix, intrinsics, distortion, origin, extent, starts, perspective, num_threads);
  require_points(points, "points", args);
  args.points = points.mutable_data();
  py::gil_scoped_release release;
  project_forward(args);
}

template <class T>
void project_backward_py(const Array<T>& vertices, const Array<T>& matrix, const Array<T>& intrinsics,
                         const Optional<T>& distortion, const Optional<T>& origin, const Optional<T>& extent,
                         const std::optional<Indices>& starts, const Array<T>& grad_points, Optional<T> grad_vertices,
                         Optional<T> grad_matrix, Optional<T> grad_intrinsics, Optional<T> grad_distortion,
                         Optional<T> grad_origin, Optional<T> grad_extent, bool perspective, int num_threads) {
  Project<T> args =
      project_args(vertices, matrix, intrinsics, distortion, origin, extent, starts, perspective, num_threads);
  require_points(grad_points, "grad_points", args);
  args.grad_points = grad_points.data();
  args.grad_vertices = optional_like(grad_vertices, "grad_vertices", vertices);
  args.grad_matrix = optional_out(grad_matrix, "grad_matrix", {args.batch, 3, 4});
  args.grad_intrinsics = optional_out(grad_intrinsics, "grad_intrinsics", {args.batch, 2, 3});
  args.grad_distortion = optional_out(grad_distortion, "grad_distortion", {args.batch, args.coefficients});
  args.grad_origin = optional_out(grad_origin, "grad_origin", {args.batch, 3});
  args.grad_extent = optional_out(grad_extent, "grad_extent", {args.batch});
  py::gil_scoped_release release;
  project_backward(args);
}

template <class T>
void define_camera(py::module_& m) {
  m.def("pose_forward", &pose_forward_py<T>, array("forward"), array("up"), array("matrix"));
  m.def("pose_backward", &pose_backward_py<T>, array("forward"), array("up"), array("grad_matrix"),
        array("grad_forward"), array("grad_up"));
  m.def("project_forward", &project_forward_py<T>, array("vertices"), array("matrix"), array("intrinsics"),
        array("distortion"), array("origin"), array("extent"), array("starts"), array("points"), py::arg("perspective"),
        py::arg("num_threads"));
  m.def("project_backward", &project_backward_py<T>, array("vertices"), array("matrix"), array("intrinsics"),
        array("distortion"), array("origin"), array("extent"), array("starts"), array("grad_points"),
        array("grad_vertices"), array("grad_matrix"), array("grad_intrinsics"), array("grad_distortion"),
        array("grad_origin"), array("grad_extent"), py::arg("perspective"), py::arg("num_threads"));
}

}  // namespace

void bind_camera(py::module_& m) {
  define_camera<float>(m);
  define_camera<double>(m);
}

}  // namespace nmr
