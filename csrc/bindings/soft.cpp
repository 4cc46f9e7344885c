// The soft silhouette, and the faces around each pixel.
#include "read.h"

namespace nmr {
namespace {

// sigma is a float64 number in an array, because it can have a gradient.
template <class T>
SoftSettings<T> read_settings(Call& call, const char* drawn, bool perspective) {
  const double* sigma = nullptr;
  call.read("sigma []", sigma);
  const double reach = *sigma * call.number("reach_per_sigma");
  require(static_cast<T>(*sigma) > 0 && reach >= 0,
          "sigma must be positive, and reach not negative");
  return {raster_settings<T>(call, drawn_size(call, drawn), perspective), static_cast<T>(*sigma),
          static_cast<T>(reach)};
}

template <class T>
void draw_soft(Call& call) {
  SoftForward<T> args{};
  args.mesh = read_mesh<T>(call);
  call.read("transmittance [B, H, W]", args.transmittance);
  args.settings = read_settings<T>(call, "transmittance", true);
  args.num_threads = num_threads(call);
  soft_forward(args);
}

template <class T>
void soft_gradient(Call& call) {
  SoftBackward<T> args{};
  args.mesh = read_mesh<T>(call);
  call.read("transmittance [B, H, W]", args.transmittance);
  call.read("grad_transmittance [B, H, W]", args.grad_transmittance);
  args.settings = read_settings<T>(call, "transmittance", true);
  args.num_threads = num_threads(call);
  std::vector<T> all_vertices, of_sigma(args.mesh.batch);  // where nobody asked for them
  double* grad_sigma = nullptr;
  call.gradient("vertices", args.grad_vertices);
  call.gradient("sigma", grad_sigma);
  if (!args.grad_vertices) {
    all_vertices.resize(call("vertices").count());
    args.grad_vertices = all_vertices.data();
  }
  args.grad_sigma = of_sigma.data();
  soft_backward(args);
  if (!grad_sigma) return;
  *grad_sigma = 0;
  for (T value : of_sigma) *grad_sigma += value;
}

template <class T>
SoftLayers<T> read_layers(Call& call) {
  SoftLayers<T> args{};
  args.mesh = read_mesh<T>(call);
  call.read("face_index [B, H, W, K]", args.face_index);
  args.settings = read_settings<T>(call, "face_index", call.flag("perspective"));
  args.layers = num_layers(call);
  args.num_threads = num_threads(call);
  return args;
}

template <class T>
SoftFragments<T> read_soft_fragments(Call& call) {
  SoftFragments<T> args{};
  args.mesh = read_mesh<T>(call);
  args.num_threads = num_threads(call);
  read_face_index(call, "face_index [B, H, W, K]", args.face_index, args.mesh.face_rows,
                  args.num_threads);
  args.raster = drawn_size(call, "face_index");
  args.layers = num_layers(call);
  args.perspective = call.flag("perspective");
  args.far = static_cast<T>(call.number("far"));
  call.result("weights [B, H, W, K, 3]", args.weights, args.grad_weights);
  call.result("depth [B, H, W, K]", args.depth, args.grad_depth);
  call.result("distances [B, H, W, K]", args.distances, args.grad_distances);
  call.only_gradient("vertices", args.grad_vertices);
  return args;
}

}  // namespace

void add_soft(Kernels& kernels) {
  kernels.add_with_backward("soft_silhouette", [](auto zero, Call& call) {
    using T = decltype(zero);
    call.backward ? soft_gradient<T>(call) : draw_soft<T>(call);
  });
  kernels.add("soft_layers",
              [](auto zero, Call& call) { soft_layers(read_layers<decltype(zero)>(call)); });
  NMR_ADD_STAGE(kernels, soft_fragments);
}

}  // namespace nmr
