// The rasterizer and the silhouette, with its two gradients.
#include "arrays.h"

namespace nmr {
namespace {

template <class T>
void rasterize_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                  Array<int32_t>& owner, bool fill_back, double near, double far, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  require(owner.ndim() == 3 && owner.shape(0) == mesh.batch && owner.shape(1) >= 1 && owner.shape(1) <= 16384 &&
              owner.shape(2) >= 1 && owner.shape(2) <= 16384,
          "owner must have shape [" + std::to_string(mesh.batch) + ", H, W] with H and W in 1..16384, got " +
              shape_of(owner));
  const Size raster{owner.shape(1), owner.shape(2)};
  const Rasterize<T> args{
      mesh, {raster, fill_back, static_cast<T>(near), static_cast<T>(far)}, owner.mutable_data(), num_threads};
  py::gil_scoped_release release;
  rasterize(args);
}

template <class T>
void rasterize_layers_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                         Array<int32_t>& owner, bool fill_back, double near, double far, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  require(owner.ndim() == 4 && owner.shape(0) == mesh.batch && owner.shape(1) >= 1 && owner.shape(1) <= 16384 &&
              owner.shape(2) >= 1 && owner.shape(2) <= 16384 && owner.shape(3) >= 1,
          "owner must have shape [" + std::to_string(mesh.batch) + ", H, W, K] with H and W in 1..16384, got " +
              shape_of(owner));
  const RasterSettings<T> settings{
      {owner.shape(1), owner.shape(2)}, fill_back, static_cast<T>(near), static_cast<T>(far)};
  const RasterizeLayers<T> args{mesh, settings, owner.shape(3), owner.mutable_data(), num_threads};
  py::gil_scoped_release release;
  rasterize_layers(args);
}

template <class T>
void silhouette_forward_py(const Array<int32_t>& owner, Array<T>& alpha, bool anti_aliasing, int num_threads) {
  require(alpha.ndim() == 3, "alpha must have shape [B, h, w], got " + shape_of(alpha));
  const Size image{alpha.shape(1), alpha.shape(2)}, raster = raster_of(image, anti_aliasing);
  require_shape(owner, "owner", {alpha.shape(0), raster.height, raster.width});
  const SilhouetteForward<T> args{owner.data(),  alpha.shape(0),       image,
                                  anti_aliasing, alpha.mutable_data(), num_threads};
  py::gil_scoped_release release;
  silhouette_forward(args);
}

template <class T, void backward(const SilhouetteBackward<T>&)>
void silhouette_backward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                            const Array<int32_t>& owner, const Array<T>& grad_alpha, Array<T>& grad_vertices,
                            bool anti_aliasing, double eps, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  const Size image = require_image(owner, require_owner(owner, mesh, num_threads), anti_aliasing);
  require_shape(grad_alpha, "grad_alpha", {mesh.batch, image.height, image.width});
  require_like(grad_vertices, "grad_vertices", vertices);
  const SilhouetteBackward<T> args{mesh, image, anti_aliasing, static_cast<T>(eps), owner.data(), grad_alpha.data(),
                                   grad_vertices.mutable_data(), num_threads};
  py::gil_scoped_release release;
  backward(args);
}

template <class T>
void define_raster(py::module_& m) {
  m.def("rasterize", &rasterize_py<T>, array("vertices"), array("faces"), array("starts"), array("owner"),
        py::arg("fill_back"), py::arg("near"), py::arg("far"), py::arg("num_threads"));
  m.def("rasterize_layers", &rasterize_layers_py<T>, array("vertices"), array("faces"), array("starts"), array("owner"),
        py::arg("fill_back"), py::arg("near"), py::arg("far"), py::arg("num_threads"));
  m.def("silhouette_forward", &silhouette_forward_py<T>, array("owner"), array("alpha"), py::arg("anti_aliasing"),
        py::arg("num_threads"));
  const auto define_backward = [&m](const char* name, auto* function) {
    m.def(name, function, array("vertices"), array("faces"), array("starts"), array("owner"), array("grad_alpha"),
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
