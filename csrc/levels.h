// Compiles one file of inner loops for several instruction sets (levels) and lets the program
// choose at run time:
//
//   #define NMR_LEVEL_FILE "fill.h"   // has functions and templates, but no namespace and no
//   include guard #include "levels.h"
//   ...
//   NMR_AT_BEST_LEVEL(fill_band, image, band);   // calls base::fill_band or v3::fill_band
//
// The file is included once per level, each time in a namespace of its own that also holds the
// lanes (level_lanes.h) of that level. Loops over plain arrays are vectorized by the compiler,
// others use lanes. Headers are included before the levels: the linker could otherwise keep the AVX
// copy of an inline library function for code of every processor, because functions of a level are
// local to their file, and those of the library are not. Levels above `base` exist for x86-64 with
// GCC 12 or later and glibc, if NMR_MULTIVERSION is defined. Level v4 (AVX-512) exists if
// NMR_LEVEL_V4 is defined first: plain loops gain from it, lanes lose 5 % on Intel.
// NMR_CPU_LEVEL=base or v3 in the environment keeps a process at that level; results do not depend
// on it.
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#include "parallel.h"

namespace nmr {
namespace base {
namespace {
#include "level_lanes.h"
#include NMR_LEVEL_FILE
}  // namespace
}  // namespace base
}  // namespace nmr

#if NMR_LEVELS
#define NMR_AVX2 1
#pragma GCC push_options
#pragma GCC target("arch=x86-64-v3")
namespace nmr {
namespace v3 {
namespace {
#include "level_lanes.h"
#include NMR_LEVEL_FILE
}  // namespace
}  // namespace v3
}  // namespace nmr
#pragma GCC pop_options
#ifdef NMR_LEVEL_V4
#pragma GCC push_options
#pragma GCC target("arch=x86-64-v4")
namespace nmr {
namespace v4 {
namespace {
#include "level_lanes.h"
#include NMR_LEVEL_FILE
}  // namespace
}  // namespace v4
}  // namespace nmr
#pragma GCC pop_options
#define NMR_AT_BEST_LEVEL(function, ...)          \
  (cpu_level() == 4   ? v4::function(__VA_ARGS__) \
   : cpu_level() == 3 ? v3::function(__VA_ARGS__) \
                      : base::function(__VA_ARGS__))
#else
#define NMR_AT_BEST_LEVEL(function, ...) \
  (cpu_level() >= 3 ? v3::function(__VA_ARGS__) : base::function(__VA_ARGS__))
#endif
#undef NMR_AVX2
#else
#define NMR_AT_BEST_LEVEL(function, ...) base::function(__VA_ARGS__)
#endif
