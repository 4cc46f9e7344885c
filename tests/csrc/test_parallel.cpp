#include <atomic>
#include <cmath>
#include <new>
#include <stdexcept>
#include <thread>

#include "../../csrc/parallel.h"
#include "check.h"

namespace nmr::test {

TEST(parallel_for_exceptions_reach_the_caller) {
  for (int threads : {1, 2, 5}) {
    std::atomic<int> ran{0};
    std::string message;
    try {
      parallel_for(20, threads, [&](int64_t i) {
        ++ran;
        if (i == 7) throw std::runtime_error("seven");
      });
    } catch (const std::runtime_error& error) {
      message = error.what();
    }
    CHECK_EQUAL(message, "seven");
    bool out_of_memory = false;  // all of them at once
    try {
      parallel_for(20, threads, [&](int64_t) { throw std::bad_alloc(); });
    } catch (const std::bad_alloc&) {
      out_of_memory = true;
    }
    CHECK(out_of_memory);
    std::atomic<int64_t> sum{0};  // and the next loop works
    parallel_for(10, threads, [&](int64_t i) { sum += i; });
    CHECK_EQUAL(sum.load(), 45);
  }
}

TEST(a_caller_that_waited_in_vain_works_alone_for_a_while) {
  const int64_t ms = 1000000;
  const auto wants = [&](int64_t waited, int64_t worked, int64_t stopped) {
    OversubscriptionGuard guard;
    CHECK(guard.allows_threads());
    guard.record_wait(OversubscriptionGuard::now() - waited, worked, stopped);
    return guard.allows_threads();
  };
  CHECK(!wants(20 * ms, 0, 0));              // the other thread had no core to begin on
  CHECK(!wants(20 * ms, 30 * ms, 15 * ms));  // it lost its core
  CHECK(wants(20 * ms, 1000 * ms, 0));       // it had a longer iteration
  CHECK(wants(0, 0, 0));
}

// A buffer that counts how many of its kind exist.
struct Counted {
  static std::atomic<int> alive;
  std::vector<double> values;
  Counted() { ++alive; }
  ~Counted() { --alive; }
};
std::atomic<int> Counted::alive{0};

TEST(scratch_beyond_the_limit_is_freed_after_the_outermost_loop) {
  ThreadScratch::free_all();
  const size_t limit = ThreadScratch::kLimit / sizeof(double);
  for (int threads : {1, 3}) {
    parallel_for(6, threads,
                 [&](int64_t) { reserve(thread_scratch<Counted>().values, limit / 4); });
    CHECK(Counted::alive >= 1 && Counted::alive <= threads);
    parallel_for(1, 1, [&](int64_t) {
      double* values = reserve(thread_scratch<Counted>().values, 2 * limit);
      values[0] = 7;
      parallel_for(threads, threads,
                   [](int64_t) { thread_scratch<Counted>(); });  // a loop within frees nothing
      CHECK_EQUAL(values[0], 7);
      CHECK_EQUAL(&thread_scratch<Counted>().values[0], values);
    });
    parallel_for(6, threads,
                 [&](int64_t) { reserve(thread_scratch<Counted>().values, 2 * limit); });
    CHECK(Counted::alive <
          threads);  // a thread that had no part in this loop keeps a quarter of the limit
  }
}

TEST(free_all_spares_what_is_in_use) {
  parallel_for(4, 2, [](int64_t) { reserve(thread_scratch<Counted>().values, 10); });
  {
    const ScratchUse use;
    reserve(thread_scratch<Counted>().values, 10);
    std::thread other([] { ThreadScratch::free_all(); });
    other.join();
    CHECK_EQUAL(Counted::alive.load(), 1);
    CHECK_EQUAL(thread_scratch<Counted>().values.size(), size_t(10));
  }
  ThreadScratch::free_all();
  CHECK_EQUAL(Counted::alive.load(), 0);
}

#ifdef NMR_FRESH_SCRATCH
TEST(fresh_scratch_is_not_a_number) {
  const ScratchUse use;
  CHECK(std::isnan(reserve(thread_scratch<Counted>().values, 3)[2]));
}
#endif

}  // namespace nmr::test
