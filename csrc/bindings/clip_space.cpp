// Meshes in clip space: weights with their derivatives on the screen, silhouette edges.
#include "read.h"

namespace nmr {
namespace {

template <class T>
ClipMesh<T> read_clip_mesh(Call& call) {
  ClipMesh<T> mesh{};
  call.read("faces [F, 3]", mesh.faces);
  mesh.num_faces = call["F"];
  mesh.num_threads = num_threads(call);
  read_face_index(call, "face_index [B, H, W]", mesh.face_index,
                  Rows{mesh.num_faces, false, nullptr}, mesh.num_threads);
  const bool each = call.read("positions [1|B, V, 4]", mesh.positions).shape[0] != 1;
  mesh.rows = {call["V"], each, nullptr};
  mesh.batch = call["B"];
  mesh.raster = raster_size(call);
  require_indices(mesh.faces, 3 * mesh.num_faces, mesh.rows.size, "faces", "vertex", "vertices");
  return mesh;
}

template <class T>
ClipWeights<T> read_clip_weights(Call& call) {
  ClipWeights<T> args{};
  args.mesh = read_clip_mesh<T>(call);
  call.result("rast [B, H, W, 4]", args.rast, args.grad_rast);
  call.result("slopes? [B, H, W, 4]", args.slopes, args.grad_slopes);
  call.only_gradient("positions", args.grad_positions);
  return args;
}

template <class T>
Antialias<T> read_antialias(Call& call) {
  Antialias<T> args{};
  args.mesh = read_clip_mesh<T>(call);
  call.read("rast [B, H, W, 4]", args.rast);
  call.read("colors [B, H, W, C]", args.colors);
  args.channels = call["C"];
  call.read("twins [F, 3]", args.twins);
  require(are_indices(args.twins, 3 * args.mesh.num_faces, 3 * args.mesh.num_faces),
          "twins must number the edges of the faces");
  call.result("blended [B, H, W, C]", args.blended, args.grad_blended);
  call.gradient("colors", args.grad_colors);
  call.gradient("positions", args.grad_positions);
  return args;
}

}  // namespace

void add_clip_space(Kernels& kernels) {
  NMR_ADD_STAGE(kernels, clip_weights);
  NMR_ADD_STAGE(kernels, antialias);
}

}  // namespace nmr
