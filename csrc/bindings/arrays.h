// Shared by all bindings: NumPy arrays as raw pointers. Shapes and indices are checked again after the Python layer,
// so that no call can read or write outside an array. Only the files in this folder know Python.
#pragma once

#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "../indices.h"
#include "../parallel.h"
#include "../stages.h"

namespace py = pybind11;

namespace nmr {

// C-contiguous; every argument is marked noconvert(), so a wrong type or layout is an error and never a silent copy.
template <class T>
using Array = py::array_t<T, py::array::c_style>;
using Indices = Array<int64_t>;

inline py::arg array(const char* name) { return py::arg(name).noconvert(); }

inline void require(bool condition, const std::string& message) {
  if (!condition) throw std::invalid_argument(message);
}

template <class T>
std::string shape_of(const Array<T>& array) {
  std::string text = "[";
  for (py::ssize_t d = 0; d < array.ndim(); ++d) text += (d ? ", " : "") + std::to_string(array.shape(d));
  return text + "]";
}

inline std::string shape_text(const std::vector<int64_t>& shape) {
  std::string text = "[";
  for (size_t d = 0; d < shape.size(); ++d) text += (d ? ", " : "") + std::to_string(shape[d]);
  return text + "]";
}

template <class T>
void require_shape(const Array<T>& array, const char* name, const std::vector<int64_t>& shape) {
  bool same = array.ndim() == static_cast<py::ssize_t>(shape.size());
  for (size_t d = 0; same && d < shape.size(); ++d) same = array.shape(d) == shape[d];
  require(same, std::string(name) + " must have shape " + shape_text(shape) + ", got " + shape_of(array));
}

// The same shape as another array.
template <class T, class U>
void require_like(const Array<T>& array, const char* name, const Array<U>& other) {
  require_shape(array, name, std::vector<int64_t>(other.shape(), other.shape() + other.ndim()));
}

// The storage of a gradient of this shape, or of that of another array; nullptr if the gradient is not wanted.
template <class T>
T* optional_out(std::optional<Array<T>>& grad, const char* name, const std::vector<int64_t>& shape) {
  if (!grad) return nullptr;
  require_shape(*grad, name, shape);
  return grad->mutable_data();
}
template <class T>
T* optional_like(std::optional<Array<T>>& grad, const char* name, const Array<T>& other) {
  if (!grad) return nullptr;
  require_like(*grad, name, other);
  return grad->mutable_data();
}

// Throws if an index is outside 0..limit-1. Callers release the GIL.
inline void require_indices(const int64_t* index, int64_t count, int64_t limit, const char* name, const char* what,
                            const char* plural) {
  if (are_indices(index, count, limit)) return;
  for (int64_t n = 0; n < count; ++n)
    if (index[n] < 0 || index[n] >= limit)
      throw std::invalid_argument(std::string(name) + " refer to " + what + " " + std::to_string(index[n]) +
                                  ", but a mesh has " + std::to_string(limit) + " " + plural + " (the first is 0)");
}

// [B + 1, 2]: ascending from (0, 0) to (rows, faces).
inline void require_starts(const Indices& starts, int64_t rows, int64_t faces) {
  require(starts.ndim() == 2 && starts.shape(0) >= 1 && starts.shape(1) == 2,
          "starts must have shape [B + 1, 2], got " + shape_of(starts));
  const int64_t* s = starts.data();
  const int64_t last = 2 * (starts.shape(0) - 1);
  bool valid = s[0] == 0 && s[1] == 0 && s[last] == rows && s[last + 1] == faces;
  for (int64_t n = 0; valid && n < last; ++n) valid = s[n] <= s[n + 2];
  require(valid, "starts must ascend from (0, 0) to (" + std::to_string(rows) + ", " + std::to_string(faces) + ")");
}

// Checks a batch of meshes and every index in it.
template <class T>
MeshBatch<T> mesh_batch(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts) {
  const bool packed = starts.has_value(), per_image = faces.ndim() == 3;
  require(vertices.ndim() == (packed ? 2 : 3) && vertices.shape(vertices.ndim() - 1) == 3,
          std::string("vertices must have shape ") + (packed ? "[N, 3]" : "[B, V, 3]") + ", got " + shape_of(vertices));
  require((faces.ndim() == 2 || (per_image && !packed && faces.shape(0) == vertices.shape(0))) &&
              faces.shape(faces.ndim() - 1) == 3,
          "faces must have shape [F, 3], or [B, F, 3] with the B of vertices " + shape_of(vertices) + ", got " +
              shape_of(faces));
  MeshBatch<T> mesh{vertices.data(),
                    faces.data(),
                    0,
                    vertices.shape(packed ? 0 : 1),
                    faces.shape(per_image ? 1 : 0),
                    per_image,
                    packed ? starts->data() : nullptr};
  require(mesh.num_faces < (int64_t(1) << 30), "at most 2^30 faces per mesh");
  const auto require_vertices = [](int64_t count) {
    require(count < (int64_t(1) << 29), "at most 2^29 vertices per mesh");
  };
  if (packed) {
    require_starts(*starts, mesh.num_vertices, mesh.num_faces);
    mesh.batch = starts->shape(0) - 1;
    for (int64_t b = 0; b < mesh.batch; ++b) require_vertices(mesh.vertex_count(b));
    const py::gil_scoped_release release;
    for (int64_t b = 0; b < mesh.batch; ++b)
      require_indices(mesh.image_faces(b), 3 * mesh.face_count(b), mesh.vertex_count(b), "faces", "vertex", "vertices");
  } else {
    mesh.batch = vertices.shape(0);
    require_vertices(mesh.num_vertices);
    const py::gil_scoped_release release;
    require_indices(faces.data(), faces.size(), mesh.num_vertices, "faces", "vertex", "vertices");
  }
  return mesh;
}

// The raster of a face index map [B, H, W]; each of its entries must name a face of its image, or a reversed copy of
// one.
template <class FaceCount>
Size require_face_index(const Array<int32_t>& face_index, int64_t batch, const FaceCount& face_count, int num_threads) {
  require(face_index.ndim() == 3 && face_index.shape(0) == batch,
          "face_index must have shape [" + std::to_string(batch) + ", H, W], got " + shape_of(face_index));
  const int64_t pixels = face_index.shape(1) * face_index.shape(2);
  const int32_t* entries = face_index.data();
  const py::gil_scoped_release release;
  const int64_t parts = pixels / (int64_t(1) << 18) + 1;  // of each image
  parallel_for(batch * parts, num_threads, [&](int64_t n) {
    const int64_t b = n / parts, k = n % parts, first = k * pixels / parts, last = (k + 1) * pixels / parts;
    require(are_face_indices(entries + b * pixels + first, last - first, face_count(b)),
            "the face index map does not belong to these faces");
  });
  return {face_index.shape(1), face_index.shape(2)};
}

template <class T>
Size require_face_index(const Array<int32_t>& face_index, const MeshBatch<T>& mesh, int num_threads) {
  return require_face_index(face_index, mesh.batch, [&](int64_t b) { return mesh.face_count(b); }, num_threads);
}

// The image of a raster: half its size with anti-aliasing.
inline Size require_image(const Array<int32_t>& face_index, Size raster, bool anti_aliasing) {
  require(!anti_aliasing || (raster.height % 2 == 0 && raster.width % 2 == 0),
          "an anti-aliased face index map has an even size, got " + shape_of(face_index));
  return anti_aliasing ? Size{raster.height / 2, raster.width / 2} : raster;
}

// The parts of the module, one per file.
void bind_camera(py::module_& m);
void bind_clip(py::module_& m);
void bind_raster(py::module_& m);
void bind_soft(py::module_& m);
void bind_fragments(py::module_& m);
void bind_edges(py::module_& m);
void bind_shade(py::module_& m);
void bind_texture(py::module_& m);
void bind_clip_space(py::module_& m);
void bind_lights(py::module_& m);
void bind_mesh(py::module_& m);

}  // namespace nmr
