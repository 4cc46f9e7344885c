// Images of any channels: the mean of 2x2 pixels, and NMR's gradient.
#include "arrays.h"

namespace nmr {
namespace {

// `pixels` is [B, H, W, C], `resolved` [B, h, w, C].
template <class T>
Resolve<T> resolve_args(const Array<T>& pixels, const Array<T>& resolved, bool anti_aliasing, int num_threads) {
  require(resolved.ndim() == 4, "a resolved image must have shape [B, h, w, C], got " + shape_of(resolved));
  const int64_t batch = resolved.shape(0), channels = resolved.shape(3);
  const Size image{resolved.shape(1), resolved.shape(2)}, raster = raster_of(image, anti_aliasing);
  require(image.height >= 1 && image.width >= 1 && channels >= 1, "an image must have pixels and channels, got " + shape_of(resolved));
  require_shape(pixels, "image", {batch, raster.height, raster.width, channels});
  return {batch, image, anti_aliasing, channels, nullptr, nullptr, nullptr, nullptr, num_threads};
}

template <class T>
void resolve_forward_py(const Array<T>& image, Array<T>& resolved, bool anti_aliasing, int num_threads) {
  Resolve<T> args = resolve_args(image, resolved, anti_aliasing, num_threads);
  args.pixels = image.data();
  args.resolved = resolved.mutable_data();
  py::gil_scoped_release release;
  resolve_forward(args);
}

template <class T>
void resolve_backward_py(const Array<T>& grad_resolved, Array<T>& grad_image, bool anti_aliasing, int num_threads) {
  Resolve<T> args = resolve_args(grad_image, grad_resolved, anti_aliasing, num_threads);
  args.grad_resolved = grad_resolved.data();
  args.grad_pixels = grad_image.mutable_data();
  py::gil_scoped_release release;
  resolve_backward(args);
}

template <class T>
void edges_backward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                       const Array<int32_t>& owner, const Array<T>& image, const Array<T>& grad_image, Array<T>& grad_vertices,
                       double eps, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  const Size raster = require_owner(owner, mesh, num_threads);
  require(image.ndim() == 4 && image.shape(3) >= 1, "image must have shape [B, H, W, C], got " + shape_of(image));
  require_shape(image, "image", {mesh.batch, raster.height, raster.width, image.shape(3)});
  require_like(grad_image, "grad_image", image);
  require_like(grad_vertices, "grad_vertices", vertices);
  const EdgesBackward<T> args{mesh, raster, static_cast<T>(eps), owner.data(), image.data(), image.shape(3), grad_image.data(),
                              grad_vertices.mutable_data(), num_threads};
  py::gil_scoped_release release;
  edges_backward(args);
}

template <class T>
void define_edges(py::module_& m) {
  m.def("resolve_forward", &resolve_forward_py<T>, py::arg("image").noconvert(), py::arg("resolved").noconvert(),
        py::arg("anti_aliasing"), py::arg("num_threads"));
  m.def("resolve_backward", &resolve_backward_py<T>, py::arg("grad_resolved").noconvert(), py::arg("grad_image").noconvert(),
        py::arg("anti_aliasing"), py::arg("num_threads"));
  m.def("edges_backward", &edges_backward_py<T>, py::arg("vertices").noconvert(), py::arg("faces").noconvert(),
        py::arg("starts").noconvert(), py::arg("owner").noconvert(), py::arg("image").noconvert(),
        py::arg("grad_image").noconvert(), py::arg("grad_vertices").noconvert(), py::arg("eps"), py::arg("num_threads"));
}

}  // namespace

void bind_edges(py::module_& m) {
  define_edges<float>(m);
  define_edges<double>(m);
}

}  // namespace nmr
