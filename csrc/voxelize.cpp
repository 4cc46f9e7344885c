// Occupancy grids: the surface cells, and all cells that cannot be reached from the border of the
// grid through empty cells. Surface cells are those of Kato et al. 2018 ("kato18", used for most
// published voxel IoU) or of Kato and Harada 2019 ("kato19"): every cell that a face touches.
#include <algorithm>
#include <cmath>
#include <vector>

#include <Eigen/Core>

#include "parallel.h"
#include "stages.h"
#include "triangle_cells.h"

namespace nmr {
namespace {

using Vec3f = Eigen::Vector3f;

constexpr uint8_t kEmpty = 0, kSurface = 1, kOutside = 2;

struct VoxelScratch {
  std::vector<uint8_t> cells;  // [s + 2, s + 2, s + 2]
  std::vector<int32_t> frontier;
};

// The cells of the grid, surrounded by a layer of outside cells, so that code that visits
// neighbours needs no test for the border.
struct Grid {
  uint8_t* cells;
  int64_t size;

  int64_t side() const { return size + 2; }
  int64_t index(int64_t x, int64_t y, int64_t z) const {
    return ((x + 1) * side() + y + 1) * side() + z + 1;
  }

  void clear() {
    const int64_t row = side(), slab = row * row;
    std::fill_n(cells, slab * row, kOutside);
    for (int64_t x = 0; x < size; ++x)
      for (int64_t y = 0; y < size; ++y) std::fill_n(cells + index(x, y, 0), size, kEmpty);
  }
  void mark(const int64_t (&c)[3]) {
    for (int64_t x : c)
      if (x < 0 || x >= size) return;
    cells[index(c[0], c[1], c[2])] = kSurface;
  }
};

// First and last integer in [0, size) within [lo, hi]; none if either is NaN.
void lattice_range(float lo, float hi, int64_t size, int64_t& first, int64_t& last) {
  first = 0;
  last = -1;
  if (std::isnan(lo) || std::isnan(hi)) return;
  const float end = static_cast<float>(size);
  first = static_cast<int64_t>(std::ceil(std::min(std::max(lo, 0.f), end)));
  last = static_cast<int64_t>(std::floor(std::min(std::max(hi, -1.f), end - 1)));
}

// Rays along `axis` through the integer points (p, q) of the other two axes. Each hit marks the
// four cells around the ray at the depth of the hit.
void mark_ray_hits(const Vec3f (&v)[3], int axis, Grid& grid) {
  const int pa = (axis + 1) % 3, qa = (axis + 2) % 3;
  const float p0 = v[0][pa], p1 = v[1][pa], p2 = v[2][pa], q0 = v[0][qa], q1 = v[1][qa],
              q2 = v[2][qa];
  const float det = (p1 - p0) * (q2 - q0) - (p2 - p0) * (q1 - q0);
  if (det == 0) return;
  int64_t p_first, p_last, q_first, q_last;
  lattice_range(std::min({p0, p1, p2}), std::max({p0, p1, p2}), grid.size, p_first, p_last);
  lattice_range(std::min({q0, q1, q2}), std::max({q0, q1, q2}), grid.size, q_first, q_last);
  for (int64_t p = p_first; p <= p_last; ++p) {
    for (int64_t q = q_first; q <= q_last; ++q) {
      const float dp = static_cast<float>(p) - p0, dq = static_cast<float>(q) - q0;
      const float t1 = (dp * (q2 - q0) - (p2 - p0) * dq) / det;
      const float t2 = ((p1 - p0) * dq - dp * (q1 - q0)) / det;
      if (!(t1 >= 0 && t2 >= 0 && t1 + t2 <= 1)) continue;
      const float depth =
          std::floor(v[0][axis] + t1 * (v[1][axis] - v[0][axis]) + t2 * (v[2][axis] - v[0][axis]));
      if (!(depth >= 0 && depth < static_cast<float>(grid.size))) continue;
      int64_t cell[3];
      cell[axis] = static_cast<int64_t>(depth);
      for (int64_t cp = p - 1; cp <= p; ++cp)
        for (int64_t cq = q - 1; cq <= q; ++cq) {
          cell[pa] = cp;
          cell[qa] = cq;
          grid.mark(cell);
        }
    }
  }
}

// The cell of a vertex, coordinates truncated towards zero: (-1, 0) falls into cell 0.
void mark_vertex(const Vec3f& v, Grid& grid) {
  int64_t cell[3];
  for (int k = 0; k < 3; ++k) {
    if (!(v[k] > -1 && v[k] < static_cast<float>(grid.size))) return;
    cell[k] = static_cast<int64_t>(v[k]);
  }
  grid.mark(cell);
}

void mark_rays_and_vertices(const Vec3f (&corners)[3], Grid& grid) {
  for (const Vec3f& corner : corners) mark_vertex(corner, grid);
  for (int axis = 0; axis < 3; ++axis) mark_ray_hits(corners, axis, grid);
}

void mark_touched(const Vec3f (&corners)[3], Grid& grid) {
  TriangleCells(corners, grid.size).for_each([&](int64_t x, int64_t y, int64_t z) {
    grid.cells[grid.index(x, y, z)] = kSurface;
  });
}

// Floods the empty cells from the border (6-connected) and marks them as outside.
void flood_outside(Grid& grid, std::vector<int32_t>& frontier) {
  const int64_t s = grid.size, row = grid.side(), slab = row * row;
  uint8_t* cells = grid.cells;
  int32_t* end = reserve(frontier, s * s * s + 1);
  int32_t* const start = end;
  const auto visit = [&](int64_t n) {
    *end = static_cast<int32_t>(n);  // kept if the cell was empty
    end += cells[n] == kEmpty;
    cells[n] = cells[n] == kEmpty ? kOutside : cells[n];
  };
  for (int64_t a = 0; a < s; ++a)
    for (int64_t b = 0; b < s; ++b)
      for (int64_t side : {int64_t(0), s - 1}) {
        visit(grid.index(side, a, b));
        visit(grid.index(a, side, b));
        visit(grid.index(a, b, side));
      }
  while (end != start) {
    const int64_t n = *--end;
    for (int64_t step : {slab, row, int64_t(1)}) {
      visit(n - step);
      visit(n + step);
    }
  }
}

}  // namespace

void voxelize(const Voxelize& args) {
  const int64_t s = args.size, num_cells = s * s * s;
  parallel_for(args.mesh.batch, args.num_threads, [&](int64_t b) {
    VoxelScratch& scratch = thread_scratch<VoxelScratch>();
    Grid grid{reserve(scratch.cells, (s + 2) * (s + 2) * (s + 2)), s};
    grid.clear();
    const float* vertices = args.mesh.image_vertices(b);
    const int64_t* faces = args.mesh.image_faces(b);
    for (int64_t f = 0; f < args.mesh.face_rows.count(b); ++f) {
      Vec3f corners[3];
      for (int k = 0; k < 3; ++k)
        corners[k] =
            Eigen::Map<const Vec3f>(vertices + 3 * faces[3 * f + k]) * static_cast<float>(s);
      if (args.touched)
        mark_touched(corners, grid);
      else
        mark_rays_and_vertices(corners, grid);
    }
    flood_outside(grid, scratch.frontier);
    bool* voxels = args.voxels + b * num_cells;
    for (int64_t x = 0; x < s; ++x)
      for (int64_t y = 0; y < s; ++y, voxels += s) {
        const uint8_t* cells = grid.cells + grid.index(x, y, 0);
        for (int64_t z = 0; z < s; ++z) voxels[z] = cells[z] != kOutside;
      }
  });
}

}  // namespace nmr
