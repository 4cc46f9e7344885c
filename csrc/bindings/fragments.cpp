// Fragments and depth images of a face index map.
#include "arrays.h"

namespace nmr {
namespace {

template <class T>
Fragments<T> fragments_args(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                            const Array<int32_t>& face_index, double far, bool perspective, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  const Size raster = require_face_index(face_index, mesh, num_threads);
  return {mesh,    raster,  static_cast<T>(far), face_index.data(), nullptr, nullptr, nullptr,
          nullptr, nullptr, num_threads, perspective};
}

template <class T>
void fragments_forward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                          const Array<int32_t>& face_index, Array<T>& weights, Array<T>& depth, double far,
                          bool perspective, int num_threads) {
  Fragments<T> args = fragments_args(vertices, faces, starts, face_index, far, perspective, num_threads);
  require_shape(weights, "weights", {args.mesh.batch, args.raster.height, args.raster.width, 3});
  require_shape(depth, "depth", {args.mesh.batch, args.raster.height, args.raster.width});
  args.weights = weights.mutable_data();
  args.depth = depth.mutable_data();
  py::gil_scoped_release release;
  fragments_forward(args);
}

template <class T>
void fragments_backward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                           const Array<int32_t>& face_index, const std::optional<Array<T>>& grad_weights,
                           const std::optional<Array<T>>& grad_depth, Array<T>& grad_vertices, bool perspective,
                           int num_threads) {
  Fragments<T> args = fragments_args(vertices, faces, starts, face_index, 0, perspective, num_threads);
  if (grad_weights) {
    require_shape(*grad_weights, "grad_weights", {args.mesh.batch, args.raster.height, args.raster.width, 3});
    args.grad_weights = grad_weights->data();
  }
  if (grad_depth) {
    require_shape(*grad_depth, "grad_depth", {args.mesh.batch, args.raster.height, args.raster.width});
    args.grad_depth = grad_depth->data();
  }
  require_like(grad_vertices, "grad_vertices", vertices);
  args.grad_vertices = grad_vertices.mutable_data();
  py::gil_scoped_release release;
  fragments_backward(args);
}

template <class T>
DepthImage<T> depth_args(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                         const Array<int32_t>& face_index, bool anti_aliasing, double far, bool perspective,
                         int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  const Size image = require_image(face_index, require_face_index(face_index, mesh, num_threads), anti_aliasing);
  return {mesh, image, anti_aliasing, static_cast<T>(far), face_index.data(), nullptr, nullptr, nullptr, num_threads,
          perspective};
}

template <class T>
void depth_forward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                      const Array<int32_t>& face_index, Array<T>& depth, bool anti_aliasing, double far,
                      bool perspective, int num_threads) {
  DepthImage<T> args = depth_args(vertices, faces, starts, face_index, anti_aliasing, far, perspective, num_threads);
  require_shape(depth, "depth", {args.mesh.batch, args.image.height, args.image.width});
  args.depth = depth.mutable_data();
  py::gil_scoped_release release;
  depth_forward(args);
}

template <class T>
void depth_backward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                       const Array<int32_t>& face_index, const Array<T>& grad_depth, Array<T>& grad_vertices,
                       bool anti_aliasing, bool perspective, int num_threads) {
  DepthImage<T> args = depth_args(vertices, faces, starts, face_index, anti_aliasing, 0, perspective, num_threads);
  require_shape(grad_depth, "grad_depth", {args.mesh.batch, args.image.height, args.image.width});
  require_like(grad_vertices, "grad_vertices", vertices);
  args.grad_depth = grad_depth.data();
  args.grad_vertices = grad_vertices.mutable_data();
  py::gil_scoped_release release;
  depth_backward(args);
}

template <class T>
void define_fragments(py::module_& m) {
  m.def("fragments_forward", &fragments_forward_py<T>, array("vertices"), array("faces"), array("starts"),
        array("face_index"), array("weights"), array("depth"), py::arg("far"), py::arg("perspective"), py::arg("num_threads"));
  m.def("fragments_backward", &fragments_backward_py<T>, array("vertices"), array("faces"), array("starts"),
        array("face_index"), array("grad_weights"), array("grad_depth"), array("grad_vertices"),
        py::arg("perspective"), py::arg("num_threads"));
  m.def("depth_forward", &depth_forward_py<T>, array("vertices"), array("faces"), array("starts"), array("face_index"),
        array("depth"), py::arg("anti_aliasing"), py::arg("far"), py::arg("perspective"), py::arg("num_threads"));
  m.def("depth_backward", &depth_backward_py<T>, array("vertices"), array("faces"), array("starts"),
        array("face_index"), array("grad_depth"), array("grad_vertices"), py::arg("anti_aliasing"),
        py::arg("perspective"), py::arg("num_threads"));
}

}  // namespace

void bind_fragments(py::module_& m) {
  define_fragments<float>(m);
  define_fragments<double>(m);
}

}  // namespace nmr
