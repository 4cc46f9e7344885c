// Images of any channels: the mean of 2x2 pixels, and the gradients of edges.
#include "arrays.h"

namespace nmr {
namespace {

// The colour of pixels without a face.
template <class T>
struct Background {
  const T* values = nullptr;
  int64_t batch = 0;

  Background(const std::optional<Array<T>>& background, int64_t images, int64_t channels) {
    if (!background) return;
    require(background->ndim() == 2 && (background->shape(0) == 1 || background->shape(0) == images) &&
                background->shape(1) == channels,
            "background must have shape [1 or " + std::to_string(images) + ", " + std::to_string(channels) + "], got " +
                shape_of(*background));
    values = background->data();
    batch = background->shape(0);
  }
};

// `pixels` is [B, H, W, C], `resolved` [B, h, w, C]; the face index map belongs to the pixels.
template <class T>
Resolve<T> resolve_args(const Array<int32_t>& face_index, const Array<T>& resolved,
                        const std::optional<Array<T>>& background, bool anti_aliasing, int num_threads) {
  require(resolved.ndim() == 4, "a resolved image must have shape [B, h, w, C], got " + shape_of(resolved));
  const int64_t batch = resolved.shape(0), channels = resolved.shape(3);
  const Size image{resolved.shape(1), resolved.shape(2)}, raster = raster_of(image, anti_aliasing);
  require(image.height >= 1 && image.width >= 1 && channels >= 1,
          "an image must have pixels and channels, got " + shape_of(resolved));
  require_shape(face_index, "face_index", {batch, raster.height, raster.width});
  const Background<T> behind(background, batch, channels);
  Resolve<T> args{};
  args.batch = batch;
  args.image = image;
  args.anti_aliasing = anti_aliasing;
  args.channels = channels;
  args.face_index = face_index.data();
  args.background = behind.values;
  args.background_batch = behind.batch;
  args.num_threads = num_threads;
  return args;
}

template <class T>
void require_pixels(const Array<T>& pixels, const char* name, const Resolve<T>& args) {
  const Size raster = raster_of(args.image, args.anti_aliasing);
  require_shape(pixels, name, {args.batch, raster.height, raster.width, args.channels});
}

template <class T>
void resolve_forward_py(const Array<T>& image, const std::optional<Array<T>>& background,
                        const Array<int32_t>& face_index, Array<T>& resolved, bool anti_aliasing, int num_threads) {
  Resolve<T> args = resolve_args(face_index, resolved, background, anti_aliasing, num_threads);
  require_pixels(image, "image", args);
  args.pixels = image.data();
  args.resolved = resolved.mutable_data();
  py::gil_scoped_release release;
  resolve_forward(args);
}

template <class T>
void resolve_backward_py(const Array<T>& grad_resolved, const std::optional<Array<T>>& background,
                         const Array<int32_t>& face_index, std::optional<Array<T>>& grad_image,
                         std::optional<Array<T>>& grad_background, bool anti_aliasing, int num_threads) {
  Resolve<T> args = resolve_args(face_index, grad_resolved, background, anti_aliasing, num_threads);
  args.grad_resolved = grad_resolved.data();
  if (grad_image) {
    require_pixels(*grad_image, "grad_image", args);
    args.grad_pixels = grad_image->mutable_data();
  }
  args.grad_background = optional_out(grad_background, "grad_background", {args.batch, args.channels});
  py::gil_scoped_release release;
  resolve_backward(args);
}

template <class T>
void edges_backward_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts,
                       const Array<int32_t>& face_index, const Array<T>& image,
                       const std::optional<Array<T>>& background, const Array<T>& grad_resolved,
                       Array<T>& grad_vertices, bool anti_aliasing, double eps, bool local, bool perspective,
                       int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  const Size raster = require_face_index(face_index, mesh, num_threads),
             size = require_image(face_index, raster, anti_aliasing);
  require(image.ndim() == 4 && image.shape(3) >= 1, "image must have shape [B, H, W, C], got " + shape_of(image));
  require_shape(image, "image", {mesh.batch, raster.height, raster.width, image.shape(3)});
  require_shape(grad_resolved, "grad_resolved", {mesh.batch, size.height, size.width, image.shape(3)});
  require_like(grad_vertices, "grad_vertices", vertices);
  const Background<T> behind(background, mesh.batch, image.shape(3));
  const EdgesBackward<T> args{mesh,
                              size,
                              anti_aliasing,
                              static_cast<T>(eps),
                              face_index.data(),
                              image.data(),
                              image.shape(3),
                              behind.values,
                              behind.batch,
                              grad_resolved.data(),
                              grad_vertices.mutable_data(),
                              num_threads,
                              perspective};
  py::gil_scoped_release release;
  local ? local_edges_backward(args) : edges_backward(args);
}

template <class T>
void define_edges(py::module_& m) {
  m.def("resolve_forward", &resolve_forward_py<T>, array("image"), array("background"), array("face_index"),
        array("resolved"), py::arg("anti_aliasing"), py::arg("num_threads"));
  m.def("resolve_backward", &resolve_backward_py<T>, array("grad_resolved"), array("background"), array("face_index"),
        array("grad_image"), array("grad_background"), py::arg("anti_aliasing"), py::arg("num_threads"));
  m.def("edges_backward", &edges_backward_py<T>, array("vertices"), array("faces"), array("starts"),
        array("face_index"), array("image"), array("background"), array("grad_resolved"), array("grad_vertices"),
        py::arg("anti_aliasing"), py::arg("eps"), py::arg("local"), py::arg("perspective"), py::arg("num_threads"));
}

}  // namespace

void bind_edges(py::module_& m) {
  define_edges<float>(m);
  define_edges<double>(m);
}

}  // namespace nmr
