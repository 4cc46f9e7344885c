#include "scene.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <string_view>
#include <type_traits>

namespace nmr::test {
namespace {

// Streams of noise, one per input.
enum Stream : uint64_t {
  kGradAlpha = 1,
  kGradWeights,
  kGradDepth,
  kGradDepthImage,
  kTextures,
  kGradColors,
  kAttributes,
  kGradValues,
  kImage,
  kBackground,
  kMatrix,
  kIntrinsics,
  kDistortion,
  kGradPoints,
  kGradLoss,
  kFaceIndex,
  kGradResolved,
  kOrigin,
  kExtent,
  kGradPose,
  kTexels,
  kGradPyramid,
  kUV,
  kGradSampled,
  kGradNormals,
  kLights,
  kViewer,
  kLitColors,
  kGradLit,
  kGradSoft
};

bool is_upstream(Stream stream) {
  return stream == kGradAlpha || stream == kGradWeights || stream == kGradDepth || stream == kGradDepthImage ||
         stream == kGradColors || stream == kGradValues || stream == kGradPoints ||
         stream == kGradLoss || stream == kGradResolved || stream == kGradPose || stream == kGradPyramid ||
         stream == kGradSampled || stream == kGradNormals || stream == kGradLit || stream == kGradSoft;
}

// Noise for one input of the stages. The array belongs to the thread and keeps its storage until the next scene.
template <class T>
std::vector<T>& input(const Scene<T>& scene, Stream stream, int64_t size) {
  static thread_local std::vector<T> inputs[64];
  using Limits = std::numeric_limits<T>;
  constexpr T special[] = {Limits::quiet_NaN(),
                           Limits::infinity(),
                           -Limits::infinity(),
                           Limits::max(),
                           Limits::lowest(),
                           Limits::denorm_min(),
                           T(1e30),
                           T(0)};
  std::vector<T>& values = inputs[stream];
  resize(values, size);
  for (int64_t n = 0; n < size; ++n) values[n] = static_cast<T>(noise(64 * scene.seed + stream, n));
  if (scene.hostile_upstream && is_upstream(stream))
    for (int64_t n = 0; n < size; ++n)
      if (std::abs(values[n]) < T(1) / 16) values[n] = special[static_cast<int>((values[n] + T(1) / 16) * 64) % 8];
  return values;
}

// Face index maps that no rasterizer made: any entry that names a face of its image.
template <class T>
void make_up_face_index(const Scene<T>& scene, std::vector<int32_t>& face_index) {
  const int64_t per_image = scene.raster().pixels();
  for (int64_t n = 0; n < scene.pixels(); ++n) {
    const int64_t choices = 2 * scene.mesh().face_count(n / per_image) + 1;
    const double u = (noise(64 * scene.seed + kFaceIndex, n) + 1) / 2;
    face_index[n] = static_cast<int32_t>(u * static_cast<double>(choices)) - 1;
  }
}

template <class T>
void run_silhouette(const Scene<T>& s, Results<T>& r, int num_threads) {
  const int64_t size = s.batch * s.image.pixels();
  unwritten(r.alpha, size);
  silhouette_forward(SilhouetteForward<T>{r.face_index.data(), s.batch, s.image, s.anti_aliasing, r.alpha.data(), num_threads});
  const std::vector<T>& grad_alpha = input(s, kGradAlpha, size);
  unwritten(r.grad_silhouette, 3 * s.rows());
  unwritten(r.grad_local, 3 * s.rows());
  SilhouetteBackward<T> args{
      s.mesh(), s.image, s.anti_aliasing, s.eps, r.face_index.data(), grad_alpha.data(), r.grad_silhouette.data(), num_threads};
  silhouette_backward(args);
  args.grad_vertices = r.grad_local.data();
  local_gradient(args);
}

template <class T>
void run_fragments(const Scene<T>& s, Results<T>& r, int num_threads) {
  unwritten(r.weights, 3 * s.pixels());
  unwritten(r.depth, s.pixels());
  unwritten(r.grad_fragments, 3 * s.rows());
  const std::vector<T>&grad_weights = input(s, kGradWeights, 3 * s.pixels()),
        &grad_depth = input(s, kGradDepth, s.pixels());
  Fragments<T> args{s.mesh(),
                    s.raster(),
                    s.far,
                    r.face_index.data(),
                    r.weights.data(),
                    r.depth.data(),
                    s.no_grad_weights ? nullptr : grad_weights.data(),
                    s.no_grad_depth ? nullptr : grad_depth.data(),
                    r.grad_fragments.data(),
                    num_threads};
  fragments_forward(args);
  fragments_backward(args);

  const int64_t size = s.batch * s.image.pixels();
  unwritten(r.depth_image, size);
  unwritten(r.grad_depth, 3 * s.rows());
  const std::vector<T>& grad_image = input(s, kGradDepthImage, size);
  DepthImage<T> image{s.mesh(),
                      s.image,
                      s.anti_aliasing,
                      s.far,
                      r.face_index.data(),
                      r.depth_image.data(),
                      grad_image.data(),
                      r.grad_depth.data(),
                      num_threads};
  depth_forward(image);
  depth_backward(image);
}

template <class T>
void run_shading(const Scene<T>& s, Results<T>& r, int num_threads) {
  const int64_t ts = s.texture_size, C = s.channels, groups = s.packed() ? 1 : s.per_image_values ? s.batch : 1;
  const int64_t* starts = s.packed() ? s.starts.data() : nullptr;
  const std::vector<T>& textures = input(s, kTextures, groups * s.num_faces * ts * ts * ts * C);
  const std::vector<T>& grad_colors = input(s, kGradColors, s.pixels() * C);
  unwritten(r.colors, s.pixels() * C);
  unwritten(r.grad_textures, textures.size());
  TextureCubes<T> cubes{r.face_index.data(),
                        r.weights.data(),
                        s.batch,
                        s.raster(),
                        textures.data(),
                        groups,
                        s.num_faces,
                        starts,
                        ts,
                        C,
                        s.eps,
                        r.colors.data(),
                        grad_colors.data(),
                        r.grad_textures.data(),
                        num_threads};
  texture_cubes_forward(cubes);
  texture_cubes_backward(cubes);

  const std::vector<T>& attributes = input(s, kAttributes, groups * s.num_vertices * C);
  const std::vector<T>& grad_values = input(s, kGradValues, s.pixels() * C);
  unwritten(r.values, s.pixels() * C);
  unwritten(r.grad_attributes, attributes.size());
  unwritten(r.grad_weights, 3 * s.pixels());
  Interpolate<T> values{r.face_index.data(),
                        r.weights.data(),
                        s.batch,
                        s.raster(),
                        attributes.data(),
                        groups,
                        s.num_vertices,
                        C,
                        s.faces.data(),
                        s.num_faces,
                        s.faces_per_image,
                        starts,
                        r.values.data(),
                        grad_values.data(),
                        r.grad_attributes.data(),
                        r.grad_weights.data(),
                        num_threads};
  interpolate_forward(values);
  interpolate_backward(values);
}

// Textures of 1 to 5 texels a side, shared or one for each image, with or without mipmaps; uv in [-1.5, 1.5).
template <class T>
void run_texture_images(const Scene<T>& s, Results<T>& r, int num_threads) {
  const int64_t groups = s.packed() || !s.per_image_values ? 1 : s.batch, C = s.channels,
                seed = static_cast<int64_t>(s.seed);
  const int64_t images = s.per_image_values && s.batch > 0 ? s.batch : 1, levels = seed % 2 ? 3 : 1;
  static thread_local std::vector<int64_t> grids;
  resize(grids, 3 * images * levels);
  int64_t count = 0, whole = 0;
  for (int64_t i = 0; i < images; ++i) {
    Size size{1 + (seed + 2 * i) % 5, 1 + (seed / 2 + i) % 5};
    whole += size.pixels();
    for (int64_t level = 0; level < levels; ++level) {
      int64_t* grid = grids.data() + 3 * (i * levels + level);
      grid[0] = count;
      grid[1] = size.height;
      grid[2] = size.width;
      count += size.pixels();
      size = {std::max(size.height / 2, int64_t(1)), std::max(size.width / 2, int64_t(1))};
    }
  }
  const std::vector<T>&texels = input(s, kTexels, whole * C), &grad_pyramid = input(s, kGradPyramid, count * C);
  unwritten(r.pyramid, count * C);
  unwritten(r.grad_texels, whole * C);
  const Mipmaps<T> mipmaps{images,        levels,           grids.data(),        C,
                           texels.data(), r.pyramid.data(), grad_pyramid.data(), r.grad_texels.data(),
                           num_threads};
  mipmaps_forward(mipmaps);
  mipmaps_backward(mipmaps);

  std::vector<T>& uv = input(s, kUV, groups * s.num_vertices * 2);
  for (T& x : uv) x *= T(1.5);
  unwritten(r.grad_uv, static_cast<int64_t>(uv.size()));
  unwritten(r.grad_uv_weights, 3 * s.pixels());
  const Interpolate<T> at{r.face_index.data(),
                          r.weights.data(),
                          s.batch,
                          s.raster(),
                          uv.data(),
                          groups,
                          s.num_vertices,
                          2,
                          s.faces.data(),
                          s.num_faces,
                          s.faces_per_image,
                          s.packed() ? s.starts.data() : nullptr,
                          nullptr,
                          nullptr,
                          r.grad_uv.data(),
                          s.no_grad_weights ? nullptr : r.grad_uv_weights.data(),
                          num_threads};
  unwritten(r.level, s.pixels());
  uv_levels(UVLevels<T>{at, s.mesh(), grids.data(), images, levels, r.level.data()});
  const std::vector<T>& grad_sampled = input(s, kGradSampled, s.pixels() * C);
  unwritten(r.sampled, s.pixels() * C);
  unwritten(r.grad_sampled_texels, count * C);
  const SampleUV<T> sample{at,
                           r.pyramid.data(),
                           count,
                           C,
                           grids.data(),
                           images,
                           levels,
                           levels > 1 ? r.level.data() : nullptr,
                           static_cast<Wrap>(seed / 4 % 3),
                           r.sampled.data(),
                           grad_sampled.data(),
                           r.grad_sampled_texels.data()};
  sample_uv_forward(sample);
  sample_uv_backward(sample);
}

// Up to two directional and two point lights, shared or one set for each image, with or without highlights; or the
// normals themselves.
template <class T>
void run_lights(const Scene<T>& s, Results<T>& r, int num_threads) {
  const int64_t seed = static_cast<int64_t>(s.seed), rows = s.per_image_values ? s.batch : 1;
  const bool smooth = seed & 1;
  const int64_t count = smooth ? s.rows() : s.packed() ? s.num_faces : s.batch * s.num_faces;
  unwritten(r.normals, 3 * count);
  unwritten(r.grad_normals_vertices, 3 * s.rows());
  const std::vector<T>& grad_normals = input(s, kGradNormals, 3 * count);
  const Normals<T> normals{s.mesh(),   smooth, r.normals.data(), grad_normals.data(), r.grad_normals_vertices.data(),
                           num_threads};
  normals_forward(normals);
  normals_backward(normals);

  constexpr int64_t kKinds = static_cast<int64_t>(Light::count), kWidths[kKinds] = {1, 3, 1, 3, 3, 1, 3, 3, 1, 1, 1};
  const int64_t directional = seed / 2 % 3, points = seed / 8 % 3, highlights = seed / 32 % 2;
  const int64_t lights[kKinds] = {1, 1, directional, 1, directional, points, 1, points, 1, highlights, highlights};
  int64_t layout[3 * kKinds], num_parameters = 0;
  for (int64_t n = 0; n < kKinds; ++n) {
    layout[3 * n] = num_parameters;
    layout[3 * n + 1] = n % 3 == 0 ? rows : 1;
    layout[3 * n + 2] = lights[n];
    num_parameters += layout[3 * n + 1] * lights[n] * kWidths[n];
  }
  std::vector<T>&parameters = input(s, kLights, num_parameters), &viewer = input(s, kViewer, 5 * s.batch);
  for (int64_t n = 0; n < kKinds; ++n)  // numbered so that those of the first image do not depend on the size of the batch
    for (int64_t k = 0; k < layout[3 * n + 1] * lights[n] * kWidths[n]; ++k) {
      const T x = static_cast<T>(noise(64 * s.seed + kLights, 1000 * n + k));
      parameters[layout[3 * n] + k] = T(1) / 4 + x * x;
    }
  for (int64_t b = 0; b < s.batch; ++b) {
    viewer[5 * b + 3] = T(seed / 4 % 2);
    viewer[5 * b + 4] = viewer[5 * b + 4] < 0 ? T(-1) : T(1);
  }
  const int64_t C = seed % 3 == 0 ? 1 : 3;
  const bool lit = seed % 8 != 6, colored = lit && seed % 5 != 0;
  const std::vector<T>&colors = input(s, kLitColors, s.pixels() * C), &grad_lit = input(s, kGradLit, 3 * s.pixels());
  unwritten(r.lit, 3 * s.pixels());
  unwritten(r.grad_lit_colors, colored ? s.pixels() * C : 0);
  unwritten(r.grad_lit_normals, 3 * count);
  unwritten(r.grad_lights, lit ? num_parameters : 0);
  unwritten(r.grad_lit_vertices, 3 * s.rows());
  unwritten(r.grad_lit_weights, 3 * s.pixels());
  Lit<T> args{};
  args.at = Interpolate<T>{r.face_index.data(),
                           r.weights.data(),
                           s.batch,
                           s.raster(),
                           s.vertices.data(),
                           s.batch,
                           s.num_vertices,
                           3,
                           s.faces.data(),
                           s.num_faces,
                           s.faces_per_image,
                           s.packed() ? s.starts.data() : nullptr,
                           nullptr,
                           nullptr,
                           r.grad_lit_vertices.data(),
                           r.grad_lit_weights.data(),
                           num_threads};
  args.normals = r.normals.data();
  args.normal_batch = s.packed() ? 0 : s.batch;
  args.smooth = smooth;
  args.viewer = viewer.data();
  if (lit) {
    args.parameters = parameters.data();
    args.layout = layout;
    args.num_parameters = num_parameters;
    args.grad_parameters = r.grad_lights.data();
  }
  if (colored) {
    args.colors = colors.data();
    args.channels = C;
    args.grad_colors = r.grad_lit_colors.data();
  }
  args.lit = r.lit.data();
  args.grad_lit = grad_lit.data();
  args.grad_normals = r.grad_lit_normals.data();
  lit_forward(args);
  lit_backward(args);
}

// SoftRas's silhouette, and the nearest one to three faces.
template <class T>
void run_surfaces(const Scene<T>& s, Results<T>& r, int num_threads) {
  const RasterSettings<T> raster{s.raster(), s.fill_back, s.near, s.far};
  const int64_t layers = 1 + static_cast<int64_t>(s.seed) % 3;
  resize(r.layers, layers * s.pixels());
  std::fill(r.layers.begin(), r.layers.end(), std::numeric_limits<int32_t>::min());
  rasterize_layers(RasterizeLayers<T>{s.mesh(), raster, layers, r.layers.data(), num_threads});

  const T sigma = s.seed % 4 == 0 ? T(1e-4) : s.seed % 4 == 1 ? T(1e-2) : T(0.3);
  const SoftSettings<T> settings{raster, sigma, s.seed % 5 == 0 ? T(100) : T(7) * sigma};
  unwritten(r.clear, s.pixels());
  unwritten(r.grad_soft, 3 * s.rows());
  soft_forward(SoftForward<T>{s.mesh(), settings, r.clear.data(), num_threads});
  const std::vector<T>& grad_clear = input(s, kGradSoft, s.pixels());
  soft_backward(
      SoftBackward<T>{s.mesh(), settings, r.clear.data(), grad_clear.data(), r.grad_soft.data(), num_threads});
}

template <class T>
void run_clip(const Scene<T>& s, Results<T>& r, int num_threads) {
  resize(r.clip_counts, 2 * s.batch);
  std::fill(r.clip_counts.begin(), r.clip_counts.end(), -1);
  clip_count(ClipCount<T>{s.mesh(), s.near, r.clip_counts.data(), num_threads});
  const int64_t spare = s.seed % 4 == 0;
  resize(r.clip_starts, 2 * s.batch + 2);
  r.clip_starts[0] = r.clip_starts[1] = 0;
  for (int64_t n = 0; n < 2 * s.batch; ++n) r.clip_starts[n + 2] = r.clip_starts[n] + r.clip_counts[n] + spare;
  const int64_t P = r.clip_starts[2 * s.batch], M = r.clip_starts[2 * s.batch + 1];
  resize(r.clip_faces, 3 * M);
  resize(r.clip_corners, 3 * M);
  resize(r.clip_ends, 4 * P);
  resize(r.clip_source, M);
  for (auto* indices : {&r.clip_faces, &r.clip_corners, &r.clip_ends}) std::fill(indices->begin(), indices->end(), -1);
  std::fill(r.clip_source.begin(), r.clip_source.end(), -1);
  clip_faces(ClipFaces<T>{s.mesh(), s.near, r.clip_starts.data(), r.clip_faces.data(), r.clip_source.data(),
                          r.clip_corners.data(), r.clip_ends.data(), num_threads});
}

template <class T>
void run_edges(const Scene<T>& s, Results<T>& r, int num_threads) {
  const std::vector<T>& image = input(s, kImage, s.pixels() * s.channels);

  const int64_t size = s.batch * s.image.pixels() * s.channels;
  const std::vector<T>& grad_resolved = input(s, kGradResolved, size);
  unwritten(r.resolved, size);
  unwritten(r.grad_image, image.size());
  unwritten(r.grad_background, s.batch * s.channels);
  unwritten(r.grad_edges, 3 * s.rows());
  // Half of the scenes have a background, of their own for each image or one for all.
  const int64_t background_batch = s.per_image_values ? s.batch : 1;
  const std::vector<T>& colors = input(s, kBackground, background_batch * s.channels);
  const T* background = s.fill_back ? colors.data() : nullptr;
  Resolve<T> resolve{
      s.batch,    s.image,          s.anti_aliasing,   s.channels,           r.face_index.data(), image.data(),
      background, background_batch, r.resolved.data(), grad_resolved.data(), r.grad_image.data(), r.grad_background.data(),
      num_threads};
  edges_backward(EdgesBackward<T>{s.mesh(), s.image, s.anti_aliasing, s.eps, r.face_index.data(), image.data(), s.channels,
                                  background, background_batch, grad_resolved.data(), r.grad_edges.data(), num_threads});
  resolve_forward(resolve);
  resolve_backward(resolve);
}

// A camera per image: nearly the identity, three units back.
template <class T>
void run_camera(const Scene<T>& s, Results<T>& r, int num_threads) {
  std::vector<T>&matrix = input(s, kMatrix, 12 * s.batch), &intrinsics = input(s, kIntrinsics, 6 * s.batch);
  std::vector<T>& distortion = input(s, kDistortion, 5 * s.batch);
  for (int64_t b = 0; b < s.batch; ++b) {
    for (int k = 0; k < 12; ++k) matrix[12 * b + k] = matrix[12 * b + k] / 8 + T(k % 5 == 0) + (k == 11 ? T(2) : T(0));
    for (int k = 0; k < 6; ++k) intrinsics[6 * b + k] = intrinsics[6 * b + k] / 8 + T(k % 4 == 0);
    for (int k = 0; k < 5; ++k) distortion[5 * b + k] /= 16;
  }
  const std::vector<T>& grad_points = input(s, kGradPoints, 3 * s.rows());
  unwritten(r.points, 3 * s.rows());
  unwritten(r.grad_world, 3 * s.rows());
  unwritten(r.grad_matrix, 12 * s.batch);
  unwritten(r.grad_intrinsics, 6 * s.batch);
  const bool distorted = s.distorted && s.perspective, placed = !s.distorted;
  unwritten(r.grad_distortion, distorted ? 5 * s.batch : 0);
  std::vector<T>&origin = input(s, kOrigin, 3 * s.batch), &extent = input(s, kExtent, s.batch);
  for (T& x : extent) x = T(0.25) + x * x;
  unwritten(r.grad_origin, placed ? 3 * s.batch : 0);
  unwritten(r.grad_extent, placed ? s.batch : 0);
  const auto pointer = [](bool wanted, auto& values) { return wanted ? values.data() : nullptr; };
  Project<T> args{s.vertices.data(),
                  s.packed() ? s.starts.data() : nullptr,
                  s.batch,
                  s.batch,
                  s.num_vertices,
                  matrix.data(),
                  intrinsics.data(),
                  pointer(distorted, distortion),
                  pointer(placed, origin),
                  pointer(placed, extent),
                  s.perspective,
                  r.points.data(),
                  grad_points.data(),
                  r.grad_world.data(),
                  r.grad_matrix.data(),
                  r.grad_intrinsics.data(),
                  pointer(distorted, r.grad_distortion),
                  pointer(placed, r.grad_origin),
                  pointer(placed, r.grad_extent),
                  num_threads};
  project_forward(args);
  project_backward(args);
}

// Directions from the vertices, with whatever they hold; a pose for each pair of them.
template <class T>
void run_pose(const Scene<T>& s, Results<T>& r) {
  const int64_t poses = s.rows() / 2;
  const T *forward = s.vertices.data(), *up = forward + 3 * poses;
  const std::vector<T>& grad_matrix = input(s, kGradPose, 12 * poses);
  unwritten(r.pose, 12 * poses);
  unwritten(r.grad_forward, 3 * poses);
  unwritten(r.grad_up, 3 * poses);
  const Pose<T> args{forward, up, poses, r.pose.data(), grad_matrix.data(), r.grad_forward.data(), r.grad_up.data()};
  pose_forward(args);
  pose_backward(args);
}

// The edges are made up: corners of consecutive faces of the first mesh. Packed vertices count as one mesh.
template <class T>
void run_smoothness(const Scene<T>& s, Results<T>& r, int num_threads) {
  const int64_t num_edges = s.batch > 0 ? s.mesh().face_count(0) : 0, batch = s.packed() ? 1 : s.batch;
  static thread_local std::vector<int64_t> edges;
  resize(edges, 4 * num_edges);
  for (int64_t f = 0; f < num_edges; ++f) {
    const int64_t* face = s.faces.data() + 3 * f;
    for (int k = 0; k < 3; ++k) edges[4 * f + k] = face[k];
    edges[4 * f + 3] = s.faces[3 * ((f + 1) % num_edges) + 1];
  }
  const std::vector<T>& grad_loss = input(s, kGradLoss, batch);
  unwritten(r.loss, batch);
  unwritten(r.grad_loss, 3 * s.rows());
  Smoothness<T> args{s.vertices.data(), edges.data(), batch, s.num_vertices, num_edges, r.loss.data(), grad_loss.data(),
                     r.grad_loss.data(), num_threads};
  smoothness_forward(args);
  smoothness_backward(args);
}

template <class T>
void run_voxels(const Scene<T>& s, Results<T>& r, int num_threads) {
  static thread_local std::vector<float> vertices;
  resize(vertices, static_cast<int64_t>(s.vertices.size()));
  std::copy(s.vertices.begin(), s.vertices.end(), vertices.begin());
  const int64_t cells = s.grid_size * s.grid_size * s.grid_size;
  for (auto* voxels : {&r.voxels, &r.touched_voxels}) {
    resize(*voxels, s.batch * cells);
    std::fill(voxels->begin(), voxels->end(), 2);
  }
  const MeshBatch<float> mesh{vertices.data(), s.faces.data(), s.batch, s.num_vertices, s.num_faces, s.faces_per_image,
                              s.packed() ? s.starts.data() : nullptr};
  voxelize(Voxelize{mesh, s.grid_size, false, reinterpret_cast<bool*>(r.voxels.data()), num_threads});
  voxelize(Voxelize{mesh, s.grid_size, true, reinterpret_cast<bool*>(r.touched_voxels.data()), num_threads});
}

// Every index that clipping gives lies within what it indexes.
template <class T>
const char* broken_clip(const Scene<T>& scene, const Results<T>& r) {
  const MeshBatch<T> mesh = scene.mesh();
  for (int64_t b = 0; b < scene.batch; ++b) {
    const int64_t V = mesh.vertex_count(b), F = mesh.face_count(b), first = mesh.vertex_start(b);
    const int64_t P = r.clip_starts[2 * b + 2] - r.clip_starts[2 * b];
    for (int64_t f = r.clip_starts[2 * b + 1]; f < r.clip_starts[2 * b + 3]; ++f) {
      if (r.clip_source[f] < 0 || r.clip_source[f] >= std::max<int64_t>(F, 1)) return "a drawn face is part of a face";
      for (int k = 0; k < 3; ++k) {
        const int64_t v = r.clip_faces[3 * f + k], corner = r.clip_corners[3 * f + k];
        if (V > 0 && (v < 0 || v >= V + P)) return "a corner of a drawn face is a vertex or a new vertex";
        if (corner < 0 || corner >= 3 + std::max<int64_t>(P, 1)) return "a corner of a drawn face lies on its face";
      }
    }
    for (int64_t p = r.clip_starts[2 * b]; p < r.clip_starts[2 * b + 2] && F > 0; ++p)
      for (int k = 0; k < 4; ++k) {
        const int64_t end = r.clip_ends[4 * p + k];
        if (k < 2 ? end < first || end >= first + V : end < 0 || end > 2)
          return "a new vertex lies between two corners";
      }
  }
  return nullptr;
}

template <class T>
bool all_finite(const std::vector<T>& values) {
  for (T x : values)
    if (!std::isfinite(x)) return false;
  return true;
}

// Every coordinate is a multiple of 1/256 within +-16, and no depth is nearer to 0 than that: areas and depths are far
// from underflow and overflow, so that every derivative is finite.
template <class T>
bool is_tame(const Scene<T>& scene) {
  for (int64_t n = 0; n < static_cast<int64_t>(scene.vertices.size()); ++n) {
    const T x = scene.vertices[n] * 256;
    if (!(std::abs(x) <= 4096) || x != std::round(x) || (n % 3 == 2 && x == 0)) return false;
  }
  return scene.near >= T(0.01) && scene.far <= T(1e4);
}

constexpr size_t kDifferent = ~size_t(0);

// The same bits; any NaN is a NaN.
template <class Number>
bool same(const Number* a, const Number* b, size_t size) {
  if (size == 0 || std::memcmp(a, b, size * sizeof(Number)) == 0) return true;
  if constexpr (std::is_floating_point_v<Number>) {
    for (size_t n = 0; n < size; ++n)
      if (std::memcmp(a + n, b + n, sizeof(Number)) != 0 && !(std::isnan(a[n]) && std::isnan(b[n]))) return false;
    return true;
  }
  return false;
}

// The name of the first result of which the first numbers, as many as `share(name, size in a, size in b)`, differ; or
// nullptr.
template <class T, class Share>
const char* compare(const Results<T>& a, const Results<T>& b, const Share& share) {
  struct Array {
    const void* data;
    size_t size;
  } arrays[64];
  size_t count = 0;
  const char* different = nullptr;
  a.for_each([&](const char*, const auto& values) { arrays[count++] = {values.data(), values.size()}; });
  count = 0;
  b.for_each([&](const char* name, const auto& values) {
    const Array other = arrays[count++];
    const size_t size = share(name, other.size, values.size());
    using Number = std::decay_t<decltype(values[0])>;
    if (!different && (size == kDifferent || !same(static_cast<const Number*>(other.data), values.data(), size)))
      different = name;
  });
  return different;
}

}  // namespace

template <class T>
void run_stages(const Scene<T>& scene, int num_threads, Results<T>& r) {
  resize(r.face_index, scene.pixels());
  std::fill(r.face_index.begin(), r.face_index.end(), std::numeric_limits<int32_t>::min());
  rasterize(
      Rasterize<T>{scene.mesh(), {scene.raster(), scene.fill_back, scene.near, scene.far}, r.face_index.data(), num_threads});
  run_surfaces(scene, r, num_threads);
  if (scene.foreign_face_index) make_up_face_index(scene, r.face_index);
  run_clip(scene, r, num_threads);
  run_silhouette(scene, r, num_threads);
  run_fragments(scene, r, num_threads);
  run_shading(scene, r, num_threads);
  run_texture_images(scene, r, num_threads);
  run_lights(scene, r, num_threads);
  run_edges(scene, r, num_threads);
  run_camera(scene, r, num_threads);
  run_pose(scene, r);
  run_smoothness(scene, r, num_threads);
  run_voxels(scene, r, num_threads);
}

template <class T>
Scene<T> packed(const Scene<T>& scene) {
  Scene<T> result = scene;
  result.num_vertices = result.num_faces = 0;
  result.faces.clear();
  result.faces_per_image = false;
  const MeshBatch<T> mesh = scene.mesh();
  for (int64_t b = 0; b < scene.batch; ++b) {
    result.add_start();
    result.num_vertices += scene.num_vertices;
    result.num_faces += scene.num_faces;
    result.faces.insert(result.faces.end(), mesh.image_faces(b), mesh.image_faces(b) + 3 * scene.num_faces);
  }
  result.add_start();
  return result;
}

template <class T>
Scene<T> first_image(const Scene<T>& scene) {
  Scene<T> result = scene;
  const MeshBatch<T> mesh = scene.mesh();
  result.batch = 1;
  result.num_vertices = mesh.vertex_count(0);
  result.num_faces = mesh.face_count(0);
  result.vertices.resize(3 * result.num_vertices);
  result.faces.resize(3 * result.num_faces);
  if (scene.packed()) result.starts = {0, 0, result.num_vertices, result.num_faces};
  return result;
}

template <class T>
const char* first_difference(const Results<T>& a, const Results<T>& b) {
  return compare(a, b,
                 [](const char*, size_t size_a, size_t size_b) { return size_a == size_b ? size_a : kDifferent; });
}

template <class T>
const char* depends_on_company(const Scene<T>& scene, const Results<T>& together, const Results<T>& alone) {
  const bool shared = !scene.per_image_values && !scene.packed();
  return compare(together, alone, [&](const char* name, size_t, size_t size) {
    const std::string_view which = name;
    if (which == "pose" || which == "grad_forward" || which == "grad_up") return size_t(0);  // not of an image
    if (scene.packed() && (which == "loss" || which == "grad_loss")) return size_t(0);
    if (shared && (which == "grad_textures" || which == "grad_attributes" || which == "grad_uv")) return size_t(0);
    if (!scene.per_image_values && which == "grad_sampled_texels") return size_t(0);
    if (which == "grad_lights") return size_t(0);
    return size;
  });
}

template <class T>
const char* depends_on_packing(const Results<T>& stacked, const Results<T>& packed) {
  return compare(stacked, packed, [](const char* name, size_t size_a, size_t size_b) {
    const std::string_view which = name;
    if (which == "loss" || which == "grad_loss") return size_t(0);
    return size_a == size_b ? size_a : kDifferent;
  });
}

template <class T>
const char* broken_promise(const Scene<T>& scene, const Results<T>& r) {
  const MeshBatch<T> mesh = scene.mesh();
  const Size raster = scene.raster(), image = scene.image;
  const int64_t H = raster.height, W = raster.width, C = scene.channels;
  for (int64_t b = 0; b < scene.batch; ++b) {
    const int64_t F = mesh.face_count(b), limit = scene.fill_back || scene.foreign_face_index ? 2 * F : F;
    const int32_t* face_index = r.face_index.data() + b * raster.pixels();
    for (int64_t n = 0; n < raster.pixels(); ++n) {
      const int32_t id = face_index[n];
      if (id < -1 || id >= limit) return "face_index names a face of its image, or -1";
      if (id < 0 || scene.foreign_face_index) continue;
      const int64_t* face = mesh.image_faces(b) + 3 * (id % F);
      const T x = static_cast<T>(2 * (n % W) + 1 - W) / static_cast<T>(W),
              y = static_cast<T>(H - 1 - 2 * (n / W)) / static_cast<T>(H);
      bool left = false, right = false, above = false, below = false;
      for (int k = 0; k < 3; ++k) {
        const T* v = mesh.image_vertices(b) + 3 * face[k];
        if (!std::isfinite(v[0]) || !std::isfinite(v[1]) || std::isnan(v[2]))
          return "a face with a NaN or an infinite x or y is not drawn";
        left |= v[0] <= x;
        right |= v[0] >= x;
        below |= v[1] <= y;
        above |= v[1] >= y;
      }
      if (!(left && right && above && below)) return "a face covers no centre outside its bounding box";
    }
    for (int64_t n = 0; n < image.pixels(); ++n) {
      const int32_t* pixel =
          scene.anti_aliasing ? face_index + 2 * (n / image.width) * W + 2 * (n % image.width) : face_index + n;
      const int covered = scene.anti_aliasing
                              ? (pixel[0] >= 0) + (pixel[1] >= 0) + (pixel[W] >= 0) + (pixel[W + 1] >= 0)
                              : 4 * (pixel[0] >= 0);
      if (r.alpha[b * image.pixels() + n] != T(covered) / 4) return "alpha is the covered share of a pixel";
    }
  }
  if (const char* broken = broken_clip(scene, r)) return broken;
  const size_t layers = r.face_index.empty() ? 0 : r.layers.size() / r.face_index.size();
  for (size_t n = 0; n < r.layers.size(); ++n) {
    const int32_t id = r.layers[n],
                  F = static_cast<int32_t>(mesh.face_count(static_cast<int64_t>(n / layers) / raster.pixels()));
    if (id < -1 || id >= (scene.fill_back ? 2 * F : F)) return "a layer names a face of its image, or -1";
    if (n % layers > 0 && id >= 0 && (r.layers[n - 1] < 0 || r.layers[n - 1] == id))
      return "layers are different faces, then -1";
    if (n % layers == 0 && !scene.foreign_face_index && id != r.face_index[n / layers])
      return "the first layer is the face index map";
  }
  for (T clear : r.clear)
    if (!(clear >= 0 && clear <= 1)) return "a soft silhouette lies in [0, 1]";
  for (T x : r.normals)
    if (!(std::abs(x) <= T(1.00001))) return "a normal has the length 1 or 0";
  for (const std::vector<unsigned char>* voxels : {&r.voxels, &r.touched_voxels})
    for (unsigned char cell : *voxels)
      if (cell > 1) return "a cell is filled or empty";
  for (size_t n = 0; n < r.points.size(); ++n)
    if (n % 3 == 2 ? !std::isfinite(r.points[n]) : std::isnan(r.points[n]))
      return "a projected vertex has a depth and a place, or is at infinity";
  for (size_t n = 0; n < r.pose.size(); ++n)
    if (std::isfinite(r.pose[n]) != std::isfinite(r.pose[n - n % 12]) || std::isinf(r.pose[n]))
      return "a pose is finite or all NaN";
  for (size_t n = 0; n < r.depth.size(); ++n) {
    if (r.face_index[n] >= 0) continue;
    if (r.depth[n] != scene.far) return "the background's depth is far";
    for (int k = 0; k < 3; ++k)
      if (r.weights[3 * n + k] != 0) return "the background's weights are 0";
    for (int64_t c = 0; c < C && !r.values.empty(); ++c)
      if (r.values[C * n + c] != 0 || r.colors[C * n + c] != 0 || r.sampled[C * n + c] != 0 ||
          r.lit[3 * n + c % 3] != 0)
        return "the background's colours are 0";
  }
  for (T level : r.level)
    if (!(level >= 0 && level <= 2)) return "a mipmap level is one that there is";
  for (const auto* grad : {&r.grad_silhouette, &r.grad_local, &r.grad_edges, &r.grad_soft})
    for (size_t n = 2; n < grad->size(); n += 3)
      if ((*grad)[n] != 0) return "the gradients of silhouettes and edges have no z";
  if (!scene.hostile_upstream) {
    if (!all_finite(r.grad_local)) return "the silhouette's local gradient is finite";
    if (!scene.foreign_face_index && !all_finite(r.grad_silhouette)) return "the silhouette's gradient is finite";
    if (!scene.foreign_face_index && !all_finite(r.grad_edges)) return "the edges' gradient is finite";
    for (const auto* grad :
         {&r.grad_world, &r.grad_matrix, &r.grad_intrinsics, &r.grad_distortion, &r.grad_origin, &r.grad_extent})
      if (!all_finite(*grad)) return "the gradient of the projection is finite";
    if (!all_finite(r.grad_soft)) return "the soft silhouette's gradient is finite";
    if (!all_finite(r.grad_forward) || !all_finite(r.grad_up)) return "the gradient of a pose is finite";
  }
  if (scene.foreign_face_index || !is_tame(scene)) return nullptr;

  for (size_t n = 0; n < r.depth.size(); ++n) {
    if (r.face_index[n] < 0) continue;
    const T* w = r.weights.data() + 3 * n;
    if (!(std::abs(w[0] + w[1] + w[2] - 1) <= T(1e-4))) return "the weights of a covered pixel sum to 1";
    if (!(r.depth[n] > scene.near * T(0.99) && r.depth[n] < scene.far * T(1.01)))
      return "a covered pixel's depth lies between near and far";
  }
  const char* not_finite = nullptr;
  if (scene.hostile_upstream) return nullptr;
  r.for_each([&](const char* name, const auto& values) {
    if constexpr (std::is_same_v<std::decay_t<decltype(values[0])>, T>)
      if (!not_finite && &values != &r.points && &values != &r.pose &&
          !(scene.no_grad_weights && &values == &r.grad_uv_weights) && !all_finite(values))
        not_finite = name;
  });
  return not_finite;
}

#define NMR_INSTANTIATE(T)                                                                                 \
  template void run_stages(const Scene<T>&, int, Results<T>&);                                             \
  template Scene<T> packed(const Scene<T>&);                                                               \
  template Scene<T> first_image(const Scene<T>&);                                                          \
  template const char* first_difference(const Results<T>&, const Results<T>&);                             \
  template const char* depends_on_company(const Scene<T>&, const Results<T>&, const Results<T>&);          \
  template const char* depends_on_packing(const Results<T>&, const Results<T>&);                           \
  template const char* broken_promise(const Scene<T>&, const Results<T>&);
NMR_INSTANTIATE(float)
NMR_INSTANTIATE(double)

}  // namespace nmr::test
