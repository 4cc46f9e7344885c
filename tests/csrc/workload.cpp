// Workload W1 of tools/bench/bench.py, as a program whose instructions can be counted and whose results can be compared
// between builds: deformed spheres of 1280 faces, 64x64 anti-aliased, forward and backward of 1 - soft IoU with the
// neighbour in the batch; and the other stages on the same spheres.
//   workload IMAGES        prints hashes of the results
//   workload IMAGES ROW [TIMES]    runs what one row of count.py counts
#include <cinttypes>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "meshes.h"

namespace nmr::test {
namespace {

constexpr int64_t kSize = 64;

// Icospheres with axes scaled by 0.4..1.2 and noise of deviation 0.03, times 0.5, in world space. The camera is 2.732
// away at an elevation of 30 degrees, half field of view 15; the azimuth comes as (cos, sin) of a multiple of 3-4-5
// angles: no sine of any C library has a part in it.
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
  std::vector<int32_t> face_index;
  std::vector<T> alpha, target, grad_alpha, grad_vertices;

  explicit W1(int64_t batch)
      : scene(spheres<T>(batch)),
        face_index(scene.pixels()),
        alpha(batch * kSize * kSize),
        target(alpha.size()),
        grad_alpha(alpha.size()),
        grad_vertices(scene.vertices.size()) {}

  void forward() {
    rasterize(Rasterize<T>{scene.mesh(), {scene.raster(), true, scene.near, scene.far}, face_index.data(), 1});
    silhouette_forward(SilhouetteForward<T>{face_index.data(), scene.batch, scene.image, true, alpha.data(), 1});
  }

  void backward() {
    silhouette_backward(SilhouetteBackward<T>{scene.mesh(), scene.image, true, scene.eps, face_index.data(), grad_alpha.data(),
                                              grad_vertices.data(), 1});
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
        grad_alpha[n] =
            static_cast<T>(-(double(target[n]) * either - both * (1 - double(target[n]))) / (either * either));
    }
  }
};

// Colours on the spheres of W1: from the face index map to the image, and back. 32x32 texels with mipmaps; one directional
// light, flat.
template <class T>
struct Colors {
  static constexpr int64_t kTexels = 32, kLevels = 6, kLayers = 4;
  Scene<T> scene;
  int64_t pixels, rows, faces;
  std::vector<int32_t> face_index, layers;
  std::vector<T> weights, depth, at_vertices, uv, texels, colors, resolved, pyramid, level, normals, lit, clear;
  std::vector<T> upstream, grad_image, grad_weights, grad_depth, grad_vertices, grad_values, grad_texels, grad_pyramid,
      grad_normals, grad_lights;
  std::vector<T> background = std::vector<T>(3, T(0.2));
  std::vector<int64_t> grids, counts, starts;
  std::vector<T> lights, viewer;
  std::vector<int64_t> layout;

  explicit Colors(int64_t batch) : scene(spheres<T>(batch)) {
    pixels = scene.pixels();
    rows = scene.rows();
    faces = batch * scene.num_faces;
    face_index.resize(pixels), layers.resize(kLayers * pixels);
    weights.resize(3 * pixels), depth.resize(pixels), colors.resize(3 * pixels), resolved.resize(3 * pixels),
        level.resize(pixels);
    lit.resize(3 * pixels), clear.resize(pixels), normals.resize(3 * faces);
    grad_image.resize(3 * pixels), grad_weights.resize(3 * pixels), grad_depth.resize(pixels),
        grad_vertices.resize(3 * rows);
    grad_values.resize(3 * rows), grad_normals.resize(3 * faces);
    at_vertices = noise_array<T>(7, 3 * rows), uv = noise_array<T>(8, 2 * rows),
    upstream = noise_array<T>(9, 3 * pixels);
    texels = noise_array<T>(10, kTexels * kTexels * 3);
    int64_t first = 0;
    for (int64_t l = 0, side = kTexels; l < kLevels; ++l, side /= 2) {
      grids.insert(grids.end(), {first, side, side});
      first += side * side;
    }
    pyramid.resize(3 * first), grad_pyramid.resize(3 * first), grad_texels.resize(texels.size());
    lights = {T(0.5), 1, 1, 1, T(0.5), 1, 1, 1, 0, 1, 0};
    layout = {0, 1, 1, 1, 1, 1, 4, 1, 1, 5, 1, 1, 8, 1, 1};
    layout.resize(3 * static_cast<size_t>(Light::count), 0);
    grad_lights.resize(lights.size());
    for (int64_t b = 0; b < batch; ++b) viewer.insert(viewer.end(), {0, 0, 0, 1, 1});
  }

  Fragments<T> fragments() {
    return {scene.mesh(), scene.raster(),      scene.far,         face_index.data(),    weights.data(),
            depth.data(), grad_weights.data(), grad_depth.data(), grad_vertices.data(), 1};
  }
  Interpolate<T> interpolate(std::vector<T>& attributes, int64_t channels) {
    return {face_index.data(),
            weights.data(),
            scene.batch,
            scene.raster(),
            attributes.data(),
            scene.batch,
            scene.num_vertices,
            channels,
            scene.faces.data(),
            scene.num_faces,
            false,
            nullptr,
            colors.data(),
            grad_image.data(),
            grad_values.data(),
            grad_weights.data(),
            1};
  }
  Resolve<T> resolve() {
    return {
        scene.batch,     scene.image,       true,    3, face_index.data(), colors.data(), background.data(), 1, resolved.data(),
        upstream.data(), grad_image.data(), nullptr, 1};
  }
  Mipmaps<T> mipmaps() {
    return {1, kLevels, grids.data(), 3, texels.data(), pyramid.data(), grad_pyramid.data(), grad_texels.data(), 1};
  }
  SampleUV<T> sample() {
    return {interpolate(uv, 2),
            pyramid.data(),
            static_cast<int64_t>(pyramid.size()) / 3,
            3,
            grids.data(),
            1,
            kLevels,
            level.data(),
            Wrap::repeat,
            colors.data(),
            grad_image.data(),
            grad_pyramid.data()};
  }
  Normals<T> face_normals() {
    return {scene.mesh(), false, normals.data(), grad_normals.data(), grad_vertices.data(), 1};
  }
  Lit<T> light() {
    Lit<T> args{};
    args.at = interpolate(scene.vertices, 3);
    args.at.grad_attributes = args.at.grad_weights = nullptr;
    args.normals = normals.data();
    args.normal_batch = scene.batch;
    args.viewer = viewer.data();
    args.parameters = lights.data();
    args.layout = layout.data();
    args.num_parameters = static_cast<int64_t>(lights.size());
    args.colors = colors.data();
    args.channels = 3;
    args.lit = lit.data();
    args.grad_lit = grad_image.data();
    args.grad_colors = upstream.data();
    args.grad_normals = grad_normals.data();
    args.grad_parameters = grad_lights.data();
    return args;
  }
  RasterSettings<T> settings() const { return {scene.raster(), true, scene.near, scene.far}; }
  SoftSettings<T> soft() const { return {settings(), T(1e-4), T(9.2e-4)}; }

  void rasterize_first() {
    rasterize(Rasterize<T>{scene.mesh(), settings(), face_index.data(), 1});
    fragments_forward(fragments());
    resolve_backward(resolve());
  }
};

using C = Colors<float>;

// What count.py counts, by name; each function runs once before, which brings every scratch buffer to its size.
struct Row {
  const char* name;
  void (*run)(C&);
};
constexpr Row kRows[] = {
    {"vertex_colors_forward",
     [](C& c) {
       fragments_forward(c.fragments());
       interpolate_forward(c.interpolate(c.at_vertices, 3));
       resolve_forward(c.resolve());
     }},
    {"vertex_colors_backward",
     [](C& c) {
       resolve_backward(c.resolve());
       interpolate_backward(c.interpolate(c.at_vertices, 3));
       fragments_backward(c.fragments());
     }},
    {"edges_backward",
     [](C& c) {
       edges_backward(EdgesBackward<float>{c.scene.mesh(), c.scene.image, true, c.scene.eps, c.face_index.data(), c.colors.data(),
                                           3, c.background.data(), 1, c.upstream.data(), c.grad_vertices.data(), 1});
     }},
    {"uv_forward",
     [](C& c) {
       mipmaps_forward(c.mipmaps());
       uv_levels(
           UVLevels<float>{c.interpolate(c.uv, 2), c.scene.mesh(), c.grids.data(), 1, C::kLevels, c.level.data()});
       sample_uv_forward(c.sample());
     }},
    {"uv_backward", [](C& c) { sample_uv_backward(c.sample()), mipmaps_backward(c.mipmaps()); }},
    {"lights_forward", [](C& c) { normals_forward(c.face_normals()), lit_forward(c.light()); }},
    {"lights_backward", [](C& c) { lit_backward(c.light()), normals_backward(c.face_normals()); }},
    {"layers",
     [](C& c) { rasterize_layers(RasterizeLayers<float>{c.scene.mesh(), c.settings(), C::kLayers, c.layers.data(), 1}); }},
    {"soft_forward", [](C& c) { soft_forward(SoftForward<float>{c.scene.mesh(), c.soft(), c.clear.data(), 1}); }},
    {"soft_backward",
     [](C& c) {
       soft_backward(
           SoftBackward<float>{c.scene.mesh(), c.soft(), c.clear.data(), c.depth.data(), c.grad_vertices.data(), 1});
     }},
};

// FNV-1a of the bits.
template <class Values>
uint64_t hash(const Values& values) {
  uint64_t h = 0xcbf29ce484222325ull;
  const auto* byte = reinterpret_cast<const unsigned char*>(values.data());
  for (size_t n = 0; n < values.size() * sizeof(values[0]); ++n) h = (h ^ byte[n]) * 0x100000001b3ull;
  return h;
}

// callgrind counts between entering and leaving these (--toggle-collect).
extern "C" __attribute__((noinline)) void counted_forward(W1<float>& w1) { w1.forward(); }
extern "C" __attribute__((noinline)) void counted_backward(W1<float>& w1) { w1.backward(); }
extern "C" __attribute__((noinline)) void counted_row(const Row& row, C& colors) { row.run(colors); }

// For count.py: one row, so many times.
int run_row(const char* name, int64_t images, int64_t times) {
  if (std::strcmp(name, "forward") == 0 || std::strcmp(name, "backward") == 0) {
    W1<float> w1(images);
    w1.forward();  // for the loss; it also brings every scratch buffer to its size
    w1.loss();
    w1.backward();
    const auto run = std::strcmp(name, "forward") == 0 ? counted_forward : counted_backward;
    for (int64_t n = 0; n < times; ++n) run(w1);
    return 0;
  }
  C colors(images);
  colors.rasterize_first();
  for (const Row& row : kRows) {
    row.run(colors);  // in this order: each finds what those before it computed
    if (std::strcmp(row.name, name) != 0) continue;
    for (int64_t n = 0; n < times; ++n) counted_row(row, colors);
    return 0;
  }
  std::fprintf(stderr, "no row %s\n", name);
  return 1;
}

template <class T>
void print_hashes(const char* type, const W1<T>& w1) {
  double area = 0;
  for (T a : w1.alpha) area += double(a);
  std::printf("%-7s w1 face_index %016" PRIx64 "  alpha %016" PRIx64 "  gradient %016" PRIx64 "  (mean alpha %.4f)\n", type,
              hash(w1.face_index), hash(w1.alpha), hash(w1.grad_vertices), area / double(w1.alpha.size()));
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
  if (argc > 2) return run_row(argv[2], images, argc > 3 ? std::atol(argv[3]) : 1);
  W1<float> single(images);
  single.forward();
  single.loss();
  single.backward();
  W1<double> twice(images);
  twice.forward();
  twice.loss();
  twice.backward();
  print_hashes("float", single);
  print_hashes("double", twice);
}
