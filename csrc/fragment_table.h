// The visible faces of a block of rows, as fragments.cpp takes them.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "average.h"
#include "corner_values.h"
#include "geometry.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

// Numbers per face in the table: columns 0, 1, 2 of M and the depths, each padded to four.
constexpr int64_t kFaceEntry = 16;

// Memory for one block.
template <class T>
struct FragmentScratch {
  VisibleFaces* visible;
  std::vector<T> table;  // [visible + 1 + 8, kFaceEntry]
  std::vector<T> rows;   // [2, W + 8] a row of depths or gradients each
  std::vector<T> sums;   // [visible + 1 + 8, 4 or 12] gradients per face
  bool perspective;

  void reserve_for(const RowBlocks& blocks, bool has_perspective, VisibleFaces& faces) {
    const int64_t most = blocks.most_visible();
    perspective = has_perspective;
    visible = &faces;
    faces.reserve_for(blocks.num_faces, most);
    reserve(table, (most + 1 + kLanes) * kFaceEntry);
    reserve(rows, 2 * (blocks.raster.width + kLanes));
  }
};

// One block of rows of image b.
template <class T>
struct FragmentBlock {
  const T* vertices;
  const int64_t* faces;
  int64_t num_faces;
  Size raster;
  const int32_t* face_index;  // [H, W], row 0 = top
  int64_t b, first, last;     // first, last: rows

  FragmentBlock(const Fragments<T>& args, const RowBlock& block)
      : vertices(args.mesh.image_vertices(block.b)),
        faces(args.mesh.image_faces(block.b)),
        num_faces(block.blocks.num_faces),
        raster(block.blocks.raster),
        face_index(args.face_index + block.b * raster.pixels()),
        b(block.b),
        first(block.first()),
        last(block.last()) {}
};

}  // namespace nmr
