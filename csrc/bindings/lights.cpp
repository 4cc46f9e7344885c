// Normals of meshes, and lights.
#include "read.h"

namespace nmr {
namespace {

template <class T>
Normals<T> read_normals(Call& call) {
  Normals<T> args{};
  args.mesh = read_mesh<T>(call);
  args.smooth = call.flag("smooth");
  args.num_threads = num_threads(call);
  const bool packed = args.mesh.face_rows.starts;
  const char* of_vertices = packed ? "normals [N, 3]" : "normals [B, V, 3]";
  const char* of_faces = packed ? "normals [M, 3]" : "normals [B, F, 3]";
  call.result(args.smooth ? of_vertices : of_faces, args.normals, args.grad_normals);
  call.only_gradient("vertices", args.grad_vertices);
  return args;
}

// Numbers of each parameter, in the order of LightParameter.
constexpr int64_t kWidths[] = {1, 3, 1, 3, 3, 1, 3, 3, 1, 1, 1};
constexpr int64_t kCount = static_cast<int64_t>(LightParameter::count), kMostLights = int64_t(1)
                                                                                      << 20;

// Parameters that belong together have one light or the same number.
void require_group(const int64_t* layout, LightParameter from, LightParameter to) {
  const int64_t begin = static_cast<int64_t>(from), end = static_cast<int64_t>(to) + 1;
  int64_t most = 0, least = kMostLights;
  for (int64_t n = begin; n < end; ++n) {
    most = std::max(most, layout[3 * n + 2]);
    least = std::min(least, layout[3 * n + 2]);
  }
  for (int64_t n = begin; n < end && least > 0; ++n)
    require(layout[3 * n + 2] == 1 || layout[3 * n + 2] == most,
            "parameters of different numbers of lights");
}

// Every parameter must be inside the array.
void require_layout(const int64_t* layout, int64_t num_parameters, int64_t batch) {
  for (int64_t n = 0; n < kCount; ++n) {
    const int64_t *l = layout + 3 * n, first = l[0], rows = l[1], lights = l[2];
    const bool several = n >= static_cast<int64_t>(LightParameter::directional) &&
                         n < static_cast<int64_t>(LightParameter::specular);
    require(
        lights >= 0 && lights < kMostLights && (several || lights <= 1) && (n > 1 || lights == 1),
        "impossible number of lights");
    require(lights == 0 || ((rows == 1 || rows == batch) && first >= 0 &&
                            first + rows * lights * kWidths[n] <= num_parameters),
            "a parameter of lights lies outside the array");
  }
  require_group(layout, LightParameter::directional, LightParameter::direction);
  require_group(layout, LightParameter::point, LightParameter::falloff);
}

template <class T>
LitColors<T> read_lit(Call& call) {
  LitColors<T> args{};
  args.at = read_interpolate<T>(call, "vertices", "faces", "3");
  const bool packed = args.at.rows.starts;
  args.smooth = call.flag("smooth");
  const char* of_vertices = packed ? "normals [A, 3]" : "normals [1|B, A, 3]";
  const char* of_faces = packed ? "normals [M, 3]" : "normals [1|B, F, 3]";
  const auto& shape = call.read(args.smooth ? of_vertices : of_faces, args.normals).shape;
  args.normal_rows = args.smooth ? args.at.rows : args.at.face_rows;
  args.normal_rows.each = packed || shape[0] != 1;
  call.read("viewer [B, 5]", args.viewer);
  call.read("layout [lights, 3]", args.layout);
  call.read("parameters? [P]", args.parameters);
  if (args.parameters) {
    require(call["lights"] == kCount,
            "layout must have shape [11, 3], got " + call("layout").shape_text());
    args.num_parameters = call["P"];
    require_layout(args.layout, args.num_parameters, args.at.batch);
  }
  const Argument& colors = call.read("colors? [B, H, W, 1|3]", args.colors);
  args.channels = args.colors ? colors.shape[3] : 0;
  call.result("lit [B, H, W, 3]", args.lit, args.grad_lit);
  call.gradient("colors", args.grad_colors);
  call.gradient("normals", args.grad_normals);
  call.gradient("parameters", args.grad_parameters);
  return args;
}

}  // namespace

void add_lights(Kernels& kernels) {
  NMR_ADD_STAGE(kernels, normals);
  NMR_ADD_STAGE(kernels, lit);
}

}  // namespace nmr
