// Every stage on deformed spheres of 1280 faces, 64x64 anti-aliased, as in workload W1 of
// tools/bench/bench.py: a program whose instructions can be counted and whose results can be
// compared between builds.
//   workload IMAGES         prints hashes of the results in float and double, small meshes too
//   workload IMAGES RUNS    runs every stage so many times in float
#include <cinttypes>
#include <cstdio>
#include <cstdlib>

#include "meshes.h"

namespace nmr::test {
namespace {

template <class T>
Scene<T> spheres(int64_t batch) {
  std::vector<Mesh> meshes;
  for (int64_t b = 0; b < batch; ++b) meshes.push_back(sphere(3, b + 1));
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
