// The rasterizer and the silhouette, with its two gradients.
#include "arrays.h"

namespace nmr {
namespace {

template <class T>
void rasterize_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                  Array<int32_t>& face_index, bool fill_back, double near, double far, bool perspective, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  require(face_index.ndim() == 3 && face_index.shape(0) == mesh.batch && face_index.shape(1) >= 1 &&
              face_index.shape(1) <= 16384 && face_index.shape(2) >= 1 && face_index.shape(2) <= 16384,
          "face_index must have shape [" + std::to_string(mesh.batch) + ", H, W] with H and W in 1..16384, got " +
              shape_of(face_index));
  const Size raster{face_index.shape(1), face_index.shape(2)};
  const Rasterize<T> args{
      mesh, {raster, fill_back, static_cast<T>(near), static_cast<T>(far), perspective}, face_index.mutable_data(),
      num_threads};
  py::gil_scoped_release release;
  rasterize(args);
}

template <class T>
void rasterize_layers_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                         Array<int32_t>& face_index, bool fill_back, double near, double far, bool perspective, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  require(face_index.ndim() == 4 && face_index.shape(0) == mesh.batch && face_index.shape(1) >= 1 &&
              face_index.shape(1) <= 16384 && face_index.shape(2) >= 1 && face_index.shape(2) <= 16384 &&
              face_index.shape(3) >= 1,
          "face_index must have shape [" + std::to_string(mesh.batch) + ", H, W, K] with H and W in 1..16384, got " +
              shape_of(face_index));
  const RasterSettings<T> settings{
      {face_index.shape(1), face_index.shape(2)}, fill_back, static_cast<T>(near), static_cast<T>(far), perspective};
  const RasterizeLayers<T> args{mesh, settings, face_index.shape(3), face_index.mutable_data(), num_threads};
  py::gil_scoped_release release;
  rasterize_layers(args);
}

template <class T>
void silhouette_forward_py(const Array<int32_t>& face_index, Array<T>& alpha, bool anti_aliasing, int num_threads) {
  require(alpha.ndim() == 3, "alpha must have shape [B, h, w], got " + shape_of(alpha));
  const Size image{alpha.shape(1), alpha.shape(2)}, raster = raster_of(image, anti_aliasing);
  require_shape(face_index, "face_index", {alpha.shape(0), raster.height, raster.width});
  const SilhouetteForward<T> args{face_index.data(), alpha.shape(0),       image,
                                  anti_aliasing,     alpha.mutable_data(), num_threads};
  py::gil_scoped_release release;
  silhouette_forward(args);
}

template <class T, void backward(const SilhouetteBackward<T>&)>
void silhouette_backward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                            const Array<int32_t>& face_index, const Array<T>& grad_alpha, Array<T>& grad_vertices,
                            bool anti_aliasing, double eps, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  const Size image = require_image(face_index, require_face_index(face_index, mesh, num_threads), anti_aliasing);
  require_shape(grad_alpha, "grad_alpha", {mesh.batch, image.height, image.width});
  require_like(grad_vertices, "grad_vertices", vertices);
  const SilhouetteBackward<T> args{mesh,
                                   image,
                                   anti_aliasing,
                                   static_cast<T>(eps),
                                   face_index.data(),
                                   grad_alpha.data(),
                                   grad_vertices.mutable_data(),
                                   num_threads};
  py::gil_scoped_release release;
  backward(args);
}

template <class T>
void define_raster(py::module_& m) {
  m.def("rasterize", &rasterize_py<T>, array("vertices"), array("faces"), array("starts"), array("face_index"),
        py::arg("fill_back"), py::arg("near"), py::arg("far"), py::arg("perspective"), py::arg("num_threads"));
  m.def("rasterize_layers", &rasterize_layers_py<T>, array("vertices"), array("faces"), array("starts"),
        array("face_index"), py::arg("fill_back"), py::arg("near"), py::arg("far"), py::arg("perspective"), py::arg("num_threads"));
  m.def("silhouette_forward", &silhouette_forward_py<T>, array("face_index"), array("alpha"), py::arg("anti_aliasing"),
        py::arg("num_threads"));
  const auto define_backward = [&m](const char* name, auto* function) {
    m.def(name, function, array("vertices"), array("faces"), array("starts"), array("face_index"), array("grad_alpha"),
          array("grad_vertices"), py::arg("anti_aliasing"), py::arg("eps"), py::arg("num_threads"));
  };
  define_backward("silhouette_backward", &silhouette_backward_py<T, silhouette_backward<T>>);
  define_backward("local_gradient", &silhouette_backward_py<T, local_gradient<T>>);
}

}  // namespace

void bind_raster(py::module_& m) {
  define_raster<float>(m);
  define_raster<double>(m);
}

}  // namespace nmr
