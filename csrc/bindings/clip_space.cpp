// Meshes in clip space: weights with their derivatives on the screen, silhouette edges.
#include "arrays.h"

namespace nmr {
namespace {

template <class T>
ClipMesh<T> clip_mesh(const Array<T>& positions, const Indices& faces, const Array<int32_t>& face_index,
                      int num_threads) {
  require(positions.ndim() == 3 && positions.shape(2) == 4,
          "positions must have shape [B or 1, V, 4], got " + shape_of(positions));
  require(faces.ndim() == 2 && faces.shape(1) == 3, "faces must have shape [F, 3], got " + shape_of(faces));
  const int64_t batch = face_index.ndim() == 3 ? face_index.shape(0) : 0, F = faces.shape(0), V = positions.shape(1);
  const Size raster = require_face_index(face_index, batch, [&](int64_t) { return F; }, num_threads);
  require(positions.shape(0) == 1 || positions.shape(0) == batch,
          "positions must have the batch size " + std::to_string(batch) + " or 1, got " + shape_of(positions));
  const py::gil_scoped_release release;
  require_indices(faces.data(), faces.size(), V, "faces", "vertex", "vertices");
  return {positions.data(), positions.shape(0), V, faces.data(), F, face_index.data(), batch, raster, num_threads};
}

template <class T>
void require_pixels(const Array<T>& array, const char* name, const ClipMesh<T>& mesh, int64_t channels) {
  require_shape(array, name, {mesh.batch, mesh.raster.height, mesh.raster.width, channels});
}

template <class T>
void clip_weights_forward_py(const Array<T>& positions, const Indices& faces, const Array<int32_t>& face_index,
                             Array<T>& rast, Array<T>& slopes, int num_threads) {
  ClipWeights<T> args{};
  args.mesh = clip_mesh(positions, faces, face_index, num_threads);
  require_pixels(rast, "rast", args.mesh, 4);
  require_pixels(slopes, "slopes", args.mesh, 4);
  args.rast = rast.mutable_data();
  args.slopes = slopes.mutable_data();
  py::gil_scoped_release release;
  clip_weights_forward(args);
}

template <class T>
void clip_weights_backward_py(const Array<T>& positions, const Indices& faces, const Array<int32_t>& face_index,
                              const Array<T>& grad_rast, const std::optional<Array<T>>& grad_slopes,
                              Array<T>& grad_positions, int num_threads) {
  ClipWeights<T> args{};
  args.mesh = clip_mesh(positions, faces, face_index, num_threads);
  require_pixels(grad_rast, "grad_rast", args.mesh, 4);
  if (grad_slopes) require_pixels(*grad_slopes, "grad_slopes", args.mesh, 4);
  require_like(grad_positions, "grad_positions", positions);
  args.grad_rast = grad_rast.data();
  args.grad_slopes = grad_slopes ? grad_slopes->data() : nullptr;
  args.grad_positions = grad_positions.mutable_data();
  py::gil_scoped_release release;
  clip_weights_backward(args);
}

// --- antialias

template <class T>
Antialias<T> antialias_args(const Array<T>& colors, const Array<T>& rast, const Array<T>& positions,
                            const Indices& faces, const Array<int32_t>& face_index, const Indices& twins,
                            int num_threads) {
  Antialias<T> args{};
  args.mesh = clip_mesh(positions, faces, face_index, num_threads);
  require_pixels(rast, "rast", args.mesh, 4);
  args.channels = colors.ndim() == 4 ? colors.shape(3) : 0;
  require_pixels(colors, "colors", args.mesh, args.channels);
  require_like(twins, "twins", faces);
  require(are_indices(twins.data(), twins.size(), faces.size()), "twins must number the edges of the faces");
  args.rast = rast.data();
  args.twins = twins.data();
  args.colors = colors.data();
  return args;
}

template <class T>
void antialias_forward_py(const Array<T>& colors, const Array<T>& rast, const Array<T>& positions, const Indices& faces,
                          const Array<int32_t>& face_index, const Indices& twins, Array<T>& blended, int num_threads) {
  Antialias<T> args = antialias_args(colors, rast, positions, faces, face_index, twins, num_threads);
  require_like(blended, "blended", colors);
  args.blended = blended.mutable_data();
  py::gil_scoped_release release;
  antialias_forward(args);
}

template <class T>
void antialias_backward_py(const Array<T>& colors, const Array<T>& rast, const Array<T>& positions,
                           const Indices& faces, const Array<int32_t>& face_index, const Indices& twins,
                           const Array<T>& grad_blended, std::optional<Array<T>> grad_colors,
                           std::optional<Array<T>> grad_positions, int num_threads) {
  Antialias<T> args = antialias_args(colors, rast, positions, faces, face_index, twins, num_threads);
  require_like(grad_blended, "grad_blended", colors);
  args.grad_blended = grad_blended.data();
  args.grad_colors = optional_like(grad_colors, "grad_colors", colors);
  args.grad_positions = optional_like(grad_positions, "grad_positions", positions);
  py::gil_scoped_release release;
  antialias_backward(args);
}

template <class T>
void define_clip_space(py::module_& m) {
  m.def("clip_weights_forward", &clip_weights_forward_py<T>, array("positions"), array("faces"), array("face_index"),
        array("rast"), array("slopes"), py::arg("num_threads"));
  m.def("clip_weights_backward", &clip_weights_backward_py<T>, array("positions"), array("faces"), array("face_index"),
        array("grad_rast"), array("grad_slopes"), array("grad_positions"), py::arg("num_threads"));
  m.def("antialias_forward", &antialias_forward_py<T>, array("colors"), array("rast"), array("positions"),
        array("faces"), array("face_index"), array("twins"), array("blended"), py::arg("num_threads"));
  m.def("antialias_backward", &antialias_backward_py<T>, array("colors"), array("rast"), array("positions"),
        array("faces"), array("face_index"), array("twins"), array("grad_blended"), array("grad_colors"),
        array("grad_positions"), py::arg("num_threads"));
}

}  // namespace

void bind_clip_space(py::module_& m) {
  define_clip_space<float>(m);
  define_clip_space<double>(m);
}

}  // namespace nmr
