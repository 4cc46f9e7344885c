// Memory that threads keep between calls, and when they give it back.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <memory>
#include <mutex>
#include <type_traits>
#include <vector>

namespace nmr {

// What one thread keeps: any number of objects, each of another type. They belong to the thread
// while it works (ScratchUse); otherwise any thread may free them.
class ThreadScratch {
 public:
  // A thread whose buffers have grown by more than this since it last freed them frees them when it
  // has finished. The silhouette gradient of an image of 1024x1024 with anti-aliasing needs 69 MB.
  static constexpr int64_t kLimit = int64_t(128) << 20;

  static ThreadScratch& mine() {
    static thread_local ThreadScratch scratch;
    return scratch;
  }

  template <class Scratch>
  Scratch& get() {
    static thread_local Kept<Scratch>* kept = nullptr;
    if (!kept) {
      auto created = std::make_unique<Kept<Scratch>>(&kept);
      objects_.reserve(objects_.size() + 1);
      kept = created.get();
      objects_.push_back(std::move(created));
    }
    return kept->value;
  }

  void count(int64_t bytes) { grown_ += bytes; }
  int64_t grown() const { return grown_; }

  void start_use() {
    if (depth_++ == 0) busy_.lock();
  }
  void end_use() {
    if (--depth_ > 0) return;
    if (grown_ > kLimit) free();
    busy_.unlock();
  }

  // Frees the memory of all threads that are not at work.
  static void free_all() {
    Registry& all = registry();
    const std::lock_guard<std::mutex> lock(all.mutex);
    for (ThreadScratch* thread : all.threads) {
      if (!thread->busy_.try_lock()) continue;
      thread->free();
      thread->busy_.unlock();
    }
  }

 private:
  struct AnyKept {
    virtual ~AnyKept() = default;
  };
  template <class Scratch>
  struct Kept : AnyKept {
    Scratch value;
    Kept** holder;  // the thread's pointer to this object (see get)
    explicit Kept(Kept** holder) : holder(holder) {}
    ~Kept() override { *holder = nullptr; }
  };
  struct Registry {
    std::mutex mutex;
    std::vector<ThreadScratch*> threads;
  };

  static Registry& registry() {
    static Registry* all =
        new Registry;  // never destroyed: threads may end after the program's static objects
    return *all;
  }

  ThreadScratch() {
    const std::lock_guard<std::mutex> lock(registry().mutex);
    registry().threads.push_back(this);
  }
  ~ThreadScratch() {
    const std::lock_guard<std::mutex> lock(registry().mutex);
    std::vector<ThreadScratch*>& threads = registry().threads;
    threads.erase(std::find(threads.begin(), threads.end(), this));
  }

  void free() {
    objects_.clear();
    grown_ = 0;
  }

  std::mutex busy_;
  int depth_ = 0;      // number of nested parallel loops
  int64_t grown_ = 0;  // bytes
  std::vector<std::unique_ptr<AnyKept>> objects_;
};

// While one of these lives, the references of thread_scratch stay valid on this thread.
// parallel_for makes one on every thread; a function that calls thread_scratch outside parallel_for
// makes one itself.
struct ScratchUse {
  ScratchUse() { ThreadScratch::mine().start_use(); }
  ~ScratchUse() { ThreadScratch::mine().end_use(); }
  ScratchUse(const ScratchUse&) = delete;
  ScratchUse& operator=(const ScratchUse&) = delete;
};

// An object that the thread keeps between calls, one per type.
template <class Scratch>
Scratch& thread_scratch() {
  return ThreadScratch::mine().get<Scratch>();
}

// An allocator that leaves new numbers unset, so that a large buffer costs only what is used of it.
template <class T>
struct Unset : std::allocator<T> {
  template <class U>
  struct rebind {
    using other = Unset<U>;
  };
  template <class U>
  void construct(U* place) {
    ::new (static_cast<void*>(place)) U;
  }
};
template <class T>
using Buffer = std::vector<T, Unset<T>>;

// Grows a buffer (never shrinks it) and returns its storage. With NMR_FRESH_SCRATCH (sanitizer
// builds) the buffer is new, has exactly this size, and all its bits are set, which is NaN in a
// floating-point number: sanitizers and tests then notice reads beyond it and reads of unwritten
// values.
template <class T, class Allocator>
T* reserve(std::vector<T, Allocator>& buffer, size_t size) {
  if (buffer.size() < size)
    ThreadScratch::mine().count(static_cast<int64_t>((size - buffer.size()) * sizeof(T)));
#ifdef NMR_FRESH_SCRATCH
  buffer = std::vector<T, Allocator>(size);
  if constexpr (std::is_trivially_copyable_v<T>)
    if (size > 0) std::memset(static_cast<void*>(buffer.data()), 0xff, size * sizeof(T));
#endif
  if (buffer.size() < size) buffer.resize(size);
  return buffer.data();
}

}  // namespace nmr
