// The soft silhouette.
#include "arrays.h"

namespace nmr {
namespace {

template <class T>
SoftSettings<T> soft_settings(const Array<T>& clear, int64_t batch, bool fill_back, double near, double far,
                              double sigma, double reach) {
  require(
      clear.ndim() == 3 && clear.shape(0) == batch && clear.shape(1) >= 1 && clear.shape(1) <= 16384 &&
          clear.shape(2) >= 1 && clear.shape(2) <= 16384,
      "clear must have shape [" + std::to_string(batch) + ", H, W] with H and W in 1..16384, got " + shape_of(clear));
  require(static_cast<T>(sigma) > 0 && reach >= 0, "sigma must be positive, and reach not negative");
  const RasterSettings<T> raster{
      {clear.shape(1), clear.shape(2)}, fill_back, static_cast<T>(near), static_cast<T>(far)};
  return {raster, static_cast<T>(sigma), static_cast<T>(reach)};
}

template <class T>
void soft_forward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                     Array<T>& clear, bool fill_back, double near, double far, double sigma, double reach,
                     int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  const SoftSettings<T> settings = soft_settings(clear, mesh.batch, fill_back, near, far, sigma, reach);
  const SoftForward<T> args{mesh, settings, clear.mutable_data(), num_threads};
  py::gil_scoped_release release;
  soft_forward(args);
}

template <class T>
void soft_backward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                      const Array<T>& clear, const Array<T>& grad_clear, Array<T>& grad_vertices, bool fill_back,
                      double near, double far, double sigma, double reach, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  const SoftSettings<T> settings = soft_settings(clear, mesh.batch, fill_back, near, far, sigma, reach);
  require_like(grad_clear, "grad_clear", clear);
  require_like(grad_vertices, "grad_vertices", vertices);
  const SoftBackward<T> args{mesh,       settings, clear.data(), grad_clear.data(), grad_vertices.mutable_data(),
                             num_threads};
  py::gil_scoped_release release;
  soft_backward(args);
}

template <class T>
void define_soft(py::module_& m) {
  m.def("soft_forward", &soft_forward_py<T>, array("vertices"), array("faces"), array("starts"), array("clear"),
        py::arg("fill_back"), py::arg("near"), py::arg("far"), py::arg("sigma"), py::arg("reach"),
        py::arg("num_threads"));
  m.def("soft_backward", &soft_backward_py<T>, array("vertices"), array("faces"), array("starts"), array("clear"),
        array("grad_clear"), array("grad_vertices"), py::arg("fill_back"), py::arg("near"), py::arg("far"),
        py::arg("sigma"), py::arg("reach"), py::arg("num_threads"));
}

}  // namespace

void bind_soft(py::module_& m) {
  define_soft<float>(m);
  define_soft<double>(m);
}

}  // namespace nmr
