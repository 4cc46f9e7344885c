// World space to renderer space, forward and backward. (The published renderer uses a chain of
// tensor operations.)
#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <vector>

#include "lens.h"

#define NMR_LEVEL_V4
#define NMR_LEVEL_FILE "project_lanes.h"
#include "levels.h"

namespace nmr {
namespace {

// Vertices per task. Sums are taken per chunk, in kGroup partial sums, then over chunks: the same
// on every processor.
constexpr int64_t kVertexChunk = 512;

struct ProjectScratch {
  std::vector<Run> runs;
  std::vector<CameraGradient> gradients;  // of each run
};

// The runs of all images, in order.
template <class T>
const std::vector<Run>& runs_of(const Project<T>& args, ProjectScratch& scratch) {
  scratch.runs.clear();
  const Rows &vertices = args.vertex_rows, points{vertices.size, true, vertices.starts};
  for (int64_t b = 0; b < args.batch; ++b) {
    const int64_t count = vertices.count(b);
    for (int64_t n = 0; n < count; n += kVertexChunk)
      scratch.runs.push_back(
          {b, vertices.first(b) + n, points.first(b) + n, std::min(kVertexChunk, count - n)});
  }
  return scratch.runs;
}

// The parts of cameras as rows.
template <class T>
void join_parts(const Project<T>& args) {
  for (int64_t b = 0; b < args.cameras; ++b) {
    T* row = args.camera + kCamera * b;
    std::copy_n(args.matrix.of(b, 12), 12, row);
    std::copy_n(args.intrinsics.of(b, 6), 6, row + kIntrinsics);
    for (int k = 0; k < 3; ++k)
      row[kOrigin + k] = args.origin.values ? args.origin.of(b, 3)[k] : T(0);
    row[kExtent] = args.extent.values ? *args.extent.of(b, 1) : T(1);
  }
}

// Multiplies the rows of K by `across` and `down`.
template <class T>
void stretch(const Project<T>& args, T* rows) {
  for (int64_t b = 0; b < args.cameras; ++b)
    for (int k = 0; k < 6; ++k)
      rows[kCamera * b + kIntrinsics + k] *= k < 3 ? args.across : args.down;
}

template <class T>
T in_range(double sum) {
  const double largest = std::numeric_limits<T>::max();
  return static_cast<T>(std::clamp(sum, -largest, largest));
}

// The gradient of one part of the cameras, `size` numbers of each row.
template <class T>
void write_part(const Project<T>& args, const std::vector<T>& rows, int64_t first, int64_t size,
                const Parameter<T>& part) {
  if (!part.grad) return;
  for (int64_t k = 0; k < size; ++k) {
    double sum = 0;
    for (int64_t b = 0; b < args.cameras; ++b) {
      const T value = rows[kCamera * b + first + k];
      sum += static_cast<double>(value);
      if (part.each) part.grad[size * b + k] = value;
    }
    if (!part.each) part.grad[k] = in_range<T>(sum);
  }
}

// Adds what one image contributes to the gradient of its camera.
void add(const CameraGradient& more, CameraGradient& sum) {
  const auto add_numbers = [](const auto& from, auto& to) {
    for (size_t k = 0; k < std::size(from); ++k) to[k] += from[k];
  };
  add_numbers(more.matrix, sum.matrix);
  add_numbers(more.intrinsics, sum.intrinsics);
  add_numbers(more.distortion, sum.distortion);
  add_numbers(more.origin, sum.origin);
  sum.extent += more.extent;
}

template <class T>
void write_row(const CameraGradient& sum, T* row) {
  for (double value : sum.matrix) *row++ = in_range<T>(value);
  for (double value : sum.intrinsics) *row++ = in_range<T>(value);
  for (double value : sum.origin) *row++ = in_range<T>(value);
  *row = in_range<T>(sum.extent);
}

}  // namespace

template <class T>
void project_forward(const Project<T>& args) {
  const ScratchUse use;
  args.eye.values ? look_at(args) : join_parts(args);
  stretch(args, args.camera);
  const std::vector<Run>& runs = runs_of(args, thread_scratch<ProjectScratch>());
  std::vector<T> nearest(runs.size());
  parallel_for(static_cast<int64_t>(runs.size()), args.num_threads,
               [&](int64_t r) { nearest[r] = NMR_AT_BEST_LEVEL(forward_run, args, runs[r]); });
  *args.nearest = std::numeric_limits<T>::infinity();
  for (T depth : nearest) *args.nearest = std::min(*args.nearest, depth);
}

template <class T>
void project_backward(const Project<T>& args) {
  const ScratchUse use;
  ProjectScratch& scratch = thread_scratch<ProjectScratch>();
  const std::vector<Run>& runs = runs_of(args, scratch);
  const int64_t num_runs = static_cast<int64_t>(runs.size());
  const bool of_pose = args.eye.grad || args.at.grad || args.up.grad || args.view.grad,
             of_parts =
                 args.matrix.grad || args.intrinsics.grad || args.origin.grad || args.extent.grad;
  const bool of_camera = of_pose || of_parts || args.distortion.grad;
  CameraGradient* gradients = of_camera ? reserve(scratch.gradients, num_runs) : nullptr;

  if (args.batch == 0 && args.grad_vertices)
    std::fill_n(args.grad_vertices, 3 * args.vertex_rows.total(0), T(0));

  // If all images share the vertices, each chunk of vertices belongs to one task, which visits the
  // images in order.
  const bool shared = !args.vertex_rows.each && args.batch > 1;
  const int64_t images = shared ? args.batch : 1, tasks = num_runs / images;
  parallel_for(tasks, args.num_threads, [&](int64_t task) {
    T discarded[3 * kVertexChunk];
    T* grad = args.grad_vertices ? args.grad_vertices + 3 * runs[task].vertices : discarded;
    std::fill_n(grad, 3 * runs[task].count, T(0));
    for (int64_t b = 0; b < images; ++b) {
      const int64_t r = b * tasks + task;
      NMR_AT_BEST_LEVEL(backward_run, args, runs[r], grad, gradients ? gradients + r : nullptr);
    }
  });
  if (!of_camera) return;

  // One camera for all images gets the sum over them.
  std::vector<T> rows(kCamera * args.cameras);
  CameraGradient of_all{};
  const auto write_distortion = [&](const CameraGradient& sum, int64_t b) {
    for (int64_t k = 0; k < args.coefficients && args.distortion.grad; ++k)
      args.distortion.grad[args.coefficients * b + k] = in_range<T>(sum.distortion[k]);
  };
  for (int64_t b = 0, r = 0; b < args.batch; ++b) {
    CameraGradient sum{};
    for (; r < num_runs && runs[r].image == b; ++r) add(gradients[r], sum);
    add(sum, of_all);
    if (args.cameras == args.batch) write_row(sum, rows.data() + kCamera * b);
    if (args.distortion.each) write_distortion(sum, b);
  }
  if (args.cameras != args.batch && args.cameras == 1) write_row(of_all, rows.data());
  if (!args.distortion.each) write_distortion(of_all, 0);

  if (args.grad_camera)
    for (size_t k = 0; k < rows.size(); ++k) rows[k] += args.grad_camera[k];
  stretch(args, rows.data());
  if (of_pose) look_at_backward(args, rows.data());
  write_part(args, rows, 0, 12, args.matrix);
  write_part(args, rows, kIntrinsics, 6, args.intrinsics);
  write_part(args, rows, kOrigin, 3, args.origin);
  write_part(args, rows, kExtent, 1, args.extent);
}

NMR_FLOAT_AND_DOUBLE(project_forward, Project)
NMR_FLOAT_AND_DOUBLE(project_backward, Project)

}  // namespace nmr
