// Near-plane clipping: the drawn faces are the parts of the faces in front of the plane, in the same order and direction.
#include <algorithm>
#include <cmath>

#include "check.h"
#include "meshes.h"

namespace nmr::test {
namespace {

constexpr double kNear = 3;  // within the depths of soup()

struct ClippedMeshes {
  std::vector<int64_t> starts, faces, corners, ends;
  std::vector<int32_t> source;
};

// `spare`: new vertices and faces of room beyond what is needed, for each mesh.
template <class T>
ClippedMeshes clip(const Scene<T>& scene, int64_t spare, int num_threads) {
  std::vector<int64_t> counts(2 * scene.batch, -1);
  clip_count(ClipCount<T>{scene.mesh(), T(kNear), counts.data(), num_threads});
  ClippedMeshes out;
  out.starts = {0, 0};
  for (int64_t n = 0; n < 2 * scene.batch; ++n) out.starts.push_back(out.starts[n] + counts[n] + spare);
  const int64_t P = out.starts[2 * scene.batch], M = out.starts[2 * scene.batch + 1];
  out.faces.assign(3 * M, -1), out.corners.assign(3 * M, -1), out.ends.assign(4 * P, -1), out.source.assign(M, -1);
  clip_faces(ClipFaces<T>{scene.mesh(), T(kNear), out.starts.data(), out.faces.data(), out.source.data(), out.corners.data(),
                          out.ends.data(), num_threads});
  return out;
}

using Point = std::vector<double>;

// Twice the area vector of a triangle.
Point area(const Point& a, const Point& b, const Point& c) {
  Point n(3);
  for (int k = 0; k < 3; ++k) {
    const int i = (k + 1) % 3, j = (k + 2) % 3;
    n[k] = (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i]);
  }
  return n;
}

Point between(const Point& a, const Point& b) {
  const double t = (kNear - a[2]) / (b[2] - a[2]);
  return {a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), kNear};
}

// The area in front of the plane, by cutting the polygon side by side.
Point area_in_front(const std::vector<Point>& corner) {
  std::vector<Point> polygon;
  for (int k = 0; k < 3; ++k) {
    const Point &a = corner[k], &b = corner[(k + 1) % 3];
    if (a[2] >= kNear) polygon.push_back(a);
    if ((a[2] >= kNear) != (b[2] >= kNear)) polygon.push_back(between(a, b));
  }
  Point sum(3, 0);
  for (size_t n = 2; n < polygon.size(); ++n)
    for (int k = 0; k < 3; ++k) sum[k] += area(polygon[0], polygon[n - 1], polygon[n])[k];
  return sum;
}

}  // namespace

TEST_REAL(drawn_faces_are_the_parts_in_front) {
  for (const bool packed : {true, false}) {
    const std::vector<Mesh> meshes{soup(40, 1), soup(40, 2)};
    const Scene<T> scene = packed ? pack<T>(meshes) : stack<T>(meshes, false);
    for (const int64_t spare : {0, 3}) {
      const ClippedMeshes out = clip(scene, spare, 1), again = clip(scene, spare, 3);
      CHECK(out.faces == again.faces && out.corners == again.corners && out.ends == again.ends && out.source == again.source);
      for (int64_t b = 0; b < 2; ++b) {
        const MeshBatch<T> mesh = scene.mesh();
        const int64_t F = mesh.face_count(b), V = mesh.vertex_count(b), P = out.starts[2 * b + 2] - out.starts[2 * b];
        const auto vertex = [&](int64_t v) {
          const auto own = [&](int64_t row) { return Point(mesh.vertices + 3 * row, mesh.vertices + 3 * row + 3); };
          if (v < V) return own(mesh.vertex_start(b) + v);
          const int64_t* end = out.ends.data() + 4 * (out.starts[2 * b] + v - V);
          return between(own(end[0]), own(end[1]));
        };
        std::vector<Point> sums(F, Point(3, 0));
        int64_t last = 0, cut = 0;
        for (int64_t n = out.starts[2 * b + 1]; n < out.starts[2 * b + 3] - spare; ++n) {
          const int64_t *drawn = out.faces.data() + 3 * n, f = out.source[n], *face = mesh.image_faces(b) + 3 * f;
          CHECK(f >= last && f < F);
          last = f;
          for (int k = 0; k < 3; ++k) {
            const int64_t corner = out.corners[3 * n + k];
            CHECK_EQUAL(drawn[k], corner < 3 ? face[corner] : V + corner - 3);
            if (corner < 3) continue;
            CHECK(corner - 3 < P);
            const int64_t* end = out.ends.data() + 4 * (out.starts[2 * b] + corner - 3);
            CHECK(end[0] < end[1]);  // neighbours compute the same vertex
            for (int side : {0, 1}) CHECK_EQUAL(end[side], mesh.vertex_start(b) + face[end[2 + side]]);
            ++cut;
          }
          const Point part = area(vertex(drawn[0]), vertex(drawn[1]), vertex(drawn[2]));
          for (int k = 0; k < 3; ++k) sums[f][k] += part[k];
        }
        CHECK(cut > 20);
        for (int64_t f = 0; f < F; ++f) {
          const int64_t* face = mesh.image_faces(b) + 3 * f;
          const Point wanted = area_in_front({vertex(face[0]), vertex(face[1]), vertex(face[2])});
          for (int k = 0; k < 3; ++k) CHECK_NEAR(sums[f][k], wanted[k], 1e-9);
        }
        for (int64_t n = out.starts[2 * b + 3] - spare; n < out.starts[2 * b + 3]; ++n)  // spare faces have no area
          CHECK(out.faces[3 * n] == out.faces[3 * n + 1] && out.source[n] == 0);
      }
    }
  }
}

TEST_REAL(a_mesh_that_nothing_crosses_keeps_its_faces) {
  Mesh ahead = soup(10, 3), behind = soup(10, 4);
  for (size_t n = 2; n < ahead.vertices.size(); n += 3) ahead.vertices[n] += 5, behind.vertices[n] -= 5;
  const Scene<T> scene = pack<T>({ahead, soup(10, 5), behind});
  const ClippedMeshes out = clip(scene, 0, 1);
  CHECK_EQUAL(out.starts[3], 10);
  CHECK_EQUAL(out.starts[7] - out.starts[5], 10);  // also the one behind: alone it would be drawn so
  CHECK(out.starts[2] == 0 && out.starts[4] == out.starts[6]);
  CHECK(std::equal(ahead.faces.begin(), ahead.faces.end(), out.faces.begin()));
  const MeshBatch<T> mesh = scene.mesh();
  CHECK(!crosses_near(mesh.image_vertices(0), mesh.vertex_count(0), T(kNear)));
  CHECK(crosses_near(mesh.image_vertices(1), mesh.vertex_count(1), T(kNear)));
}

TEST_REAL(the_plane_itself_is_in_front_and_nan_is_left_alone) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const Mesh touching{{0, 0, kNear, 1, 0, kNear, 0, 1, 4, 0, 0, nan, 0, 0, 1}, {0, 1, 2, 2, 3, 4, 0, 2, 4}};
  const ClippedMeshes out = clip(single<T>(touching), 0, 1);
  CHECK(out.source == std::vector<int32_t>({0, 1, 2, 2}));
  CHECK_EQUAL(out.ends.size(), 8u);
}

}  // namespace nmr::test
