// Texture cubes and interpolation.
#include "corner_values.h"

namespace nmr {
namespace {

// --- texture cubes

template <class T>
TextureCubes<T> texture_args(const Array<T>& textures, const Array<int32_t>& face_index, const Array<T>& weights,
                             const std::optional<Indices>& starts, double eps, int num_threads) {
  const py::ssize_t lead = starts ? 1 : 2;
  const std::string layout = starts ? "[M, ts, ts, ts, C]" : "[B or 1, F, ts, ts, ts, C]";
  require(textures.ndim() == lead + 4, "textures must have shape " + layout + ", got " + shape_of(textures));
  const int64_t ts = textures.shape(lead), channels = textures.shape(lead + 3), num_faces = textures.shape(lead - 1);
  require(ts >= 1 && textures.shape(lead + 1) == ts && textures.shape(lead + 2) == ts && channels >= 1,
          "textures must be cubes of the same size in all three directions, with channels, got " + shape_of(textures));
  // Textures have no rows, so the number of rows at the end of starts is not checked.
  if (starts)
    require_starts(*starts, starts->ndim() == 2 && starts->size() >= 2 ? starts->data()[starts->size() - 2] : 0,
                   num_faces);
  require_fragments(face_index, weights, starts, num_faces, num_threads);
  const int64_t texture_batch = starts ? 1 : textures.shape(0);
  require(
      starts || texture_batch == 1 || texture_batch == face_index.shape(0),
      "textures must have the batch size " + std::to_string(face_index.shape(0)) + " or 1, got " + shape_of(textures));
  TextureCubes<T> args{};
  args.face_index = face_index.data();
  args.weights = weights.data();
  args.batch = face_index.shape(0);
  args.raster = {face_index.shape(1), face_index.shape(2)};
  args.textures = textures.data();
  args.texture_batch = texture_batch;
  args.num_faces = num_faces;
  args.starts = starts ? starts->data() : nullptr;
  args.texture_size = ts;
  args.channels = channels;
  args.eps = static_cast<T>(eps);
  args.num_threads = num_threads;
  return args;
}

template <class T>
void texture_cubes_forward_py(const Array<T>& textures, const Array<int32_t>& face_index, const Array<T>& weights,
                              const std::optional<Indices>& starts, Array<T>& colors, double eps, int num_threads) {
  TextureCubes<T> args = texture_args(textures, face_index, weights, starts, eps, num_threads);
  require_shape(colors, "colors", {args.batch, args.raster.height, args.raster.width, args.channels});
  args.colors = colors.mutable_data();
  py::gil_scoped_release release;
  texture_cubes_forward(args);
}

// The gradient has the shape of the textures; their values are not needed.
template <class T>
void texture_cubes_backward_py(const Array<int32_t>& face_index, const Array<T>& weights,
                               const std::optional<Indices>& starts, const Array<T>& grad_colors,
                               Array<T>& grad_textures, double eps, int num_threads) {
  TextureCubes<T> args = texture_args(grad_textures, face_index, weights, starts, eps, num_threads);
  require_shape(grad_colors, "grad_colors", {args.batch, args.raster.height, args.raster.width, args.channels});
  args.textures = nullptr;
  args.grad_colors = grad_colors.data();
  args.grad_textures = grad_textures.mutable_data();
  py::gil_scoped_release release;
  texture_cubes_backward(args);
}

// --- interpolate

template <class T>
void interpolate_forward_py(const Array<T>& attributes, const Indices& corners, const Array<int32_t>& face_index,
                            const Array<T>& weights, const std::optional<Indices>& starts, Array<T>& values,
                            int num_threads) {
  Interpolate<T> args = interpolate_args(attributes, corners, face_index, weights, starts, num_threads);
  require_shape(values, "values", {args.batch, args.raster.height, args.raster.width, args.channels});
  args.values = values.mutable_data();
  py::gil_scoped_release release;
  interpolate_forward(args);
}

template <class T>
void interpolate_backward_py(const Array<T>& attributes, const Indices& corners, const Array<int32_t>& face_index,
                             const Array<T>& weights, const std::optional<Indices>& starts, const Array<T>& grad_values,
                             std::optional<Array<T>> grad_attributes, std::optional<Array<T>> grad_weights,
                             int num_threads) {
  Interpolate<T> args = interpolate_args(attributes, corners, face_index, weights, starts, num_threads);
  require_shape(grad_values, "grad_values", {args.batch, args.raster.height, args.raster.width, args.channels});
  args.grad_values = grad_values.data();
  args.grad_attributes = optional_like(grad_attributes, "grad_attributes", attributes);
  args.grad_weights = optional_like(grad_weights, "grad_weights", weights);
  py::gil_scoped_release release;
  interpolate_backward(args);
}

template <class T>
void define_shade(py::module_& m) {
  m.def("texture_cubes_forward", &texture_cubes_forward_py<T>, array("textures"), array("face_index"), array("weights"),
        array("starts"), array("colors"), py::arg("eps"), py::arg("num_threads"));
  m.def("texture_cubes_backward", &texture_cubes_backward_py<T>, array("face_index"), array("weights"), array("starts"),
        array("grad_colors"), array("grad_textures"), py::arg("eps"), py::arg("num_threads"));
  m.def("interpolate_forward", &interpolate_forward_py<T>, array("attributes"), array("corners"), array("face_index"),
        array("weights"), array("starts"), array("values"), py::arg("num_threads"));
  m.def("interpolate_backward", &interpolate_backward_py<T>, array("attributes"), array("corners"), array("face_index"),
        array("weights"), array("starts"), array("grad_values"), array("grad_attributes"), array("grad_weights"),
        py::arg("num_threads"));
}

}  // namespace

void bind_shade(py::module_& m) {
  define_shade<float>(m);
  define_shade<double>(m);
}

}  // namespace nmr
