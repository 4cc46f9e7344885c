// NMR's gradient (Kato et al. 2018) of a silhouette, or of an image with any number of channels.
// For every edge of a visible face and every line of pixels (a column or a row) that crosses it,
// let c be the crossing, `inner` the pixel just inside and `outer` the pixel just outside:
//   outside: if the face owns `inner`, each pixel m from `outer` to the border would become
//   I(inner) if the edge moved
//            out to it;
//   inside:  each pixel m of the face would become I(outer) if the edge moved in past it.
// If this lowers the loss, D = sum over channels of (I(m) - I(inner or outer)) g(m) > 0, then m
// pulls both ends of the edge with D / (distance they must travel). A silhouette is an image with I
// = 1 on faces and 0 on the background. Columns move y, rows move x. If a gradient of an image is
// not finite, those of all its visible faces are NaN.
//
// Only faces that own a pixel of a line have a part in it. So the work goes by runs: the longest
// stretches of pixels of a line with one face. Runs come in the order of the line, and eight of
// them share its list of pulling pixels. Columns are the rows of the transposed face index map.
//
// With s the coordinate across the lines and t along them, edge P-Q crosses line n of M pixels at
//   c = (Qt - Pt) / (Qs - Ps) (n - Ps) + Pt.
// If P moves by 1 (in [-1, 1] coordinates), c moves by r = (Qs - n) / (Qs - Ps) M / 2 pixels; so P
// must travel |m - c| / |r| to reach m. `eps` is added to that, and D / (|m - c| / |r| + eps) = D
// |r| / (|m - c| + eps |r|).
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "edge_lines.h"

#define NMR_LEVEL_FILE "edge_runs.h"
#include "levels.h"

namespace nmr {
namespace {

// Numbers the faces of `count` runs, and writes the corners of new ones.
template <class T>
void number_faces(const EdgeImage<T>& image, const RunList& runs, int64_t count,
                  EdgeScratch<T>& scratch, EdgeSums<T>& sums) {
  int32_t *numbers = scratch.numbers.data() + 1, *ids = sums.ids.data(), *face_of_run = runs.face;
  int32_t found = static_cast<int32_t>(sums.count);
  for (int64_t r = 0; r < count; ++r) {
    const int32_t id = face_of_run[r], known = numbers[id], number = known < 0 ? found : known;
    ids[found] = id;
    numbers[id] = number;
    face_of_run[r] = number;
    found += known < 0;
  }
  const T width = static_cast<T>(image.raster.width), height = static_cast<T>(image.raster.height);
  for (int64_t n = sums.count; n < found; ++n) {
    T* entry = sums.entries.data() + n * kEdgeEntry;
    const bool reversed = ids[n] >= image.num_faces;
    const int64_t* face = image.faces + 3 * face_of(ids[n], image.num_faces);
    for (int k = 0; k < 3; ++k) {
      const T* vertex = image.vertices + 3 * face[reversed ? 2 - k : k];
      entry[k] = to_pixel(vertex[0], width);
      entry[4 + k] = to_pixel(vertex[1], height);
    }
    entry[3] = entry[7] = 0;
    std::fill_n(entry + 8, 8, T(0));
  }
  sums.count = found;
}

// A block has a band of rows and a band of so many columns.
int64_t columns_of(const RowBlocks& blocks) {
  const int64_t columns = (blocks.raster.width + blocks.count - 1) / blocks.count;
  return columns + columns % 2;
}

// Lines of a block that faces can reach; whole pairs.
LineRange band_of(const RowBlock& block, bool columns, const PixelRange& reached) {
  const RowBlocks& blocks = block.blocks;
  const int64_t width = columns ? columns_of(blocks) : blocks.rows;
  const int64_t first = std::max(block.number * width, reached.first / 2 * 2);
  const int64_t last = std::min(reached.last + reached.last % 2,
                                columns ? blocks.raster.width : blocks.raster.height);
  return {first, std::min((block.number + 1) * width, last) - first, columns};
}

// The sums of one block.
template <class T>
void sum_bands(const EdgeImage<T>& image, const RowBlock& block, EdgeSums<T>& sums) {
  const Size raster = image.raster;
  const int64_t entries = 2 * image.num_faces + 1;
  const int64_t most = std::min(
      entries, 1 + block.blocks.rows * raster.width + columns_of(block.blocks) * raster.height);
  EdgeScratch<T>& scratch = thread_scratch<EdgeScratch<T>>();
  LineGroup<T> group = scratch.reserve_group(image, std::max(raster.width, raster.height));
  std::fill_n(reserve(scratch.numbers, entries), entries, -1);
  reserve(sums.ids, most + 1);  // one may be written behind the last
  std::fill_n(reserve(sums.entries, most * kEdgeEntry), kEdgeEntry,
              T(0));  // of the background: a point, which no line crosses
  scratch.numbers[0] = 0;
  sums.count = 1;
  const int64_t scale = image.anti_aliasing ? 2 : 1, row = image.size.width * image.channels,
                first = block.first() / scale, last = block.last() / scale;
  sums.finite = NMR_AT_BEST_LEVEL(all_finite, image.grad + first * row, (last - first) * row);
  for (const bool columns : {false, true}) {
    const Reach& reach = image.reach;
    const LineRange band = band_of(block, columns, columns ? reach.columns : reach.rows);
    const PixelRange bottom_up{raster.height - reach.rows.last, raster.height - reach.rows.first};
    const PixelRange& along = columns ? bottom_up : reach.columns;
    group.window = {along.first / 8 * 8, (along.last + 7) / 8 * 8};
    for (int64_t n = 0; n < band.count; n += kLines) {
      group.lines = {band.first + n, std::min(kLines, band.count - n), columns};
      group.length = columns ? raster.height : raster.width;
      NMR_AT_BEST_LEVEL(find_group_runs, image, group);
      const int64_t runs = group.runs_end[group.lines.count - 1];
      if (runs == 0) continue;
      number_faces(image, group.runs, runs, scratch, sums);
      if (!image.pixels)
        NMR_AT_BEST_LEVEL(pull_group<kCoverage>, image, group, scratch.list, sums.entries.data());
      else
        with_channels<T>(image.channels, [&](auto known) {
          constexpr int64_t kChannels = known();
          NMR_AT_BEST_LEVEL(pull_group<kChannels>, image, group, scratch.list, sums.entries.data());
        });
    }
  }
}

// NaN for the corners of all faces that own a pixel.
template <class T>
void spoil_gradients(const EdgeImage<T>& image, T* grad_vertices) {
  VisibleFaces visible;
  visible.list(image.face_index, image.raster.pixels(), image.num_faces);
  for (int64_t n = 1; n < visible.count; ++n) {  // skips the background
    const int64_t* face = image.faces + 3 * face_of(visible.ids[n], image.num_faces);
    for (int k = 0; k < 3; ++k)
      std::fill_n(grad_vertices + 3 * face[k], 2, std::numeric_limits<T>::quiet_NaN());
  }
}

// Gradients of all images; image_of(b) describes one.
template <class T, class ImageOf>
void sum_edges(const MeshBatch<T>& mesh, Size raster, T* grad_vertices, int num_threads,
               const ImageOf& image_of) {
  std::vector<char> finite(mesh.batch, true);
  std::vector<Reach> reach(mesh.batch);
  parallel_for(mesh.batch, num_threads, [&](int64_t b) {
    reach[b] = reach_of(mesh.image_vertices(b), mesh.vertex_rows.count(b), raster);
    std::fill_n(grad_vertices + 3 * mesh.vertex_rows.first(b), 3 * mesh.vertex_rows.count(b), T(0));
  });
  sum_blocks<EdgeSums<T>>(
      mesh.batch, raster, false, num_threads, mesh.face_rows,
      [&](const RowBlock& block, EdgeSums<T>& sums) {
        EdgeImage<T> image = image_of(block.b);
        image.reach = reach[block.b];
        sum_bands(image, block, sums);
      },
      [&](int64_t b, const EdgeSums<T>& sums) {
        finite[b] = finite[b] && sums.finite;
        const int64_t F = mesh.face_rows.count(b);
        T* grad_image = grad_vertices + 3 * mesh.vertex_rows.first(b);
        for (int64_t n = 1; n < sums.count; ++n) {  // skips the background
          const int32_t id = sums.ids[n];
          const int64_t* face = mesh.image_faces(b) + 3 * face_of(id, F);
          const T* grads = sums.entries.data() + n * kEdgeEntry + 8;
          for (int k = 0; k < 3; ++k) {
            T* grad = grad_image + 3 * face[id < F ? k : 2 - k];
            grad[0] += grads[k];
            grad[1] += grads[4 + k];
          }
        }
      });
  for (int64_t b = 0; b < mesh.batch; ++b)
    if (!finite[b]) spoil_gradients(image_of(b), grad_vertices + 3 * mesh.vertex_rows.first(b));
}

template <class Args>
auto edge_image(const Args& args, int64_t b) {
  using T = decltype(Args::eps);
  const Size raster = raster_of(args.image, args.anti_aliasing);
  return EdgeImage<T>{args.mesh.image_vertices(b),
                      args.mesh.image_faces(b),
                      args.mesh.face_rows.count(b),
                      raster,
                      args.image,
                      args.anti_aliasing,
                      args.eps,
                      args.face_index + b * raster.pixels(),
                      nullptr,
                      1,
                      nullptr,
                      nullptr,
                      {}};
}

}  // namespace

template <class T>
void silhouette_backward(const SilhouetteBackward<T>& args) {
  sum_edges(args.mesh, raster_of(args.image, args.anti_aliasing), args.grad_vertices,
            args.num_threads, [&](int64_t b) {
              EdgeImage<T> image = edge_image(args, b);
              image.grad = args.grad_alpha + b * args.image.pixels();
              return image;
            });
}

template <class T>
void edges_backward(const EdgesBackward<T>& args) {
  const Size raster = raster_of(args.image, args.anti_aliasing);
  sum_edges(args.mesh, raster, args.grad_vertices, args.num_threads, [&](int64_t b) {
    EdgeImage<T> image = edge_image(args, b);
    image.channels = args.channels;
    image.grad = args.grad_resolved + b * args.image.pixels() * args.channels;
    image.pixels = args.pixels + b * raster.pixels() * args.channels;
    image.background = args.background.of(b, args.channels);
    return image;
  });
}

NMR_FLOAT_AND_DOUBLE(silhouette_backward, SilhouetteBackward)
NMR_FLOAT_AND_DOUBLE(edges_backward, EdgesBackward)

}  // namespace nmr
