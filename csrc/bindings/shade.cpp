// Texture cubes, and values interpolated over faces.
#include "read.h"

namespace nmr {
namespace {

// Textures have no rows, so the number of rows at the end of starts is not checked.
template <class T>
TextureCubes<T> read_texture_cubes(Call& call) {
  TextureCubes<T> args{};
  const bool packed = call.has("starts");
  const int64_t* starts = nullptr;
  call.read("starts? [B + 1, 2]", starts);
  const char* text = packed ? "textures [M, ts, ts, ts, C]" : "textures [1|I, F, ts, ts, ts, C]";
  const int64_t sets = call.read(text, args.textures).shape[0];
  args.cubes = {call[packed ? "M" : "F"], packed || sets != 1, packed ? starts + 1 : nullptr};
  args.texture_size = call["ts"];
  args.channels = call["C"];
  require(args.texture_size >= 1 && args.channels >= 1,
          "textures must have texels and channels, got " + call("textures").shape_text());
  if (packed) require_starts(starts, call["B"], starts[2 * call["B"]], args.cubes.size);
  read_pixels(call, args, args.cubes);
  require(packed || sets == 1 || sets == args.batch,
          "textures must have the batch size " + std::to_string(args.batch) + " or 1, got " +
              call("textures").shape_text());
  args.eps = static_cast<T>(call.number("eps"));
  call.result("colors [B, H, W, C]", args.colors, args.grad_colors);
  call.only_gradient("textures", args.grad_textures);
  return args;
}

template <class T>
Interpolate<T> read_interpolate(Call& call) {
  Interpolate<T> args = read_interpolate<T>(call, "attributes", "corners", "C");
  call.result("values [B, H, W, C]", args.values, args.grad_values);
  return args;
}

}  // namespace

void add_shade(Kernels& kernels) {
  NMR_ADD_STAGE(kernels, texture_cubes);
  NMR_ADD_STAGE(kernels, interpolate);
}

}  // namespace nmr
