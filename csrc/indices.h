// Range checks of indices. Without branches, so that the loops are vectorized.
#pragma once

#include <cstdint>

namespace nmr {

// Whether every index is in 0 .. limit - 1.
bool are_indices(const int64_t* index, int64_t count, int64_t limit);

// Every entry of a face index map is -1, a face, or a reversed copy of one.
bool are_face_indices(const int32_t* entry, int64_t count, int64_t num_faces);

}  // namespace nmr
