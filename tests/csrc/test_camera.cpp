#include <cmath>

#include "check.h"
#include "meshes.h"

namespace nmr::test {
namespace {

template <class T>
struct Camera {
  int64_t batch = 3, vertex_batch, num_vertices = 4;
  bool perspective, packed;
  std::vector<T> vertices, matrix, intrinsics, distortion, origin, extent;
  std::vector<int64_t> starts{0, 0, 4, 0, 4, 0, 12, 0};

  Camera(int64_t vertex_batch, bool perspective, bool distorted, bool placed, bool packed)
      : vertex_batch(vertex_batch), perspective(perspective), packed(packed), matrix(noise_array<T>(2, 36)), intrinsics(noise_array<T>(3, 18)) {
    if (packed) num_vertices = 12;
    vertices = noise_array<T>(1, 3 * (packed ? num_vertices : vertex_batch * num_vertices));
    if (distorted) distortion = noise_array<T>(4, 15);
    for (T& k : distortion) k /= 8;
    if (placed) {
      origin = noise_array<T>(5, 9);
      extent = {T(0.25), T(0.5), T(1.5)};
      for (T& x : origin) x /= 8;
    }
    for (int b = 0; b < 3; ++b) matrix[12 * b + 11] += T(3);  // in front of the camera
  }
  int64_t outputs() const { return packed ? num_vertices : batch * num_vertices; }
  // The image and the vertex of an output row.
  int64_t image(int64_t row) const { return packed ? (row < 4 ? 0 : 2) : row / num_vertices; }
  int64_t vertex(int64_t row) const { return packed || vertex_batch > 1 ? row : row % num_vertices; }

  Project<T> args(int num_threads) const {
    return {vertices.data(), packed ? starts.data() : nullptr, batch, vertex_batch, num_vertices, matrix.data(), intrinsics.data(),
            distortion.empty() ? nullptr : distortion.data(), origin.empty() ? nullptr : origin.data(),
            extent.empty() ? nullptr : extent.data(), perspective, nullptr, nullptr, nullptr, nullptr, nullptr, nullptr, nullptr, nullptr,
            num_threads};
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
      for (bool placed : {false, true})
        for (int layout = 0; layout < 3; ++layout)
          if (perspective || !distorted) visit(layout == 0 ? 1 : 3, perspective, distorted, placed, layout == 2);
}

}  // namespace

TEST_REAL(project_is_the_definition) {
  for_each_camera([](int64_t vertex_batch, bool perspective, bool distorted, bool placed, bool packed) {
    const Camera<T> camera(vertex_batch, perspective, distorted, placed, packed);
    const std::vector<T> points = camera.points();
    for (int64_t row = 0; row < camera.outputs(); ++row) {
      const int64_t b = camera.image(row);
      const T *v = camera.vertices.data() + 3 * camera.vertex(row), *m = camera.matrix.data() + 12 * b, *k = camera.intrinsics.data() + 6 * b;
      double u[3], relative[3];
      for (int c = 0; c < 3; ++c) relative[c] = double(v[c]) - (placed ? double(camera.origin[3 * b + c]) : 0);
      for (int r = 0; r < 3; ++r)
        u[r] = double(m[4 * r]) * relative[0] + double(m[4 * r + 1]) * relative[1] + double(m[4 * r + 2]) * relative[2] + m[4 * r + 3];
      double x = perspective ? u[0] / u[2] : u[0], y = perspective ? u[1] / u[2] : u[1];
      if (distorted) {
        const T* d = camera.distortion.data() + 5 * b;
        const double r2 = x * x + y * y, radial = 1 + d[0] * r2 + d[1] * r2 * r2 + d[4] * r2 * r2 * r2;
        const double xd = x * radial + 2 * d[2] * x * y + d[3] * (r2 + 2 * x * x);
        y = y * radial + d[2] * (r2 + 2 * y * y) + 2 * d[3] * x * y;
        x = xd;
      }
      if (placed) {
        x /= camera.extent[b];
        y /= camera.extent[b];
      }
      const double tolerance = sizeof(T) == 4 ? 5e-5 : 1e-13;
      CHECK_NEAR(points[3 * row], k[0] * x + k[1] * y + k[2], tolerance);
      CHECK_NEAR(points[3 * row + 1], k[3] * x + k[4] * y + k[5], tolerance);
      CHECK_NEAR(points[3 * row + 2], u[2], tolerance);
    }
  });
}

// Central differences for every input, and gradients that can be left out.
TEST(project_gradients_are_the_derivative) {
  for_each_camera([](int64_t vertex_batch, bool perspective, bool distorted, bool placed, bool packed) {
    Camera<double> camera(vertex_batch, perspective, distorted, placed, packed);
    const std::vector<double> grad_points = noise_array<double>(7, 3 * camera.outputs());
    std::vector<double>* inputs[6] = {&camera.vertices, &camera.matrix, &camera.intrinsics, &camera.distortion, &camera.origin, &camera.extent};
    std::vector<double> grads[6];
    for (int i = 0; i < 6; ++i) grads[i] = unwritten<double>(inputs[i]->size());
    Project<double> call = camera.args(2);
    call.grad_points = grad_points.data();
    call.grad_vertices = grads[0].data();
    call.grad_matrix = grads[1].data();
    call.grad_intrinsics = grads[2].data();
    call.grad_distortion = distorted ? grads[3].data() : nullptr;
    call.grad_origin = placed ? grads[4].data() : nullptr;
    call.grad_extent = placed ? grads[5].data() : nullptr;
    project_backward(call);
    for (int i = 0; i < 6; ++i)
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
    call.grad_matrix = call.grad_intrinsics = call.grad_distortion = call.grad_origin = call.grad_extent = nullptr;
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
  Camera<T> camera(1, true, true, false, false);
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

// A vertex without a finite image is at infinity, and has no gradient.
TEST_REAL(project_of_vertices_that_have_no_image) {
  const T inf = std::numeric_limits<T>::infinity(), nan = std::numeric_limits<T>::quiet_NaN();
  for (bool distorted : {false, true})
    for (T special : {inf, -inf, nan, T(0)}) {
      Camera<T> camera(3, true, distorted, false, false);
      const std::vector<T> usual = camera.points();
      for (int n = 0; n < 36; ++n) camera.matrix[n] = n < 12 ? T(n % 5 == 0 && n < 11) : camera.matrix[n];  // image 0: u = v
      camera.vertices[2] = special;  // of vertex 0: in the plane of the eye if it is 0
      const std::vector<T> points = camera.points(), grad_points = noise_array<T>(7, 36);
      std::vector<T> grad_vertices = unwritten<T>(36), grad_matrix = unwritten<T>(36);
      Project<T> call = camera.args(1);
      call.grad_points = grad_points.data();
      call.grad_vertices = grad_vertices.data();
      call.grad_matrix = grad_matrix.data();
      project_backward(call);
      CHECK(std::isinf(points[0]) && std::isinf(points[1]) && std::isfinite(points[2]));
      for (int k = 0; k < 3; ++k) CHECK_EQUAL(grad_vertices[k], T(0));
      for (T g : grad_vertices) CHECK(std::isfinite(g));
      for (T g : grad_matrix) CHECK(std::isfinite(g));
      for (int n = 12; n < 36; ++n) CHECK_EQUAL(points[n], usual[n]);  // the other images
    }
}

// An upstream gradient that is infinite or NaN must be seen: it makes the gradient of its vertex and of its camera NaN, and no other.
// One that is finite but would overflow counts as 0.
TEST_REAL(project_passes_on_gradients_that_are_not_finite) {
  const T inf = std::numeric_limits<T>::infinity(), nan = std::numeric_limits<T>::quiet_NaN(), huge = std::numeric_limits<T>::max();
  for_each_camera([&](int64_t vertex_batch, bool perspective, bool distorted, bool placed, bool packed) {
    for (T upstream : {inf, -inf, nan, huge})
      for (int k = 0; k < 3; ++k) {
        const Camera<T> camera(vertex_batch, perspective, distorted, placed, packed);
        std::vector<T> grad_points = noise_array<T>(7, 3 * camera.outputs());
        grad_points[3 * 2 + k] = upstream;  // of vertex 2 in image 0
        std::vector<T> grad_vertices = unwritten<T>(camera.vertices.size()), grad_matrix = unwritten<T>(36);
        std::vector<T> grad_intrinsics = unwritten<T>(18);
        Project<T> call = camera.args(1);
        call.grad_points = grad_points.data();
        call.grad_vertices = grad_vertices.data();
        call.grad_matrix = grad_matrix.data();
        call.grad_intrinsics = grad_intrinsics.data();
        project_backward(call);
        for (size_t n = 0; n < grad_vertices.size(); ++n) CHECK_EQUAL(std::isfinite(grad_vertices[n]), upstream == huge || n / 3 != 2);
        bool seen = false;
        for (size_t n = 0; n < 12; ++n) seen = seen || std::isnan(grad_matrix[n]);
        CHECK_EQUAL(seen, upstream != huge);
        for (size_t n = 12; n < 36; ++n) CHECK(std::isfinite(grad_matrix[n]));
        for (size_t n = 6; n < 18; ++n) CHECK(std::isfinite(grad_intrinsics[n]));
      }
  });
}

TEST_REAL(pose_passes_on_gradients_that_are_not_finite) {
  const std::vector<T> forward = noise_array<T>(1, 6), up = noise_array<T>(2, 6);
  const T inf = std::numeric_limits<T>::infinity(), nan = std::numeric_limits<T>::quiet_NaN();
  for (T upstream : {inf, -inf, nan}) {
    std::vector<T> grad_matrix = noise_array<T>(3, 24), grad_forward = unwritten<T>(6), grad_up = unwritten<T>(6);
    grad_matrix[9] = upstream;
    pose_backward(Pose<T>{forward.data(), up.data(), 2, nullptr, grad_matrix.data(), grad_forward.data(), grad_up.data()});
    for (int n = 0; n < 6; ++n) CHECK(n < 3 ? std::isnan(grad_forward[n]) : std::isfinite(grad_forward[n]));
    for (int n = 0; n < 6; ++n) CHECK(n < 3 ? std::isnan(grad_up[n]) : std::isfinite(grad_up[n]));
  }
}

// Rows x, -y, z of a rotation; z along forward, and up seen upwards.
TEST_REAL(a_pose_is_a_rotation_that_looks_along_its_direction) {
  const std::vector<T> forward = noise_array<T>(1, 30), up = noise_array<T>(2, 30);
  std::vector<T> matrix = unwritten<T>(120);
  pose_forward(Pose<T>{forward.data(), up.data(), 10, matrix.data(), nullptr, nullptr, nullptr});
  for (int b = 0; b < 10; ++b) {
    const T* m = matrix.data() + 12 * b;
    double along = 0, length = 0, upwards = 0;
    for (int k = 0; k < 3; ++k) {
      CHECK_EQUAL(m[4 * k + 3], T(0));
      along += m[8 + k] * forward[3 * b + k];
      length += forward[3 * b + k] * forward[3 * b + k];
      upwards -= m[4 + k] * up[3 * b + k];
      for (int j = 0; j < 3; ++j) {
        double product = 0;
        for (int i = 0; i < 3; ++i) product += m[4 * k + i] * m[4 * j + i];
        CHECK_NEAR(product, j == k, 1e-5);
      }
    }
    CHECK_NEAR(along, std::sqrt(length), 1e-5);
    CHECK(upwards > 0);
  }
}

TEST(pose_gradients_are_the_derivative) {
  std::vector<double> forward = noise_array<double>(1, 12), up = noise_array<double>(2, 12);
  const std::vector<double> grad_matrix = noise_array<double>(3, 48);
  std::vector<double> grad_forward = unwritten<double>(12), grad_up = grad_forward;
  pose_backward(Pose<double>{forward.data(), up.data(), 4, nullptr, grad_matrix.data(), grad_forward.data(), grad_up.data()});
  for (std::vector<double>* values : {&forward, &up})
    for (int n = 0; n < 12; ++n) {
      const double original = (*values)[n];
      double difference = 0;
      for (int side : {1, -1}) {
        std::vector<double> matrix = unwritten<double>(48);
        (*values)[n] = original + side * 1e-6;
        pose_forward(Pose<double>{forward.data(), up.data(), 4, matrix.data(), nullptr, nullptr, nullptr});
        for (int k = 0; k < 48; ++k) difference += side * matrix[k] * grad_matrix[k] / 2e-6;
      }
      (*values)[n] = original;
      CHECK_NEAR((values == &up ? grad_up : grad_forward)[n], difference, 1e-7 * (1 + std::abs(difference)));
    }
}

}  // namespace nmr::test
