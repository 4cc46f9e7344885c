// The part of GCC's OpenMP interface that csrc/parallel.h compiles to, on plain threads and
// mutexes. ThreadSanitizer does not see the synchronisation inside libgomp, which is not compiled
// with it, and would report every loop; this it sees. A construct that is not here yet fails to
// link.
#include <deque>
#include <map>
#include <mutex>
#include <thread>
#include <vector>

namespace {

struct Loop {
  long next, end, step, chunk;
};

struct Team {
  std::mutex mutex;
  int size = 1;
  std::deque<Loop> loops;  // that its members have come to so far
};

// Where a thread is.
struct Place {
  Team* team = nullptr;
  int number = 0;
  size_t loops = 0;  // that it has begun
};

thread_local Place place;

void run(void (*body)(void*), void* data, unsigned threads, Team& team) {
  team.size = threads == 0 ? 4 : static_cast<int>(threads);
  const size_t begun = team.loops.size();
  const auto member = [&](int number) {
    const Place outer = place;
    place = {&team, number, begun};
    body(data);
    place = outer;
  };
  std::vector<std::thread> others;
  for (int n = 1; n < team.size; ++n) others.emplace_back(member, n);
  member(0);
  for (std::thread& thread : others) thread.join();
}

std::mutex& critical_mutex(void** name) {
  static std::mutex guard;
  static std::map<void**, std::mutex> mutexes;
  const std::lock_guard<std::mutex> lock(guard);
  return mutexes[name];
}

}  // namespace

extern "C" {

void GOMP_parallel(void (*body)(void*), void* data, unsigned threads, unsigned) {
  Team team;
  run(body, data, threads, team);
}

bool GOMP_loop_dynamic_next(long* start, long* end) {
  const std::lock_guard<std::mutex> lock(place.team->mutex);
  Loop& loop = place.team->loops[place.loops - 1];
  if (loop.next >= loop.end) return false;
  *start = loop.next;
  loop.next += loop.chunk * loop.step;
  *end = loop.next < loop.end ? loop.next : loop.end;
  return true;
}

bool GOMP_loop_nonmonotonic_dynamic_next(long* start, long* end) {
  return GOMP_loop_dynamic_next(start, end);
}

bool GOMP_loop_dynamic_start(long first, long last, long step, long chunk, long* start, long* end) {
  {
    const std::lock_guard<std::mutex> lock(place.team->mutex);
    if (++place.loops > place.team->loops.size())
      place.team->loops.push_back({first, last, step, chunk});
  }
  return GOMP_loop_dynamic_next(start, end);
}

bool GOMP_loop_nonmonotonic_dynamic_start(long first, long last, long step, long chunk, long* start,
                                          long* end) {
  return GOMP_loop_dynamic_start(first, last, step, chunk, start, end);
}

// A region that is one loop (what the compiler makes of it when it optimises).
void GOMP_parallel_loop_dynamic(void (*body)(void*), void* data, unsigned threads, long first,
                                long last, long step, long chunk, unsigned) {
  Team team;
  team.loops.push_back({first, last, step, chunk});
  run(body, data, threads, team);
}

void GOMP_parallel_loop_nonmonotonic_dynamic(void (*body)(void*), void* data, unsigned threads,
                                             long first, long last, long step, long chunk,
                                             unsigned flags) {
  GOMP_parallel_loop_dynamic(body, data, threads, first, last, step, chunk, flags);
}

void GOMP_loop_end_nowait() {}

void GOMP_critical_name_start(void** name) { critical_mutex(name).lock(); }

void GOMP_critical_name_end(void** name) { critical_mutex(name).unlock(); }

int omp_get_thread_num() { return place.number; }

int omp_get_num_threads() { return place.team ? place.team->size : 1; }

int omp_get_max_threads() { return 4; }
}
