// Scenes for the tests: spheres, soups, and the same meshes laid out as a batch, per image, or
// packed. Nothing here calls a library function whose last bit differs between machines.
#pragma once

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "scene.h"

namespace nmr::test {

struct Mesh {
  std::vector<double> vertices;  // [V, 3]
  std::vector<int64_t> faces;    // [F, 3]
};

// Unit sphere of 20 * 4^subdivisions faces, counter-clockwise from outside in a right-handed frame.
inline Mesh icosphere(int subdivisions) {
  const double p = (1 + std::sqrt(5.0)) / 2;
  Mesh mesh{{-1, p,  0,  1, p, 0,  -1, -p, 0,  1, -p, 0, 0,  -1, p,  0,  1, p,
             0,  -1, -p, 0, 1, -p, p,  0,  -1, p, 0,  1, -p, 0,  -1, -p, 0, 1},
            {0, 11, 5,  0, 5,  1, 0, 1, 7, 0, 7,  10, 0, 10, 11, 1, 5, 9, 5, 11,
             4, 11, 10, 2, 10, 7, 6, 7, 1, 8, 3,  9,  4, 3,  4,  2, 3, 2, 6, 3,
             6, 8,  3,  8, 9,  4, 9, 5, 2, 4, 11, 6,  2, 10, 8,  6, 7, 9, 8, 1}};
  for (int level = 0; level < subdivisions; ++level) {
    std::map<std::pair<int64_t, int64_t>, int64_t> middles;
    const auto middle = [&](int64_t a, int64_t b) {
      const auto [entry, added] =
          middles.try_emplace(std::minmax(a, b), static_cast<int64_t>(mesh.vertices.size() / 3));
      if (added)
        for (int k = 0; k < 3; ++k)
          mesh.vertices.push_back((mesh.vertices[3 * a + k] + mesh.vertices[3 * b + k]) / 2);
      return entry->second;
    };
    std::vector<int64_t> finer;
    for (size_t f = 0; f < mesh.faces.size(); f += 3) {
      const int64_t a = mesh.faces[f], b = mesh.faces[f + 1], c = mesh.faces[f + 2];
      const int64_t ab = middle(a, b), bc = middle(b, c), ca = middle(c, a);
      for (int64_t v : {a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca}) finer.push_back(v);
    }
    mesh.faces = finer;
  }
  for (size_t v = 0; v < mesh.vertices.size(); v += 3) {
    double* x = mesh.vertices.data() + v;
    const double length = std::sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
    for (int k = 0; k < 3; ++k) x[k] /= length;
  }
  return mesh;
}

// A sphere in renderer space: squeezed, shaken, and at depth 3.
inline Mesh sphere(int subdivisions, uint64_t seed) {
  Mesh mesh = icosphere(subdivisions);
  for (size_t n = 0; n < mesh.vertices.size(); ++n) {
    const double scale = 0.55 + 0.3 * noise(seed, n % 3);
    mesh.vertices[n] = scale * mesh.vertices[n] + 0.03 * noise(seed, 3 + n) + (n % 3 == 2 ? 3 : 0);
  }
  return mesh;
}

// Faces anywhere, some of them partly off the screen, with depths in 1..5.
inline Mesh soup(int64_t num_faces, uint64_t seed) {
  Mesh mesh;
  for (int64_t n = 0; n < 9 * num_faces; ++n) {
    mesh.vertices.push_back(n % 3 == 2 ? 3 + 2 * noise(seed, n) : 1.2 * noise(seed, n));
    if (n % 3 == 0) mesh.faces.push_back(n / 3);
  }
  return mesh;
}

// Meshes of any sizes, packed.
template <class T>
Scene<T> pack(const std::vector<Mesh>& meshes) {
  Scene<T> scene;
  scene.batch = static_cast<int64_t>(meshes.size());
  for (const Mesh& mesh : meshes) {
    scene.add_start();
    scene.vertices.insert(scene.vertices.end(), mesh.vertices.begin(), mesh.vertices.end());
    scene.faces.insert(scene.faces.end(), mesh.faces.begin(), mesh.faces.end());
    scene.num_vertices += static_cast<int64_t>(mesh.vertices.size() / 3);
    scene.num_faces += static_cast<int64_t>(mesh.faces.size() / 3);
  }
  scene.add_start();
  return scene;
}

// Meshes of one size; with shared_faces, the first one's faces are everybody's.
template <class T>
Scene<T> stack(const std::vector<Mesh>& meshes, bool shared_faces) {
  Scene<T> scene = pack<T>(meshes);
  scene.starts.clear();
  if (scene.batch == 0) return scene;
  scene.num_vertices /= scene.batch;
  scene.num_faces /= scene.batch;
  scene.faces_per_image = !shared_faces;
  if (shared_faces) scene.faces.resize(3 * scene.num_faces);
  return scene;
}

template <class T>
Scene<T> single(const Mesh& mesh) {
  return stack<T>({mesh}, true);
}

// One face with the given corners.
inline Mesh triangle(std::vector<double> corners) { return {std::move(corners), {0, 1, 2}}; }

}  // namespace nmr::test
