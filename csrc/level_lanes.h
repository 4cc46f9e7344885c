// kLanes values that are processed together (lanes), for one level (levels.h). A vector that does
// not fit into a register of the level is two halves. Every operation treats each lane separately,
// so results do not depend on the level.
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#include "parallel.h"

#ifndef NMR_LEVEL
#define NMR_LEVEL base
#endif

namespace nmr::NMR_LEVEL {
namespace {

// Two vectors of half the lanes.
template <class V>
struct Halves {
  V low, high;
};

#if defined(__AVX512F__) && !NMR_AVX2
constexpr int64_t kRegisterBytes = 64;
#elif defined(__AVX2__) || NMR_AVX2
constexpr int64_t kRegisterBytes = 32;
#else
constexpr int64_t kRegisterBytes = 16;
#endif

// N values of type E: a vector type of the compiler if it fits into a register.
template <class E, int64_t N, bool fits = N * static_cast<int64_t>(sizeof(E)) <= kRegisterBytes>
struct LaneType {
  typedef E Type __attribute__((vector_size(N * sizeof(E))));
};
template <class E, int64_t N>
struct LaneType<E, N, false> {
  using Type = Halves<typename LaneType<E, N / 2>::Type>;
};

template <class T>
using Lanes = typename LaneType<T, kLanes>::Type;
using Lanes32 = Lanes<int32_t>;

template <class V>
struct IsHalves : std::false_type {};
template <class V>
struct IsHalves<Halves<V>> : std::true_type {};

#define NMR_LANE_OPERATOR(op)                                  \
  template <class V>                                           \
  NMR_INLINE Halves<V> operator op(Halves<V> a, Halves<V> b) { \
    return {a.low op b.low, a.high op b.high};                 \
  }
#define NMR_LANE_COMPARISON(op)                                                \
  template <class V>                                                           \
  NMR_INLINE auto operator op(Halves<V> a, Halves<V> b) {                      \
    return Halves<decltype(a.low op b.low)>{a.low op b.low, a.high op b.high}; \
  }
NMR_LANE_OPERATOR(+)
NMR_LANE_OPERATOR(-)
NMR_LANE_OPERATOR(*)
NMR_LANE_OPERATOR(/)
NMR_LANE_OPERATOR(&)
NMR_LANE_OPERATOR(|)
NMR_LANE_COMPARISON(<)
NMR_LANE_COMPARISON(>)
NMR_LANE_COMPARISON(<=)
NMR_LANE_COMPARISON(>=)
NMR_LANE_COMPARISON(==)
#undef NMR_LANE_OPERATOR
#undef NMR_LANE_COMPARISON

// What a comparison gives: all bits of a lane are set or none.
template <class T>
using LaneMask = decltype(std::declval<Lanes<T>>() < std::declval<Lanes<T>>());

template <class V, class U>
NMR_INLINE V load_lanes(const U* p) {
  V v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
template <class V, class U>
NMR_INLINE void store_lanes(U* p, V v) {
  std::memcpy(p, &v, sizeof v);
}

// All lanes equal to x.
template <class V, class E>
NMR_INLINE V splat_as(E x) {
  if constexpr (IsHalves<V>::value) {
    const auto half = splat_as<decltype(V::low)>(x);
    return {half, half};
  } else {
    return x - V{};
  }
}
template <class T>
NMR_INLINE Lanes<T> splat(T x) {
  return splat_as<Lanes<T>>(x);
}

// 0, 1, ..., 7
NMR_INLINE Lanes32 lane_numbers() {
  constexpr int32_t numbers[kLanes] = {0, 1, 2, 3, 4, 5, 6, 7};
  return load_lanes<Lanes32>(numbers);
}

// The lanes of `yes` if the mask is set, else those of `no`.
template <class M, class V>
NMR_INLINE V select(M mask, V yes, V no) {
  if constexpr (IsHalves<V>::value)
    return {select(mask.low, yes.low, no.low), select(mask.high, yes.high, no.high)};
  else
    return mask ? yes : no;
}

// The values if the mask is set, else +0, for NaN as well.
template <class M, class V>
NMR_INLINE V keep(M mask, V v) {
  if constexpr (IsHalves<V>::value)
    return {keep(mask.low, v.low), keep(mask.high, v.high)};
  else
    return (V)(mask & (M)v);
}

// a < b ? a : b and a > b ? a : b, as one instruction if the processor has it.
template <class V>
NMR_INLINE V min_of(V a, V b) {
#if defined(__AVX2__) || NMR_AVX2
  if constexpr (std::is_same_v<V, Lanes<float>>) return (V)_mm256_min_ps((__m256)a, (__m256)b);
  if constexpr (std::is_same_v<V, Lanes32>) return (V)_mm256_min_epi32((__m256i)a, (__m256i)b);
#endif
  return select(a < b, a, b);
}
template <class V>
NMR_INLINE V max_of(V a, V b) {
#if defined(__AVX2__) || NMR_AVX2
  if constexpr (std::is_same_v<V, Lanes<float>>) return (V)_mm256_max_ps((__m256)a, (__m256)b);
  if constexpr (std::is_same_v<V, Lanes32>) return (V)_mm256_max_epi32((__m256i)a, (__m256i)b);
#endif
  return select(a > b, a, b);
}

// select() without the comparison of the mask with 0 that the compiler puts before it.
template <class M, class V>
NMR_INLINE V choose(M mask, V yes, V no) {
#if defined(__AVX2__) || NMR_AVX2
  if constexpr (sizeof(V) == 32 && !IsHalves<V>::value && sizeof(M) == 32)
    return (V)_mm256_blendv_ps((__m256)no, (__m256)yes, (__m256)mask);
#endif
  return select(mask, yes, no);
}

// a & ~b: lanes of a that are not set in b.
template <class M>
NMR_INLINE M without(M a, M b) {
  if constexpr (IsHalves<M>::value)
    return {without(a.low, b.low), without(a.high, b.high)};
  else {
#if defined(__AVX2__) || NMR_AVX2
    if constexpr (sizeof(M) == 32) return (M)_mm256_andnot_si256((__m256i)b, (__m256i)a);
#endif
    return a & ~b;
  }
}

// |x|
template <class T>
NMR_INLINE Lanes<T> absolute(Lanes<T> x) {
  return max_of(x, splat(T(0)) - x);
}

// The smallest lane.
template <class E>
NMR_INLINE E least_lane(Lanes<E> v) {
#if defined(__AVX2__) || NMR_AVX2
  if constexpr (std::is_same_v<E, float>) {
    const __m128 four =
        _mm_min_ps(_mm256_castps256_ps128((__m256)v), _mm256_extractf128_ps((__m256)v, 1));
    const __m128 two = _mm_min_ps(four, _mm_movehl_ps(four, four));
    return _mm_cvtss_f32(_mm_min_ss(two, _mm_movehdup_ps(two)));
  }
#endif
  E each[kLanes];
  store_lanes(each, v);
  return *std::min_element(each, each + kLanes);
}

// to_pixel of geometry.h
template <class T>
NMR_INLINE Lanes<T> pixel_coordinates(Lanes<T> x, Lanes<T> size) {
  return (x * size + size - splat(T(1))) / splat(T(2));
}

// weights_at of geometry.h, from weights that are neither clamped nor divided by their sum.
template <class V>
NMR_INLINE void normalize_weights(V (&w)[3], V zero, V one) {
  for (V& weight : w) weight = min_of(max_of(weight, zero), one);
  const V sum = w[0] + w[1] + w[2];
  for (V& weight : w) weight = weight / sum;
}

// depth_at of geometry.h
template <class V>
NMR_INLINE V lane_depths(const V (&w)[3], const V (&z)[3], V one, bool perspective) {
  if (!perspective) return w[0] * z[0] + w[1] * z[1] + w[2] * z[2];
  return one / (w[0] / z[0] + w[1] / z[1] + w[2] / z[2]);
}

// Each lane converted to the element type of `To`; to integers truncated, and then every lane must
// be in range. Halves on one side only come from element types of different size.
template <class To, class V>
NMR_INLINE To convert_lanes(V v) {
  if constexpr (IsHalves<V>::value && IsHalves<To>::value) {
    return {convert_lanes<decltype(To::low)>(v.low), convert_lanes<decltype(To::low)>(v.high)};
  } else if constexpr (IsHalves<To>::value) {
    typename LaneType<std::decay_t<decltype(v[0])>,
                      static_cast<int64_t>(sizeof(V) / sizeof(v[0])) / 2>::Type half[2];
    std::memcpy(half, &v, sizeof v);
    return {convert_lanes<decltype(To::low)>(half[0]), convert_lanes<decltype(To::low)>(half[1])};
  } else if constexpr (IsHalves<V>::value) {
    using Element = std::decay_t<decltype(std::declval<To>()[0])>;
    using Half =
        typename LaneType<Element, static_cast<int64_t>(sizeof(To) / sizeof(Element)) / 2>::Type;
    const Half half[2] = {convert_lanes<Half>(v.low), convert_lanes<Half>(v.high)};
    To result;
    std::memcpy(&result, half, sizeof result);
    return result;
  } else {
    return __builtin_convertvector(v, To);
  }
}
template <class T>
NMR_INLINE Lanes<T> to_values(Lanes32 v) {
  return convert_lanes<Lanes<T>>(v);
}
template <class V>
NMR_INLINE Lanes32 truncate(V v) {
  return convert_lanes<Lanes32>(v);
}
// A mask over lanes of T as one over 32-bit lanes, and back.
template <class M>
NMR_INLINE Lanes32 narrow_mask(M mask) {
  return convert_lanes<Lanes32>(mask);
}
template <class T>
NMR_INLINE LaneMask<T> widen_mask(Lanes32 mask) {
  return convert_lanes<LaneMask<T>>(mask);
}

// Number of lanes of a vector, or of a half.
template <class V>
constexpr int lane_count() {
  if constexpr (IsHalves<V>::value)
    return 2 * lane_count<decltype(V::low)>();
  else
    return sizeof(V) / sizeof(std::declval<V>()[0]);
}

// Bit k is set if lane k of the mask is.
template <class M>
NMR_INLINE uint32_t lane_bits(M mask) {
  if constexpr (IsHalves<M>::value) {
    return lane_bits(mask.low) | lane_bits(mask.high) << lane_count<decltype(mask.low)>();
  } else {
    [[maybe_unused]] constexpr size_t bytes = sizeof mask, lane_bytes = bytes / lane_count<M>();
#if defined(__AVX2__) || NMR_AVX2
    if constexpr (bytes == 32 && lane_bytes == 4) return _mm256_movemask_ps((__m256)mask);
    if constexpr (bytes == 32 && lane_bytes == 8) return _mm256_movemask_pd((__m256d)mask);
#endif
#if defined(__SSE2__)
    if constexpr (bytes == 16 && lane_bytes == 4) return _mm_movemask_ps((__m128)mask);
    if constexpr (bytes == 16 && lane_bytes == 8) return _mm_movemask_pd((__m128d)mask);
#endif
    uint32_t bits = 0;
    for (int k = 0; k < lane_count<M>(); ++k) bits |= static_cast<uint32_t>(mask[k] & 1) << k;
    return bits;
  }
}

// p[offset[0]], ..., p[offset[7]]. Eight loads: the gather instructions of x86-64 are slower.
template <class T>
NMR_INLINE Lanes<T> gather_values(const T* p, const int32_t* offset) {
  T value[kLanes];
  for (int64_t k = 0; k < kLanes; ++k) value[k] = p[offset[k]];
  return load_lanes<Lanes<T>>(value);
}
template <class T>
NMR_INLINE Lanes<T> gather_values(const T* p, Lanes32 offset) {
  int32_t at[kLanes];
  store_lanes(at, offset);
  return gather_values(p, at);
}

#if defined(__AVX2__) || NMR_AVX2
// Byte k of entry b: the number of the k-th set bit of b.
struct SetBits {
  uint64_t entry[256];
  constexpr SetBits() : entry() {
    for (int b = 0; b < 256; ++b) {
      int found = 0;
      for (uint64_t k = 0; k < 8; ++k)
        if (b >> k & 1) entry[b] |= k << 8 * found++;
    }
  }
};
constexpr SetBits kSetBits;
#endif

// Writes the lanes whose bit is set to out, one after the other, and anything to the rest of
// out[0..7]; returns how many are set.
template <class E>
NMR_INLINE int64_t compress_lanes(Lanes<E> v, uint32_t bits, E* out) {
#if defined(__AVX2__) || NMR_AVX2
  if constexpr (sizeof(E) == 4) {
    const __m256i order =
        _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(static_cast<int64_t>(kSetBits.entry[bits])));
    store_lanes(out, _mm256_permutevar8x32_epi32((__m256i)v, order));
    return __builtin_popcount(bits);
  }
#endif
  E value[kLanes];
  store_lanes(value, v);
  int64_t count = 0;
  for (int64_t k = 0; k < kLanes; ++k) {
    out[count] = value[k];
    count += bits >> k & 1;
  }
  return count;
}

// floor(x), for x in the range of int32
template <class T>
NMR_INLINE Lanes<T> floor_lanes(Lanes<T> x) {
#if defined(__AVX2__) || NMR_AVX2
  if constexpr (std::is_same_v<T, float>) return (Lanes<T>)_mm256_floor_ps((__m256)x);
#endif
  const Lanes<T> rounded = to_values<T>(truncate(x));
  return select(rounded > x, rounded - splat(T(1)), rounded);
}

#if defined(__AVX2__) || NMR_AVX2
// Swaps rows and columns of four values, in each group of four lanes.
NMR_INLINE void transpose_quads(__m256 (&q)[4]) {
  const __m256 a = _mm256_unpacklo_ps(q[0], q[1]), b = _mm256_unpackhi_ps(q[0], q[1]);
  const __m256 c = _mm256_unpacklo_ps(q[2], q[3]), d = _mm256_unpackhi_ps(q[2], q[3]);
  q[0] = _mm256_shuffle_ps(a, c, 0x44), q[1] = _mm256_shuffle_ps(a, c, 0xee);
  q[2] = _mm256_shuffle_ps(b, d, 0x44), q[3] = _mm256_shuffle_ps(b, d, 0xee);
}
NMR_INLINE void transpose_quads(__m256d (&q)[4]) {
  const __m256d a = _mm256_unpacklo_pd(q[0], q[1]), b = _mm256_unpackhi_pd(q[0], q[1]);
  const __m256d c = _mm256_unpacklo_pd(q[2], q[3]), d = _mm256_unpackhi_pd(q[2], q[3]);
  q[0] = _mm256_permute2f128_pd(a, c, 0x20), q[1] = _mm256_permute2f128_pd(b, d, 0x20);
  q[2] = _mm256_permute2f128_pd(a, c, 0x31), q[3] = _mm256_permute2f128_pd(b, d, 0x31);
}
#endif

// Four numbers of four or eight bytes per lane: column[c] gets row[k][c] in lane k.
template <class T>
NMR_INLINE void load_quads(const T* const (&row)[kLanes], Lanes<T> (&column)[4]) {
#if defined(__AVX2__) || NMR_AVX2
  if constexpr (sizeof(T) == 4) {
    const auto quad = [&](int64_t k) {
      return _mm_loadu_ps(reinterpret_cast<const float*>(row[k]));
    };
    __m256 q[4];
    for (int k = 0; k < 4; ++k)
      q[k] = _mm256_insertf128_ps(_mm256_castps128_ps256(quad(k)), quad(k + 4), 1);
    transpose_quads(q);
    for (int c = 0; c < 4; ++c) column[c] = (Lanes<T>)q[c];
    return;
  }
  if constexpr (sizeof(T) == 8) {
    __m256d low[4], high[4];
    for (int k = 0; k < 4; ++k)
      low[k] = _mm256_loadu_pd(row[k]), high[k] = _mm256_loadu_pd(row[k + 4]);
    transpose_quads(low);
    transpose_quads(high);
    for (int c = 0; c < 4; ++c) {
      const __m256d halves[2] = {low[c], high[c]};
      std::memcpy(&column[c], halves, sizeof halves);
    }
    return;
  }
#endif
  T value[4][kLanes];
  for (int64_t k = 0; k < kLanes; ++k)
    for (int c = 0; c < 4; ++c) value[c][k] = row[k][c];
  for (int c = 0; c < 4; ++c) column[c] = load_lanes<Lanes<T>>(value[c]);
}

// The other way round: row k of rows, [8, 4], gets lane k of the columns.
template <class T>
NMR_INLINE void store_quads(const Lanes<T> (&column)[4], T (&rows)[kLanes][4]) {
#if defined(__AVX2__) || NMR_AVX2
  if constexpr (std::is_same_v<T, float>) {
    __m256 q[4];
    for (int c = 0; c < 4; ++c) q[c] = (__m256)column[c];
    transpose_quads(q);
    for (int k = 0; k < 4; ++k) {
      _mm_storeu_ps(rows[k], _mm256_castps256_ps128(q[k]));
      _mm_storeu_ps(rows[k + 4], _mm256_extractf128_ps(q[k], 1));
    }
    return;
  }
  if constexpr (std::is_same_v<T, double>) {
    __m256d low[4], high[4];
    for (int c = 0; c < 4; ++c) {
      __m256d halves[2];
      std::memcpy(halves, &column[c], sizeof halves);
      low[c] = halves[0], high[c] = halves[1];
    }
    transpose_quads(low);
    transpose_quads(high);
    for (int k = 0; k < 4; ++k)
      _mm256_storeu_pd(rows[k], low[k]), _mm256_storeu_pd(rows[k + 4], high[k]);
    return;
  }
#endif
  T value[4][kLanes];
  for (int c = 0; c < 4; ++c) store_lanes(value[c], column[c]);
  for (int64_t k = 0; k < kLanes; ++k)
    for (int c = 0; c < 4; ++c) rows[k][c] = value[c][k];
}

// Adds four numbers per lane: lane k of the columns to sums[k][0 .. 3].
template <class T>
NMR_INLINE void add_quads(const Lanes<T> (&column)[4], T* const (&sums)[kLanes]) {
  T term[kLanes][4];
  store_quads<T>(column, term);
  for (int64_t n = 0; n < kLanes; ++n) {
    T total[4];
    for (int c = 0; c < 4; ++c) total[c] = sums[n][c] + term[n][c];
    std::copy_n(total, 4, sums[n]);
  }
}

// Face indices of the pixels [i, i + 8) of a line of pixels; background beyond its end.
NMR_INLINE Lanes32 load_face_indices(const int32_t* line, int64_t i, int64_t length) {
  if (i + kLanes <= length) return load_lanes<Lanes32>(line + i);
  int32_t rest[kLanes];
  for (int64_t n = 0; n < kLanes; ++n) rest[n] = i + n < length ? line[i + n] : -1;
  return load_lanes<Lanes32>(rest);
}

// Lanes of a vector as an array, for code that treats them one by one.
template <class E, class V>
struct LaneArray {
  E lane[kLanes];
  explicit NMR_INLINE LaneArray(V v) { store_lanes(lane, v); }
};

// sums[0] += the sum of the lanes of p, sums[1] += that of q; always in the order ((0 + 4) + (2 +
// 6)) + ((1 + 5) + (3
// + 7)).
template <class T>
NMR_INLINE void add_lane_sums(Lanes<T> p, Lanes<T> q, T* sums) {
#if defined(__AVX2__) || NMR_AVX2
  if constexpr (std::is_same_v<T, float>) {
    __m128 a[2], b[2];
    std::memcpy(a, &p, sizeof a);
    std::memcpy(b, &q, sizeof b);
    const __m128 p4 = a[0] + a[1], q4 = b[0] + b[1];
    const __m128 pairs = _mm_unpacklo_ps(p4, q4) + _mm_unpackhi_ps(p4, q4);  // p02 q02 p13 q13
    const __m128 sum = pairs + _mm_movehl_ps(pairs, pairs);
    __m128 total = _mm_castsi128_ps(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(sums)));
    total = total + sum;
    _mm_storel_epi64(reinterpret_cast<__m128i*>(sums), _mm_castps_si128(total));
    return;
  }
#endif
  const LaneArray<T, Lanes<T>> a(p), b(q);
  const auto sum = [](const T* v) {
    return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
  };
  sums[0] += sum(a.lane);
  sums[1] += sum(b.lane);
}

}  // namespace
}  // namespace nmr::NMR_LEVEL
