#include "scene.h"

#include <cmath>
#include <cstring>
#include <type_traits>

namespace nmr::test {
namespace {

// Streams of noise, one per input.
enum Stream : uint64_t { kGradAlpha = 1, kGradWeights, kGradDepth, kGradDepthImage, kTextures, kGradColors, kAttributes,
                         kGradValues, kImage, kGradImage, kMatrix, kIntrinsics, kDistortion, kGradPoints, kGradLoss, kOwner, kGradResolved,
                         kOrigin, kExtent, kGradPose };

template <class T>
std::vector<T> input(const Scene<T>& scene, Stream stream, int64_t size) {
  return noise_array<T>(64 * scene.seed + stream, size);
}

// Owner maps that no rasterizer made: any entry that names a face of its image.
template <class T>
std::vector<int32_t> made_up_owner(const Scene<T>& scene) {
  std::vector<int32_t> owner(scene.pixels());
  const int64_t per_image = scene.raster().pixels();
  for (int64_t n = 0; n < scene.pixels(); ++n) {
    const int64_t choices = 2 * scene.mesh().face_count(n / per_image) + 1;
    const double u = (noise(64 * scene.seed + kOwner, n) + 1) / 2;
    owner[n] = static_cast<int32_t>(u * static_cast<double>(choices)) - 1;
  }
  return owner;
}

template <class T>
void run_silhouette(const Scene<T>& s, Results<T>& r, int num_threads) {
  const int64_t size = s.batch * s.image.pixels();
  r.alpha = unwritten<T>(size);
  silhouette_forward(SilhouetteForward<T>{r.owner.data(), s.batch, s.image, s.anti_aliasing, r.alpha.data(), num_threads});
  const std::vector<T> grad_alpha = input(s, kGradAlpha, size);
  r.grad_silhouette = unwritten<T>(3 * s.rows());
  r.grad_local = unwritten<T>(3 * s.rows());
  SilhouetteBackward<T> args{s.mesh(), s.image, s.anti_aliasing, s.eps, r.owner.data(), grad_alpha.data(),
                             r.grad_silhouette.data(), num_threads};
  silhouette_backward(args);
  args.grad_vertices = r.grad_local.data();
  local_gradient(args);
}

template <class T>
void run_fragments(const Scene<T>& s, Results<T>& r, int num_threads) {
  r.weights = unwritten<T>(3 * s.pixels());
  r.depth = unwritten<T>(s.pixels());
  r.grad_fragments = unwritten<T>(3 * s.rows());
  const std::vector<T> grad_weights = input(s, kGradWeights, 3 * s.pixels()), grad_depth = input(s, kGradDepth, s.pixels());
  Fragments<T> args{s.mesh(), s.raster(), s.far, r.owner.data(), r.weights.data(), r.depth.data(), grad_weights.data(),
                    grad_depth.data(), r.grad_fragments.data(), num_threads};
  fragments_forward(args);
  fragments_backward(args);

  const int64_t size = s.batch * s.image.pixels();
  r.depth_image = unwritten<T>(size);
  r.grad_depth = unwritten<T>(3 * s.rows());
  const std::vector<T> grad_image = input(s, kGradDepthImage, size);
  DepthImage<T> image{s.mesh(), s.image, s.anti_aliasing, s.far, r.owner.data(), r.depth_image.data(), grad_image.data(),
                      r.grad_depth.data(), num_threads};
  depth_forward(image);
  depth_backward(image);
}

template <class T>
void run_shading(const Scene<T>& s, Results<T>& r, int num_threads) {
  const int64_t ts = s.texture_size, C = s.channels, groups = s.packed() ? 1 : s.per_image_values ? s.batch : 1;
  const int64_t* starts = s.packed() ? s.starts.data() : nullptr;
  const std::vector<T> textures = input(s, kTextures, groups * s.num_faces * ts * ts * ts * C);
  const std::vector<T> grad_colors = input(s, kGradColors, s.pixels() * C);
  r.colors = unwritten<T>(s.pixels() * C);
  r.grad_textures = unwritten<T>(textures.size());
  TextureCubes<T> cubes{r.owner.data(), r.weights.data(), s.batch, s.raster(), textures.data(), groups, s.num_faces, starts, ts,
                        C, s.eps, r.colors.data(), grad_colors.data(), r.grad_textures.data(), num_threads};
  texture_cubes_forward(cubes);
  texture_cubes_backward(cubes);

  const std::vector<T> attributes = input(s, kAttributes, groups * s.num_vertices * C);
  const std::vector<T> grad_values = input(s, kGradValues, s.pixels() * C);
  r.values = unwritten<T>(s.pixels() * C);
  r.grad_attributes = unwritten<T>(attributes.size());
  r.grad_weights = unwritten<T>(3 * s.pixels());
  Interpolate<T> values{r.owner.data(), r.weights.data(), s.batch, s.raster(), attributes.data(), groups, s.num_vertices, C,
                        s.faces.data(), s.num_faces, s.faces_per_image, starts, r.values.data(), grad_values.data(),
                        r.grad_attributes.data(), r.grad_weights.data(), num_threads};
  interpolate_forward(values);
  interpolate_backward(values);
}

template <class T>
void run_edges(const Scene<T>& s, Results<T>& r, int num_threads) {
  const std::vector<T> image = input(s, kImage, s.pixels() * s.channels), grad = input(s, kGradImage, s.pixels() * s.channels);
  r.grad_edges = unwritten<T>(3 * s.rows());
  edges_backward(EdgesBackward<T>{s.mesh(), s.raster(), s.eps, r.owner.data(), image.data(), s.channels, grad.data(),
                                  r.grad_edges.data(), num_threads});

  const int64_t size = s.batch * s.image.pixels() * s.channels;
  const std::vector<T> grad_resolved = input(s, kGradResolved, size);
  r.resolved = unwritten<T>(size);
  r.grad_image = unwritten<T>(image.size());
  Resolve<T> resolve{s.batch, s.image, s.anti_aliasing, s.channels, image.data(), r.resolved.data(), grad_resolved.data(),
                     r.grad_image.data(), num_threads};
  resolve_forward(resolve);
  resolve_backward(resolve);
}

// A camera per image: nearly the identity, three units back.
template <class T>
void run_camera(const Scene<T>& s, Results<T>& r, int num_threads) {
  std::vector<T> matrix = input(s, kMatrix, 12 * s.batch), intrinsics = input(s, kIntrinsics, 6 * s.batch);
  std::vector<T> distortion = input(s, kDistortion, 5 * s.batch);
  for (int64_t b = 0; b < s.batch; ++b) {
    for (int k = 0; k < 12; ++k) matrix[12 * b + k] = matrix[12 * b + k] / 8 + T(k % 5 == 0) + (k == 11 ? T(2) : T(0));
    for (int k = 0; k < 6; ++k) intrinsics[6 * b + k] = intrinsics[6 * b + k] / 8 + T(k % 4 == 0);
    for (int k = 0; k < 5; ++k) distortion[5 * b + k] /= 16;
  }
  const std::vector<T> grad_points = input(s, kGradPoints, 3 * s.rows());
  r.points = unwritten<T>(3 * s.rows());
  r.grad_world = unwritten<T>(3 * s.rows());
  r.grad_matrix = unwritten<T>(12 * s.batch);
  r.grad_intrinsics = unwritten<T>(6 * s.batch);
  const bool distorted = s.distorted && s.perspective, placed = !s.distorted;
  if (distorted) r.grad_distortion = unwritten<T>(5 * s.batch);
  std::vector<T> origin = input(s, kOrigin, 3 * s.batch), extent = input(s, kExtent, s.batch);
  for (T& x : extent) x = T(0.25) + x * x;
  if (placed) {
    r.grad_origin = unwritten<T>(3 * s.batch);
    r.grad_extent = unwritten<T>(s.batch);
  }
  const auto pointer = [](bool wanted, auto& values) { return wanted ? values.data() : nullptr; };
  Project<T> args{s.vertices.data(), s.packed() ? s.starts.data() : nullptr, s.batch, s.batch, s.num_vertices, matrix.data(),
                  intrinsics.data(), pointer(distorted, distortion), pointer(placed, origin), pointer(placed, extent), s.perspective,
                  r.points.data(), grad_points.data(), r.grad_world.data(), r.grad_matrix.data(), r.grad_intrinsics.data(),
                  pointer(distorted, r.grad_distortion), pointer(placed, r.grad_origin), pointer(placed, r.grad_extent), num_threads};
  project_forward(args);
  project_backward(args);
}

// Directions from the vertices, with whatever they hold; a pose for each pair of them.
template <class T>
void run_pose(const Scene<T>& s, Results<T>& r) {
  const int64_t poses = s.rows() / 2;
  const T *forward = s.vertices.data(), *up = forward + 3 * poses;
  const std::vector<T> grad_matrix = input(s, kGradPose, 12 * poses);
  r.pose = unwritten<T>(12 * poses);
  r.grad_forward = unwritten<T>(3 * poses);
  r.grad_up = unwritten<T>(3 * poses);
  const Pose<T> args{forward, up, poses, r.pose.data(), grad_matrix.data(), r.grad_forward.data(), r.grad_up.data()};
  pose_forward(args);
  pose_backward(args);
}

// The edges are made up: corners of consecutive faces of the first mesh. Packed vertices count as one mesh.
template <class T>
void run_smoothness(const Scene<T>& s, Results<T>& r, int num_threads) {
  const int64_t num_edges = s.batch > 0 ? s.mesh().face_count(0) : 0, batch = s.packed() ? 1 : s.batch;
  std::vector<int64_t> edges(4 * num_edges);
  for (int64_t f = 0; f < num_edges; ++f) {
    const int64_t* face = s.faces.data() + 3 * f;
    for (int k = 0; k < 3; ++k) edges[4 * f + k] = face[k];
    edges[4 * f + 3] = s.faces[3 * ((f + 1) % num_edges) + 1];
  }
  const std::vector<T> grad_loss = input(s, kGradLoss, batch);
  r.loss = unwritten<T>(batch);
  r.grad_loss = unwritten<T>(3 * s.rows());
  Smoothness<T> args{s.vertices.data(), edges.data(), batch, s.num_vertices, num_edges, r.loss.data(), grad_loss.data(),
                     r.grad_loss.data(), num_threads};
  smoothness_forward(args);
  smoothness_backward(args);
}

template <class T>
void run_voxels(const Scene<T>& s, Results<T>& r, int num_threads) {
  const std::vector<float> vertices(s.vertices.begin(), s.vertices.end());
  const int64_t cells = s.grid_size * s.grid_size * s.grid_size;
  r.voxels.assign(s.batch * cells, 2);
  r.touched_voxels.assign(s.batch * cells, 2);
  const MeshBatch<float> mesh{vertices.data(), s.faces.data(), s.batch, s.num_vertices, s.num_faces, s.faces_per_image,
                              s.packed() ? s.starts.data() : nullptr};
  voxelize(Voxelize{mesh, s.grid_size, false, reinterpret_cast<bool*>(r.voxels.data()), num_threads});
  voxelize(Voxelize{mesh, s.grid_size, true, reinterpret_cast<bool*>(r.touched_voxels.data()), num_threads});
}

template <class T>
bool all_finite(const std::vector<T>& values) {
  for (T x : values)
    if (!std::isfinite(x)) return false;
  return true;
}

// Every coordinate is a multiple of 1/256 within +-16, and no depth is nearer to 0 than that: areas and depths are far from
// underflow and overflow, so that every derivative is finite.
template <class T>
bool is_tame(const Scene<T>& scene) {
  for (int64_t n = 0; n < static_cast<int64_t>(scene.vertices.size()); ++n) {
    const T x = scene.vertices[n] * 256;
    if (!(std::abs(x) <= 4096) || x != std::round(x) || (n % 3 == 2 && x == 0)) return false;
  }
  return scene.near >= T(0.01) && scene.far <= T(1e4);
}

}  // namespace

template <class T>
Results<T> run_stages(const Scene<T>& scene, int num_threads) {
  Results<T> r;
  r.owner.assign(scene.pixels(), std::numeric_limits<int32_t>::min());
  rasterize(Rasterize<T>{scene.mesh(), {scene.raster(), scene.fill_back, scene.near, scene.far}, r.owner.data(), num_threads});
  if (scene.foreign_owner) r.owner = made_up_owner(scene);
  run_silhouette(scene, r, num_threads);
  run_fragments(scene, r, num_threads);
  run_shading(scene, r, num_threads);
  run_edges(scene, r, num_threads);
  run_camera(scene, r, num_threads);
  run_pose(scene, r);
  run_smoothness(scene, r, num_threads);
  run_voxels(scene, r, num_threads);
  return r;
}

template <class T>
const char* first_difference(const Results<T>& a, const Results<T>& b) {
  struct Bytes {
    const void* data;
    size_t size;
  };
  std::vector<Bytes> of_a;
  a.for_each([&](const char*, const auto& values) { of_a.push_back({values.data(), values.size() * sizeof(values[0])}); });
  const char* different = nullptr;
  size_t n = 0;
  b.for_each([&](const char* name, const auto& values) {
    const Bytes other = of_a[n++];
    const size_t size = values.size() * sizeof(values[0]);
    if (!different && (size != other.size || (size > 0 && std::memcmp(other.data, values.data(), size) != 0))) different = name;
  });
  return different;
}

template <class T>
const char* broken_promise(const Scene<T>& scene, const Results<T>& r) {
  const MeshBatch<T> mesh = scene.mesh();
  const int64_t R = scene.raster_size(), S = scene.image.width, C = scene.channels;
  for (int64_t b = 0; b < scene.batch; ++b) {
    const int64_t F = mesh.face_count(b), limit = scene.fill_back || scene.foreign_owner ? 2 * F : F;
    for (int64_t n = 0; n < R * R; ++n) {
      const int32_t id = r.owner[b * R * R + n];
      if (id < -1 || id >= limit) return "owner names a face of its image, or -1";
      if (id < 0 || scene.foreign_owner) continue;
      const int64_t* face = mesh.image_faces(b) + 3 * (id % F);
      const T x = static_cast<T>(2 * (n % R) + 1 - R) / static_cast<T>(R), y = static_cast<T>(R - 1 - 2 * (n / R)) / static_cast<T>(R);
      bool left = false, right = false, above = false, below = false;
      for (int k = 0; k < 3; ++k) {
        const T* v = mesh.image_vertices(b) + 3 * face[k];
        if (!std::isfinite(v[0]) || !std::isfinite(v[1]) || std::isnan(v[2])) return "a face with a NaN or an infinite x or y is not drawn";
        left |= v[0] <= x;
        right |= v[0] >= x;
        below |= v[1] <= y;
        above |= v[1] >= y;
      }
      if (!(left && right && above && below)) return "a face covers no centre outside its bounding box";
    }
    for (int64_t n = 0; n < S * S; ++n) {
      const int64_t y = n / S, x = n % S;
      const int32_t* owner = r.owner.data() + b * R * R;
      const int covered = scene.anti_aliasing ? (owner[2 * y * R + 2 * x] >= 0) + (owner[2 * y * R + 2 * x + 1] >= 0) +
                                                    (owner[(2 * y + 1) * R + 2 * x] >= 0) + (owner[(2 * y + 1) * R + 2 * x + 1] >= 0)
                                              : 4 * (owner[n] >= 0);
      if (r.alpha[b * S * S + n] != T(covered) / 4) return "alpha is the covered share of a pixel";
    }
  }
  for (size_t n = 2; n < r.grad_silhouette.size(); n += 3)
    if (r.grad_silhouette[n] != 0) return "the silhouette's gradient has no z";
  for (size_t n = 2; n < r.grad_local.size(); n += 3)
    if (r.grad_local[n] != 0) return "the silhouette's local gradient has no z";
  if (!all_finite(r.grad_local)) return "the silhouette's local gradient is finite";
  for (size_t n = 2; n < r.grad_edges.size(); n += 3)
    if (r.grad_edges[n] != 0) return "the edges' gradient has no z";
  for (const std::vector<unsigned char>* voxels : {&r.voxels, &r.touched_voxels})
    for (unsigned char cell : *voxels)
      if (cell > 1) return "a cell is filled or empty";
  if (!scene.foreign_owner) {
    if (!all_finite(r.grad_silhouette)) return "the silhouette's gradient is finite";
    if (!all_finite(r.grad_edges)) return "the edges' gradient is finite";
  }
  for (size_t n = 0; n < r.points.size(); ++n)
    if (n % 3 == 2 ? !std::isfinite(r.points[n]) : std::isnan(r.points[n])) return "a projected vertex has a depth and a place, or is at infinity";
  for (const std::vector<T>* grad : {&r.grad_world, &r.grad_matrix, &r.grad_intrinsics, &r.grad_distortion, &r.grad_origin, &r.grad_extent})
    if (!all_finite(*grad)) return "the gradient of the projection is finite";
  for (size_t n = 0; n < r.pose.size(); ++n)
    if (std::isfinite(r.pose[n]) != std::isfinite(r.pose[n - n % 12]) || std::isinf(r.pose[n])) return "a pose is finite or all NaN";
  if (!all_finite(r.grad_forward) || !all_finite(r.grad_up)) return "the gradient of a pose is finite";
  for (size_t n = 0; n < r.depth.size(); ++n) {
    if (r.owner[n] >= 0) continue;
    if (r.depth[n] != scene.far) return "the background's depth is far";
    for (int k = 0; k < 3; ++k)
      if (r.weights[3 * n + k] != 0) return "the background's weights are 0";
    for (int64_t c = 0; c < C && !r.values.empty(); ++c)
      if (r.values[C * n + c] != 0 || r.colors[C * n + c] != 0) return "the background's colours are 0";
  }
  if (scene.foreign_owner || !is_tame(scene)) return nullptr;

  for (size_t n = 0; n < r.depth.size(); ++n) {
    if (r.owner[n] < 0) continue;
    const T* w = r.weights.data() + 3 * n;
    if (!(std::abs(w[0] + w[1] + w[2] - 1) <= T(1e-4))) return "the weights of a covered pixel sum to 1";
    if (!(r.depth[n] > scene.near * T(0.99) && r.depth[n] < scene.far * T(1.01))) return "a covered pixel's depth lies between near and far";
  }
  const char* not_finite = nullptr;
  r.for_each([&](const char* name, const auto& values) {
    if constexpr (std::is_same_v<std::decay_t<decltype(values[0])>, T>)
      if (!not_finite && &values != &r.points && &values != &r.pose && !all_finite(values)) not_finite = name;
  });
  return not_finite;
}

template Results<float> run_stages(const Scene<float>&, int);
template Results<double> run_stages(const Scene<double>&, int);
template const char* first_difference(const Results<float>&, const Results<float>&);
template const char* first_difference(const Results<double>&, const Results<double>&);
template const char* broken_promise(const Scene<float>&, const Results<float>&);
template const char* broken_promise(const Scene<double>&, const Results<double>&);

}  // namespace nmr::test
