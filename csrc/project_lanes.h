// The loops of project over vertices.
#include "lens.h"
#include "level_lanes.h"

namespace nmr::NMR_LEVEL {
namespace {

template <class T>
NMR_INLINE T larger(T a, T b) {
  return a > b ? a : b;
}

template <class T>
NMR_INLINE bool is_finite(T value) {
  return std::abs(value) <= std::numeric_limits<T>::max();
}

// The image of a vertex. If there is none (the vertex is not finite, in the plane of the eye, or so
// close to it that x / z^2 overflows), `size` is not finite and all else is undefined. (One number,
// because compilers do not vectorize loops over `&&`.)
template <class T>
struct ProjectedVertex {
  T inverse_z;
  T px, py;  // before the distortion
  T cx, cy;  // the nearest point within the reach of the distortion: (px, py) itself, or share
             // times that
  T share;
  T qx, qy;   // after it, divided by the extent
  T x, y, z;  // in renderer space
  T slope;    // bound of the derivative of extent q by the vertex in camera axes, up to a factor
              // below 10
  T size;     // |x| + |y| + |z|
};

// x, y, z are relative to the origin. Images use divisions, which round as the published ones.
// Derivatives (kExact false) use one reciprocal instead, which saves time.
template <class T, bool kPerspective, int kDistortion, bool kExact>
NMR_INLINE ProjectedVertex<T> project_vertex(const Lens<T>& c, T x, T y, T z) {
  ProjectedVertex<T> s;
  const T ux = c.a[0] * x + c.a[1] * y + c.a[2] * z + c.a[3];
  const T uy = c.a[4] * x + c.a[5] * y + c.a[6] * z + c.a[7];
  s.z = c.a[8] * x + c.a[9] * y + c.a[10] * z + c.a[11];
  s.inverse_z = kPerspective ? 1 / s.z : T(1);
  s.px = !kPerspective ? ux : kExact ? ux / s.z : ux * s.inverse_z;
  s.py = !kPerspective ? uy : kExact ? uy / s.z : uy * s.inverse_z;
  const T reach = larger(larger(std::abs(s.px), std::abs(s.py)), T(1));
  s.slope = kPerspective ? reach * std::abs(s.inverse_z) : T(1);
  s.qx = s.px;
  s.qy = s.py;
  if (kDistortion) {
    const T length2 = s.px * s.px + s.py * s.py;
    s.share = length2 > c.reach2 ? std::sqrt(c.reach2 / length2) : T(1);
    s.cx = s.share * s.px;
    s.cy = s.share * s.py;
    const T r2 = s.cx * s.cx + s.cy * s.cy, xy = s.cx * s.cy;
    const Radial<T> radial = radial_of<kDistortion>(c.d, r2);
    s.qx = s.cx * radial.m;
    s.qy = s.cy * radial.m;
    s.slope *= 1 + std::abs(radial.m) + r2 * std::abs(radial.slope);
    if (kDistortion != kFisheye) {
      s.qx = s.qx + 2 * c.d[2] * xy + c.d[3] * (r2 + 2 * s.cx * s.cx);
      s.qy = s.qy + c.d[2] * (r2 + 2 * s.cy * s.cy) + 2 * c.d[3] * xy;
      s.slope *= 1 + reach * (std::abs(c.d[2]) + std::abs(c.d[3]));
    }
    s.qx += s.px - s.cx;
    s.qy += s.py - s.cy;
  }
  s.qx = kExact ? s.qx / c.extent : s.qx * c.inverse_extent;
  s.qy = kExact ? s.qy / c.extent : s.qy * c.inverse_extent;
  s.x = c.k[0] * s.qx + c.k[1] * s.qy + c.k[2];
  s.y = c.k[3] * s.qx + c.k[4] * s.qy + c.k[5];
  s.size = s.slope < kLimit<T> ? std::abs(s.x) + std::abs(s.y) + std::abs(s.z)
                               : std::numeric_limits<T>::infinity();
  return s;
}

template <class T, bool kPerspective, int kDistortion>
NMR_INLINE void forward_lanes(const Lens<T>& c, const T* __restrict vertices,
                              T* __restrict points) {
  const T infinity = std::numeric_limits<T>::infinity();
  for (int l = 0; l < kGroup; ++l) {
    const ProjectedVertex<T> s = project_vertex<T, kPerspective, kDistortion, true>(
        c, vertices[3 * l] - c.o[0], vertices[3 * l + 1] - c.o[1], vertices[3 * l + 2] - c.o[2]);
    points[3 * l] = is_finite(s.size) ? s.x : infinity;
    points[3 * l + 1] = is_finite(s.size) ? s.y : infinity;
    points[3 * l + 2] = is_finite(s.z) ? s.z : T(0);
  }
}

// Adds the gradients of the coefficients at a distorted point (x, y) to the partial sums of lane l.
// along: the gradient of m.
template <int kDistortion, class T>
NMR_INLINE void add_coefficients(const Radial<T>& radial, T along, T gqx, T gqy, T x, T y, int l,
                                 LensGradient<T[kGroup]>* __restrict sums) {
  const T r2 = x * x + y * y, xy = x * y;
  if (kDistortion == kFisheye) {
    T power = along * radial.per_r;
    for (int k = 0; k < 4; ++k) {
      power *= radial.angle2;
      sums->distortion[k][l] += power;
    }
    return;
  }
  const T by_numerator = kDistortion == kRational ? along * radial.inverse : along;
  sums->distortion[0][l] += by_numerator * r2;
  sums->distortion[1][l] += by_numerator * r2 * r2;
  sums->distortion[2][l] += 2 * gqx * xy + gqy * (r2 + 2 * y * y);
  sums->distortion[3][l] += gqx * (r2 + 2 * x * x) + 2 * gqy * xy;
  sums->distortion[4][l] += by_numerator * r2 * r2 * r2;
  if (kDistortion == kRational) {
    const T by_denominator = -by_numerator * radial.m;
    sums->distortion[5][l] += by_denominator * r2;
    sums->distortion[6][l] += by_denominator * r2 * r2;
    sums->distortion[7][l] += by_denominator * r2 * r2 * r2;
  }
}

// The gradient of p from that of q, and those of the coefficients. keep: see backward_lanes.
template <int kDistortion, bool kSumCamera, class T>
NMR_INLINE void distort_backward(const Lens<T>& c, const ProjectedVertex<T>& s, bool keep, T gqx,
                                 T gqy, int l, LensGradient<T[kGroup]>* __restrict sums, T& gpx,
                                 T& gpy) {
  const T x = keep ? s.cx : T(0), y = keep ? s.cy : T(0);
  const T r2 = x * x + y * y;
  const Radial<T> radial = radial_of<kDistortion>(c.d, r2);
  const T along = gqx * x + gqy * y;  // gradient of m
  gpx = gqx * radial.m;
  gpy = gqy * radial.m;
  if (kDistortion == kFisheye) {
    gpx += 2 * along * radial.slope * x;
    gpy += 2 * along * radial.slope * y;
  } else {
    const T g_r2 = along * radial.slope + gqx * c.d[3] + gqy * c.d[2];
    const T cross = 2 * (gqx * c.d[2] + gqy * c.d[3]);  // gradient of x y
    gpx = gpx + cross * y + 4 * gqx * c.d[3] * x + 2 * g_r2 * x;
    gpy = gpy + cross * x + 4 * gqy * c.d[2] * y + 2 * g_r2 * y;
  }
  const bool within = s.share == T(1);
  // Beyond the reach: q = q(c) + p - c, with c = share p. The length of c is the reach, a constant.
  const T length2 = within ? T(1) : s.px * s.px + s.py * s.py,
          length = std::sqrt(keep ? length2 : T(1));
  const T nx = s.px / length, ny = s.py / length, vx = gpx - gqx, vy = gpy - gqy,
          out = vx * nx + vy * ny;
  gpx = within ? gpx : gqx + s.share * (vx - nx * out);
  gpy = within ? gpy : gqy + s.share * (vy - ny * out);
  if (kSumCamera)  // beyond the reach: 0
    add_coefficients<kDistortion>(radial, within ? along : T(0), within ? gqx : T(0),
                                  within ? gqy : T(0), x, y, l, sums);
}

// Adds the gradient of kGroup vertices to grad_vertices, and that of the camera to the partial
// sums. A vertex without an image, or whose gradient would overflow although the upstream gradient
// is finite, gets gradient 0 and contributes 0 to the camera. If the upstream gradient is infinite
// or NaN, that of the vertex and of the camera is NaN.
template <class T, bool kPerspective, int kDistortion, bool kSumCamera>
NMR_INLINE void backward_lanes(const Lens<T>& c, const T* __restrict vertices,
                               const T* __restrict grad_points, T* __restrict grad_vertices,
                               LensGradient<T[kGroup]>* __restrict sums) {
  for (int l = 0; l < kGroup; ++l) {
    T x = vertices[3 * l] - c.o[0], y = vertices[3 * l + 1] - c.o[1],
      z = vertices[3 * l + 2] - c.o[2];
    T gx = grad_points[3 * l], gy = grad_points[3 * l + 1], gz = grad_points[3 * l + 2];
    ProjectedVertex<T> s = project_vertex<T, kPerspective, kDistortion, false>(c, x, y, z);
    T reach = larger(std::abs(s.qx), std::abs(s.qy)) + c.largest_k * s.slope;
    if (kDistortion) {
      const T r2 = 1 + s.px * s.px + s.py * s.py;
      reach = (reach + c.largest_k * r2 * r2 * r2 * r2) * c.largest_d;
    }
    const T bound = ((std::abs(gx) + std::abs(gy)) * reach + std::abs(gz)) * c.largest_a *
                    larger(larger(larger(std::abs(x), std::abs(y)), std::abs(z)), T(1));
    const bool keep = is_finite(bound >= kLimit<T> ? std::numeric_limits<T>::infinity() : s.size);
    // Values of skipped vertices are set to 0 before they are multiplied, so that no product is 0 *
    // inf.
    x = keep ? x : T(0), y = keep ? y : T(0), z = keep ? z : T(0);
    const T nothing = is_finite(s.size) ? gx * T(0) + gy * T(0) + gz * T(0)
                                        : T(0);  // NaN if the upstream gradient is not finite
    gx = keep ? gx : nothing, gy = keep ? gy : nothing, gz = keep ? gz : nothing;
    s.px = keep ? s.px : T(0), s.py = keep ? s.py : T(0);
    s.qx = keep ? s.qx : T(0), s.qy = keep ? s.qy : T(0);
    if (kPerspective) s.inverse_z = keep ? s.inverse_z : T(0);

    const T gqx = (c.k[0] * gx + c.k[3] * gy) * c.inverse_extent;
    const T gqy = (c.k[1] * gx + c.k[4] * gy) * c.inverse_extent;
    T gpx = gqx, gpy = gqy;
    if (kDistortion)
      distort_backward<kDistortion, kSumCamera>(c, s, keep, gqx, gqy, l, sums, gpx, gpy);
    const T gux = kPerspective ? gpx * s.inverse_z : gpx,
            guy = kPerspective ? gpy * s.inverse_z : gpy;
    const T guz = kPerspective ? gz - (gux * s.px + guy * s.py) : gz;
    grad_vertices[3 * l] += c.a[0] * gux + c.a[4] * guy + c.a[8] * guz;
    grad_vertices[3 * l + 1] += c.a[1] * gux + c.a[5] * guy + c.a[9] * guz;
    grad_vertices[3 * l + 2] += c.a[2] * gux + c.a[6] * guy + c.a[10] * guz;
    if (kSumCamera) {
      const T gu[3] = {gux, guy, guz}, g[2] = {gx, gy};
      for (int i = 0; i < 3; ++i) {
        sums->matrix[4 * i][l] += gu[i] * x;
        sums->matrix[4 * i + 1][l] += gu[i] * y;
        sums->matrix[4 * i + 2][l] += gu[i] * z;
        sums->matrix[4 * i + 3][l] += gu[i];
      }
      for (int i = 0; i < 2; ++i) {
        sums->intrinsics[3 * i][l] += g[i] * s.qx;
        sums->intrinsics[3 * i + 1][l] += g[i] * s.qy;
        sums->intrinsics[3 * i + 2][l] += g[i];
      }
    }
  }
}

// The last, incomplete group of a run is copied and padded with NaN vertices, which have no image.
template <class T>
struct Padded {
  T vertices[3 * kGroup], grad_points[3 * kGroup], out[3 * kGroup];

  Padded(const T* from, int64_t count) : grad_points{}, out{} {
    std::fill_n(vertices, 3 * kGroup, std::numeric_limits<T>::quiet_NaN());
    std::copy_n(from, 3 * count, vertices);
  }
};

template <class T>
NMR_INLINE T least_depth(const T* points, int64_t count) {
  T least[kGroup];
  std::fill_n(least, kGroup, std::numeric_limits<T>::infinity());
  int64_t n = 0;
  for (; n + kGroup <= count; n += kGroup)
    for (int64_t l = 0; l < kGroup; ++l) least[l] = std::min(least[l], points[3 * (n + l) + 2]);
  for (; n < count; ++n) least[0] = std::min(least[0], points[3 * n + 2]);
  return *std::min_element(least, least + kGroup);
}

template <class T, bool kPerspective, int kDistortion>
NMR_INLINE T forward_run_of(const Project<T>& args, const Lens<T>& lens, const Run& run) {
  const T* vertices = args.vertices + 3 * run.vertices;
  T* points = args.points + 3 * run.points;
  const int64_t whole = run.count / kGroup * kGroup, rest = run.count - whole;
  Padded<T> last(vertices + 3 * whole, rest);
  for (int64_t n = 0; n < run.count; n += kGroup)  // one call, so that it is inlined
    forward_lanes<T, kPerspective, kDistortion>(lens, n < whole ? vertices + 3 * n : last.vertices,
                                                n < whole ? points + 3 * n : last.out);
  std::copy_n(last.out, 3 * rest, points + 3 * whole);
  return least_depth(points, run.count);
}

// Calls body(perspective, distortion) with compile-time constants: of the camera, and its number of
// coefficients.
template <class T, class Body>
NMR_INLINE auto with_lens(const Project<T>& args, const Body& body) {
  using None = std::integral_constant<int, 0>;
  if (!args.perspective) return body(std::false_type(), None());
  if (!args.distortion.values) return body(std::true_type(), None());
  if (args.coefficients == 4) return body(std::true_type(), std::integral_constant<int, 4>());
  if (args.coefficients == 5) return body(std::true_type(), std::integral_constant<int, 5>());
  return body(std::true_type(), std::integral_constant<int, 8>());
}

// The points of a run, and the least depth of them.
template <class T>
T forward_run(const Project<T>& args, const Run& run) {
  const Lens<T> lens(args, run.image);
  if (lens.usable)
    return with_lens(args, [&](auto perspective, auto distortion) {
      return forward_run_of<T, perspective(), distortion()>(args, lens, run);
    });
  T* points = args.points + 3 * run.points;
  for (int64_t n = 0; n < run.count; ++n) {
    points[3 * n] = points[3 * n + 1] = std::numeric_limits<T>::infinity();
    points[3 * n + 2] = 0;
  }
  return 0;
}

template <class T, bool kPerspective, int kDistortion, bool kSumCamera>
NMR_INLINE void backward_run_of(const Project<T>& args, const Lens<T>& lens, const Run& run,
                                T* grad_vertices, CameraGradient* total) {
  LensGradient<T[kGroup]> sums = {};
  const T* vertices = args.vertices + 3 * run.vertices;
  const T* grad_points = args.grad_points + 3 * run.points;
  const int64_t whole = run.count / kGroup * kGroup, rest = run.count - whole;
  Padded<T> last(vertices + 3 * whole, rest);
  std::copy_n(grad_points + 3 * whole, 3 * rest, last.grad_points);
  std::copy_n(grad_vertices + 3 * whole, 3 * rest, last.out);
  for (int64_t n = 0; n < run.count; n += kGroup) {
    const bool inside = n < whole;
    backward_lanes<T, kPerspective, kDistortion, kSumCamera>(
        lens, inside ? vertices + 3 * n : last.vertices,
        inside ? grad_points + 3 * n : last.grad_points, inside ? grad_vertices + 3 * n : last.out,
        &sums);
  }
  std::copy_n(last.out, 3 * rest, grad_vertices + 3 * whole);
  if (!kSumCamera) return;
  const auto add_up = [](const auto& groups, auto& numbers) {
    for (size_t k = 0; k < std::size(numbers); ++k) {
      numbers[k] = 0;
      for (T part : groups[k]) numbers[k] += static_cast<double>(part);
    }
  };
  add_up(sums.matrix, total->matrix);
  add_up(sums.intrinsics, total->intrinsics);
  add_up(sums.distortion, total->distortion);
  // u depends on v - origin and q on p / extent.
  const double *a = total->matrix, *k = total->intrinsics;
  for (int j = 0; j < 3; ++j)
    total->origin[j] =
        -(double(lens.a[j]) * a[3] + double(lens.a[4 + j]) * a[7] + double(lens.a[8 + j]) * a[11]);
  total->extent = -(double(lens.k[0]) * k[0] + double(lens.k[1]) * k[1] + double(lens.k[3]) * k[3] +
                    double(lens.k[4]) * k[4]) /
                  double(lens.extent);
}

// total: the gradient of the camera, summed over this run, or nullptr.
template <class T>
void backward_run(const Project<T>& args, const Run& run, T* grad_vertices, CameraGradient* total) {
  const Lens<T> lens(args, run.image);
  if (lens.usable)
    return with_lens(args, [&](auto perspective, auto distortion) {
      if (total)
        backward_run_of<T, perspective(), distortion(), true>(args, lens, run, grad_vertices,
                                                              total);
      else
        backward_run_of<T, perspective(), distortion(), false>(args, lens, run, grad_vertices,
                                                               nullptr);
    });
  if (total) *total = {};
}

}  // namespace
}  // namespace nmr::NMR_LEVEL
