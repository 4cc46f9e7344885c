// The loops of the soft silhouette over pixels; included by levels.h for every instruction set.

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

// Multiplies the rows [first, last] (from the bottom) of `transmittance [H, W]`, row 0 = top, by 1
// - D of every face.
template <class T>
void soft_forward_band(const SoftImage<T>& image, int64_t first, int64_t last, T* transmittance) {
  const Size raster = image.settings.raster;
  for (int64_t f = 0; f < image.num_faces; ++f) {
    SoftFace<T> face;
    if (!set_up_face(image, f, face)) continue;
    for (int64_t j = std::max(face.row_first, first); j <= std::min(face.row_last, last); ++j) {
      const T py = image.row(j);
      T* row = transmittance + (raster.height - 1 - j) * raster.width;
      for (int64_t i = face.column_first; i <= face.column_last; i += kGroup) {
        T clears[kGroup];
        for (int64_t n = 0; n < kGroup; ++n)
          clears[n] =
              evaluate<T, false>(face, image.columns[i + n], py, image.sigma, image.reach).clears;
        const int64_t lanes = std::min(kGroup, face.column_last - i + 1);
        for (int64_t n = 0; n < lanes; ++n) row[i + n] *= clears[n];
      }
    }
  }
}

// Inserts every face into the lists of the pixels that it reaches, behind those that are equally
// near.
template <class T>
void soft_layers_band(const SoftImage<T>& image, const SoftBand<T>& band) {
  const Size raster = image.settings.raster;
  const int64_t K = band.layers;
  for (int64_t f = 0; f < image.num_faces; ++f) {
    SoftFace<T> face;
    if (!set_up_face(image, f, face)) continue;
    T z[3];
    for (int k = 0; k < 3; ++k) z[k] = image.vertices[3 * face.corner[k] + 2];
    const int32_t id = static_cast<int32_t>(face.back ? image.num_faces + f : f);
    for (int64_t j = std::max(face.row_first, band.first); j <= std::min(face.row_last, band.last);
         ++j) {
      const T py = image.row(j);
      for (int64_t i = face.column_first; i <= face.column_last; i += kGroup) {
        T depth[kGroup];
        int32_t reaches[kGroup], any = 0;
        for (int64_t n = 0; n < kGroup; ++n) {
          const T px = image.columns[i + n];
          depth[n] = SoftWeights<T>(face.x, face.y, px, py).depth(z, image.settings.perspective);
          reaches[n] = evaluate<T, false>(face, px, py, image.sigma, image.reach).reaches &
                       (depth[n] > image.settings.near) & (depth[n] < image.settings.far);
          any |= reaches[n];
        }
        const int64_t lanes = any ? std::min(kGroup, face.column_last - i + 1) : 0;
        for (int64_t n = 0; n < lanes; ++n) {
          T* depths = band.depth + ((j - band.first) * raster.width + i + n) * K;
          if (!reaches[n] || !(depth[n] < depths[K - 1])) continue;
          int32_t* face_indices =
              band.face_index + ((raster.height - 1 - j) * raster.width + i + n) * K;
          insert_sorted(depth[n], id, K, depths, face_indices);
        }
      }
    }
  }
}

// The gradient of one face: x and y of its corners, and sigma. pull [H, W] is grad_alpha *
// transmittance: the gradient of x_j (soft.cpp) without its factor D_j.
template <class T>
void soft_backward_face(const SoftImage<T>& image, const SoftFace<T>& face, const T* pull,
                        T* grad) {
  const Size raster = image.settings.raster;
  T sums[kSums][kGroup] = {};
  for (int64_t j = face.row_first; j <= face.row_last; ++j) {
    const T py = image.row(j);
    const T* row = pull + (raster.height - 1 - j) * raster.width;
    for (int64_t i = face.column_first; i <= face.column_last; i += kGroup) {
      T g[kGroup] = {};
      const int64_t lanes = std::min(kGroup, face.column_last - i + 1);
      for (int64_t n = 0; n < lanes; ++n) g[n] = row[i + n];
      for (int64_t n = 0; n < kGroup; ++n) {
        const SoftPixel<T> p =
            evaluate<T, true>(face, image.columns[i + n], py, image.sigma, image.reach);
        const T strength = g[n] * p.covers * p.sign * (T(-2) / image.sigma);
        sums[6][n] += strength * p.square;
        for (int k = 0; k < 3; ++k) {
          sums[2 * k][n] += strength * p.share[k] * p.away_x;
          sums[2 * k + 1][n] += strength * p.share[k] * p.away_y;
        }
      }
    }
  }
  for (int64_t k = 0; k < kSums; ++k) {
    T sum = 0;
    for (int64_t n = 0; n < kGroup; ++n) sum += sums[k][n];
    grad[k] = sum * (k == 6 ? 1 / (2 * image.sigma) : k % 2 ? image.scale_y : image.scale_x);
  }
}
