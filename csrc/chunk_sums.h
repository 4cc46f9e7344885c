// Sums of soft_iou.cpp.
#pragma once

#include <cstdint>

#include "blocks.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {

// The sums over a chunk, lane by lane, and its smallest and largest target (at most 0, at least 1).
template <class T>
struct ChunkSums {
  T product[2 * kLanes], sum[2 * kLanes];  // of p t, and of p + t
  T low[kLanes], high[kLanes];
};

}  // namespace nmr
