// The one parallel loop, per-thread scratch, and the choice of instruction set.
#pragma once

#include <cstdint>
#include <vector>

#include <omp.h>

// A function marked NMR_CLONES is compiled for three levels of x86-64 and the loader picks one. Only code inlined into it
// is cloned with it, so what it calls in its loops is marked NMR_INLINE. Elsewhere the macro is empty.
#if defined(NMR_MULTIVERSION) && defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define NMR_CLONES __attribute__((target_clones("default", "arch=x86-64-v3", "arch=x86-64-v4")))
#else
#define NMR_CLONES
#endif

#if defined(__GNUC__)
#define NMR_INLINE inline __attribute__((always_inline))
#else
#define NMR_INLINE inline
#endif

namespace nmr {

// Calls body(i) for i in [0, count), each i on one thread. Iterations must be independent: then the result does not
// depend on num_threads.
template <class Body>
void parallel_for(int64_t count, int num_threads, const Body& body) {
  const int threads = static_cast<int>(count < num_threads ? count : num_threads);
  if (threads <= 1) {
    for (int64_t i = 0; i < count; ++i) body(i);
    return;
  }
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int64_t i = 0; i < count; ++i) body(i);
}

// Memory that a thread keeps between calls. `Tag` separates users of the same element type.
template <class Scratch>
Scratch& thread_scratch() {
  static thread_local Scratch scratch;
  return scratch;
}

// Grows a buffer (never shrinks it) and returns its storage.
template <class T>
T* reserve(std::vector<T>& buffer, size_t size) {
  if (buffer.size() < size) buffer.resize(size);
  return buffer.data();
}

}  // namespace nmr
