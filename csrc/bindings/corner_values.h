// Checks of arguments that several stages have: fragments, and values at the corners of faces.
#pragma once

#include "arrays.h"

namespace nmr {

// Checks weights [B, H, W, 3] and a face index map of the given number of faces (packed: those of starts).
template <class T>
void require_fragments(const Array<int32_t>& face_index, const Array<T>& weights, const std::optional<Indices>& starts,
                       int64_t num_faces, int num_threads) {
  const int64_t batch = starts ? starts->shape(0) - 1 : face_index.ndim() == 3 ? face_index.shape(0) : 0;
  const int64_t* s = starts ? starts->data() : nullptr;
  const Size raster = require_face_index(
      face_index, batch, [&](int64_t b) { return s ? s[2 * b + 3] - s[2 * b + 1] : num_faces; }, num_threads);
  require_shape(weights, "weights", {batch, raster.height, raster.width, 3});
}

// Checks values at the corners of faces, and every index among them.
template <class T>
Interpolate<T> interpolate_args(const Array<T>& attributes, const Indices& corners, const Array<int32_t>& face_index,
                                const Array<T>& weights, const std::optional<Indices>& starts, int num_threads) {
  const bool packed = starts.has_value(), per_image = corners.ndim() == 3;
  require(attributes.ndim() == (packed ? 2 : 3) && attributes.shape(attributes.ndim() - 1) >= 1,
          std::string("attributes must have shape ") + (packed ? "[N, C]" : "[B or 1, N, C]") + ", got " +
              shape_of(attributes));
  require((corners.ndim() == 2 || (per_image && !packed)) && corners.shape(corners.ndim() - 1) == 3,
          std::string("corners must have shape ") + (packed ? "[M, 3]" : "[F, 3] or [B, F, 3]") + ", got " +
              shape_of(corners));
  const int64_t num_attributes = attributes.shape(packed ? 0 : 1), num_faces = corners.shape(per_image ? 1 : 0);
  if (packed) require_starts(*starts, num_attributes, num_faces);
  require_fragments(face_index, weights, starts, num_faces, num_threads);
  const int64_t batch = face_index.shape(0), attribute_batch = packed ? 1 : attributes.shape(0);
  require(packed || attribute_batch == 1 || attribute_batch == batch,
          "attributes must have the batch size " + std::to_string(batch) + " or 1, got " + shape_of(attributes));
  require(!per_image || corners.shape(0) == batch,
          "corners [B, F, 3] must have the batch size " + std::to_string(batch) + ", got " + shape_of(corners));
  const py::gil_scoped_release release;
  for (int64_t b = 0; packed && b < batch; ++b) {
    const int64_t* s = starts->data() + 2 * b;
    require_indices(corners.data() + 3 * s[1], 3 * (s[3] - s[1]), s[2] - s[0], "corners", "attribute", "attributes");
  }
  if (!packed) require_indices(corners.data(), corners.size(), num_attributes, "corners", "attribute", "attributes");
  Interpolate<T> args{};
  args.face_index = face_index.data();
  args.weights = weights.data();
  args.batch = batch;
  args.raster = {face_index.shape(1), face_index.shape(2)};
  args.attributes = attributes.data();
  args.attribute_batch = attribute_batch;
  args.num_attributes = num_attributes;
  args.channels = attributes.shape(packed ? 1 : 2);
  args.corners = corners.data();
  args.num_faces = num_faces;
  args.corners_per_image = per_image;
  args.starts = packed ? starts->data() : nullptr;
  args.num_threads = num_threads;
  return args;
}

}  // namespace nmr
