// Near-plane clipping, the rasterizer, and the silhouette with its two gradients.
#include "read.h"

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
    require(args.mesh.vertex_count(b) > 0 || args.starts[2 * b + 3] == args.starts[2 * b + 1],
            "a mesh without vertices has no faces");
  return args;
}

template <class T>
Rasterize<T> read_rasterize(Call& call) {
  Rasterize<T> args{};
  args.mesh = read_mesh<T>(call);
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

template <class T>
void draw_silhouette(Call& call) {
  Rasterize<T> args = read_rasterize<T>(call);
  args.anti_aliasing = call.flag("anti_aliasing");
  image_size(call, args.anti_aliasing);
  call.read("alpha [B, h, w]", args.alpha);
  rasterize(args);
}

template <class T>
void pull_silhouette(Call& call) {
  SilhouetteBackward<T> args{};
  args.mesh = read_mesh<T>(call);
  args.num_threads = num_threads(call);
  args.anti_aliasing = call.flag("anti_aliasing");
  args.eps = static_cast<T>(call.number("eps"));
  read_face_index(call, "face_index [B, H, W]", args.face_index, args.mesh, args.num_threads);
  args.image = image_size(call, args.anti_aliasing);
  call.read("grad_alpha [B, h, w]", args.grad_alpha);
  call.only_gradient("vertices", args.grad_vertices);
  call.flag("local") ? local_gradient(args) : silhouette_backward(args);
}

}  // namespace

void add_raster(Kernels& kernels) {
  kernels.add("clip_count",
              [](auto zero, Call& call) { clip_count(read_clip_count<decltype(zero)>(call)); });
  kernels.add("clip_faces",
              [](auto zero, Call& call) { clip_faces(read_clip<decltype(zero)>(call)); });
  kernels.add("rasterize",
              [](auto zero, Call& call) { rasterize(read_rasterize<decltype(zero)>(call)); });
  kernels.add("rasterize_layers",
              [](auto zero, Call& call) { rasterize_layers(read_layers<decltype(zero)>(call)); });
  kernels.add_with_backward("silhouette", [](auto zero, Call& call) {
    using T = decltype(zero);
    call.backward ? pull_silhouette<T>(call) : draw_silhouette<T>(call);
  });
}

}  // namespace nmr
