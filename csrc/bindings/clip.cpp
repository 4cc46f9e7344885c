// Near-plane clipping.
#include "arrays.h"

namespace nmr {
namespace {

// Leaves the counts alone if no vertex is behind the plane.
template <class T>
void clip_count_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts, double near,
                   Indices& counts, int num_threads) {
  require(vertices.ndim() >= 1 && vertices.shape(vertices.ndim() - 1) == 3,
          "vertices must have shape [B, V, 3] or [N, 3], got " + shape_of(vertices));
  if (!crosses_near(vertices.data(), vertices.size() / 3, static_cast<T>(near))) return;
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  require_shape(counts, "counts", {mesh.batch, 2});
  const ClipCount<T> args{mesh, static_cast<T>(near), counts.mutable_data(), num_threads};
  py::gil_scoped_release release;
  clip_count(args);
}

template <class T>
void clip_faces_py(const Array<T>& vertices, const Indices& faces, const std::optional<Indices>& starts, double near,
                   const Indices& new_starts, Indices& new_faces, Array<int32_t>& source, Indices& corners,
                   Indices& ends, int num_threads) {
  const MeshBatch<T> mesh = mesh_batch(vertices, faces, starts);
  require(ends.ndim() == 2 && source.ndim() == 1,
          "ends must have shape [P, 4] and source [M], got " + shape_of(ends) + " and " + shape_of(source));
  require_starts(new_starts, ends.shape(0), source.shape(0));
  require(new_starts.shape(0) == mesh.batch + 1,
          "new_starts must be those of " + std::to_string(mesh.batch) + " meshes, got " + shape_of(new_starts));
  require_shape(ends, "ends", {ends.shape(0), 4});
  require_shape(new_faces, "new_faces", {source.shape(0), 3});
  require_shape(corners, "corners", {source.shape(0), 3});
  std::vector<int64_t> counts(2 * mesh.batch);
  clip_count(ClipCount<T>{mesh, static_cast<T>(near), counts.data(), num_threads});
  for (int64_t n = 0; n < 2 * mesh.batch; ++n)
    require(new_starts.data()[n + 2] - new_starts.data()[n] >= counts[n],
            "new_starts leave too little room for the clipped meshes");
  for (int64_t b = 0; b < mesh.batch; ++b)
    require(mesh.vertex_count(b) > 0 || new_starts.data()[2 * b + 3] == new_starts.data()[2 * b + 1],
            "a mesh without vertices has no faces");
  const ClipFaces<T> args{mesh,
                          static_cast<T>(near),
                          new_starts.data(),
                          new_faces.mutable_data(),
                          source.mutable_data(),
                          corners.mutable_data(),
                          ends.mutable_data(),
                          num_threads};
  py::gil_scoped_release release;
  clip_faces(args);
}

template <class T>
void define_clip(py::module_& m) {
  m.def("clip_count", &clip_count_py<T>, array("vertices"), array("faces"), array("starts"), py::arg("near"),
        array("counts"), py::arg("num_threads"));
  m.def("clip_faces", &clip_faces_py<T>, array("vertices"), array("faces"), array("starts"), py::arg("near"),
        array("new_starts"), array("new_faces"), array("source"), array("corners"), array("ends"),
        py::arg("num_threads"));
}

}  // namespace

void bind_clip(py::module_& m) {
  define_clip<float>(m);
  define_clip<double>(m);
}

}  // namespace nmr
