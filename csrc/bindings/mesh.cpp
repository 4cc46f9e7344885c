// Losses, and voxels.
#include "arrays.h"

namespace nmr {
namespace {

template <class T>
Smoothness<T> smoothness_args(const Array<T>& vertices, const Array<int64_t>& edges, int num_threads) {
  require(vertices.ndim() == 3 && vertices.shape(2) == 3,
          "vertices must have shape [B, V, 3], got " + shape_of(vertices));
  require(edges.ndim() == 2 && edges.shape(1) == 4, "edges must have shape [E, 4], got " + shape_of(edges));
  Smoothness<T> args{vertices.data(), edges.data(), vertices.shape(0), vertices.shape(1), edges.shape(0),
                     nullptr,         nullptr,      nullptr,           num_threads};
  const py::gil_scoped_release release;
  require_indices(edges.data(), edges.size(), args.num_vertices, "edges", "vertex", "vertices");
  return args;
}

template <class T>
void smoothness_forward_py(const Array<T>& vertices, const Array<int64_t>& edges, Array<T>& loss, int num_threads) {
  Smoothness<T> args = smoothness_args(vertices, edges, num_threads);
  require_shape(loss, "loss", {args.batch});
  args.loss = loss.mutable_data();
  py::gil_scoped_release release;
  smoothness_forward(args);
}

template <class T>
void smoothness_backward_py(const Array<T>& vertices, const Array<int64_t>& edges, const Array<T>& grad_loss,
                            Array<T>& grad_vertices, int num_threads) {
  Smoothness<T> args = smoothness_args(vertices, edges, num_threads);
  require_shape(grad_loss, "grad_loss", {args.batch});
  require_shape(grad_vertices, "grad_vertices", {args.batch, args.num_vertices, 3});
  args.grad_loss = grad_loss.data();
  args.grad_vertices = grad_vertices.mutable_data();
  py::gil_scoped_release release;
  smoothness_backward(args);
}

template <class T>
SoftIou<T> soft_iou_args(const Array<T>& prediction, const Array<T>& target, Array<double>& areas, int num_threads) {
  require(prediction.ndim() == 2, "prediction must have shape [B, N], got " + shape_of(prediction));
  require_like(target, "target", prediction);
  require_shape(areas, "areas", {prediction.shape(0), 2});
  return {prediction.data(),
          target.data(),
          prediction.shape(0),
          prediction.shape(1),
          areas.mutable_data(),
          nullptr,
          nullptr,
          nullptr,
          nullptr,
          num_threads};
}

template <class T>
void soft_iou_forward_py(const Array<T>& prediction, const Array<T>& target, Array<double>& areas, Array<T>& iou,
                         int num_threads) {
  SoftIou<T> args = soft_iou_args(prediction, target, areas, num_threads);
  require_shape(iou, "iou", {args.batch});
  args.iou = iou.mutable_data();
  py::gil_scoped_release release;
  soft_iou_forward(args);
}

template <class T>
void soft_iou_backward_py(const Array<T>& prediction, const Array<T>& target, Array<double>& areas,
                          const Array<T>& grad_iou, std::optional<Array<T>> grad_prediction,
                          std::optional<Array<T>> grad_target, int num_threads) {
  SoftIou<T> args = soft_iou_args(prediction, target, areas, num_threads);
  require_shape(grad_iou, "grad_iou", {args.batch});
  args.grad_iou = grad_iou.data();
  args.grad_prediction = optional_out(grad_prediction, "grad_prediction", {args.batch, args.count});
  args.grad_target = optional_out(grad_target, "grad_target", {args.batch, args.count});
  py::gil_scoped_release release;
  soft_iou_backward(args);
}

void voxelize_py(const Array<float>& vertices, const Indices& faces, Array<bool>& voxels, int64_t size, bool touched,
                 int num_threads) {
  const MeshBatch<float> mesh = mesh_batch(vertices, faces, std::nullopt);
  require(size >= 1 && size <= 1024, "size must lie in 1..1024, got " + std::to_string(size));
  require_shape(voxels, "voxels", {mesh.batch, size, size, size});
  const Voxelize args{mesh, size, touched, voxels.mutable_data(), num_threads};
  py::gil_scoped_release release;
  voxelize(args);
}

template <class T>
void define_losses(py::module_& m) {
  m.def("smoothness_forward", &smoothness_forward_py<T>, array("vertices"), array("edges"), array("loss"),
        py::arg("num_threads"));
  m.def("smoothness_backward", &smoothness_backward_py<T>, array("vertices"), array("edges"), array("grad_loss"),
        array("grad_vertices"), py::arg("num_threads"));
  m.def("soft_iou_forward", &soft_iou_forward_py<T>, array("prediction"), array("target"), array("areas"), array("iou"),
        py::arg("num_threads"));
  m.def("soft_iou_backward", &soft_iou_backward_py<T>, array("prediction"), array("target"), array("areas"),
        array("grad_iou"), array("grad_prediction"), array("grad_target"), py::arg("num_threads"));
}

}  // namespace

void bind_mesh(py::module_& m) {
  define_losses<float>(m);
  define_losses<double>(m);
  m.def("voxelize", &voxelize_py, array("vertices"), array("faces"), array("voxels"), py::arg("size"),
        py::arg("touched"), py::arg("num_threads"));
}

}  // namespace nmr
