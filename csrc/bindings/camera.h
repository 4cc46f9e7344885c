// The arguments of cameras, which the kernels `project` and `silhouette` have.
#pragma once

#include "read.h"

namespace nmr {

// A pose, or parts (see Project).
inline bool has_camera(const Call& call) { return call.has("eye") || call.has("matrix"); }

// With `drawn`, the same kernel draws the points: their gradient and `nearest` are no arguments.
template <class T>
Project<T> read_project(Call& call, bool drawn = false);

}  // namespace nmr
