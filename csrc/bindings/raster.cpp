// Near-plane clipping, the rasterizer, and the silhouette with its two gradients.
#include <algorithm>

#include "../scratch.h"
#include "camera.h"

namespace nmr {
namespace {

template <class T>
ClipCount<T> read_clip_count(Call& call) {
  ClipCount<T> args{read_mesh<T>(call), static_cast<T>(call.number("near")), nullptr,
                    num_threads(call)};
  call.read("counts [B, 2]", args.counts);
  return args;
}

template <class T>
ClipFaces<T> read_clip(Call& call) {
  ClipFaces<T> args{};
  args.mesh = read_mesh<T>(call);
  args.near = static_cast<T>(call.number("near"));
  args.num_threads = num_threads(call);
  call.read("new_starts [B + 1, 2]", args.starts);
  call.read("drawn_faces [D, 3]", args.faces);
  call.read("source [D]", args.source);
  call.read("corners [D, 3]", args.corners);
  call.read("ends [P, 4]", args.ends);
  const int64_t batch = args.mesh.batch;
  require_starts(args.starts, batch, call["P"], call["D"]);
  std::vector<int64_t> counts(2 * batch);
  clip_count(ClipCount<T>{args.mesh, args.near, counts.data(), args.num_threads});
  for (int64_t n = 0; n < 2 * batch; ++n)
    require(args.starts[n + 2] - args.starts[n] >= counts[n],
            "new_starts leave too little room for the clipped meshes");
  for (int64_t b = 0; b < batch; ++b)
    require(args.mesh.vertex_rows.count(b) > 0 || args.starts[2 * b + 3] == args.starts[2 * b + 1],
            "a mesh without vertices has no faces");
  return args;
}

template <class T>
Rasterize<T> read_rasterize(Call& call, const MeshBatch<T>& mesh) {
  Rasterize<T> args{};
  args.mesh = mesh;
  call.read("face_index [B, H, W]", args.face_index);
  args.settings =
      raster_settings<T>(call, drawn_size(call, "face_index"), call.flag("perspective"));
  args.num_threads = num_threads(call);
  return args;
}

template <class T>
RasterizeLayers<T> read_layers(Call& call) {
  RasterizeLayers<T> args{};
  args.mesh = read_mesh<T>(call);
  call.read("face_index [B, H, W, K]", args.face_index);
  args.settings =
      raster_settings<T>(call, drawn_size(call, "face_index"), call.flag("perspective"));
  args.layers = num_layers(call);
  args.num_threads = num_threads(call);
  return args;
}

// The meshes of a silhouette in renderer space: the points of a camera, or without one the
// vertices.
template <class T>
MeshBatch<T> read_drawn_mesh(Call& call) {
  if (has_camera(call)) return read_mesh<T>(call, "starts", "points");
  const T* nothing;
  call.read("points [0]", nothing);
  call.read("camera [0]", nothing);
  return read_mesh<T>(call);
}

template <class T>
void draw_silhouette(Call& call) {
  Project<T> camera{};
  if (has_camera(call)) camera = read_project<T>(call, true);
  Rasterize<T> args = read_rasterize<T>(call, read_drawn_mesh<T>(call));
  args.anti_aliasing = call.flag("anti_aliasing");
  const Size image = image_size(call, args.anti_aliasing);
  call.read("alpha [B, h, w]", args.alpha);
  bool* cut;
  call.read("cut []", cut);
  *cut = false;
  if (has_camera(call)) {
    T nearest;
    camera.nearest = &nearest;
    project_forward(camera);
    *cut = call.flag("clip") && nearest < args.settings.near;
    if (*cut) {
      const int64_t batch = args.mesh.batch, raster = args.settings.raster.pixels();
      std::fill_n(args.face_index, batch * raster, -1);
      std::fill_n(args.alpha, batch * image.pixels(), T(0));
      return;
    }
  }
  rasterize(args);
}

template <class T>
struct PointsScratch {
  std::vector<T> grad;
};

template <class T>
void pull_silhouette(Call& call) {
  SilhouetteBackward<T> args{};
  Project<T> camera{};
  if (has_camera(call)) camera = read_project<T>(call, true);
  args.mesh = read_drawn_mesh<T>(call);
  args.num_threads = num_threads(call);
  args.anti_aliasing = call.flag("anti_aliasing");
  args.eps = static_cast<T>(call.number("eps"));
  read_face_index(call, "face_index [B, H, W]", args.face_index, args.mesh.face_rows,
                  args.num_threads);
  args.image = image_size(call, args.anti_aliasing);
  call.read("grad_alpha [B, h, w]", args.grad_alpha);
  const bool* cut;
  call.read("cut []", cut);
  const ScratchUse use;
  if (has_camera(call)) {
    args.grad_vertices =
        reserve(thread_scratch<PointsScratch<T>>().grad,
                static_cast<size_t>(3 * args.mesh.vertex_rows.total(args.mesh.batch)));
    camera.grad_points = args.grad_vertices;
  } else {
    call.only_gradient("vertices", args.grad_vertices);
  }
  call.flag("local") ? local_gradient(args) : silhouette_backward(args);
  if (has_camera(call)) project_backward(camera);
}

}  // namespace

void add_raster(Kernels& kernels) {
  kernels.add("clip_count",
              [](auto zero, Call& call) { clip_count(read_clip_count<decltype(zero)>(call)); });
  kernels.add("clip_faces",
              [](auto zero, Call& call) { clip_faces(read_clip<decltype(zero)>(call)); });
  kernels.add("rasterize", [](auto zero, Call& call) {
    using T = decltype(zero);
    rasterize(read_rasterize<T>(call, read_mesh<T>(call)));
  });
  kernels.add("rasterize_layers",
              [](auto zero, Call& call) { rasterize_layers(read_layers<decltype(zero)>(call)); });
  kernels.add_with_backward("silhouette", [](auto zero, Call& call) {
    using T = decltype(zero);
    call.backward ? pull_silhouette<T>(call) : draw_silhouette<T>(call);
  });
}

}  // namespace nmr
