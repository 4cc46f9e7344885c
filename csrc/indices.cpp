#include "indices.h"

namespace nmr {

bool are_indices(const int64_t* index, int64_t count, int64_t limit) {
  const uint64_t last = static_cast<uint64_t>(limit) - 1;
  uint64_t wrong = 0;  // its highest bit: the signs of i and limit - 1 - i
  for (int64_t n = 0; n < count; ++n)
    wrong |= static_cast<uint64_t>(index[n]) | (last - static_cast<uint64_t>(index[n]));
  return !(wrong >> 63);
}

bool are_face_indices(const int32_t* entry, int64_t count, int64_t num_faces) {
  const uint32_t limit = static_cast<uint32_t>(2 * num_faces);
  uint32_t wrong = 0;
  for (int64_t n = 0; n < count; ++n) wrong |= static_cast<uint32_t>(entry[n]) + 1 > limit;
  return !wrong;
}

}  // namespace nmr
