#include <cmath>

#include "check.h"
#include "meshes.h"

namespace nmr::test {
namespace {

template <class T>
struct Camera {
  int64_t batch = 3, vertex_batch, num_vertices = 4;
  bool perspective, packed;
  std::vector<T> vertices, matrix, intrinsics, distortion;
  std::vector<int64_t> starts{0, 0, 4, 0, 4, 0, 12, 0};

  Camera(int64_t vertex_batch, bool perspective, bool distorted, bool packed)
      : vertex_batch(vertex_batch), perspective(perspective), packed(packed), matrix(noise_array<T>(2, 36)), intrinsics(noise_array<T>(3, 18)) {
    if (packed) num_vertices = 12;
    vertices = noise_array<T>(1, 3 * (packed ? num_vertices : vertex_batch * num_vertices));
    if (distorted) distortion = noise_array<T>(4, 15);
    for (T& k : distortion) k /= 8;
    for (int b = 0; b < 3; ++b) matrix[12 * b + 11] += T(3);  // in front of the camera
  }
  int64_t outputs() const { return packed ? num_vertices : batch * num_vertices; }
  // The image and the vertex of an output row.
  int64_t image(int64_t row) const { return packed ? (row < 4 ? 0 : 2) : row / num_vertices; }
  int64_t vertex(int64_t row) const { return packed || vertex_batch > 1 ? row : row % num_vertices; }

  Project<T> args(int num_threads) const {
    return {vertices.data(), packed ? starts.data() : nullptr, batch, vertex_batch, num_vertices, matrix.data(), intrinsics.data(),
            distortion.empty() ? nullptr : distortion.data(), perspective, nullptr, nullptr, nullptr, nullptr, nullptr, nullptr, num_threads};
  }
  std::vector<T> points() const {
    std::vector<T> out = unwritten<T>(3 * outputs());
    Project<T> call = args(1);
    call.points = out.data();
    project_forward(call);
    return out;
  }
};

template <class Visit>
void for_each_camera(const Visit& visit) {
  for (bool perspective : {true, false})
    for (bool distorted : {false, true})
      for (int layout = 0; layout < 3; ++layout)
        if (perspective || !distorted) visit(layout == 0 ? 1 : 3, perspective, distorted, layout == 2);
}

}  // namespace

TEST_REAL(project_is_the_definition) {
  for_each_camera([](int64_t vertex_batch, bool perspective, bool distorted, bool packed) {
    const Camera<T> camera(vertex_batch, perspective, distorted, packed);
    const std::vector<T> points = camera.points();
    for (int64_t row = 0; row < camera.outputs(); ++row) {
      const int64_t b = camera.image(row);
      const T *v = camera.vertices.data() + 3 * camera.vertex(row), *m = camera.matrix.data() + 12 * b, *k = camera.intrinsics.data() + 6 * b;
      double u[3];
      for (int r = 0; r < 3; ++r) u[r] = double(m[4 * r]) * v[0] + double(m[4 * r + 1]) * v[1] + double(m[4 * r + 2]) * v[2] + m[4 * r + 3];
      double x = perspective ? u[0] / u[2] : u[0], y = perspective ? u[1] / u[2] : u[1];
      if (distorted) {
        const T* d = camera.distortion.data() + 5 * b;
        const double r2 = x * x + y * y, radial = 1 + d[0] * r2 + d[1] * r2 * r2 + d[4] * r2 * r2 * r2;
        const double xd = x * radial + 2 * d[2] * x * y + d[3] * (r2 + 2 * x * x);
        y = y * radial + d[2] * (r2 + 2 * y * y) + 2 * d[3] * x * y;
        x = xd;
      }
      const double tolerance = sizeof(T) == 4 ? 2e-5 : 1e-13;
      CHECK_NEAR(points[3 * row], k[0] * x + k[1] * y + k[2], tolerance);
      CHECK_NEAR(points[3 * row + 1], k[3] * x + k[4] * y + k[5], tolerance);
      CHECK_NEAR(points[3 * row + 2], u[2], tolerance);
    }
  });
}

// Central differences for every input, and gradients that can be left out.
TEST(project_gradients_are_the_derivative) {
  for_each_camera([](int64_t vertex_batch, bool perspective, bool distorted, bool packed) {
    Camera<double> camera(vertex_batch, perspective, distorted, packed);
    const std::vector<double> grad_points = noise_array<double>(7, 3 * camera.outputs());
    std::vector<double> grads[4] = {unwritten<double>(camera.vertices.size()), unwritten<double>(36), unwritten<double>(18),
                                    unwritten<double>(camera.distortion.size())};
    Project<double> call = camera.args(2);
    call.grad_points = grad_points.data();
    call.grad_vertices = grads[0].data();
    call.grad_matrix = grads[1].data();
    call.grad_intrinsics = grads[2].data();
    call.grad_distortion = distorted ? grads[3].data() : nullptr;
    project_backward(call);
    std::vector<double>* inputs[4] = {&camera.vertices, &camera.matrix, &camera.intrinsics, &camera.distortion};
    for (int i = 0; i < 4; ++i)
      for (size_t n = 0; n < inputs[i]->size(); ++n) {
        double& x = (*inputs[i])[n];
        const double original = x;
        double difference = 0;
        for (int side : {1, -1}) {
          x = original + side * 1e-6;
          const std::vector<double> points = camera.points();
          for (size_t m = 0; m < points.size(); ++m) difference += side * grad_points[m] * points[m] / 2e-6;
        }
        x = original;
        CHECK_NEAR(grads[i][n], difference, 1e-6 * (1 + std::abs(difference)));
      }
    std::vector<double> again = unwritten<double>(camera.vertices.size());
    call.grad_vertices = again.data();
    call.grad_matrix = call.grad_intrinsics = call.grad_distortion = nullptr;
    project_backward(call);
    CHECK(again == grads[0]);
    again = unwritten<double>(36);
    call.grad_vertices = nullptr;
    call.grad_matrix = again.data();
    project_backward(call);
    CHECK(again == grads[1]);
  });
}

// The optical axis is no exception: published code has a NaN there.
TEST_REAL(project_gradients_on_the_optical_axis_are_finite) {
  Camera<T> camera(1, true, true, false);
  for (T& x : camera.vertices) x = 0;
  for (int n = 0; n < 36; ++n) camera.matrix[n] = T(n % 12 == 11 ? 2 : n % 12 % 5 == 0);
  const std::vector<T> grad_points = noise_array<T>(7, 3 * camera.outputs());
  std::vector<T> grad_vertices = unwritten<T>(12), grad_distortion = unwritten<T>(15);
  Project<T> call = camera.args(1);
  call.grad_points = grad_points.data();
  call.grad_vertices = grad_vertices.data();
  call.grad_distortion = grad_distortion.data();
  project_backward(call);
  for (T g : grad_vertices) CHECK(std::isfinite(g));
  for (T g : grad_distortion) CHECK_EQUAL(g, T(0));
}

}  // namespace nmr::test
