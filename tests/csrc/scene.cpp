#include "scene.h"

#include <algorithm>
#include <cmath>
#include <string_view>
#include <type_traits>

namespace nmr::test {
namespace {

using std::string_view;

template <class T>
struct Run {
  const Scene<T>& s;
  Results<T>& r;
  const int threads;

  const MeshBatch<T> mesh = s.mesh();
  const Size raster = s.raster();
  const int64_t pixels = s.pixels(), image_pixels = s.batch * s.image.pixels(), rows = s.rows(),
                C = s.channels;
  const int64_t seed = static_cast<int64_t>(s.seed),
                groups = s.packed() || !s.per_image_values ? 1 : s.batch;
  const int32_t* face_index = nullptr;
  const T* weights = nullptr;

  // Noise for one input of the stages. Upstream gradients have names that begin with "grad".
  T* in(const char* name, int64_t size) {
    std::vector<T>& values = r.inputs.resize(name, size);
    const uint64_t stream = stream_of(name);
    for (int64_t n = 0; n < size; ++n) values[n] = static_cast<T>(noise(stream, n));
    const bool upstream = string_view(name).substr(0, 4) == "grad";
    for (T& x : values)
      if (upstream && s.hostile_upstream && std::abs(x) < T(1) / 16)
        x = kSpecial<T>[static_cast<int>((x + T(1) / 16) * 120) % 15];
    return values.data();
  }
  uint64_t stream_of(const char* name) const {
    uint64_t stream = s.seed;
    for (char c : string_view(name)) stream = 31 * stream + static_cast<uint64_t>(c);
    return stream;
  }
  template <class Number = T>
  Number* out(const char* name, int64_t size) {
    return r.template out<Number>(name, size);
  }
  T* out_if(bool wanted, const char* name, int64_t size) {
    T* values = out(name, wanted ? size : 0);
    return wanted ? values : nullptr;
  }
  const T* in_if(bool wanted, const char* name, int64_t size) {
    const T* values = in(name, wanted ? size : 0);
    return wanted ? values : nullptr;
  }

  // `channels` values at the vertices of the faces, and their gradients.
  Interpolate<T> interpolate(const T* attributes, int64_t attribute_batch, int64_t channels,
                             T* grad, T* grad_weights) {
    const Rows rows{s.num_vertices, s.packed() || attribute_batch != 1, mesh.vertex_rows.starts};
    return {face_index,     weights,        s.batch, raster,  attributes, rows,         channels,
            s.faces.data(), mesh.face_rows, nullptr, nullptr, grad,       grad_weights, threads};
  }

  void all() {
    surfaces();
    clip();
    silhouettes();
    fragments();
    shading();
    texture_images();
    clip_space();
    lights();
    edges();
    camera();
    poses();
    smoothness();
    soft_iou();
    voxels();
  }

  // The face index map; SoftRas's silhouette; the nearest one to three faces.
  void surfaces() {
    const RasterSettings<T> settings{raster, s.fill_back, s.near, s.far, s.perspective};
    int32_t* index = out<int32_t>("face_index", pixels);
    face_index = index;
    rasterize(
        Rasterize<T>{mesh, settings, index, threads, out("alpha", image_pixels), s.anti_aliasing});
    const int64_t layers = 1 + seed % 3;
    rasterize_layers(RasterizeLayers<T>{mesh, settings, layers,
                                        out<int32_t>("layers", layers * pixels), threads});

    const T sigma = seed % 7 < 3 ? T(1e-4) : seed % 7 < 5 ? T(1e-2) : T(0.3);
    const SoftSettings<T> soft{settings, sigma, seed % 5 == 0 ? T(100) : T(7) * sigma};
    T* transmittance = out("transmittance", pixels);
    soft_forward(SoftForward<T>{mesh, soft, transmittance, threads});
    soft_backward(SoftBackward<T>{mesh, soft, transmittance, in("grad_transmittance", pixels),
                                  out("grad_soft", 3 * rows), out("grad_sigma", s.batch), threads});
    soft_layers(
        SoftLayers<T>{mesh, soft, layers, out<int32_t>("soft_layers", layers * pixels), threads});

    for (int64_t n = 0; n < pixels && s.foreign_face_index; ++n) {
      const double u = (noise(stream_of("face_index"), n) + 1) / 2;
      index[n] = static_cast<int32_t>(
                     u * static_cast<double>(2 * mesh.face_rows.count(n / raster.pixels()) + 1)) -
                 1;
    }
    if (s.given_face_index) std::copy_n(s.given_face_index, pixels, index);
  }

  void clip() {
    int64_t* counts = out<int64_t>("clip_counts", 2 * s.batch);
    clip_count(ClipCount<T>{mesh, s.near, counts, threads});
    int64_t* starts = out<int64_t>("clip_starts", 2 * s.batch + 2);
    starts[0] = starts[1] = 0;
    for (int64_t n = 0; n < 2 * s.batch; ++n)
      starts[n + 2] = starts[n] + counts[n] + (seed % 4 == 0);  // or room to spare
    const int64_t P = starts[2 * s.batch], M = starts[2 * s.batch + 1];
    clip_faces(ClipFaces<T>{mesh, s.near, starts, out<int64_t>("clip_faces", 3 * M),
                            out<int32_t>("clip_source", M), out<int64_t>("clip_corners", 3 * M),
                            out<int64_t>("clip_ends", 4 * P), threads});
  }

  void silhouettes() {
    SilhouetteBackward<T> args{mesh,
                               s.image,
                               s.anti_aliasing,
                               s.eps,
                               face_index,
                               in("grad_alpha", image_pixels),
                               out("grad_silhouette", 3 * rows),
                               threads};
    silhouette_backward(args);
    args.grad_vertices = out("grad_local", 3 * rows);
    local_gradient(args);
  }

  void fragments() {
    T* weights_out = out("weights", 3 * pixels);
    const Fragments<T> args{mesh,
                            raster,
                            false,
                            s.far,
                            face_index,
                            weights_out,
                            out("depth", pixels),
                            in_if(!s.no_grad_weights, "grad_weights", 3 * pixels),
                            in_if(!s.no_grad_depth, "grad_depth", pixels),
                            out("grad_fragments", 3 * rows),
                            threads,
                            s.perspective};
    fragments_forward(args);
    fragments_backward(args);
    weights = weights_out;
    // Of a map of one's own, pixels lie inside and outside of their faces.
    SoftFragments<T> soft{mesh,
                          raster,
                          1,
                          s.far,
                          s.perspective,
                          face_index,
                          out("soft_weights", 3 * pixels),
                          out("soft_depth", pixels),
                          out("distances", pixels),
                          in("grad_soft_weights", 3 * pixels),
                          in("grad_soft_depth", pixels),
                          in("grad_distances", pixels),
                          out("grad_soft_fragments", 3 * rows),
                          threads};
    soft_fragments_forward(soft);
    soft_fragments_backward(soft);
    const Fragments<T> image{mesh,
                             s.image,
                             s.anti_aliasing,
                             s.far,
                             face_index,
                             nullptr,
                             out("depth_image", image_pixels),
                             nullptr,
                             in("grad_depth_image", image_pixels),
                             out("grad_depth_vertices", 3 * rows),
                             threads,
                             s.perspective};
    fragments_forward(image);
    fragments_backward(image);
  }

  void shading() {
    const int64_t size =
        groups * s.num_faces * s.texture_size * s.texture_size * s.texture_size * C;
    const TextureCubes<T> cubes{face_index,
                                weights,
                                s.batch,
                                raster,
                                in("textures", size),
                                {s.num_faces, s.packed() || groups != 1, mesh.face_rows.starts},
                                s.texture_size,
                                C,
                                s.eps,
                                out("colors", pixels * C),
                                in("grad_colors", pixels * C),
                                out("grad_textures", size),
                                threads};
    texture_cubes_forward(cubes);
    texture_cubes_backward(cubes);
    const int64_t count = groups * s.num_vertices * C;
    Interpolate<T> args =
        interpolate(in("attributes", count), groups, C, out("grad_attributes", count),
                    out("grad_value_weights", 3 * pixels));
    args.values = out("values", pixels * C);
    args.grad_values = in("grad_values", pixels * C);
    interpolate_forward(args);
    interpolate_backward(args);
  }

  // Textures of 1 to 5 texels a side, shared or one for each image, with or without mipmaps; uv in
  // [-1.5, 1.5).
  void texture_images() {
    const int64_t images = s.per_image_values && s.batch > 0 ? s.batch : 1,
                  levels = seed % 2 ? 3 : 1;
    int64_t* grids = r.tables.resize("grids", 3 * images * levels).data();
    int64_t count = 0, whole = 0;
    for (int64_t i = 0; i < images; ++i) {
      Size size{1 + (seed + 2 * i) % 5, 1 + (seed / 2 + i) % 5};
      whole += size.pixels();
      for (int64_t level = 0; level < levels; ++level) {
        int64_t* grid = grids + 3 * (i * levels + level);
        grid[0] = count, grid[1] = size.height, grid[2] = size.width;
        count += size.pixels();
        size = {std::max(size.height / 2, int64_t(1)), std::max(size.width / 2, int64_t(1))};
      }
    }
    T* pyramid = out("pyramid", count * C);
    const Mipmaps<T> mipmaps{images,
                             levels,
                             grids,
                             C,
                             in("texels", whole * C),
                             pyramid,
                             in("grad_pyramid", count * C),
                             out("grad_texels", whole * C),
                             threads};
    mipmaps_forward(mipmaps);
    mipmaps_backward(mipmaps);

    const int64_t size = groups * s.num_vertices * 2;
    T* uv = in("uv", size);
    for (int64_t n = 0; n < size; ++n) uv[n] *= T(1.5);
    const Interpolate<T> at =
        interpolate(uv, groups, 2, out("grad_uv", size),
                    out_if(!s.no_grad_weights, "grad_uv_weights", 3 * pixels));
    T* level = out("level", pixels);
    uv_levels(UVLevels<T>{at, mesh, grids, images, levels, level});
    const SampleUV<T> sample{at,
                             pyramid,
                             count,
                             C,
                             grids,
                             images,
                             levels,
                             levels > 1 ? level : nullptr,
                             static_cast<Wrap>(seed / 4 % 3),
                             out("sampled", pixels * C),
                             in("grad_sampled", pixels * C),
                             out("grad_sampled_texels", count * C)};
    sample_uv_forward(sample);
    sample_uv_backward(sample);
  }

  // The same faces in clip space, image by image, and colours blended at their silhouettes.
  void clip_space() {
    T *rast = out("rast", 4 * pixels), *slopes = out("slopes", 4 * pixels),
      *blended = out("blended", pixels * C);
    T *grad_clip = out("grad_clip", 4 * rows),
      *grad_blended_positions = out("grad_blended_positions", 4 * rows);
    T* grad_blended_colors = out("grad_blended_colors", pixels * C);
    const T *colors = in("unblended", pixels * C), *grad_rast = in("grad_rast", 4 * pixels);
    const T *grad_slopes = in_if(!s.no_grad_depth, "grad_slopes", 4 * pixels),
            *grad = in("grad_blended", pixels * C);
    std::vector<T>& positions = r.inputs.resize("positions", 4 * rows);
    for (int64_t n = 0; n < rows; ++n) {
      const T *v = mesh.vertices + 3 * n, w = s.perspective ? v[2] : T(1),
              position[] = {v[0] * w, v[1] * w, v[2], w};
      std::copy_n(position, 4, positions.data() + 4 * n);
    }
    for (int64_t b = 0; b < s.batch; ++b) {
      const int64_t first = b * raster.pixels(), vertex = mesh.vertex_rows.first(b),
                    edges = 3 * mesh.face_rows.count(b);
      std::vector<int64_t>& twins =
          r.tables.resize("twins", edges);  // of other edges, too: any in range is allowed
      for (int64_t n = 0; n < edges; ++n) twins[n] = n % 3 ? n : (5 * n + seed) % edges;
      const ClipMesh<T> clip{positions.data() + 4 * vertex,
                             {mesh.vertex_rows.count(b), false, nullptr},
                             mesh.image_faces(b),
                             mesh.face_rows.count(b),
                             face_index + first,
                             1,
                             raster,
                             threads};
      const ClipWeights<T> args{clip,
                                rast + 4 * first,
                                slopes + 4 * first,
                                grad_rast + 4 * first,
                                grad_slopes ? grad_slopes + 4 * first : nullptr,
                                grad_clip + 4 * vertex};
      clip_weights_forward(args);
      clip_weights_backward(args);
      const Antialias<T> blend{clip,
                               rast + 4 * first,
                               twins.data(),
                               C,
                               colors + C * first,
                               blended + C * first,
                               grad + C * first,
                               grad_blended_colors + C * first,
                               grad_blended_positions + 4 * vertex};
      antialias_forward(blend);
      antialias_backward(blend);
    }
  }

  // Up to two directional and two point lights, shared or one set for each image, with or without
  // highlights; or the normals themselves.
  void lights() {
    const bool smooth = seed & 1;
    const int64_t count = smooth ? rows : s.packed() ? s.num_faces : s.batch * s.num_faces;
    T* unit = out("normals", 3 * count);
    const Normals<T> normals{
        mesh,   smooth, unit, in("grad_normals", 3 * count), out("grad_normals_vertices", 3 * rows),
        threads};
    normals_forward(normals);
    normals_backward(normals);

    constexpr int64_t kKinds = static_cast<int64_t>(LightParameter::count),
                      kWidths[kKinds] = {1, 3, 1, 3, 3, 1, 3, 3, 1, 1, 1};
    const int64_t directional = seed / 2 % 3, points = seed / 8 % 3, highlights = seed / 32 % 2;
    const int64_t number[kKinds] = {1, 1,      directional, 1,          directional, points,
                                    1, points, 1,           highlights, highlights};
    int64_t *layout = r.tables.resize("layout", 3 * kKinds).data(), num_parameters = 0;
    for (int64_t n = 0; n < kKinds; ++n) {
      layout[3 * n] = num_parameters;
      layout[3 * n + 1] = n % 3 == 0 && s.per_image_values ? s.batch : 1;
      layout[3 * n + 2] = number[n];
      num_parameters += layout[3 * n + 1] * number[n] * kWidths[n];
    }
    T *parameters = in("lights", num_parameters), *viewer = in("viewer", 5 * s.batch);
    for (int64_t n = 0; n < kKinds;
         ++n)  // those of the first image do not depend on the size of the batch
      for (int64_t k = 0; k < layout[3 * n + 1] * number[n] * kWidths[n]; ++k) {
        const T x = static_cast<T>(noise(stream_of("lights"), 1000 * n + k));
        parameters[layout[3 * n] + k] = T(1) / 4 + x * x;
      }
    for (int64_t b = 0; b < s.batch; ++b) {
      viewer[5 * b + 3] = T(seed / 4 % 2);
      viewer[5 * b + 4] = viewer[5 * b + 4] < 0 ? T(-1) : T(1);
    }
    const bool lit = seed % 8 != 6, colored = lit && seed % 5 != 0;
    LitColors<T> args{};
    args.at = interpolate(s.vertices.data(), s.batch, 3, out("grad_lit_vertices", 3 * rows),
                          out("grad_lit_weights", 3 * pixels));
    args.normals = unit;
    args.normal_rows = smooth ? args.at.rows : Rows{s.num_faces, true, mesh.face_rows.starts};
    args.smooth = smooth;
    args.viewer = viewer;
    args.parameters = lit ? parameters : nullptr;
    args.layout = layout;
    args.num_parameters = num_parameters;
    args.channels = seed % 3 == 0 ? 1 : 3;
    args.colors = in_if(colored, "lit_colors", pixels * args.channels);
    args.lit = out("lit", 3 * pixels);
    args.grad_lit = in("grad_lit", 3 * pixels);
    args.grad_colors = out_if(colored, "grad_lit_colors", pixels * args.channels);
    args.grad_normals = out("grad_lit_normals", 3 * count);
    args.grad_parameters = out_if(lit, "grad_lights", num_parameters);
    lit_forward(args);
    lit_backward(args);
  }

  // Half of the scenes have a background, of their own for each image or one for all.
  void edges() {
    const int64_t size = image_pixels * C, backgrounds = s.per_image_values ? s.batch : 1;
    const T *image = in("image", pixels * C), *grad = in("grad_resolved", size);
    const Parameter<T> background{in_if(s.fill_back, "background", backgrounds * C),
                                  s.fill_back && backgrounds != 1, nullptr};
    EdgesBackward<T> edges{mesh,
                           s.image,
                           s.anti_aliasing,
                           s.eps,
                           face_index,
                           image,
                           C,
                           background,
                           grad,
                           out("grad_edges", 3 * rows),
                           threads,
                           s.perspective};
    edges_backward(edges);
    edges.grad_vertices = out("grad_local_edges", 3 * rows);
    local_edges_backward(edges);
    const Resolve<T> resolve{s.batch,
                             s.image,
                             s.anti_aliasing,
                             C,
                             face_index,
                             image,
                             background,
                             out("resolved", size),
                             grad,
                             out("grad_image", pixels * C),
                             out("grad_background", s.batch * C),
                             threads};
    resolve_forward(resolve);
    resolve_backward(resolve);
  }

  // A camera per image: nearly the identity, three units back.
  void camera() {
    const bool distorted = s.distorted && s.perspective, placed = !s.distorted;
    const int64_t B = s.batch, D = seed % 4 == 1   ? 4
                                   : seed % 4 == 2 ? 8
                                                   : 5;  // coefficients of the distortion
    T *matrix = in("matrix", 12 * B), *intrinsics = in("intrinsics", 6 * B);
    T *origin = in("origin", 3 * B), *extent = in("extent", B);
    T* distortion = in("distortion", D * B);
    for (int64_t n = 0; n < 12 * B; ++n)
      matrix[n] = matrix[n] / 8 + T(n % 12 % 5 == 0) + T(n % 12 == 11 ? 2 : 0);
    for (int64_t n = 0; n < 6 * B; ++n) intrinsics[n] = intrinsics[n] / 8 + T(n % 6 % 4 == 0);
    for (int64_t n = 0; n < B; ++n) extent[n] = T(0.25) + extent[n] * extent[n];
    for (int64_t n = 0; n < D * B; ++n) distortion[n] /= 16;
    Project<T> args{};
    args.vertices = s.vertices.data();
    args.vertex_rows = mesh.vertex_rows;
    args.batch = args.cameras = B;
    args.perspective = s.perspective;
    args.matrix = {matrix, true, out("grad_matrix", 12 * B)};
    args.intrinsics = {intrinsics, true, out("grad_intrinsics", 6 * B)};
    if (placed) {
      args.origin = {origin, true, nullptr};
      args.extent = {extent, true, nullptr};
    }
    args.origin.grad = out_if(placed, "grad_origin", 3 * B);
    args.extent.grad = out_if(placed, "grad_extent", B);
    args.across = 1, args.down = T(0.5);
    if (distorted) args.distortion = {distortion, true, nullptr};
    args.distortion.grad = out_if(distorted, "grad_distortion", D * B);
    args.coefficients = D;
    args.camera = out("camera", kCamera * B);
    args.points = out("points", 3 * rows);
    args.nearest = out("nearest", 1);
    args.grad_points = in("grad_points", 3 * rows);
    args.grad_vertices = out("grad_world", 3 * rows);
    args.num_threads = threads;
    project_forward(args);
    project_backward(args);
  }

  // Directions from the vertices, with whatever they hold; a camera for each pair of them, at the
  // origin. Nothing is projected.
  void poses() {
    const int64_t count = rows / 2;
    const std::vector<double> points(s.vertices.begin(), s.vertices.begin() + 3 * rows);
    const double eye[3] = {}, view = 30;
    std::vector<double> grads(6 * count);
    T nearest = 0;
    Project<T> args{};
    args.batch = args.cameras = count;
    args.perspective = s.perspective;
    args.eye = {eye, false, nullptr};
    args.at = {points.data(), true, grads.data()};
    args.up = {points.data() + 3 * count, true, grads.data() + 3 * count};
    args.view = {&view, false, nullptr};
    args.along = true;
    args.across = args.down = 1;
    args.camera = out("pose", kCamera * count);
    args.nearest = &nearest;
    args.grad_camera = in("grad_pose", kCamera * count);
    args.num_threads = threads;
    project_forward(args);
    project_backward(args);
    std::copy_n(grads.data(), 3 * count, out("grad_forward", 3 * count));
    std::copy_n(grads.data() + 3 * count, 3 * count, out("grad_up", 3 * count));
  }

  // The edges are made up: corners of consecutive faces of the first mesh but the last, so that
  // groups of edges are not full. Packed vertices count as one mesh.
  void smoothness() {
    const int64_t num_faces = s.batch > 0 ? mesh.face_rows.count(0) : 0,
                  num_edges = std::max<int64_t>(num_faces - 1, 0), batch = s.packed() ? 1 : s.batch;
    int64_t* edges = r.tables.resize("edges", 4 * num_edges).data();
    for (int64_t f = 0; f < num_edges; ++f) {
      std::copy_n(s.faces.data() + 3 * f, 3, edges + 4 * f);
      edges[4 * f + 3] = s.faces[3 * (f + 1) + 1];
    }
    const Smoothness<T> args{s.vertices.data(),
                             edges,
                             batch,
                             s.num_vertices,
                             num_edges,
                             out("loss", batch),
                             in("grad_loss", batch),
                             out("grad_loss_vertices", 3 * rows),
                             threads};
    smoothness_forward(args);
    smoothness_backward(args);
  }

  // Of the raster's soft silhouettes and noise in [0, 1].
  void soft_iou() {
    T* target = in("target", pixels);
    for (int64_t n = 0; n < pixels; ++n) target[n] = std::abs(target[n]);
    double* areas = r.areas.resize("areas", 2 * s.batch).data();
    const SoftIou<T> args{r.get("transmittance").data(),
                          target,
                          s.batch,
                          raster.pixels(),
                          areas,
                          out("iou", s.batch),
                          out("target_range", 2),
                          in("grad_iou", s.batch),
                          out("grad_prediction", pixels),
                          out("grad_target", pixels),
                          threads};
    soft_iou_forward(args);
    soft_iou_backward(args);
  }

  void voxels() {
    static thread_local Arrays<float> memory;
    std::vector<float>& vertices =
        memory.resize("vertices", static_cast<int64_t>(s.vertices.size()));
    std::copy(s.vertices.begin(), s.vertices.end(), vertices.begin());
    const MeshBatch<float> batch{vertices.data(), s.faces.data(), s.batch, mesh.vertex_rows,
                                 mesh.face_rows};
    for (const bool touched : {false, true}) {
      const int64_t cells = s.grid_size * s.grid_size * s.grid_size;
      unsigned char* filled = out<unsigned char>(touched ? "touched" : "voxels", s.batch * cells);
      voxelize(Voxelize{batch, s.grid_size, touched, reinterpret_cast<bool*>(filled), threads});
    }
  }
};

template <class T>
bool all_finite(const std::vector<T>& values) {
  return std::all_of(values.begin(), values.end(), [](T x) { return std::isfinite(x); });
}

// Every coordinate is a multiple of 1/256 within +-16, and no depth is nearer to 0 than that: areas
// and depths are far from underflow and overflow, so that every derivative is finite.
template <class T>
bool is_tame(const Scene<T>& scene) {
  for (size_t n = 0; n < scene.vertices.size(); ++n) {
    const T x = scene.vertices[n] * 256;
    if (!(std::abs(x) <= 4096) || x != std::round(x) || (n % 3 == 2 && x == 0)) return false;
  }
  return scene.near >= T(0.01) && scene.far <= T(1e4);
}

constexpr size_t kDifferent = ~size_t(0);

template <class Number>
bool same(const Number* a, const Number* b, size_t size) {
  if (size == 0 || std::memcmp(a, b, size * sizeof(Number)) == 0) return true;
  if constexpr (std::is_floating_point_v<Number>) {
    for (size_t n = 0; n < size; ++n)
      if (std::memcmp(a + n, b + n, sizeof(Number)) != 0 && !(std::isnan(a[n]) && std::isnan(b[n])))
        return false;
    return true;
  }
  return false;
}

// The name of the first result that differs, or "". share(name, size in a, size in b) is how many
// of its numbers count, from the first.
template <class T, class Share>
const char* compare(const Results<T>& a, const Results<T>& b, const Share& share) {
  const char* different = "";
  const auto list = [&](const auto& these, const auto& others) {
    for (size_t n = 0; n < these.arrays.size(); ++n) {
      const auto &x = these.arrays[n].values, &y = others.arrays[n].values;
      const size_t size = share(string_view(these.arrays[n].name), x.size(), y.size());
      if (!*different && (size == kDifferent || !same(x.data(), y.data(), size)))
        different = these.arrays[n].name;
    }
  };
  std::apply(
      [&](const auto&... these) {
        (list(these, std::get<std::decay_t<decltype(these)>>(b.lists)), ...);
      },
      a.lists);
  return different;
}

size_t if_equal(size_t a, size_t b) { return a == b ? a : kDifferent; }

bool is_one_of(string_view name, std::initializer_list<string_view> names) {
  return std::find(names.begin(), names.end(), name) != names.end();
}

}  // namespace

template <class T>
void run_stages(const Scene<T>& scene, int num_threads, Results<T>& results) {
  Run<T>{scene, results, num_threads}.all();
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
    result.faces.insert(result.faces.end(), mesh.image_faces(b),
                        mesh.image_faces(b) + 3 * scene.num_faces);
  }
  result.add_start();
  return result;
}

template <class T>
Scene<T> first_image(const Scene<T>& scene) {
  Scene<T> result = scene;
  const MeshBatch<T> mesh = scene.mesh();
  result.batch = 1;
  result.num_vertices = mesh.vertex_rows.count(0);
  result.num_faces = mesh.face_rows.count(0);
  result.vertices.resize(3 * result.num_vertices);
  result.faces.resize(3 * result.num_faces);
  if (scene.packed()) result.starts = {0, 0, result.num_vertices, result.num_faces};
  return result;
}

template <class T>
const char* first_difference(const Results<T>& a, const Results<T>& b) {
  return compare(
      a, b, [](string_view, size_t size_a, size_t size_b) { return if_equal(size_a, size_b); });
}

template <class T>
const char* depends_on_company(const Scene<T>& scene, const Results<T>& together,
                               const Results<T>& alone) {
  return compare(together, alone, [&](string_view name, size_t, size_t size) {
    const bool summed =
        is_one_of(name, {"pose", "nearest", "grad_forward", "grad_up", "grad_lights"}) ||
        (scene.packed() && is_one_of(name, {"loss", "grad_loss_vertices"})) ||
        (!scene.per_image_values && name == "grad_sampled_texels") ||
        (!scene.per_image_values && !scene.packed() &&
         is_one_of(name, {"grad_textures", "grad_attributes", "grad_uv"}));
    return summed ? 0 : size;
  });
}

template <class T>
const char* depends_on_packing(const Results<T>& stacked, const Results<T>& packed) {
  return compare(stacked, packed, [](string_view name, size_t size_a, size_t size_b) {
    return is_one_of(name, {"loss", "grad_loss_vertices"}) ? 0 : if_equal(size_a, size_b);
  });
}

template <class T>
const char* broken_promise(const Scene<T>& scene, const Results<T>& r) {
  const char* broken = "";
  const auto check = [&broken](bool holds, const char* sentence) {
    if (!holds && !*broken) broken = sentence;
  };
  const auto check_all = [&](std::initializer_list<const char*> names, const auto& holds,
                             const char* sentence) {
    for (const char* name : names)
      for (T x : r.get(name)) check(holds(x), sentence);
  };
  const MeshBatch<T> mesh = scene.mesh();
  const Size raster = scene.raster();
  const int64_t H = raster.height, W = raster.width;
  const bool foreign = scene.foreign_face_index;
  const std::vector<int32_t>& face_index = r.template get<int32_t>("face_index");

  for (size_t n = 0; n < face_index.size(); ++n) {
    const int64_t b = static_cast<int64_t>(n) / raster.pixels(), x = static_cast<int64_t>(n) % W,
                  y = static_cast<int64_t>(n) / W % H;
    const int64_t F = mesh.face_rows.count(b), id = face_index[n];
    check(id >= -1 && id < (scene.fill_back || foreign ? 2 * F : F),
          "face_index names a face of its image, or -1");
    if (id < 0 || foreign || *broken) continue;
    const T centre[2] = {static_cast<T>(2 * x + 1 - W) / static_cast<T>(W),
                         static_cast<T>(H - 1 - 2 * y) / static_cast<T>(H)};
    bool below[2] = {false, false}, above[2] = {false, false};
    for (int k = 0; k < 3; ++k) {
      const T* v = mesh.image_vertices(b) + 3 * mesh.image_faces(b)[3 * (id % F) + k];
      check(std::isfinite(v[0]) && std::isfinite(v[1]) && !std::isnan(v[2]),
            "a face that is not finite is not drawn");
      for (int axis = 0; axis < 2; ++axis)
        below[axis] |= v[axis] <= centre[axis], above[axis] |= v[axis] >= centre[axis];
    }
    check(below[0] && below[1] && above[0] && above[1],
          "a face covers no centre outside its bounding box");
  }
  for (const char* name : {"layers", "soft_layers"}) {
    const std::vector<int32_t>& layers = r.template get<int32_t>(name);
    const size_t count = face_index.empty() ? 0 : layers.size() / face_index.size();
    for (size_t n = 0; n < layers.size(); ++n) {
      const int64_t id = layers[n],
                    F = mesh.face_rows.count(static_cast<int64_t>(n / count) / raster.pixels());
      check(id >= -1 && id < (scene.fill_back ? 2 * F : F),
            "a layer names a face of its image, or -1");
      if (n % count > 0)
        check(id < 0 || (layers[n - 1] >= 0 && layers[n - 1] != id),
              "layers are different faces, then -1");
      else if (string_view(name) == "layers" && !foreign)
        check(id == face_index[n / count], "the first layer is the face index map");
    }
  }

  const std::vector<int64_t>&starts = r.template get<int64_t>("clip_starts"),
        &corners = r.template get<int64_t>("clip_corners"),
        &clip_faces = r.template get<int64_t>("clip_faces"),
        &ends = r.template get<int64_t>("clip_ends");
  const std::vector<int32_t>& sources = r.template get<int32_t>("clip_source");
  for (int64_t b = 0; b < scene.batch; ++b) {
    const int64_t V = mesh.vertex_rows.count(b), F = mesh.face_rows.count(b),
                  first = mesh.vertex_rows.first(b), P = starts[2 * b + 2] - starts[2 * b];
    for (int64_t f = starts[2 * b + 1]; f < starts[2 * b + 3]; ++f) {
      const int64_t source = sources[f];
      check(source >= 0 && source < std::max<int64_t>(F, 1), "a drawn face is part of a face");
      for (int64_t n = 3 * f; n < 3 * f + 3; ++n) {
        const int64_t v = clip_faces[n];
        check(V == 0 || (v >= 0 && v < V + P),
              "a corner of a drawn face is a vertex or a new vertex");
        check(corners[n] >= 0 && corners[n] < 3 + std::max<int64_t>(P, 1),
              "a corner of a drawn face lies on its face");
      }
    }
    for (int64_t n = 4 * starts[2 * b]; n < 4 * starts[2 * b + 2] && F > 0; ++n) {
      const int64_t end = ends[n];
      check(n % 4 < 2 ? end >= first && end < first + V : end >= 0 && end <= 2,
            "a new vertex lies between two corners");
    }
  }

  check_all(
      {"transmittance"}, [](T x) { return x >= 0 && x <= 1; }, "a soft silhouette lies in [0, 1]");
  check_all(
      {"normals"}, [](T x) { return std::abs(x) <= T(1.00001); }, "a normal has the length 1 or 0");
  check_all({"level"}, [](T x) { return x >= 0 && x <= 2; }, "a mipmap level is one that there is");
  for (const char* name : {"voxels", "touched"})
    for (unsigned char cell : r.template get<unsigned char>(name))
      check(cell <= 1, "a cell is filled or empty");
  const std::vector<T>&points = r.get("points"), &pose = r.get("pose"), &depth = r.get("depth"),
        &weights = r.get("weights");
  for (size_t n = 0; n < points.size(); ++n)
    check(n % 3 == 2 ? std::isfinite(points[n]) : !std::isnan(points[n]),
          "a projected vertex has a depth and a place, or is at infinity");
  T least = std::numeric_limits<T>::infinity();
  for (size_t n = 2; n < points.size(); n += 3) least = std::min(least, points[n]);
  check(r.get("nearest")[0] == least, "the nearest depth is the least of all");
  for (size_t n = 0; n < pose.size(); ++n)
    check(n % kCamera >= kIntrinsics ||
              (std::isfinite(pose[n]) == std::isfinite(pose[n - n % kCamera]) &&
               !std::isinf(pose[n])),
          "a pose is finite or all NaN");
  for (const char* name :
       {"grad_silhouette", "grad_local", "grad_edges", "grad_local_edges", "grad_soft"}) {
    const std::vector<T>& grad = r.get(name);
    for (size_t n = 2; n < grad.size(); n += 3)
      check(grad[n] == 0, "the gradients of silhouettes and edges have no z");
  }
  for (const char* name : {"weights", "values", "colors", "sampled", "lit", "rast", "slopes"}) {
    const std::vector<T>& values = r.get(name);
    const size_t channels = depth.empty() ? 1 : values.size() / depth.size();
    for (size_t n = 0; n < values.size(); ++n)
      check(face_index[n / channels] >= 0 || values[n] == 0,
            "the background's weights and colours are 0");
  }
  const bool tame = !foreign && is_tame(scene);
  for (size_t n = 0; n < depth.size(); ++n) {
    if (face_index[n] < 0) {
      check(depth[n] == scene.far, "the background's depth is far");
    } else if (tame) {
      const T* w = weights.data() + 3 * n;
      check(std::abs(w[0] + w[1] + w[2] - 1) <= T(1e-4), "the weights of a covered pixel sum to 1");
      check(depth[n] > scene.near * T(0.99) && depth[n] < scene.far * T(1.01),
            "a covered pixel's depth lies between near and far");
    }
  }
  if (scene.hostile_upstream) return broken;

  const auto finite = [](T x) { return std::isfinite(x); };
  check_all({"grad_local", "grad_world", "grad_matrix", "grad_intrinsics", "grad_origin",
             "grad_extent", "grad_distortion", "grad_soft", "grad_sigma", "grad_forward", "grad_up",
             "iou", "grad_prediction", "grad_target"},
            finite, "a gradient is finite");
  if (!foreign)
    check_all({"grad_silhouette", "grad_edges"}, finite, "a gradient of edges is finite");
  if (!tame) return broken;
  for (const auto& array : std::get<Arrays<T>>(r.lists).arrays)
    if (!is_one_of(array.name, {"points", "pose", "nearest"}))
      check(all_finite(array.values), array.name);
  return broken;
}

#define NMR_INSTANTIATE(T)                                                                        \
  template void run_stages(const Scene<T>&, int, Results<T>&);                                    \
  template Scene<T> packed(const Scene<T>&);                                                      \
  template Scene<T> first_image(const Scene<T>&);                                                 \
  template const char* first_difference(const Results<T>&, const Results<T>&);                    \
  template const char* depends_on_company(const Scene<T>&, const Results<T>&, const Results<T>&); \
  template const char* depends_on_packing(const Results<T>&, const Results<T>&);                  \
  template const char* broken_promise(const Scene<T>&, const Results<T>&);
NMR_INSTANTIATE(float)
NMR_INSTANTIATE(double)

}  // namespace nmr::test
