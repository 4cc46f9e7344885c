// The parallel loop, and the choice of instruction set.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <exception>
#include <limits>

#if !defined(_WIN32)
#include <pthread.h>
#endif

#include "scratch.h"

// Several x86-64 levels in one program: see levels.h.
#if defined(NMR_MULTIVERSION) && defined(__x86_64__) && defined(__GLIBC__) && \
    !defined(__clang__) && __GNUC__ >= 12
#define NMR_LEVELS 1
#else
#define NMR_LEVELS 0
#endif

#define NMR_INLINE inline __attribute__((always_inline))

namespace nmr {

constexpr int64_t kLanes = 8;   // values in a vector of level_lanes.h
constexpr int64_t kGroup = 16;  // values that plain loops work on together: compilers make vectors

// Number of the lowest bit that is set; bits must not be 0.
NMR_INLINE int64_t lowest_bit(uint64_t bits) { return __builtin_ctzll(bits); }

// The highest level of this processor that inner loops are compiled for (levels.h): 4 for
// x86-64-v4, 3 for v3, else 1.
inline int cpu_level() {
#if NMR_LEVELS
  static const int level = [] {
    const char* wanted = std::getenv("NMR_CPU_LEVEL");
    const auto is_wanted = [wanted](const char* name) {
      return wanted && std::strcmp(wanted, name) == 0;
    };
    if (is_wanted("base") || !__builtin_cpu_supports("x86-64-v3")) return 1;
    return is_wanted("v3") || !__builtin_cpu_supports("x86-64-v4") ? 3 : 4;
  }();
  return level;
#else
  return 1;
#endif
}

// Keeps loops on one thread while cores are oversubscribed. A loop ends when its last thread has
// ended, and a thread without a core may need many times as long as the whole loop. A caller that
// waited for such a thread therefore works alone for 50 times as long as it waited, so that no more
// than a fiftieth of the time is lost.
class OversubscriptionGuard {
 public:
  static OversubscriptionGuard& shared() {
    static OversubscriptionGuard guard;
#if !defined(_WIN32)
    // fork copies OpenMP's list of threads, but not the threads: a loop in the child would wait for
    // them. If the parent has never wanted several threads, the child may start its own.
    static const int registered =
        pthread_atfork(nullptr, nullptr, [] { guard.alone_until_ = kForEver; });
    static_cast<void>(registered);
#endif
    return guard;
  }

  static int64_t now() {  // nanoseconds
    const auto time = std::chrono::steady_clock::now().time_since_epoch();
    return std::chrono::duration_cast<std::chrono::nanoseconds>(time).count();
  }
  // Time for which this thread has had a core; wall-clock time if the system does not report it.
  static int64_t on_core() {
#if defined(CLOCK_THREAD_CPUTIME_ID)
    timespec time;
    if (clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time) == 0)
      return time.tv_sec * INT64_C(1000000000) + time.tv_nsec;
#endif
    return now();
  }

  bool allows_threads() const { return now() >= alone_until_.load(std::memory_order_relaxed); }

  // finished: when the caller ran out of iterations. worked: the longest time that another thread
  // spent on a core; stopped: the longest time that another thread spent without one.
  void record_wait(int64_t finished, int64_t worked, int64_t stopped) {
    const int64_t time = now(), waited = time - finished;
    if (waited < kPatience || (waited < worked + kPatience && stopped < waited / 2)) return;
    alone_until_.store(time + 50 * waited, std::memory_order_relaxed);
  }

 private:
  static constexpr int64_t kPatience = 100000;  // nanoseconds
  static constexpr int64_t kForEver = std::numeric_limits<int64_t>::max();
  std::atomic<int64_t> alone_until_{0};
};

// Calls body(i) for i in [0, count), each i on one thread, on up to num_threads threads. Iterations
// must be independent, so that the result does not depend on the number of threads. An exception
// (std::bad_alloc) reaches the caller after all threads have stopped.
template <class Body>
void parallel_for(int64_t count, int num_threads, const Body& body) {
  const int threads = static_cast<int>(count < num_threads ? count : num_threads);
  const ScratchUse caller;
  if (threads <= 1 || !OversubscriptionGuard::shared().allows_threads()) {
    for (int64_t i = 0; i < count; ++i) body(i);
    return;
  }
  std::exception_ptr failure;
  ThreadScratch& mine = ThreadScratch::mine();
  int64_t grown = 0;  // scratch that other threads reserved; it may belong to this one (sum_blocks)
  int64_t finished = 0, worked = 0, stopped = 0;
#pragma omp parallel num_threads(threads)
  {
    ThreadScratch& scratch = ThreadScratch::mine();
    const ScratchUse use;
    const int64_t before = scratch.grown(), start = OversubscriptionGuard::now(),
                  start_on_core = OversubscriptionGuard::on_core();
#pragma omp for schedule(dynamic, 1) nowait
    for (int64_t i = 0; i < count; ++i) {
      try {
        body(i);
      } catch (...) {
#pragma omp critical(nmr_thread)
        if (!failure) failure = std::current_exception();
      }
    }
    const int64_t end = OversubscriptionGuard::now(),
                  with_core = OversubscriptionGuard::on_core() - start_on_core;
#pragma omp critical(nmr_thread)
    if (&scratch == &mine) {
      finished = end;
    } else {
      grown += scratch.grown() - before;
      worked = std::max(worked, with_core);
      stopped = std::max(stopped, end - start - with_core);
    }
  }
  OversubscriptionGuard::shared().record_wait(finished, worked, stopped);
  mine.count(grown);
  if (failure) std::rethrow_exception(failure);
}

}  // namespace nmr
