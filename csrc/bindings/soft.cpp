// The soft silhouette, and the faces around each pixel.
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
                      const Array<T>& clear, const Array<T>& grad_clear, Array<T>& grad_vertices, Array<T>& grad_sigma,
                      bool fill_back, double near, double far, double sigma, double reach, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  const SoftSettings<T> settings = soft_settings(clear, mesh.batch, fill_back, near, far, sigma, reach);
  require_like(grad_clear, "grad_clear", clear);
  require_like(grad_vertices, "grad_vertices", vertices);
  require_shape(grad_sigma, "grad_sigma", {mesh.batch});
  const SoftBackward<T> args{mesh, settings, clear.data(), grad_clear.data(), grad_vertices.mutable_data(),
                             grad_sigma.mutable_data(), num_threads};
  py::gil_scoped_release release;
  soft_backward(args);
}

// The raster and K of a table of faces [B, H, W, K].
inline Size require_table(const Array<int32_t>& face_index, int64_t batch) {
  require(face_index.ndim() == 4 && face_index.shape(0) == batch && face_index.shape(1) >= 1 &&
              face_index.shape(1) <= 16384 && face_index.shape(2) >= 1 && face_index.shape(2) <= 16384 &&
              face_index.shape(3) >= 1 && face_index.shape(3) <= 1024,
          "face_index must have shape [" + std::to_string(batch) + ", H, W, K] with H and W in 1..16384 and K in "
          "1..1024, got " + shape_of(face_index));
  return {face_index.shape(1), face_index.shape(2)};
}

template <class T>
void soft_layers_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                    Array<int32_t>& face_index, bool fill_back, double near, double far, bool perspective, double reach,
                    int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  const Size raster = require_table(face_index, mesh.batch);
  require(reach >= 0, "reach must not be negative");
  const RasterSettings<T> settings{raster, fill_back, static_cast<T>(near), static_cast<T>(far), perspective};
  const SoftLayers<T> args{mesh, {settings, 1, static_cast<T>(reach)}, face_index.shape(3), face_index.mutable_data(),
                           num_threads};
  py::gil_scoped_release release;
  soft_layers(args);
}

template <class T>
SoftFragments<T> soft_fragments_args(const Array<T>& vertices, const Indices& faces,
                                     const std::optional<Indices>& starts, const Array<int32_t>& face_index,
                                     bool perspective, int num_threads) {
  SoftFragments<T> args{};
  args.mesh = mesh_batch(vertices, faces, starts);
  args.raster = require_table(face_index, args.mesh.batch);
  args.layers = face_index.shape(3);
  const int64_t entries = args.raster.pixels() * args.layers;
  for (int64_t b = 0; b < args.mesh.batch; ++b)
    require(are_face_indices(face_index.data() + b * entries, entries, args.mesh.face_count(b)),
            "the face indices do not belong to these faces");
  args.perspective = perspective;
  args.face_index = face_index.data();
  args.num_threads = num_threads;
  return args;
}

template <class T>
void soft_fragments_forward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                               const Array<int32_t>& face_index, Array<T>& weights, Array<T>& depth,
                               Array<T>& distances, double far, bool perspective, int num_threads) {
  SoftFragments<T> args = soft_fragments_args(vertices, faces, starts, face_index, perspective, num_threads);
  require_shape(weights, "weights", {args.mesh.batch, args.raster.height, args.raster.width, args.layers, 3});
  require_like(depth, "depth", face_index);
  require_like(distances, "distances", face_index);
  args.far = static_cast<T>(far);
  args.weights = weights.mutable_data();
  args.depth = depth.mutable_data();
  args.distances = distances.mutable_data();
  py::gil_scoped_release release;
  soft_fragments_forward(args);
}

template <class T>
void soft_fragments_backward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                                const Array<int32_t>& face_index, const Array<T>& grad_weights,
                                const Array<T>& grad_depth, const Array<T>& grad_distances, Array<T>& grad_vertices,
                                bool perspective, int num_threads) {
  SoftFragments<T> args = soft_fragments_args(vertices, faces, starts, face_index, perspective, num_threads);
  require_shape(grad_weights, "grad_weights", {args.mesh.batch, args.raster.height, args.raster.width, args.layers, 3});
  require_like(grad_depth, "grad_depth", face_index);
  require_like(grad_distances, "grad_distances", face_index);
  require_like(grad_vertices, "grad_vertices", vertices);
  args.grad_weights = grad_weights.data();
  args.grad_depth = grad_depth.data();
  args.grad_distances = grad_distances.data();
  args.grad_vertices = grad_vertices.mutable_data();
  py::gil_scoped_release release;
  soft_fragments_backward(args);
}

template <class T>
void define_soft(py::module_& m) {
  m.def("soft_forward", &soft_forward_py<T>, array("vertices"), array("faces"), array("starts"), array("clear"),
        py::arg("fill_back"), py::arg("near"), py::arg("far"), py::arg("sigma"), py::arg("reach"),
        py::arg("num_threads"));
  m.def("soft_backward", &soft_backward_py<T>, array("vertices"), array("faces"), array("starts"), array("clear"),
        array("grad_clear"), array("grad_vertices"), array("grad_sigma"), py::arg("fill_back"), py::arg("near"),
        py::arg("far"), py::arg("sigma"), py::arg("reach"), py::arg("num_threads"));
  m.def("soft_layers", &soft_layers_py<T>, array("vertices"), array("faces"), array("starts"), array("face_index"),
        py::arg("fill_back"), py::arg("near"), py::arg("far"), py::arg("perspective"), py::arg("reach"),
        py::arg("num_threads"));
  m.def("soft_fragments_forward", &soft_fragments_forward_py<T>, array("vertices"), array("faces"), array("starts"),
        array("face_index"), array("weights"), array("depth"), array("distances"), py::arg("far"),
        py::arg("perspective"), py::arg("num_threads"));
  m.def("soft_fragments_backward", &soft_fragments_backward_py<T>, array("vertices"), array("faces"), array("starts"),
        array("face_index"), array("grad_weights"), array("grad_depth"), array("grad_distances"),
        array("grad_vertices"), py::arg("perspective"), py::arg("num_threads"));
}

}  // namespace

void bind_soft(py::module_& m) {
  define_soft<float>(m);
  define_soft<double>(m);
}

}  // namespace nmr
