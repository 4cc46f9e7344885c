// The unit cells that a triangle touches, by the separating axis test of a triangle and a box. Both
// include their borders: a triangle in the plane between two cells touches both. Cells are enlarged
// by kSlack on each side, so that this does not depend on rounding. Of the 13 axes, the three of
// the box are the bounds of the search; the others are below. All in double.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include <Eigen/Core>

namespace nmr {

class TriangleCells {
 public:
  // A face with a corner that is not finite, or farther than this from the first cell on some axis,
  // touches nothing.
  static constexpr double kFarthest = 1048576;
  // Larger than the rounding error of coordinates within kFarthest, smaller than the distance of
  // neighbouring float coordinates.
  static constexpr double kSlack = 1e-9;

  // Corners in units of cells. They are sorted first, so that their order does not change any bit.
  TriangleCells(const Eigen::Vector3f (&corners)[3], int64_t size) {
    Eigen::Vector3d v[3];
    for (int k = 0; k < 3; ++k) {
      v[k] = corners[k].cast<double>();
      for (int a = 0; a < 3; ++a)
        if (!(std::abs(v[k][a]) <= kFarthest)) return;
    }
    std::sort(v, v + 3, [](const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
      return std::lexicographical_compare(a.data(), a.data() + 3, b.data(), b.data() + 3);
    });
    for (int a = 0; a < 3; ++a) {
      const double low = std::min({v[0][a], v[1][a], v[2][a]}),
                   high = std::max({v[0][a], v[1][a], v[2][a]});
      first_[a] = std::max<int64_t>(static_cast<int64_t>(std::ceil(low - kSlack)) - 1,
                                    0);  // cell i spans [i, i + 1]
      last_[a] = std::min<int64_t>(static_cast<int64_t>(std::floor(high + kSlack)), size - 1);
    }
    for (int a = 0; a < 3; ++a)
      for (int k = 0; k < 3; ++k) edges_[a][k] = EdgeTest(v[k], v[(k + 1) % 3], v[(k + 2) % 3], a);
    const Eigen::Vector3d e = v[1] - v[0], f = v[2] - v[0];
    origin_ = v[0];
    normal_ = Eigen::Vector3d(e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2],
                              e[0] * f[1] - e[1] * f[0]);
    // Rounding may have changed the direction of the normal of a very thin face. Treated as a
    // segment: the other axes suffice.
    if (normal_.cwiseAbs().maxCoeff() <= 1e-10 * e.cwiseAbs().maxCoeff() * f.cwiseAbs().maxCoeff())
      normal_.setZero();
    for (double n : normal_) {
      (n > 0 ? plane_low_ : plane_high_) -= n;
      plane_low_ -= kSlack * std::abs(n);
      plane_high_ += kSlack * std::abs(n);
    }
    for (int a = 0; a < 3; ++a)
      if (std::abs(normal_[a]) > std::abs(normal_[inner_])) inner_ = a;
  }

  // Calls visit(i, j, k) for each touched cell of [0, size)^3. Cells are visited in columns along
  // the largest component of the normal: there the plane meets few cells of each column.
  template <class Visit>
  void for_each(const Visit& visit) const {
    const int p = (inner_ + 1) % 3, q = (inner_ + 2) % 3;
    int64_t cell[3];
    for (cell[p] = first_[p]; cell[p] <= last_[p]; ++cell[p]) {
      for (cell[q] = first_[q]; cell[q] <= last_[q]; ++cell[q]) {
        if (!passes(inner_, cell)) continue;
        int64_t first, last;
        plane_range(cell[p], cell[q], first, last);
        for (cell[inner_] = first; cell[inner_] <= last; ++cell[inner_])
          if (meets_plane(cell) && passes(p, cell) && passes(q, cell))
            visit(cell[0], cell[1], cell[2]);
      }
    }
  }

 private:
  // The axis (unit vector a) x (edge e from s to t), which is -e_q along p and e_p along q with p,
  // q the axes after a: the cell at c overlaps the triangle along it if low <= -e_q (c_p - s_p) +
  // e_p (c_q - s_q) <= high.
  struct EdgeTest {
    double s_p, s_q, along_p, along_q, low = 0, high = 0;

    EdgeTest() = default;
    EdgeTest(const Eigen::Vector3d& s, const Eigen::Vector3d& t, const Eigen::Vector3d& opposite,
             int a) {
      const int p = (a + 1) % 3, q = (a + 2) % 3;
      s_p = s[p];
      s_q = s[q];
      along_p = s[q] - t[q];
      along_q = t[p] - s[p];
      const double d = along_p * (opposite[p] - s_p) +
                       along_q * (opposite[q] - s_q);  // the triangle spans 0 and d
      const double slack = kSlack * (std::abs(along_p) + std::abs(along_q));
      low = std::min(d, 0.0) - std::max(along_p, 0.0) - std::max(along_q, 0.0) - slack;
      high = std::max(d, 0.0) - std::min(along_p, 0.0) - std::min(along_q, 0.0) + slack;
    }

    bool passes(int64_t c_p, int64_t c_q) const {
      const double at =
          along_p * (static_cast<double>(c_p) - s_p) + along_q * (static_cast<double>(c_q) - s_q);
      return low <= at && at <= high;
    }
  };

  bool passes(int axis, const int64_t (&cell)[3]) const {
    const int64_t c_p = cell[(axis + 1) % 3], c_q = cell[(axis + 2) % 3];
    return edges_[axis][0].passes(c_p, c_q) && edges_[axis][1].passes(c_p, c_q) &&
           edges_[axis][2].passes(c_p, c_q);
  }

  bool meets_plane(const int64_t (&cell)[3]) const {
    double at = 0;
    for (int a = 0; a < 3; ++a) at += normal_[a] * (static_cast<double>(cell[a]) - origin_[a]);
    return plane_low_ <= at && at <= plane_high_;
  }

  // The cells of a column that can meet the plane, and one more on either side because the division
  // rounds.
  void plane_range(int64_t c_p, int64_t c_q, int64_t& first, int64_t& last) const {
    first = first_[inner_];
    last = last_[inner_];
    const double slope = normal_[inner_];
    if (slope == 0) return;  // a face without area has no plane
    const int p = (inner_ + 1) % 3, q = (inner_ + 2) % 3;
    const double base = normal_[p] * (static_cast<double>(c_p) - origin_[p]) +
                        normal_[q] * (static_cast<double>(c_q) - origin_[q]);
    double low = origin_[inner_] + (plane_low_ - base) / slope,
           high = origin_[inner_] + (plane_high_ - base) / slope;
    if (slope < 0) std::swap(low, high);
    const double end = static_cast<double>(last);
    first = std::max(first,
                     static_cast<int64_t>(std::floor(std::min(std::max(low, 0.0), end + 2))) - 1);
    last = std::min(last, static_cast<int64_t>(std::ceil(std::min(std::max(high, -2.0), end))) + 1);
  }

  int64_t first_[3] = {0, 0, 0},
          last_[3] = {-1, -1, -1};  // cells that the triangle's bounding box touches
  EdgeTest edges_[3][3];            // [axis][edge]
  Eigen::Vector3d origin_ = Eigen::Vector3d::Zero(), normal_ = Eigen::Vector3d::Zero();
  double plane_low_ = 0, plane_high_ = 0;  // bounds of normal . (c - origin)
  int inner_ = 2;
};

}  // namespace nmr
