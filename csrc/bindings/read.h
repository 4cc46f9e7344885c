// Arguments that several kernels have: meshes, face index maps, values at the corners of faces.
#pragma once

#include "../indices.h"
#include "../parallel.h"
#include "../stages.h"
#include "call.h"

namespace nmr {

constexpr int64_t kLargestRaster = 16384, kMostLayers = 1024;

inline int num_threads(Call& call) { return static_cast<int>(call.number("num_threads")); }

// Throws if an index is outside 0..limit-1. The last two say what it numbers, as singular and
// plural.
inline void require_indices(const int64_t* index, int64_t count, int64_t limit, const char* name,
                            const char* singular, const char* plural) {
  if (are_indices(index, count, limit)) return;
  for (int64_t n = 0; n < count; ++n)
    if (index[n] < 0 || index[n] >= limit)
      throw std::invalid_argument(std::string(name) + " refer to " + singular + " " +
                                  std::to_string(index[n]) + ", but a mesh has " +
                                  std::to_string(limit) + " " + plural + " (the first is 0)");
}

// [B + 1, 2]: ascending from (0, 0) to (rows, faces).
inline void require_starts(const int64_t* starts, int64_t batch, int64_t rows, int64_t faces) {
  bool valid = starts[0] == 0 && starts[1] == 0 && starts[2 * batch] == rows &&
               starts[2 * batch + 1] == faces;
  for (int64_t n = 0; valid && n < 2 * batch; ++n) valid = starts[n] <= starts[n + 2];
  require(valid, "starts must ascend from (0, 0) to (" + std::to_string(rows) + ", " +
                     std::to_string(faces) + ")");
}

// The rows of [F, 3], [B, F, 3], or packed [M, 3].
inline Rows rows_of_faces(Call& call, const Argument& faces, const int64_t* starts) {
  if (starts) return {call["M"], true, starts + 1};
  return {call["F"], faces.shape.size() == 3, nullptr};
}

// A batch of meshes, with every index checked. The names are those of its starts and its vertices.
template <class T>
MeshBatch<T> read_mesh(Call& call, const std::string& name_of_starts = "starts",
                       const std::string& vertices = "vertices") {
  MeshBatch<T> mesh{};
  const bool packed = call.has(name_of_starts);
  call.read(vertices + (packed ? " [N, 3]" : " [B, V, 3]"), mesh.vertices);
  const Argument& faces =
      call.read(packed ? "faces [M, 3]" : "faces [F, 3] or [B, F, 3]", mesh.faces);
  const int64_t* starts = nullptr;
  if (packed) call.read(name_of_starts + " [B + 1, 2]", starts);
  mesh.batch = call["B"];
  mesh.vertex_rows = {call[packed ? "N" : "V"], true, starts};
  mesh.face_rows = rows_of_faces(call, faces, starts);
  require(mesh.face_rows.size < (int64_t(1) << 30), "at most 2^30 faces per mesh");
  if (packed) require_starts(starts, mesh.batch, mesh.vertex_rows.size, mesh.face_rows.size);
  for (int64_t b = 0; b < mesh.batch; ++b) {
    require(mesh.vertex_rows.count(b) < (int64_t(1) << 29), "at most 2^29 vertices per mesh");
    if (b == 0 || mesh.face_rows.each)
      require_indices(mesh.image_faces(b), 3 * mesh.face_rows.count(b), mesh.vertex_rows.count(b),
                      "faces", "vertex", "vertices");
  }
  return mesh;
}

// The face index map, or with "[B, H, W, K]" a table of faces; each entry must be -1 or name a face
// of its image, or a reversed copy of one.
inline void read_face_index(Call& call, const char* text, const int32_t*& field, const Rows& faces,
                            int num_threads) {
  const Argument& map = call.read(text, field);
  const int64_t batch = call["B"], entries = batch ? map.count() / batch : 0;
  const int64_t parts = entries / (int64_t(1) << 18) + 1;  // of each image
  parallel_for(batch * parts, num_threads, [&](int64_t n) {
    const int64_t b = n / parts, k = n % parts, first = k * entries / parts,
                  last = (k + 1) * entries / parts;
    require(are_face_indices(field + b * entries + first, last - first, faces.count(b)),
            "the face index map does not belong to these faces");
  });
}

inline Size raster_size(Call& call) { return {call["H"], call["W"]}; }

// A raster that is drawn: 1 x 1 to 16384 x 16384 pixels.
inline Size drawn_size(Call& call, const char* name) {
  const Size raster = raster_size(call);
  require(std::min(raster.height, raster.width) >= 1 &&
              std::max(raster.height, raster.width) <= kLargestRaster,
          std::string(name) + " must have H and W in 1..16384, got " + call(name).shape_text());
  return raster;
}

// K surfaces at each pixel.
inline int64_t num_layers(Call& call) {
  require(call["K"] >= 1 && call["K"] <= kMostLayers,
          "face_index must have K in 1..1024, got " + call("face_index").shape_text());
  return call["K"];
}

// The image of a raster: half its size with anti-aliasing. From now on h and w are known.
inline Size image_size(Call& call, bool anti_aliasing) {
  const Size raster = raster_size(call);
  require(
      !anti_aliasing || (raster.height % 2 == 0 && raster.width % 2 == 0),
      "an anti-aliased face index map has an even size, got " + call("face_index").shape_text());
  const int64_t scale = anti_aliasing ? 2 : 1;
  call.let("h", raster.height / scale);
  call.let("w", raster.width / scale);
  return {call["h"], call["w"]};
}

template <class T>
RasterSettings<T> raster_settings(Call& call, Size raster, bool perspective) {
  return {raster, call.flag("fill_back"), static_cast<T>(call.number("near")),
          static_cast<T>(call.number("far")), perspective};
}

// Face index map and weights of the pixels of these faces.
template <class Args>
void read_pixels(Call& call, Args& args, const Rows& faces) {
  args.num_threads = num_threads(call);
  read_face_index(call, "face_index [B, H, W]", args.face_index, faces, args.num_threads);
  call.read("weights [B, H, W, 3]", args.weights);
  args.batch = call["B"];
  args.raster = raster_size(call);
}

// Values at the corners of faces, and every index among them; `values` and `corners` are the names
// of these arguments, `channels` a number or a name for the number of values.
template <class T>
Interpolate<T> read_interpolate(Call& call, const std::string& values, const std::string& corners,
                                const std::string& channels) {
  Interpolate<T> args{};
  const bool packed = call.has("starts");
  const int64_t* starts = nullptr;
  call.read("starts? [B + 1, 2]", starts);
  args.face_rows = rows_of_faces(
      call, call.read(corners + (packed ? " [M, 3]" : " [F, 3] or [B, F, 3]"), args.corners),
      starts);
  read_pixels(call, args, args.face_rows);
  const auto& shape =
      call.read(values + (packed ? " [A, " : " [1|B, A, ") + channels + "]", args.attributes).shape;
  args.rows = {call["A"], packed || shape[0] != 1, starts};
  args.channels = shape.back();
  require(args.channels >= 1,
          values + " must have at least one channel, got " + call(values).shape_text());
  if (packed) require_starts(starts, args.batch, args.rows.size, args.face_rows.size);
  const bool once = !args.face_rows.each;  // also without an image
  for (int64_t b = 0; b < (once ? 1 : args.batch); ++b)
    require_indices(args.corners + 3 * args.face_rows.first(b), 3 * args.face_rows.count(b),
                    args.rows.count(b), corners.c_str(), "attribute", "attributes");
  call.gradient(values, args.grad_attributes);
  call.gradient("weights", args.grad_weights);
  return args;
}

}  // namespace nmr
