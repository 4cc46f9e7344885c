// nmr._C: the stages as functions of NumPy arrays. The only file that knows Python. Shapes are checked here once more than in
// the Python layer, so that no call can read or write outside an array.
#include <algorithm>
#include <stdexcept>
#include <string>

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include "parallel.h"
#include "stages.h"

namespace py = pybind11;

namespace nmr {
namespace {

// C-contiguous; every argument is marked noconvert(), so a wrong type or layout is an error and never a silent copy.
template <class T>
using Array = py::array_t<T, py::array::c_style>;
using Faces = Array<int64_t>;

void require(bool condition, const std::string& message) {
  if (!condition) throw std::invalid_argument(message);
}

template <class T>
std::string shape_of(const Array<T>& array) {
  std::string text = "[";
  for (py::ssize_t d = 0; d < array.ndim(); ++d) text += (d ? ", " : "") + std::to_string(array.shape(d));
  return text + "]";
}

template <class T>
void require_shape(const Array<T>& array, const char* name, std::initializer_list<int64_t> shape) {
  bool same = array.ndim() == static_cast<py::ssize_t>(shape.size());
  py::ssize_t d = 0;
  for (int64_t n : shape) same = same && array.shape(d++) == n;
  std::string wanted = "[";
  d = 0;
  for (int64_t n : shape) wanted += (d++ ? ", " : "") + std::to_string(n);
  require(same, std::string(name) + " must have shape " + wanted + "], got " + shape_of(array));
}

// Checks a batch of meshes and every index in it.
template <class T>
MeshBatch<T> mesh_batch(const Array<T>& vertices, const Faces& faces) {
  require(vertices.ndim() == 3 && vertices.shape(2) == 3, "vertices must have shape [B, V, 3], got " + shape_of(vertices));
  const bool per_image = faces.ndim() == 3;
  require((faces.ndim() == 2 || per_image) && faces.shape(faces.ndim() - 1) == 3 &&
              (!per_image || faces.shape(0) == vertices.shape(0)),
          "faces must have shape [F, 3], or [B, F, 3] with the B of vertices " + shape_of(vertices) + ", got " +
              shape_of(faces));
  MeshBatch<T> mesh{vertices.data(), faces.data(), vertices.shape(0), vertices.shape(1),
                    faces.shape(per_image ? 1 : 0), per_image};
  require(mesh.num_faces < (int64_t(1) << 30), "at most 2^30 faces per mesh");
  const int64_t* index = faces.data();
  for (int64_t n = 0; n < faces.size(); ++n)
    if (index[n] < 0 || index[n] >= mesh.num_vertices)
      throw std::invalid_argument("faces refer to vertex " + std::to_string(index[n]) + ", but a mesh has " +
                                  std::to_string(mesh.num_vertices) + " vertices (the first is 0)");
  return mesh;
}

template <class T>
void silhouette_forward_py(const Array<T>& vertices, const Faces& faces, Array<T>& alpha, Array<int32_t>& face_index,
                           int64_t image_size, bool anti_aliasing, bool fill_back, double near, double far,
                           int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces);
  require(image_size >= 1 && image_size <= 16384, "image_size must lie in 1..16384, got " + std::to_string(image_size));
  const int64_t raster_size = anti_aliasing ? 2 * image_size : image_size;
  require_shape(alpha, "alpha", {mesh.batch, image_size, image_size});
  require_shape(face_index, "face_index", {mesh.batch, raster_size, raster_size});
  SilhouetteForward<T> args{mesh,
                            {raster_size, fill_back, static_cast<T>(near), static_cast<T>(far)},
                            image_size,
                            anti_aliasing,
                            alpha.mutable_data(),
                            face_index.mutable_data(),
                            num_threads};
  py::gil_scoped_release release;
  silhouette_forward(args);
}

template <class T>
void silhouette_backward_py(const Array<T>& vertices, const Faces& faces, const Array<int32_t>& face_index,
                            const Array<T>& grad_alpha, Array<T>& grad_vertices, int64_t image_size, bool anti_aliasing,
                            double eps, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces);
  const int64_t raster_size = anti_aliasing ? 2 * image_size : image_size;
  require_shape(face_index, "face_index", {mesh.batch, raster_size, raster_size});
  require_shape(grad_alpha, "grad_alpha", {mesh.batch, image_size, image_size});
  require_shape(grad_vertices, "grad_vertices", {mesh.batch, mesh.num_vertices, 3});
  const int32_t* index = face_index.data();
  int32_t largest = -1;
  for (int64_t n = 0; n < face_index.size(); ++n) largest = std::max(largest, index[n]);
  require(largest < 2 * mesh.num_faces, "face_index does not belong to these faces");
  SilhouetteBackward<T> args{mesh,
                             image_size,
                             anti_aliasing,
                             static_cast<T>(eps),
                             face_index.data(),
                             grad_alpha.data(),
                             grad_vertices.mutable_data(),
                             num_threads};
  py::gil_scoped_release release;
  silhouette_backward(args);
}

template <class T>
Smoothness<T> smoothness_args(const Array<T>& vertices, const Array<int64_t>& edges, int num_threads) {
  require(vertices.ndim() == 3 && vertices.shape(2) == 3, "vertices must have shape [B, V, 3], got " + shape_of(vertices));
  require(edges.ndim() == 2 && edges.shape(1) == 4, "edges must have shape [E, 4], got " + shape_of(edges));
  Smoothness<T> args{vertices.data(), edges.data(), vertices.shape(0), vertices.shape(1), edges.shape(0),
                     nullptr,         nullptr,      nullptr,           num_threads};
  for (int64_t n = 0; n < edges.size(); ++n)
    if (args.edges[n] < 0 || args.edges[n] >= args.num_vertices)
      throw std::invalid_argument("edges refer to vertex " + std::to_string(args.edges[n]) + ", but a mesh has " +
                                  std::to_string(args.num_vertices) + " vertices (the first is 0)");
  return args;
}

template <class T>
void smoothness_forward_py(const Array<T>& vertices, const Array<int64_t>& edges, Array<T>& loss, int num_threads) {
  Smoothness<T> args = smoothness_args(vertices, edges, num_threads);
  require_shape(loss, "loss", {args.batch});
  args.loss = loss.mutable_data();
  py::gil_scoped_release release;
  smoothness_forward(args);
}

template <class T>
void smoothness_backward_py(const Array<T>& vertices, const Array<int64_t>& edges, const Array<T>& grad_loss,
                            Array<T>& grad_vertices, int num_threads) {
  Smoothness<T> args = smoothness_args(vertices, edges, num_threads);
  require_shape(grad_loss, "grad_loss", {args.batch});
  require_shape(grad_vertices, "grad_vertices", {args.batch, args.num_vertices, 3});
  args.grad_loss = grad_loss.data();
  args.grad_vertices = grad_vertices.mutable_data();
  py::gil_scoped_release release;
  smoothness_backward(args);
}

void voxelize_py(const Array<float>& vertices, const Faces& faces, Array<bool>& voxels, int64_t size, int num_threads) {
  const MeshBatch<float> mesh = mesh_batch(vertices, faces);
  require(size >= 1 && size <= 1024, "size must lie in 1..1024, got " + std::to_string(size));
  require_shape(voxels, "voxels", {mesh.batch, size, size, size});
  const Voxelize args{mesh, size, voxels.mutable_data(), num_threads};
  py::gil_scoped_release release;
  voxelize(args);
}

template <class T>
void define_differentiable(py::module_& m) {
  m.def("silhouette_forward", &silhouette_forward_py<T>, py::arg("vertices").noconvert(), py::arg("faces").noconvert(),
        py::arg("alpha").noconvert(), py::arg("face_index").noconvert(), py::arg("image_size"), py::arg("anti_aliasing"),
        py::arg("fill_back"), py::arg("near"), py::arg("far"), py::arg("num_threads"));
  m.def("silhouette_backward", &silhouette_backward_py<T>, py::arg("vertices").noconvert(), py::arg("faces").noconvert(),
        py::arg("face_index").noconvert(), py::arg("grad_alpha").noconvert(), py::arg("grad_vertices").noconvert(),
        py::arg("image_size"), py::arg("anti_aliasing"), py::arg("eps"), py::arg("num_threads"));
  m.def("smoothness_forward", &smoothness_forward_py<T>, py::arg("vertices").noconvert(), py::arg("edges").noconvert(),
        py::arg("loss").noconvert(), py::arg("num_threads"));
  m.def("smoothness_backward", &smoothness_backward_py<T>, py::arg("vertices").noconvert(), py::arg("edges").noconvert(),
        py::arg("grad_loss").noconvert(), py::arg("grad_vertices").noconvert(), py::arg("num_threads"));
}

}  // namespace

PYBIND11_MODULE(_C, m) {
  m.doc() = "Compiled kernels of nmr. Use the functions of the package nmr, which validate and document.";
  define_differentiable<float>(m);
  define_differentiable<double>(m);
  m.def("voxelize", &voxelize_py, py::arg("vertices").noconvert(), py::arg("faces").noconvert(),
        py::arg("voxels").noconvert(), py::arg("size"), py::arg("num_threads"));
}

}  // namespace nmr
