// The faces that own a pixel; all others have gradient 0. Part of a level file (levels.h).

// Sets seen[id + 1] of the faces that own one of these pixels. seen: [2 F + 1 + kLanes], set to 0 first.
void mark_visible(const int32_t* face_index, int64_t pixels, int64_t num_faces, uint8_t* seen) {
  std::memset(seen, 0, 2 * num_faces + 1 + kLanes);
  int64_t n = 0;
  for (; n + kLanes <= pixels; n += kLanes) {
    if (!lane_bits(load_lanes<Lanes32>(face_index + n) >= splat(int32_t(0)))) continue;
    for (int64_t k = 0; k < kLanes; ++k) seen[face_index[n + k] + 1] = 1;
  }
  for (; n < pixels; ++n) seen[face_index[n] + 1] = 1;
}

// Writes the face indices of the marked faces to ids, ascending; returns their number. ids has room for kLanes more.
int64_t list_visible(int64_t num_faces, uint8_t* seen, int32_t* ids) {
  seen[0] = 0;  // the background
  int64_t count = 0;
  for (int64_t e = 0; e < 2 * num_faces + 1; e += 8) {
    uint64_t any;
    std::memcpy(&any, seen + e, sizeof any);
    if (!any) continue;
    for (int64_t k = e; k < e + 8; ++k) {
      ids[count] = static_cast<int32_t>(k - 1);
      count += seen[k];
    }
  }
  return count;
}
