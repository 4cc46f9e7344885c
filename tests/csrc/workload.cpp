// Every stage on deformed spheres of 1280 faces, 64x64 anti-aliased (workload W1 of
// tools/bench/bench.py): a program whose instructions can be counted and whose results can be
// compared between builds.
//   workload IMAGES         prints hashes of the results, in float and double, also those of small
//   meshes workload IMAGES RUNS    runs every stage so many times in float
#include <cinttypes>
#include <cstdio>
#include <cstdlib>

#include "meshes.h"

namespace nmr::test {
namespace {

// Icospheres with axes scaled by 0.4..1.2 and noise of deviation 0.03, times 0.5, in world space.
// The camera is 2.732 away at an elevation of 30 degrees, half field of view 15; the azimuth comes
// as (cos, sin) of a multiple of 3-4-5 angles: no sine of any C library has a part in it.
template <class T>
Scene<T> spheres(int64_t batch) {
  const Mesh ball = icosphere(3);
  std::vector<Mesh> meshes(batch, ball);
  double c = 1, s = 0;
  for (int64_t b = 0; b < batch; ++b) {
    const double c_next = 0.8 * c - 0.6 * s;
    s = 0.6 * c + 0.8 * s;
    c = c_next;
    const double sin_e = 0.5, cos_e = std::sqrt(0.75), tan_half = 2 - std::sqrt(3.0),
                 distance = 2.732;
    for (size_t n = 0; n < ball.vertices.size(); n += 3) {
      double v[3];
      for (int k = 0; k < 3; ++k) {
        double normal = 0;  // a sum of four uniform numbers, of deviation 1
        for (int j = 0; j < 4; ++j) normal += noise(b + 1, 100 + 4 * (n + k) + j) * std::sqrt(0.75);
        v[k] = 0.5 * ((0.8 + 0.4 * noise(b + 1, k)) * ball.vertices[n + k] + 0.03 * normal);
      }
      const double x = c * v[0] + s * v[2],
                   z = -s * v[0] + c * v[2];  // turned about y, then tilted
      const double depth = distance + cos_e * z - sin_e * v[1], up = sin_e * z + cos_e * v[1];
      meshes[b].vertices[n] = x / depth / tan_half;
      meshes[b].vertices[n + 1] = up / depth / tan_half;
      meshes[b].vertices[n + 2] = depth;
    }
  }
  Scene<T> scene = stack<T>(meshes, true);
  scene.image = {64, 64};
  scene.seed = 107;  // lights of all kinds, mipmaps
  return scene;
}

template <class T>
void print_hashes(const char* type, const Scene<T>& scene) {
  const Results<T> results = run_stages(scene, 2);
  const auto print = [type](const auto& list) {
    for (const auto& [name, values] : list.arrays) {
      uint64_t hash = 0xcbf29ce484222325ull;  // FNV-1a of the bits
      const auto* byte = reinterpret_cast<const unsigned char*>(values.data());
      for (size_t n = 0; n < values.size() * sizeof(values[0]); ++n)
        hash = (hash ^ byte[n]) * 0x100000001b3ull;
      std::printf("%-7s %-21s %016" PRIx64 "\n", type, name, hash);
    }
  };
  std::apply([&](const auto&... lists) { (print(lists), ...); }, results.lists);
}

template <class T>
void print_all(const char* type, int64_t images) {
  print_hashes(type, spheres<T>(images));
  Scene<T> scene = pack<T>({sphere(2, 1), soup(40, 2), Mesh{}, sphere(1, 3)});
  scene.image = {31, 22};
  scene.texture_size = 4;
  print_hashes(type, scene);
  scene = stack<T>(std::vector<Mesh>(19, sphere(1, 1)),
                   true);  // more than the smoothness loss works on together
  print_hashes(type, scene);
}

}  // namespace
}  // namespace nmr::test

int main(int argc, char** argv) {
  using namespace nmr::test;
  const int64_t images = argc > 1 ? std::atol(argv[1]) : 4;
  if (argc > 2) {
    const Scene<float> scene = spheres<float>(images);
    Results<float> results;
    for (long n = 0; n < std::atol(argv[2]); ++n) run_stages(scene, 1, results);
    return 0;
  }
  print_all<float>("float", images);
  print_all<double>("double", images);
}
