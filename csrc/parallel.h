// The parallel loop, and the choice of instruction set.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <exception>

#include "scratch.h"

// Several x86-64 levels in one program: see levels.h.
#if defined(NMR_MULTIVERSION) && defined(__x86_64__) && defined(__GLIBC__) && !defined(__clang__) && __GNUC__ >= 12
#define NMR_LEVELS 1
#else
#define NMR_LEVELS 0
#endif

#if defined(__GNUC__)
#define NMR_INLINE inline __attribute__((always_inline))
#elif defined(_MSC_VER)
#define NMR_INLINE __forceinline
#else
#define NMR_INLINE inline
#endif

namespace nmr {

// Number of the lowest bit that is set; bits must not be 0.
NMR_INLINE int64_t lowest_bit(uint32_t bits) {
#if defined(__GNUC__)
  return __builtin_ctz(bits);
#else
  int64_t n = 0;
  while (!(bits >> n & 1)) ++n;
  return n;
#endif
}

// The highest level of this processor that inner loops are compiled for (levels.h): 4 for x86-64-v4, 3 for v3, else 1.
inline int cpu_level() {
#if NMR_LEVELS
  static const int level = [] {
    const char* wanted = std::getenv("NMR_CPU_LEVEL");
    const auto is_wanted = [wanted](const char* name) { return wanted && std::strcmp(wanted, name) == 0; };
    if (is_wanted("base") || !__builtin_cpu_supports("x86-64-v3")) return 1;
    return is_wanted("v3") || !__builtin_cpu_supports("x86-64-v4") ? 3 : 4;
  }();
  return level;
#else
  return 1;
#endif
}

// Calls body(i) for i in [0, count), each i on one thread. Iterations must be independent, so that the result does not
// depend on num_threads. An exception (std::bad_alloc) reaches the caller after all threads have stopped.
template <class Body>
void parallel_for(int64_t count, int num_threads, const Body& body) {
  const int threads = static_cast<int>(count < num_threads ? count : num_threads);
  const ScratchUse caller;
  if (threads <= 1) {
    for (int64_t i = 0; i < count; ++i) body(i);
    return;
  }
  std::exception_ptr failure;
  ThreadScratch& mine = ThreadScratch::mine();
  int64_t grown = 0;  // scratch that other threads reserved; it may belong to this one (sum_blocks)
#pragma omp parallel num_threads(threads)
  {
    ThreadScratch& scratch = ThreadScratch::mine();
    const ScratchUse use;
    const int64_t before = scratch.grown();
#pragma omp for schedule(dynamic, 1) nowait
    for (int64_t i = 0; i < count; ++i) {
      try {
        body(i);
      } catch (...) {
#pragma omp critical(nmr_failure)
        if (!failure) failure = std::current_exception();
      }
    }
    const int64_t reserved = &scratch == &mine ? 0 : scratch.grown() - before;
#pragma omp atomic
    grown += reserved;
  }
  mine.count(grown);
  if (failure) std::rethrow_exception(failure);
}

}  // namespace nmr
