#include <atomic>
#include <new>
#include <stdexcept>

#include "../../csrc/parallel.h"
#include "check.h"

namespace nmr::test {

TEST(parallel_for_visits_each_index_once) {
  for (int threads : {-1, 0, 1, 2, 3, 5, 16})
    for (int64_t count : {0, 1, 2, 3, 7, 100}) {
      std::vector<int> visits(count, 0);
      parallel_for(count, threads, [&](int64_t i) { ++visits[i]; });
      for (int n : visits) CHECK_EQUAL(n, 1);
    }
}

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

TEST(scratch_belongs_to_a_thread_and_grows) {
  struct Scratch {
    std::vector<double> values;
  };
  CHECK_EQUAL(&thread_scratch<Scratch>(), &thread_scratch<Scratch>());
  parallel_for(50, 4, [](int64_t i) {
    double* values = reserve(thread_scratch<Scratch>().values, 100 + i);
    for (int64_t n = 0; n < 100 + i; ++n) values[n] = static_cast<double>(i);
    for (int64_t n = 0; n < 100 + i; ++n) CHECK_EQUAL(values[n], static_cast<double>(i));
  });
}

}  // namespace nmr::test
