// World space to renderer space, forward and backward. (The published renderer uses a chain of
// tensor operations.)
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "distortion.h"
#include "parallel.h"
#include "stages.h"

namespace nmr {
namespace {

// Vertices per task. Sums are taken per chunk, in kGroup partial sums, then over chunks: the same
// on every processor.
constexpr int64_t kVertexChunk = 512;
constexpr int kCameraSums =
    12 + 6 + 8;  // sums over vertices per camera: gradients of [A | t], K, distortion
constexpr int kTotals =
    kCameraSums + 3 + 1;  // plus the gradients of origin and extent, which follow from the sums

// Derivatives, and gradients multiplied by them, count as infinite beyond this limit. It is small
// enough that sums cannot overflow.
template <class T>
constexpr T kLimit = T(1e200);
template <>
constexpr float kLimit<float> = 1e30f;

// The camera of one image.
template <class T>
struct Lens {
  T a[12], k[6], d[kMostCoefficients], o[3], extent, inverse_extent;
  T reach2;  // largest r^2 at which the distortion is that of a lens
  T largest_a, largest_k,
      largest_d;  // largest |a|, |k / extent|, |d|; the first and the last at least 1
  bool usable;    // all of it is finite, and extent is not 0

  Lens(const Project<T>& args, int64_t b)
      : d{},
        o{},
        extent(1),
        reach2(std::numeric_limits<T>::infinity()),
        largest_a(1),
        largest_k(0),
        largest_d(1),
        usable(true) {
    const T* camera = args.camera + (args.camera_each ? kCamera * b : 0);
    std::copy_n(camera, 12, a);
    std::copy_n(camera + kIntrinsics, 6, k);
    std::copy_n(camera + kOrigin, 3, o);
    extent = camera[kExtent];
    if (args.distortion)
      std::copy_n(args.distortion + (args.distortion_each ? args.coefficients * b : 0),
                  args.coefficients, d);
    inverse_extent = 1 / extent;
    for (T value : a) largest_a = std::max(largest_a, std::abs(value));
    for (T value : k) largest_k = std::max(largest_k, std::abs(value * inverse_extent));
    for (T value : d) largest_d = std::max(largest_d, std::abs(value));
    for (T value : a) usable = usable && std::isfinite(value);
    for (T value : k) usable = usable && std::isfinite(value * inverse_extent);
    for (T value : d) usable = usable && std::abs(value) < kLimit<T>;
    for (T value : o) usable = usable && std::isfinite(value);
    usable = usable && std::isfinite(extent) && std::isfinite(inverse_extent);
    if (!args.distortion || !args.perspective || !usable) return;
    const int64_t n = args.coefficients;
    reach2 = static_cast<T>(n == 4   ? square_reach<4>(d)
                            : n == 5 ? square_reach<5>(d)
                                     : square_reach<8>(d));
  }
};

// Consecutive vertices of one image: their first row in the vertices and in the points.
struct Run {
  int64_t image, vertices, points, count;
};

}  // namespace
}  // namespace nmr

#define NMR_LEVEL_V4
#define NMR_LEVEL_FILE "project_lanes.h"
#include "levels.h"

namespace nmr {
namespace {

struct ProjectScratch {
  std::vector<Run> runs;
  std::vector<double> totals;
};

// The runs of all images, in order.
template <class T>
const std::vector<Run>& runs_of(const Project<T>& args, ProjectScratch& scratch) {
  scratch.runs.clear();
  for (int64_t b = 0; b < args.batch; ++b) {
    const int64_t points = args.starts ? args.starts[2 * b] : b * args.num_vertices;
    const int64_t vertices = args.starts || args.vertex_batch != 1 ? points : 0;
    const int64_t count = args.starts ? args.starts[2 * b + 2] - points : args.num_vertices;
    for (int64_t n = 0; n < count; n += kVertexChunk)
      scratch.runs.push_back({b, vertices + n, points + n, std::min(kVertexChunk, count - n)});
  }
  return scratch.runs;
}

template <class T>
void write(const double* sum, int count, T* grad, int64_t place) {
  const double largest = std::numeric_limits<T>::max();
  for (int k = 0; k < count && grad; ++k)
    grad[place + k] = static_cast<T>(std::clamp(sum[k], -largest, largest));
}

template <class T>
void write_camera(const double* sum, T* grad, int64_t b) {
  write(sum, 18, grad, kCamera * b);
  write(sum + kCameraSums, 4, grad, kCamera * b + kOrigin);
}

}  // namespace

template <class T>
void project_forward(const Project<T>& args) {
  const ScratchUse use;
  const std::vector<Run>& runs = runs_of(args, thread_scratch<ProjectScratch>());
  parallel_for(static_cast<int64_t>(runs.size()), args.num_threads,
               [&](int64_t r) { NMR_AT_BEST_LEVEL(forward_run, args, runs[r]); });
}

template <class T>
void project_backward(const Project<T>& args) {
  const ScratchUse use;
  ProjectScratch& scratch = thread_scratch<ProjectScratch>();
  const std::vector<Run>& runs = runs_of(args, scratch);
  const int64_t num_runs = static_cast<int64_t>(runs.size());
  const bool sum_camera = args.grad_camera || args.grad_distortion;
  double* totals = sum_camera ? reserve(scratch.totals, num_runs * kTotals) : nullptr;

  if (args.batch == 0 && args.grad_vertices)
    std::fill_n(args.grad_vertices, 3 * args.vertex_batch * args.num_vertices, T(0));

  // If all images share the vertices, each chunk of vertices belongs to one task, which visits the
  // images in order.
  const bool shared = !args.starts && args.vertex_batch == 1 && args.batch > 1;
  const int64_t images = shared ? args.batch : 1, tasks = num_runs / images;
  parallel_for(tasks, args.num_threads, [&](int64_t task) {
    T discarded[3 * kVertexChunk];
    T* grad = args.grad_vertices ? args.grad_vertices + 3 * runs[task].vertices : discarded;
    std::fill_n(grad, 3 * runs[task].count, T(0));
    for (int64_t b = 0; b < images; ++b) {
      const int64_t r = b * tasks + task;
      NMR_AT_BEST_LEVEL(backward_run, args, runs[r], grad, totals ? totals + r * kTotals : nullptr);
    }
  });
  if (!sum_camera) return;

  // One camera for all images gets the sum over them.
  double of_all[kTotals] = {};
  for (int64_t b = 0, r = 0; b < args.batch; ++b) {
    double sum[kTotals] = {};
    for (; r < num_runs && runs[r].image == b; ++r)
      for (int k = 0; k < kTotals; ++k) sum[k] += totals[r * kTotals + k];
    for (int k = 0; k < kTotals; ++k) of_all[k] += sum[k];
    if (args.camera_each) write_camera(sum, args.grad_camera, b);
    if (args.distortion_each)
      write(sum + 18, static_cast<int>(args.coefficients), args.grad_distortion,
            args.coefficients * b);
  }
  if (!args.camera_each) write_camera(of_all, args.grad_camera, 0);
  if (!args.distortion_each)
    write(of_all + 18, static_cast<int>(args.coefficients), args.grad_distortion, 0);
}

NMR_FLOAT_AND_DOUBLE(project_forward, Project)
NMR_FLOAT_AND_DOUBLE(project_backward, Project)

}  // namespace nmr
