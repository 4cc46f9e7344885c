// What a face means for a pixel of the soft silhouette.
#include "level_lanes.h"
#include "soft_faces.h"

namespace nmr::NMR_LEVEL {
namespace {

// exp(-x) for x >= 0: 2^-n times the Taylor series of exp on [-ln 2 / 2, ln 2 / 2]. Written out
// because the library's function is not the same on all processors, and the compiler does not
// vectorize it. Values below 1e-37 become 1e-37 (double: 1e-300).
NMR_INLINE float exp_negative(float x) {
  x = x < 85 ? x : 85;
  const float n = static_cast<float>(static_cast<int32_t>(x * 1.44269504f + 0.5f));
  const float r = n * 0.693359375f - x + n * -2.12194440e-4f;
  float sum = 1.f / 5040;
  for (const float c : {1.f / 720, 1.f / 120, 1.f / 24, 1.f / 6, 0.5f, 1.f, 1.f}) sum = sum * r + c;
  const uint32_t bits = static_cast<uint32_t>(127 - static_cast<int32_t>(n)) << 23;
  float scale;
  std::memcpy(&scale, &bits, sizeof scale);
  return sum * scale;
}

NMR_INLINE double exp_negative(double x) {
  x = x < 690 ? x : 690;
  const double n = static_cast<double>(static_cast<int64_t>(x * 1.4426950408889634 + 0.5));
  const double r = n * 0.693145751953125 - x + n * 1.42860682030941723212e-6;
  double sum = 1.0 / 6227020800;
  for (const double c : {1.0 / 479001600, 1.0 / 39916800, 1.0 / 3628800, 1.0 / 362880, 1.0 / 40320,
                         1.0 / 5040, 1.0 / 720, 1.0 / 120, 1.0 / 24, 1.0 / 6, 0.5, 1.0, 1.0})
    sum = sum * r + c;
  const uint64_t bits = static_cast<uint64_t>(1023 - static_cast<int64_t>(n)) << 52;
  double scale;
  std::memcpy(&scale, &bits, sizeof scale);
  return sum * scale;
}

// What a face means for a pixel.
template <class T>
struct SoftPixel {
  T covers, clears;  // D and 1 - D; 0 and 1 if the pixel is out of reach
  T sign;            // +1 inside, -1 outside
  T away_x, away_y;  // from the nearest point of the border to the pixel
  T share[3];        // of the corners in that point
  T square;          // d^2
  bool reaches;
};

template <class T, bool kWithGradient>
NMR_INLINE SoftPixel<T> evaluate(const SoftFace<T>& face, T px, T py, T sigma, T reach) {
  SoftPixel<T> p;
  T least = std::numeric_limits<T>::max();
  bool inside = true;
  p.away_x = p.away_y = p.share[0] = p.share[1] = p.share[2] = 0;
  for (int k = 0; k < 3; ++k) {
    const T dx = px - face.x[k], dy = py - face.y[k], sx = face.side_x[k], sy = face.side_y[k];
    inside = inside & (sx * dy > sy * dx);
    const T t = clamp_weight((dx * sx + dy * sy) * face.inverse[k]);
    const T away_x = dx - t * sx, away_y = dy - t * sy, square = away_x * away_x + away_y * away_y;
    const bool nearer = square < least;
    least = nearer ? square : least;
    if (kWithGradient) {
      p.away_x = nearer ? away_x : p.away_x;
      p.away_y = nearer ? away_y : p.away_y;
      p.share[k] = nearer ? 1 - t : p.share[k];
      p.share[(k + 1) % 3] = nearer ? t : p.share[(k + 1) % 3];
      p.share[(k + 2) % 3] = nearer ? T(0) : p.share[(k + 2) % 3];
    }
  }
  const T e = exp_negative(least / sigma), large = 1 / (1 + e), small = e / (1 + e);
  const T outside_clears = least < reach ? large : T(1),
          outside_covers = least < reach ? small : T(0);
  p.covers = inside ? large : outside_covers;
  p.clears = inside ? small : outside_clears;
  p.sign = inside ? T(1) : T(-1);
  p.square = least;
  p.reaches = inside | (least < reach);
  return p;
}

}  // namespace
}  // namespace nmr::NMR_LEVEL
