// Headers of most kernels, read once per build (CMakeLists.txt). Every file still includes all that
// it uses.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <mutex>
#include <type_traits>
#include <utility>
#include <vector>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#include <Eigen/Core>
#include <Eigen/Geometry>
