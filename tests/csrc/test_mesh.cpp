// Smoothness and voxels.
#include <algorithm>

#include "check.h"
#include "meshes.h"

namespace nmr::test {
namespace {

template <class T>
std::vector<T> smoothness(const std::vector<T>& vertices, const std::vector<int64_t>& edges, int64_t batch) {
  std::vector<T> loss = unwritten<T>(batch);
  const auto num_vertices = static_cast<int64_t>(vertices.size()) / 3 / batch, num_edges = static_cast<int64_t>(edges.size()) / 4;
  smoothness_forward(Smoothness<T>{vertices.data(), edges.data(), batch, num_vertices, num_edges, loss.data(), nullptr, nullptr, 2});
  return loss;
}

std::vector<unsigned char> voxels_of(const std::vector<Mesh>& meshes, int64_t size, bool touched) {
  const Scene<float> scene = stack<float>(meshes, false);
  std::vector<unsigned char> voxels(scene.batch * size * size * size, 2);
  voxelize(Voxelize{scene.mesh(), size, touched, reinterpret_cast<bool*>(voxels.data()), 2});
  return voxels;
}

Mesh box(double lo, double hi) {
  Mesh mesh;
  for (int n = 0; n < 8; ++n)
    for (int k = 0; k < 3; ++k) mesh.vertices.push_back(n >> k & 1 ? hi : lo);
  mesh.faces = {0, 1, 3, 0, 3, 2, 4, 5, 7, 4, 7, 6, 0, 1, 5, 0, 5, 4, 2, 3, 7, 2, 7, 6, 0, 2, 6, 0, 6, 4, 1, 3, 7, 1, 7, 5};
  return mesh;
}

}  // namespace

// Two faces at an angle over the edge 0-1: (1 + cos)^2, up to the guards of 1e-6.
TEST_REAL(smoothness_of_a_hinge) {
  for (int degrees = 10; degrees <= 180; degrees += 10) {
    const double angle = degrees * 3.14159265358979323846 / 180;
    const std::vector<T> vertices{0, 0, 0, 1, 0, 0, T(0.5), 1, 0, T(0.5), T(std::cos(angle)), T(std::sin(angle))};
    CHECK_NEAR(smoothness(vertices, {0, 1, 2, 3}, 1)[0], std::pow(1 + std::cos(angle), 2), 2e-5);
  }
}

// Eleven meshes: eight that are worked on together, and three.
TEST(smoothness_gradient_is_the_derivative) {
  const int64_t batch = 11, size = 18;
  const std::vector<double> vertices = noise_array<double>(1, batch * size), grad_loss = noise_array<double>(2, batch);
  const std::vector<int64_t> edges{0, 1, 2, 3, 1, 2, 0, 4, 3, 4, 5, 1, 2, 5, 0, 4};
  std::vector<double> grad = unwritten<double>(batch * size);
  smoothness_backward(Smoothness<double>{vertices.data(), edges.data(), batch, 6, 4, nullptr, grad_loss.data(), grad.data(), 2});
  for (int64_t n = 0; n < size; ++n) {  // the same coordinate of every mesh at once: they do not depend on each other
    std::vector<double> more = vertices, less = vertices;
    for (int64_t b = 0; b < batch; ++b) {
      more[b * size + n] += 1e-6;
      less[b * size + n] -= 1e-6;
    }
    const std::vector<double> up = smoothness(more, edges, batch), down = smoothness(less, edges, batch);
    for (int64_t b = 0; b < batch; ++b) {
      const double difference = grad_loss[b] * (up[b] - down[b]) / 2e-6;
      CHECK_NEAR(grad[b * size + n], difference, 1e-6 * (1 + std::abs(difference)));
    }
  }
}

TEST_REAL(smoothness_does_not_depend_on_the_company) {
  const std::vector<T> vertices = noise_array<T>(1, 11 * 18);
  const std::vector<int64_t> edges{0, 1, 2, 3, 1, 2, 0, 4, 3, 4, 5, 1, 2, 5, 0, 4, 0, 5, 1, 2, 3, 2, 4, 5};
  const std::vector<T> together = smoothness(vertices, edges, 11);
  for (int b = 0; b < 11; ++b) {
    const std::vector<T> alone(vertices.begin() + 18 * b, vertices.begin() + 18 * (b + 1));
    CHECK_EQUAL(smoothness(alone, edges, 1)[0], together[b]);
  }
}

TEST(voxels_of_a_box) {
  const int64_t s = 16;
  for (bool touched : {false, true}) {
    const std::vector<unsigned char> voxels = voxels_of({box(0.3, 0.7)}, s, touched);
    for (int64_t n = 0; n < s * s * s; ++n) {
      const int64_t c[3] = {n / (s * s), n / s % s, n % s};
      bool within = true, near_surface = false;
      for (int64_t x : c) {
        within = within && x + 1 > 0.3 * s && x < 0.7 * s;  // the cell meets the box
        near_surface = near_surface || std::abs(x + 0.5 - 0.3 * s) < 1.5 || std::abs(x + 0.5 - 0.7 * s) < 1.5;
      }
      if (touched || !near_surface) CHECK_EQUAL(bool(voxels[n]), within);
      if (voxels[n]) CHECK(near_surface || within);
    }
  }
}

TEST(voxels_fill_what_is_closed_and_nothing_else) {
  Mesh ball = icosphere(3);
  for (double& x : ball.vertices) x = 0.5 + 0.4 * x;
  Mesh open = ball;
  open.faces.resize(3 * 900);
  for (bool touched : {false, true}) {
    const std::vector<unsigned char> closed = voxels_of({ball}, 32, touched);
    const auto count = std::count(closed.begin(), closed.end(), 1);
    CHECK_NEAR(static_cast<double>(count), 4.0 / 3 * 3.14159 * std::pow(0.4 * 32 + 0.5, 3), 0.05 * static_cast<double>(count));
    const std::vector<unsigned char> hollow = voxels_of({open}, 32, touched);
    CHECK(std::count(hollow.begin(), hollow.end(), 1) < 0.6 * static_cast<double>(count));
    CHECK_EQUAL(int(hollow[(16 * 32 + 16) * 32 + 16]), 0);
    for (unsigned char cell : voxels_of({Mesh{}}, 5, touched)) CHECK_EQUAL(int(cell), 0);
  }
}

// A face through the grid, far larger than it, in the plane x + y + 2 z = 2 (in widths of the grid).
TEST(voxels_of_a_plane) {
  const int64_t s = 8;
  const std::vector<unsigned char> voxels = voxels_of({triangle({-40, -40, 41, 120, -40, -39, -40, 120, -39})}, s, true);
  for (int64_t n = 0; n < s * s * s; ++n) {
    const int64_t low = n / (s * s) + n / s % s + 2 * (n % s);  // of x + y + 2 z over the cell, times s; it spans 4
    CHECK_EQUAL(bool(voxels[n]), low <= 2 * s && low + 4 >= 2 * s);
  }
}

// A face between two layers of cells, with its corners on corners of cells.
TEST(voxels_touch_on_both_sides) {
  const std::vector<double> corners{0.25, 0.25, 0.5, 0.75, 0.25, 0.5, 0.25, 0.75, 0.5};
  for (const std::vector<int64_t>& order : {std::vector<int64_t>{0, 1, 2}, {1, 2, 0}, {2, 1, 0}, {0, 2, 1}}) {
    const std::vector<unsigned char> voxels = voxels_of({Mesh{corners, order}}, 8, true);
    for (int64_t n = 0; n < 512; ++n) {
      const int64_t x = n / 64, y = n / 8 % 8, z = n % 8;
      CHECK_EQUAL(bool(voxels[n]), (z == 3 || z == 4) && x >= 1 && y >= 1 && x <= 6 && y <= 6 && x + y <= 8);
    }
  }
}

}  // namespace nmr::test
