// Near-plane clipping: which faces are drawn in place of those that cross the plane z = near. Only
// the topology is decided here; nmr/_clip.py, which knows the camera, computes the new vertices.
//
// A face with one corner in front becomes one triangle, a face with two becomes two triangles. The
// new vertices lie on the two edges that cross the plane. Faces wholly in front stay as they are,
// faces wholly behind are left out. A mesh stays as it is if no face is cut and none could be drawn
// wrongly (`any_around_eye`). Each cut face has new vertices of its own. Neighbours name the ends
// of their common edge in the same order, so their new vertices have the same bits and leave no
// gap.
#include <algorithm>

#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

// Number of triangles that remain of a face with 0, 1, 2 or 3 corners behind the plane.
constexpr int64_t kPieces[4] = {1, 2, 1, 0};

// The corners of a face that are behind the plane.
struct Sides {
  bool behind[3];
  int count;  // 0 if a depth is NaN

  bool cut() const { return count == 1 || count == 2; }
};

template <class T>
NMR_INLINE Sides sides_of(const T* vertices, const int64_t* face, T near) {
  Sides sides{};
  bool ordered = true;
  for (int k = 0; k < 3; ++k) {
    const T z = vertices[3 * face[k] + 2];
    sides.behind[k] = z < near;
    sides.count += sides.behind[k];
    ordered = ordered && z == z;
  }
  return ordered ? sides : Sides{};
}

// Whether some face lies wholly behind the near plane, and crosses or touches the plane of the eye.
// Its interpolated depths are meaningless, and could pass the test against `near`.
template <class T>
bool any_around_eye(const MeshBatch<T>& mesh, int64_t b, T near) {
  const T* vertices = mesh.image_vertices(b);
  const int64_t *face = mesh.image_faces(b), num_faces = mesh.face_rows.count(b);
  for (int64_t f = 0; f < num_faces; ++f, face += 3) {
    if (sides_of(vertices, face, near).count != 3) continue;
    const T z0 = vertices[3 * face[0] + 2], z1 = vertices[3 * face[1] + 2],
            z2 = vertices[3 * face[2] + 2];
    if (min3(z0, z1, z2) <= 0 && max3(z0, z1, z2) >= 0) return true;
  }
  return false;
}

// Whether the mesh does not stay as it is.
template <class T>
bool changes(const MeshBatch<T>& mesh, int64_t b, T near) {
  const T* vertices = mesh.image_vertices(b);
  const int64_t *faces = mesh.image_faces(b), num_faces = mesh.face_rows.count(b);
  for (int64_t f = 0; f < num_faces; ++f)
    if (sides_of(vertices, faces + 3 * f, near).cut()) return true;
  return any_around_eye(mesh, b, near);
}

}  // namespace

template <class T>
void clip_count(const ClipCount<T>& args) {
  const MeshBatch<T>& mesh = args.mesh;
  parallel_for(mesh.batch, args.num_threads, [&](int64_t b) {
    const T* vertices = mesh.image_vertices(b);
    const int64_t *faces = mesh.image_faces(b), num_faces = mesh.face_rows.count(b);
    int64_t cut = 0, drawn = 0;
    for (int64_t f = 0; f < num_faces; ++f) {
      const Sides sides = sides_of(vertices, faces + 3 * f, args.near);
      cut += sides.cut();
      drawn += kPieces[sides.count];
    }
    args.counts[2 * b] = 2 * cut;
    const bool changes = cut || (drawn < num_faces && any_around_eye(mesh, b, args.near));
    args.counts[2 * b + 1] = changes ? drawn : num_faces;
  });
}

template <class T>
void clip_faces(const ClipFaces<T>& args) {
  const MeshBatch<T>& mesh = args.mesh;
  parallel_for(mesh.batch, args.num_threads, [&](int64_t b) {
    const T* vertices = mesh.image_vertices(b);
    const int64_t *faces = mesh.image_faces(b), num_faces = mesh.face_rows.count(b);
    const int64_t vertex_start = mesh.vertex_rows.first(b),
                  num_vertices = mesh.vertex_rows.count(b);
    const int64_t first_vertex = args.starts[2 * b], last_vertex = args.starts[2 * b + 2];
    const int64_t first_face = args.starts[2 * b + 1], last_face = args.starts[2 * b + 3];
    int64_t p = first_vertex, n = first_face;
    // The new vertex on the edge between corners i and j of a face: its number among the new
    // vertices of the mesh.
    const auto cut_edge = [&](const int64_t* face, int i, int j) {
      if (face[i] > face[j]) std::swap(i, j);
      int64_t* end = args.ends + 4 * p;
      end[0] = vertex_start + face[i];
      end[1] = vertex_start + face[j];
      end[2] = i;
      end[3] = j;
      return p++ - first_vertex;
    };
    // A triangle of face f; each corner is a corner k of f (k < 3), or the new vertex k - 3.
    const auto draw = [&](int64_t f, int64_t k0, int64_t k1, int64_t k2) {
      const int64_t* face = faces + 3 * f;
      const int64_t corner[3] = {k0, k1, k2};
      for (int k = 0; k < 3; ++k) {
        args.corners[3 * n + k] = corner[k];
        args.faces[3 * n + k] = corner[k] < 3 ? face[corner[k]] : num_vertices + corner[k] - 3;
      }
      args.source[n++] = static_cast<int32_t>(f);
    };
    const bool stays = !changes(mesh, b, args.near);
    for (int64_t f = 0; f < num_faces; ++f) {
      const int64_t* face = faces + 3 * f;
      const Sides sides = sides_of(vertices, face, args.near);
      if (stays || sides.count == 0) {
        draw(f, 0, 1, 2);
      } else if (sides.cut()) {
        int i = 0;  // the corner that is alone on its side
        while (sides.behind[i] != (sides.count == 1)) ++i;
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        const int64_t on_ij = 3 + cut_edge(face, i, j), on_ki = 3 + cut_edge(face, k, i);
        int64_t whole[3];
        if (sides.count == 2) {  // the triangle at corner i, in the face's own order
          whole[i] = i, whole[j] = on_ij, whole[k] = on_ki;
          draw(f, whole[0], whole[1], whole[2]);
        } else {
          draw(f, on_ij, j, k);
          draw(f, on_ij, k, on_ki);
        }
      }
    }
    // What is left of the given room: faces without area, and new vertices that no face uses.
    for (; n < last_face; ++n) {
      std::fill_n(args.faces + 3 * n, 3, int64_t(0));
      std::fill_n(args.corners + 3 * n, 3, int64_t(0));
      args.source[n] = 0;
    }
    for (; p < last_vertex; ++p) {
      const int64_t end[4] = {vertex_start, vertex_start, 0, 0};
      std::copy_n(end, 4, args.ends + 4 * p);
    }
  });
}

NMR_FLOAT_AND_DOUBLE(clip_count, ClipCount)
NMR_FLOAT_AND_DOUBLE(clip_faces, ClipFaces)

}  // namespace nmr
