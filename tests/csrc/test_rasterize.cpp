// The face index map, to the last pixel, against the definition of docs/conventions.md: every face
// at every pixel.
#include <algorithm>
#include <cmath>

#include "check.h"
#include "meshes.h"

namespace nmr::test {
namespace {

template <class T>
struct SlowFace {
  T x[3], y[3], z[3];
  bool drawn;

  // Face id of [0, 2F): f, or F + f for the reversed copy of f.
  SlowFace(const MeshBatch<T>& mesh, int64_t b, int64_t id) {
    const int64_t F = mesh.face_count(b);
    bool usable = true;
    for (int k = 0; k < 3; ++k) {
      const T* v =
          mesh.image_vertices(b) + 3 * mesh.image_faces(b)[3 * (id % F) + (id < F ? k : 2 - k)];
      x[k] = v[0], y[k] = v[1], z[k] = v[2];
      usable = usable && std::isfinite(v[0]) && std::isfinite(v[1]) && !std::isnan(v[2]);
    }
    const double x0 = x[0], y0 = y[0];
    const bool flat = (x[1] - x0) * (y[2] - y0) == (y[1] - y0) * (x[2] - x0);
    drawn = usable && !flat && !((y[2] - y[0]) * (x[1] - x[0]) < (y[1] - y[0]) * (x[2] - x[0]));
  }

  // Depth at a pixel, row 0 at the bottom; infinite outside the face.
  T depth(int64_t column, int64_t row, Size raster, bool perspective) const {
    const T H = T(raster.height), W = T(raster.width), px = (2 * T(column) + 1 - W) / W,
            py = (2 * T(row) + 1 - H) / H;
    bool inside = drawn && px >= std::min({x[0], x[1], x[2]}) &&
                  px <= std::max({x[0], x[1], x[2]}) && py >= std::min({y[0], y[1], y[2]}) &&
                  py <= std::max({y[0], y[1], y[2]});
    for (int a = 0; a < 3 && inside; ++a) {
      const int b = (a + 1) % 3;
      inside = !((py - y[a]) * (x[b] - x[a]) < (px - x[a]) * (y[b] - y[a]));
    }
    if (!inside) return std::numeric_limits<T>::infinity();
    T X[3], Y[3], weights[3], inverse = 0, mean = 0;
    for (int k = 0; k < 3; ++k) X[k] = (x[k] * W + W - 1) / 2, Y[k] = (y[k] * H + H - 1) / 2;
    const T det = X[2] * (Y[0] - Y[1]) + X[0] * (Y[1] - Y[2]) + X[1] * (Y[2] - Y[0]);
    for (int k = 0; k < 3; ++k) {
      const int a = (k + 1) % 3, b = (k + 2) % 3;
      const T w = (Y[a] - Y[b]) / det * T(column) + (X[b] - X[a]) / det * T(row) +
                  (X[a] * Y[b] - X[b] * Y[a]) / det;
      weights[k] = w > 0 ? std::min(w, T(1)) : T(0);
    }
    const T sum = weights[0] + weights[1] + weights[2];
    for (int k = 0; k < 3; ++k) {
      inverse += weights[k] / sum / z[k];
      mean += weights[k] / sum * z[k];
    }
    return perspective ? 1 / inverse : mean;
  }
};

template <class T>
void check_rasterize_as_it_is(const Scene<T>& scene) {
  const MeshBatch<T> mesh = scene.mesh();
  const Size raster = scene.raster();
  std::vector<int32_t> face_index(scene.pixels(), -7), expected(scene.pixels(), -1);
  rasterize(Rasterize<T>{mesh,
                         {raster, scene.fill_back, scene.near, scene.far, scene.perspective},
                         face_index.data(),
                         2});
  for (int64_t b = 0; b < scene.batch; ++b) {
    std::vector<T> nearest(raster.pixels(), scene.far);
    for (int64_t id = 0; id < mesh.face_count(b) * (scene.fill_back ? 2 : 1); ++id) {
      const SlowFace<T> face(mesh, b, id);
      for (int64_t n = 0; n < raster.pixels(); ++n) {
        const T depth = face.depth(n % raster.width, raster.height - 1 - n / raster.width, raster,
                                   scene.perspective);
        if (!(depth > scene.near && depth < nearest[n]))
          continue;  // of equally near faces the first wins
        nearest[n] = depth;
        expected[b * raster.pixels() + n] = static_cast<int32_t>(id);
      }
    }
  }
  for (size_t n = 0; n < expected.size(); ++n) CHECK_EQUAL(face_index[n], expected[n]);
}

// With and without perspective.
template <class T>
void check_rasterize(Scene<T> scene) {
  for (const bool perspective : {true, false}) {
    scene.perspective = perspective;
    check_rasterize_as_it_is(scene);
  }
}

constexpr Size kRasters[] = {{1, 1}, {2, 2}, {7, 7},  {24, 24},  {33, 64},
                             {1, 9}, {9, 1}, {40, 7}, {130, 24}, {12, 90}};

template <class T>
void check_mesh(const Mesh& mesh, bool fill_back, bool cut) {
  Scene<T> scene = single<T>(mesh);
  scene.anti_aliasing = false;
  scene.fill_back = fill_back;
  if (cut) scene.near = T(2), scene.far = T(3.5);  // within the depths of soup() and sphere()
  for (const Size raster : kRasters) {
    scene.image = raster;
    check_rasterize(scene);
  }
}

}  // namespace

TEST_REAL(rasterize_draws_the_definition) {
  for (uint64_t seed = 0; seed < 6; ++seed) {
    check_mesh<T>(soup(12, seed), seed % 2, seed % 3 == 1);
    check_mesh<T>(sphere(1, seed), seed % 2, seed % 3 == 1);
  }
  Scene<T> packed = pack<T>({sphere(1, 1), soup(5, 2), Mesh{}, soup(30, 3)});
  packed.image = {9, 21};
  check_rasterize(packed);
}

// Corners on pixel centres and borders of 16 pixels: no rounding excuses a difference.
TEST_REAL(rasterize_edges_are_inclusive) {
  for (uint64_t seed = 0; seed < 40; ++seed) {
    Mesh mesh = soup(3, seed);
    for (size_t n = 0; n < mesh.vertices.size(); ++n)
      if (n % 3 != 2) mesh.vertices[n] = (2 * std::floor(8 * (mesh.vertices[n] + 1)) + 1 - 16) / 16;
    Scene<T> scene = single<T>(mesh);
    scene.image = {16, 16};
    scene.anti_aliasing = seed % 2;
    check_rasterize(scene);
  }
}

// Faces on one plane of the scene, but for some units in the last place of their depths: only the
// published rounding tells which is nearer, bounds must not. And faces that are equally near.
TEST_REAL(rasterize_of_almost_equally_near_faces_is_exact) {
  for (uint64_t seed = 0; seed < 60; ++seed) {
    Mesh mesh = soup(15, seed);
    for (size_t n = 0; n < mesh.vertices.size(); n += 3) {
      const double q = 0.4 + 0.02 * static_cast<double>(seed % 5) * mesh.vertices[n] -
                       0.03 * mesh.vertices[n + 1];
      const double z = seed % 2 ? 1 / q : 2 + q;  // one plane with perspective, or without
      mesh.vertices[n + 2] =
          z * (1 + static_cast<double>(n * (seed + 1) % 7) * std::numeric_limits<T>::epsilon());
    }
    Scene<T> scene = single<T>(mesh);
    for (const Size image : {Size{24, 24}, Size{6, 45}, Size{45, 6}}) {
      scene.image = image;
      check_rasterize(scene);
    }
  }
  Mesh thrice = triangle({-0.9, -0.9, 2, 0.9, -0.9, 2, 0, 0.9, 2});
  thrice.faces = {2, 1, 0, 0, 1, 2, 0, 1, 2};
  check_mesh<T>(thrice, true, false);
}

}  // namespace nmr::test
