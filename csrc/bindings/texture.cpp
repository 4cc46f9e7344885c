// Texture images: mipmaps, levels, sampling.
#include "read.h"

namespace nmr {
namespace {

constexpr int64_t kMostTexels = int64_t(1) << 31;

// Every level must be inside the array of texels.
void require_grids(const int64_t* grids, int64_t count, int64_t num_texels) {
  require(num_texels < kMostTexels, "at most 2^31 texels");
  for (int64_t n = 0; n < count; ++n) {
    const int64_t *g = grids + 3 * n, first = g[0], height = g[1], width = g[2];
    require(height >= 1 && width >= 1 && height < kMostTexels && width < kMostTexels &&
                first >= 0 && first + height * width <= num_texels,
            "a level of a texture lies outside the " + std::to_string(num_texels) + " texels");
  }
}

// The levels of one image per row, or of one for all.
template <class Args>
void read_grids(Call& call, Args& args, int64_t num_texels) {
  args.images = call.read("grids [1|B, L, 3]", args.grids).shape[0];
  args.levels = call["L"];
  require(args.levels >= 1,
          "grids must have at least one level, got " + call("grids").shape_text());
  require_grids(args.grids, args.images * args.levels, num_texels);
}

// Every level must follow the one before, with half its size. Returns the number of texels of the
// images themselves.
int64_t require_pyramid(const int64_t* grids, int64_t images, int64_t levels) {
  int64_t whole = 0;
  for (int64_t i = 0; i < images; ++i) {
    int64_t first = grids[3 * i * levels];
    for (int64_t l = 0; l < levels; ++l) {
      const int64_t *grid = grids + 3 * (i * levels + l), *finer = grid - 3;
      const auto follows = [&](int axis) {
        return grid[axis] == std::max<int64_t>(finer[axis] / 2, 1);
      };
      require(grid[0] == first && (l == 0 || (follows(1) && follows(2))),
              "every level must follow the one before, with half its size");
      first += grid[1] * grid[2];
    }
    whole += grids[3 * i * levels + 1] * grids[3 * i * levels + 2];
  }
  return whole;
}

template <class T>
Mipmaps<T> read_mipmaps(Call& call) {
  Mipmaps<T> args{};
  call.result("pyramid [N, C]", args.pyramid, args.grad_pyramid);
  args.channels = call["C"];
  require(args.channels >= 1, "texels must have at least one channel");
  read_grids(call, args, call["N"]);
  call.let("texels", require_pyramid(args.grids, args.images, args.levels));
  call.read("texels [texels, C]", args.texels);
  args.num_threads = num_threads(call);
  call.only_gradient("texels", args.grad_texels);
  return args;
}

template <class T>
UVLevels<T> read_levels(Call& call) {
  UVLevels<T> args{};
  args.mesh = read_mesh<T>(call, "mesh_starts");
  args.uv = read_interpolate<T>(call, "uv", "corners", "2");
  const int32_t* face_index = nullptr;
  read_face_index(call, "face_index [B, H, W]", face_index, args.mesh.face_rows,
                  args.uv.num_threads);
  read_grids(call, args, kMostTexels - 1);
  call.read("level [B, H, W]", args.level);
  return args;
}

template <class T>
SampleUV<T> read_sample_uv(Call& call) {
  SampleUV<T> args{};
  args.uv = read_interpolate<T>(call, "uv", "corners", "2");
  call.read("texels [N, C]", args.texels);
  args.num_texels = call["N"];
  args.channels = call["C"];
  require(args.channels >= 1,
          "texels must have at least one channel, got " + call("texels").shape_text());
  read_grids(call, args, args.num_texels);
  call.read("level? [B, H, W]", args.level);
  const int wrap = static_cast<int>(call.number("wrap"));
  require(wrap >= 0 && wrap <= 2, "wrap must be 0, 1 or 2, got " + std::to_string(wrap));
  args.wrap = static_cast<Wrap>(wrap);
  call.result("colors [B, H, W, C]", args.colors, args.grad_colors);
  call.gradient("texels", args.grad_texels);
  return args;
}

}  // namespace

void add_texture(Kernels& kernels) {
  NMR_ADD_STAGE(kernels, mipmaps);
  kernels.add("uv_levels",
              [](auto zero, Call& call) { uv_levels(read_levels<decltype(zero)>(call)); });
  NMR_ADD_STAGE(kernels, sample_uv);
}

}  // namespace nmr
