// Normals of meshes, and lights.
#include "corner_values.h"

namespace nmr {
namespace {

// --- normals

template <class T>
Normals<T> normals_args(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                        bool smooth, const Array<T>& normals, const char* name, int num_threads) {
  Normals<T> args{};
  args.mesh = mesh_batch(vertices, faces, starts);
  args.smooth = smooth;
  args.num_threads = num_threads;
  if (smooth)
    require_like(normals, name, vertices);
  else if (starts)
    require_shape(normals, name, {args.mesh.num_faces, 3});
  else
    require_shape(normals, name, {args.mesh.batch, args.mesh.num_faces, 3});
  return args;
}

template <class T>
void normals_forward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                        bool smooth, Array<T>& normals, int num_threads) {
  Normals<T> args = normals_args(vertices, faces, starts, smooth, normals, "normals", num_threads);
  args.normals = normals.mutable_data();
  py::gil_scoped_release release;
  normals_forward(args);
}

template <class T>
void normals_backward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                         bool smooth, const Array<T>& grad_normals, Array<T>& grad_vertices, int num_threads) {
  Normals<T> args = normals_args(vertices, faces, starts, smooth, grad_normals, "grad_normals", num_threads);
  require_like(grad_vertices, "grad_vertices", vertices);
  args.grad_normals = grad_normals.data();
  args.grad_vertices = grad_vertices.mutable_data();
  py::gil_scoped_release release;
  normals_backward(args);
}

// --- lights

constexpr int64_t kWidths[] = {1, 3, 1, 3, 3, 1, 3, 3, 1, 1, 1};  // numbers of each parameter, in the order of Light

// Every parameter must be inside the array. Those that belong together have one light or the same number.
inline void require_layout(const Indices& layout, int64_t num_parameters, int64_t batch) {
  const int64_t count = static_cast<int64_t>(Light::count);
  require_shape(layout, "layout", {count, 3});
  for (int64_t n = 0; n < count; ++n) {
    const int64_t *l = layout.data() + 3 * n, first = l[0], rows = l[1], lights = l[2];
    const bool several = n >= static_cast<int64_t>(Light::directional) && n < static_cast<int64_t>(Light::specular);
    require(lights >= 0 && lights < (int64_t(1) << 20) && (several || lights <= 1) && (n > 1 || lights == 1),
            "impossible number of lights");
    if (lights == 0) continue;
    require((rows == 1 || rows == batch) && first >= 0 && first + rows * lights * kWidths[n] <= num_parameters,
            "a parameter of lights lies outside the array");
  }
  const auto require_group = [&](Light from, Light to) {
    int64_t most = 0;
    bool none = false;
    for (int64_t n = static_cast<int64_t>(from); n <= static_cast<int64_t>(to); ++n) {
      most = std::max(most, layout.data()[3 * n + 2]);
      none = none || layout.data()[3 * n + 2] == 0;
    }
    for (int64_t n = static_cast<int64_t>(from); n <= static_cast<int64_t>(to) && !none; ++n)
      require(layout.data()[3 * n + 2] == 1 || layout.data()[3 * n + 2] == most,
              "parameters of different numbers of lights");
  };
  require_group(Light::directional, Light::direction);
  require_group(Light::point, Light::falloff);
}

template <class T>
Lit<T> lit_args(const std::optional<Array<T>>& colors, const Array<T>& normals,
                const std::optional<Array<T>>& parameters, const Indices& layout, const Array<T>& viewer,
                const Array<T>& vertices, const Indices& faces, const Array<int32_t>& face_index,
                const Array<T>& weights, const std::optional<Indices>& starts, bool smooth, int num_threads) {
  Lit<T> args{};
  args.at = interpolate_args(vertices, faces, face_index, weights, starts, num_threads);
  require(args.at.channels == 3, "vertices must have 3 coordinates, got " + shape_of(vertices));
  const int64_t rows = smooth ? args.at.num_attributes : args.at.num_faces, batch = args.at.batch;
  if (starts) {
    require_shape(normals, "normals", {rows, 3});
  } else {
    args.normal_batch = normals.ndim() == 3 ? normals.shape(0) : 0;
    require(args.normal_batch == 1 || args.normal_batch == batch,
            "normals must have the batch size 1 or " + std::to_string(batch));
    require_shape(normals, "normals", {args.normal_batch, rows, 3});
  }
  args.normals = normals.data();
  args.smooth = smooth;
  require_shape(viewer, "viewer", {batch, 5});
  args.viewer = viewer.data();
  if (parameters) {
    require(parameters->ndim() == 1, "parameters must have shape [P], got " + shape_of(*parameters));
    require_layout(layout, parameters->shape(0), batch);
    args.parameters = parameters->data();
    args.num_parameters = parameters->shape(0);
    args.layout = layout.data();
  }
  if (colors) {
    const int64_t channels = colors->ndim() == 4 ? colors->shape(3) : 0;
    require(channels == 1 || channels == 3, "colors must have 1 or 3 channels, got " + shape_of(*colors));
    require_shape(*colors, "colors", {batch, args.at.raster.height, args.at.raster.width, channels});
    args.colors = colors->data();
    args.channels = channels;
  }
  return args;
}

template <class T>
void lit_forward_py(const std::optional<Array<T>>& colors, const Array<T>& normals,
                    const std::optional<Array<T>>& parameters, const Indices& layout, const Array<T>& viewer,
                    const Array<T>& vertices, const Indices& faces, const Array<int32_t>& face_index,
                    const Array<T>& weights, const std::optional<Indices>& starts, bool smooth, Array<T>& lit,
                    int num_threads) {
  Lit<T> args = lit_args(colors, normals, parameters, layout, viewer, vertices, faces, face_index, weights, starts,
                         smooth, num_threads);
  require_shape(lit, "lit", {args.at.batch, args.at.raster.height, args.at.raster.width, 3});
  args.lit = lit.mutable_data();
  py::gil_scoped_release release;
  lit_forward(args);
}

template <class T>
void lit_backward_py(const std::optional<Array<T>>& colors, const Array<T>& normals,
                     const std::optional<Array<T>>& parameters, const Indices& layout, const Array<T>& viewer,
                     const Array<T>& vertices, const Indices& faces, const Array<int32_t>& face_index,
                     const Array<T>& weights, const std::optional<Indices>& starts, bool smooth,
                     const Array<T>& grad_lit, std::optional<Array<T>> grad_colors,
                     std::optional<Array<T>> grad_normals, std::optional<Array<T>> grad_parameters,
                     std::optional<Array<T>> grad_vertices, std::optional<Array<T>> grad_weights, int num_threads) {
  Lit<T> args = lit_args(colors, normals, parameters, layout, viewer, vertices, faces, face_index, weights, starts,
                         smooth, num_threads);
  require_shape(grad_lit, "grad_lit", {args.at.batch, args.at.raster.height, args.at.raster.width, 3});
  args.grad_lit = grad_lit.data();
  if (colors) args.grad_colors = optional_like(grad_colors, "grad_colors", *colors);
  if (parameters) args.grad_parameters = optional_like(grad_parameters, "grad_parameters", *parameters);
  args.grad_normals = optional_like(grad_normals, "grad_normals", normals);
  args.at.grad_attributes = optional_like(grad_vertices, "grad_vertices", vertices);
  args.at.grad_weights = optional_like(grad_weights, "grad_weights", weights);
  py::gil_scoped_release release;
  lit_backward(args);
}

template <class T>
void define_lights(py::module_& m) {
  m.def("normals_forward", &normals_forward_py<T>, array("vertices"), array("faces"), array("starts"),
        py::arg("smooth"), array("normals"), py::arg("num_threads"));
  m.def("normals_backward", &normals_backward_py<T>, array("vertices"), array("faces"), array("starts"),
        py::arg("smooth"), array("grad_normals"), array("grad_vertices"), py::arg("num_threads"));
  m.def("lit_forward", &lit_forward_py<T>, array("colors"), array("normals"), array("parameters"), array("layout"),
        array("viewer"), array("vertices"), array("faces"), array("face_index"), array("weights"), array("starts"),
        py::arg("smooth"), array("lit"), py::arg("num_threads"));
  m.def("lit_backward", &lit_backward_py<T>, array("colors"), array("normals"), array("parameters"), array("layout"),
        array("viewer"), array("vertices"), array("faces"), array("face_index"), array("weights"), array("starts"),
        py::arg("smooth"), array("grad_lit"), array("grad_colors"), array("grad_normals"), array("grad_parameters"),
        array("grad_vertices"), array("grad_weights"), py::arg("num_threads"));
}

}  // namespace

void bind_lights(py::module_& m) {
  define_lights<float>(m);
  define_lights<double>(m);
}

}  // namespace nmr
