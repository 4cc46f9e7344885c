// The loops of rasterize_layers; included by levels.h for every instruction set.

// A range of pixels that contains all centres in [lo, hi], and few others.
template <class T>
NMR_INLINE void around(T lo, T hi, int64_t size, int64_t& first, int64_t& last) {
  const T n = static_cast<T>(size), from = to_pixel(lo, n), to = to_pixel(hi, n);
  first = std::max<int64_t>(0, static_cast<int64_t>(from > 0 ? (from < n ? from : n) : T(0)) - 1);
  last = std::min<int64_t>(size - 1, static_cast<int64_t>(to > 0 ? (to < n ? to : n) : T(-2)) + 2);
}

// Inserts one face into the lists of the pixels that it covers.
template <bool perspective, class T>
NMR_INLINE void insert_face(const LayerBand<T>& band, int64_t f, bool reversed) {
  const Size raster = band.settings.raster;
  const Triangle<T> t = load_triangle(band.vertices, band.faces + 3 * f, reversed);
  const T *x = t.x, *y = t.y, *z = t.z;
  if ((y[2] - y[0]) * (x[1] - x[0]) < (y[1] - y[0]) * (x[2] - x[0])) return;
  // As in the rasterizer, of the face's own order: rounding may find only one of the two orders
  // flat.
  if (!is_drawable(load_triangle(band.vertices, band.faces + 3 * f, false))) return;
  const T left = std::min({x[0], x[1], x[2]}), right = std::max({x[0], x[1], x[2]});
  const T bottom = std::min({y[0], y[1], y[2]}), top = std::max({y[0], y[1], y[2]});
  int64_t i_first, i_last, j_first, j_last;
  around(left, right, raster.width, i_first, i_last);
  around(bottom, top, raster.height, j_first, j_last);
  j_first = std::max(j_first, band.first), j_last = std::min(j_last, band.last);
  if (i_first > i_last || j_first > j_last) return;
  const int32_t id = static_cast<int32_t>(reversed ? band.num_faces + f : f);
  const auto m = barycentric_matrix(t, static_cast<T>(raster.width), static_cast<T>(raster.height));
  const T near = band.settings.near, far = band.settings.far;
  const int64_t K = band.layers;

  for (int64_t j = j_first; j <= j_last; ++j) {
    const T yp = pixel_centre<T>(j, raster.height), row = static_cast<T>(j);
    if (!(yp >= bottom && yp <= top)) continue;
    for (int64_t i = i_first; i <= i_last; i += kGroup) {
      T depth[kGroup];
      int32_t covered[kGroup], any = 0;
      for (int64_t n = 0; n < kGroup; ++n) {
        const T xp = band.centres[i + n], column = static_cast<T>(static_cast<int32_t>(i + n));
        const bool outside = ((yp - y[0]) * (x[1] - x[0]) < (xp - x[0]) * (y[1] - y[0])) |
                             ((yp - y[1]) * (x[2] - x[1]) < (xp - x[1]) * (y[2] - y[1])) |
                             ((yp - y[2]) * (x[0] - x[2]) < (xp - x[2]) * (y[0] - y[2]));
        T w[3];
        for (int k = 0; k < 3; ++k)
          w[k] = clamp_weight(column * m.m[k][0] + m.m[k][1] * row + m.m[k][2]);
        const T sum = w[0] + w[1] + w[2];
        depth[n] = perspective ? 1 / (w[0] / sum / z[0] + w[1] / sum / z[1] + w[2] / sum / z[2])
                               : w[0] / sum * z[0] + w[1] / sum * z[1] + w[2] / sum * z[2];
        covered[n] = !outside & (xp >= left) & (xp <= right) & (depth[n] > near) & (depth[n] < far);
        any |= covered[n];
      }
      if (!any) continue;
      const int64_t lanes = std::min(kGroup, i_last - i + 1);
      for (int64_t n = 0; n < lanes; ++n) {
        T* depths = band.depth + ((j - band.first) * raster.width + i + n) * K;
        if (!covered[n] || !(depth[n] < depths[K - 1])) continue;
        int32_t* face_indices =
            band.face_index + ((raster.height - 1 - j) * raster.width + i + n) * K;
        insert_sorted(depth[n], id, K, depths, face_indices);
      }
    }
  }
}

// Inserts all faces of the image.
template <class T>
void fill_layers(const LayerBand<T>& band) {
  for (int reversed = 0; reversed <= band.settings.fill_back; ++reversed)
    for (int64_t f = 0; f < band.num_faces; ++f)
      band.settings.perspective ? insert_face<true>(band, f, reversed)
                                : insert_face<false>(band, f, reversed);
}
