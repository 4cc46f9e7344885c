// Compiles one file of inner loops for several instruction sets (levels) and lets the program
// choose at run time:
//
//   #define NMR_LEVEL_FILE "fill.h"
//   #include "levels.h"
//   ...
//   NMR_AT_BEST_LEVEL(fill_band, image, band);   // calls base::fill_band or v3::fill_band
//
// The file is included once per level and has no include guard: NMR_LEVEL is the namespace of its
// functions, and of the lanes (level_lanes.h) that it includes. Loops over plain arrays are
// vectorized by the compiler, others use lanes. All other headers are read at level `base`, which
// comes first: the linker could otherwise keep the AVX copy of an inline library function for code
// of every processor, because functions of a level are local to their file, and those of the
// library are not. Levels above `base` exist for x86-64 with GCC 12 or later and glibc, if
// NMR_MULTIVERSION is defined. Level v4 (AVX-512) exists if NMR_LEVEL_V4 is defined first: plain
// loops are faster with it, code written with lanes is 5 % slower on Intel. The environment
// variable NMR_CPU_LEVEL (base or v3) chooses a lower level; results are the same at all levels.
#define NMR_LEVEL base
#include NMR_LEVEL_FILE
#undef NMR_LEVEL

#if NMR_LEVELS
#define NMR_AVX2 1
#pragma GCC push_options
#pragma GCC target("arch=x86-64-v3")
#define NMR_LEVEL v3
#include NMR_LEVEL_FILE
#undef NMR_LEVEL
#pragma GCC pop_options
#ifdef NMR_LEVEL_V4
#pragma GCC push_options
#pragma GCC target("arch=x86-64-v4")
#define NMR_LEVEL v4
#include NMR_LEVEL_FILE
#undef NMR_LEVEL
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
