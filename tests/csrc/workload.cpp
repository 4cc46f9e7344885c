// Workload W1 of tools/bench/bench.py, as a program whose instructions can be counted and whose results can be compared between builds:
// deformed spheres of 1280 faces, 64x64 anti-aliased, forward and backward of 1 - soft IoU with the neighbour in the batch.
//   workload IMAGES        prints hashes of the results
#include <cinttypes>
#include <cstdio>
#include <cstdlib>

#include "meshes.h"

namespace nmr::test {
namespace {

constexpr int64_t kSize = 64;

// Icospheres with axes scaled by 0.4..1.2 and noise of deviation 0.03, times 0.5, in world space. The camera is 2.732 away at an
// elevation of 30 degrees, half field of view 15; the azimuth comes as (cos, sin) of a multiple of 3-4-5 angles: no sine of any C
// library has a part in it.
template <class T>
Scene<T> spheres(int64_t batch) {
  const Mesh ball = icosphere(3);
  std::vector<Mesh> meshes(batch, ball);
  double c = 1, s = 0;
  for (int64_t b = 0; b < batch; ++b) {
    const double c_next = 0.8 * c - 0.6 * s;
    s = 0.6 * c + 0.8 * s;
    c = c_next;
    const double sin_e = 0.5, cos_e = std::sqrt(0.75), tan_half = 2 - std::sqrt(3.0), distance = 2.732;
    for (size_t n = 0; n < ball.vertices.size(); n += 3) {
      double v[3];
      for (int k = 0; k < 3; ++k) {
        double normal = 0;  // a sum of four uniform numbers, of deviation 1
        for (int j = 0; j < 4; ++j) normal += noise(b + 1, 100 + 4 * (n + k) + j) * std::sqrt(0.75);
        v[k] = 0.5 * ((0.8 + 0.4 * noise(b + 1, k)) * ball.vertices[n + k] + 0.03 * normal);
      }
      const double x = c * v[0] + s * v[2], z = -s * v[0] + c * v[2];  // turned about y, then tilted
      const double depth = distance + cos_e * z - sin_e * v[1], up = sin_e * z + cos_e * v[1];
      meshes[b].vertices[n] = x / depth / tan_half;
      meshes[b].vertices[n + 1] = up / depth / tan_half;
      meshes[b].vertices[n + 2] = depth;
    }
  }
  Scene<T> scene = stack<T>(meshes, true);
  scene.image = square(kSize);
  return scene;
}

template <class T>
struct W1 {
  Scene<T> scene;
  std::vector<int32_t> owner;
  std::vector<T> alpha, target, grad_alpha, grad_vertices;

  explicit W1(int64_t batch)
      : scene(spheres<T>(batch)), owner(scene.pixels()), alpha(batch * kSize * kSize), target(alpha.size()), grad_alpha(alpha.size()),
        grad_vertices(scene.vertices.size()) {}

  void forward() {
    rasterize(Rasterize<T>{scene.mesh(), {scene.raster(), true, scene.near, scene.far}, owner.data(), 1});
    silhouette_forward(SilhouetteForward<T>{owner.data(), scene.batch, scene.image, true, alpha.data(), 1});
  }

  void backward() {
    silhouette_backward(SilhouetteBackward<T>{scene.mesh(), scene.image, true, scene.eps, owner.data(), grad_alpha.data(), grad_vertices.data(), 1});
  }

  // d(1 - IoU) / d alpha, IoU = sum(a t) / sum(a + t - a t) of each image with its neighbour.
  void loss() {
    const size_t pixels = kSize * kSize, batch = alpha.size() / pixels;
    for (size_t n = 0; n < alpha.size(); ++n) target[n] = alpha[(n + pixels) % alpha.size()];
    for (size_t b = 0; b < batch; ++b) {
      double both = 0, either = 0;
      for (size_t n = b * pixels; n < (b + 1) * pixels; ++n) {
        both += double(alpha[n]) * double(target[n]);
        either += double(alpha[n]) + double(target[n]) - double(alpha[n]) * double(target[n]);
      }
      for (size_t n = b * pixels; n < (b + 1) * pixels; ++n)
        grad_alpha[n] = static_cast<T>(-(double(target[n]) * either - both * (1 - double(target[n]))) / (either * either));
    }
  }
};

// FNV-1a of the bits.
template <class Values>
uint64_t hash(const Values& values) {
  uint64_t h = 0xcbf29ce484222325ull;
  const auto* byte = reinterpret_cast<const unsigned char*>(values.data());
  for (size_t n = 0; n < values.size() * sizeof(values[0]); ++n) h = (h ^ byte[n]) * 0x100000001b3ull;
  return h;
}

// callgrind counts between entering and leaving these two (--toggle-collect).
extern "C" __attribute__((noinline)) void counted_forward(W1<float>& w1) { w1.forward(); }
extern "C" __attribute__((noinline)) void counted_backward(W1<float>& w1) { w1.backward(); }

template <class T>
void print_hashes(const char* type, const W1<T>& w1) {
  double area = 0;
  for (T a : w1.alpha) area += double(a);
  std::printf("%-7s w1 owner %016" PRIx64 "  alpha %016" PRIx64 "  gradient %016" PRIx64 "  (mean alpha %.4f)\n", type, hash(w1.owner),
              hash(w1.alpha), hash(w1.grad_vertices), area / double(w1.alpha.size()));
  // Every stage on other meshes; the camera and the smoothness loss included.
  Scene<T> scene = pack<T>({sphere(2, 1), soup(40, 2), Mesh{}, sphere(1, 3)});
  scene.image = {31, 22};
  scene.texture_size = 4;
  run_stages(scene, 2).for_each([&](const char* name, const auto& values) {
    if (!values.empty()) std::printf("%-7s %-17s %016" PRIx64 "\n", type, name, hash(values));
  });
}

}  // namespace
}  // namespace nmr::test

int main(int argc, char** argv) {
  using namespace nmr::test;
  const int64_t images = argc > 1 ? std::atol(argv[1]) : 4;
  W1<float> single(images);
  single.forward();  // for the loss; it also brings every scratch buffer to its size
  single.loss();
  single.backward();
  counted_forward(single);
  counted_backward(single);
  if (argc > 2) return 0;  // for callgrind: no more than that
  W1<double> twice(images);
  twice.forward();
  twice.loss();
  twice.backward();
  print_hashes("float", single);
  print_hashes("double", twice);
}
