// Texture images: mipmaps, levels, sampling.
#include "corner_values.h"

namespace nmr {
namespace {

// [I, L, 3]: every level must be inside the array of texels.
int64_t require_grids(const Indices& grids, int64_t num_texels) {
  require(grids.ndim() == 3 && grids.shape(1) >= 1 && grids.shape(2) == 3,
          "grids must have shape [I, L, 3], got " + shape_of(grids));
  const int64_t largest = int64_t(1) << 31;
  require(num_texels < largest, "at most 2^31 texels");
  for (int64_t n = 0; n < grids.shape(0) * grids.shape(1); ++n) {
    const int64_t *g = grids.data() + 3 * n, first = g[0], height = g[1], width = g[2];
    require(height >= 1 && width >= 1 && height < largest && width < largest && first >= 0 &&
                first + height * width <= num_texels,
            "a level of a texture lies outside the " + std::to_string(num_texels) + " texels");
  }
  return grids.shape(0);
}

template <class T>
int64_t require_texels(const Array<T>& texels, const char* name) {
  require(texels.ndim() == 2 && texels.shape(1) >= 1,
          std::string(name) + " must have shape [N, C], got " + shape_of(texels));
  return texels.shape(0);
}

// --- mipmaps

template <class T>
Mipmaps<T> mipmaps_args(const Array<T>& texels, const Indices& grids, const Array<T>& pyramid, int num_threads) {
  const int64_t images = require_grids(grids, require_texels(pyramid, "pyramid"));
  const int64_t levels = grids.shape(1), *g = grids.data();
  int64_t whole = 0;
  for (int64_t i = 0; i < images; ++i) {
    int64_t first = g[3 * i * levels];
    for (int64_t l = 0; l < levels; ++l) {
      const int64_t *grid = g + 3 * (i * levels + l), *finer = grid - 3;
      const auto follows = [&](int axis) { return grid[axis] == std::max<int64_t>(finer[axis] / 2, 1); };
      require(grid[0] == first && (l == 0 || (follows(1) && follows(2))),
              "every level must follow the one before, with half its size");
      first += grid[1] * grid[2];
    }
    whole += g[3 * i * levels + 1] * g[3 * i * levels + 2];
  }
  require_shape(texels, "texels", {whole, pyramid.shape(1)});
  Mipmaps<T> args{};
  args.images = images;
  args.levels = levels;
  args.grids = g;
  args.channels = pyramid.shape(1);
  args.num_threads = num_threads;
  return args;
}

template <class T>
void mipmaps_forward_py(const Array<T>& texels, const Indices& grids, Array<T>& pyramid, int num_threads) {
  Mipmaps<T> args = mipmaps_args(texels, grids, pyramid, num_threads);
  args.texels = texels.data();
  args.pyramid = pyramid.mutable_data();
  py::gil_scoped_release release;
  mipmaps_forward(args);
}

template <class T>
void mipmaps_backward_py(const Array<T>& grad_pyramid, const Indices& grids, Array<T>& grad_texels, int num_threads) {
  Mipmaps<T> args = mipmaps_args(grad_texels, grids, grad_pyramid, num_threads);
  args.grad_pyramid = grad_pyramid.data();
  args.grad_texels = grad_texels.mutable_data();
  py::gil_scoped_release release;
  mipmaps_backward(args);
}

// --- levels

template <class T>
Interpolate<T> uv_args(const Array<T>& uv, const Indices& corners, const Array<int32_t>& face_index,
                       const Array<T>& weights, const std::optional<Indices>& starts, int num_threads) {
  const Interpolate<T> args = interpolate_args(uv, corners, face_index, weights, starts, num_threads);
  require(args.channels == 2, "uv must have 2 channels, got " + shape_of(uv));
  return args;
}

inline void require_images(int64_t images, int64_t batch) {
  require(images == 1 || images == batch,
          "there must be one texture or " + std::to_string(batch) + ", got " + std::to_string(images));
}

template <class T>
void uv_levels_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& mesh_starts,
                  const Array<T>& uv, const Indices& corners, const Array<int32_t>& face_index, const Array<T>& weights,
                  const std::optional<Indices>& starts, const Indices& grids, Array<T>& level, int num_threads) {
  UVLevels<T> args{};
  args.mesh = mesh_batch(vertices, faces, mesh_starts);
  args.uv = uv_args(uv, corners, face_index, weights, starts, num_threads);
  require_face_index(face_index, args.mesh, num_threads);
  require(args.uv.num_faces == args.mesh.num_faces, "corners must be those of the faces, got " + shape_of(corners));
  require(grids.ndim() == 3, "grids must have shape [I, L, 3], got " + shape_of(grids));
  args.images = require_grids(grids, (int64_t(1) << 31) - 1);
  require_images(args.images, args.uv.batch);
  args.grids = grids.data();
  args.levels = grids.shape(1);
  require_like(level, "level", face_index);
  args.level = level.mutable_data();
  py::gil_scoped_release release;
  uv_levels(args);
}

// --- sampling

template <class T>
SampleUV<T> sample_args(const Array<T>& texels, const Indices& grids, const std::optional<Array<T>>& level,
                        const Array<T>& uv, const Indices& corners, const Array<int32_t>& face_index,
                        const Array<T>& weights, const std::optional<Indices>& starts, int wrap, int num_threads) {
  SampleUV<T> args{};
  args.uv = uv_args(uv, corners, face_index, weights, starts, num_threads);
  args.texels = texels.data();
  args.num_texels = require_texels(texels, "texels");
  args.channels = texels.shape(1);
  args.images = require_grids(grids, args.num_texels);
  require_images(args.images, args.uv.batch);
  args.grids = grids.data();
  args.levels = grids.shape(1);
  if (level) {
    require_like(*level, "level", face_index);
    args.level = level->data();
  }
  require(wrap >= 0 && wrap <= 2, "wrap must be 0, 1 or 2, got " + std::to_string(wrap));
  args.wrap = static_cast<Wrap>(wrap);
  return args;
}

template <class T>
void sample_uv_forward_py(const Array<T>& texels, const Indices& grids, const std::optional<Array<T>>& level,
                          const Array<T>& uv, const Indices& corners, const Array<int32_t>& face_index,
                          const Array<T>& weights, const std::optional<Indices>& starts, int wrap, Array<T>& colors,
                          int num_threads) {
  SampleUV<T> args = sample_args(texels, grids, level, uv, corners, face_index, weights, starts, wrap, num_threads);
  require_shape(colors, "colors", {args.uv.batch, args.uv.raster.height, args.uv.raster.width, args.channels});
  args.colors = colors.mutable_data();
  py::gil_scoped_release release;
  sample_uv_forward(args);
}

template <class T>
void sample_uv_backward_py(const Array<T>& texels, const Indices& grids, const std::optional<Array<T>>& level,
                           const Array<T>& uv, const Indices& corners, const Array<int32_t>& face_index,
                           const Array<T>& weights, const std::optional<Indices>& starts, int wrap,
                           const Array<T>& grad_colors, std::optional<Array<T>> grad_texels,
                           std::optional<Array<T>> grad_uv, std::optional<Array<T>> grad_weights, int num_threads) {
  SampleUV<T> args = sample_args(texels, grids, level, uv, corners, face_index, weights, starts, wrap, num_threads);
  require_shape(grad_colors, "grad_colors",
                {args.uv.batch, args.uv.raster.height, args.uv.raster.width, args.channels});
  args.grad_colors = grad_colors.data();
  args.grad_texels = optional_like(grad_texels, "grad_texels", texels);
  args.uv.grad_attributes = optional_like(grad_uv, "grad_uv", uv);
  args.uv.grad_weights = optional_like(grad_weights, "grad_weights", weights);
  py::gil_scoped_release release;
  sample_uv_backward(args);
}

template <class T>
void define_texture(py::module_& m) {
  m.def("mipmaps_forward", &mipmaps_forward_py<T>, array("texels"), array("grids"), array("pyramid"),
        py::arg("num_threads"));
  m.def("mipmaps_backward", &mipmaps_backward_py<T>, array("grad_pyramid"), array("grids"), array("grad_texels"),
        py::arg("num_threads"));
  m.def("uv_levels", &uv_levels_py<T>, array("vertices"), array("faces"), array("mesh_starts"), array("uv"),
        array("corners"), array("face_index"), array("weights"), array("starts"), array("grids"), array("level"),
        py::arg("num_threads"));
  m.def("sample_uv_forward", &sample_uv_forward_py<T>, array("texels"), array("grids"), array("level"), array("uv"),
        array("corners"), array("face_index"), array("weights"), array("starts"), py::arg("wrap"), array("colors"),
        py::arg("num_threads"));
  m.def("sample_uv_backward", &sample_uv_backward_py<T>, array("texels"), array("grids"), array("level"), array("uv"),
        array("corners"), array("face_index"), array("weights"), array("starts"), py::arg("wrap"), array("grad_colors"),
        array("grad_texels"), array("grad_uv"), array("grad_weights"), py::arg("num_threads"));
}

}  // namespace

void bind_texture(py::module_& m) {
  define_texture<float>(m);
  define_texture<double>(m);
}

}  // namespace nmr
