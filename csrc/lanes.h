// Eight values that are processed together (lanes). With GCC and Clang these are vector types, which become one or
// more registers of the processor; elsewhere a struct with loops. Every operation treats each lane separately, so
// results do not depend on the width of the registers.
#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

#include "parallel.h"

namespace nmr {

constexpr int64_t kLanes = 8;

#if defined(__GNUC__) && !defined(NMR_NO_VECTOR_TYPES)

template <class T> struct LaneTypes;
template <> struct LaneTypes<float> {
  typedef float Values __attribute__((vector_size(32)));
  typedef int32_t Mask __attribute__((vector_size(32)));
};
template <> struct LaneTypes<double> {
  typedef double Values __attribute__((vector_size(64)));
  typedef int64_t Mask __attribute__((vector_size(64)));
};
typedef int32_t Lanes32 __attribute__((vector_size(32)));

template <class T> using Lanes = typename LaneTypes<T>::Values;
template <class T> using LaneMask = typename LaneTypes<T>::Mask;  // all bits of a lane are set or none

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
template <class M, class V>
NMR_INLINE V select(M mask, V yes, V no) {
  return mask ? yes : no;
}
// Converts a mask over lanes of T to one over 32-bit lanes, and back.
template <class M>
NMR_INLINE Lanes32 narrow_mask(M mask) {
  return __builtin_convertvector(mask, Lanes32);
}
template <class T>
NMR_INLINE LaneMask<T> widen_mask(Lanes32 mask) {
  return __builtin_convertvector(mask, LaneMask<T>);
}
template <class T>
NMR_INLINE Lanes<T> to_values(Lanes32 v) {
  return __builtin_convertvector(v, Lanes<T>);
}
// Truncated towards zero; every lane must be in the range of int32.
template <class V>
NMR_INLINE Lanes32 truncate(V v) {
  return __builtin_convertvector(v, Lanes32);
}

#else

// The same with loops, for other compilers.
template <class E>
struct LaneArray {
  E lane[kLanes];
  E operator[](int64_t k) const { return lane[k]; }
  E& operator[](int64_t k) { return lane[k]; }
};
template <class T> using MaskElement = std::conditional_t<sizeof(T) == 8, int64_t, int32_t>;
template <class T> using Lanes = LaneArray<T>;
template <class T> using LaneMask = LaneArray<MaskElement<T>>;
using Lanes32 = LaneArray<int32_t>;

#define NMR_LANE_OPERATOR(op)                                                        \
  template <class E> NMR_INLINE LaneArray<E> operator op(LaneArray<E> a, LaneArray<E> b) { \
    for (int64_t k = 0; k < kLanes; ++k) a.lane[k] = a.lane[k] op b.lane[k];           \
    return a;                                                                          \
  }                                                                                    \
  template <class E, class S> NMR_INLINE LaneArray<E> operator op(LaneArray<E> a, S b) {   \
    for (int64_t k = 0; k < kLanes; ++k) a.lane[k] = a.lane[k] op static_cast<E>(b);   \
    return a;                                                                          \
  }                                                                                    \
  template <class E, class S> NMR_INLINE LaneArray<E> operator op(S a, LaneArray<E> b) {   \
    for (int64_t k = 0; k < kLanes; ++k) b.lane[k] = static_cast<E>(a) op b.lane[k];   \
    return b;                                                                          \
  }
NMR_LANE_OPERATOR(+)
NMR_LANE_OPERATOR(-)
NMR_LANE_OPERATOR(*)
NMR_LANE_OPERATOR(/)
NMR_LANE_OPERATOR(&)
NMR_LANE_OPERATOR(|)
#undef NMR_LANE_OPERATOR
#define NMR_LANE_COMPARISON(op)                                                                       \
  template <class E> NMR_INLINE LaneArray<MaskElement<E>> operator op(LaneArray<E> a, LaneArray<E> b) { \
    LaneArray<MaskElement<E>> m;                                                                      \
    for (int64_t k = 0; k < kLanes; ++k) m.lane[k] = a.lane[k] op b.lane[k] ? -1 : 0;                 \
    return m;                                                                                         \
  }                                                                                                   \
  template <class E, class S> NMR_INLINE LaneArray<MaskElement<E>> operator op(LaneArray<E> a, S b) {  \
    LaneArray<MaskElement<E>> m;                                                                      \
    for (int64_t k = 0; k < kLanes; ++k) m.lane[k] = a.lane[k] op static_cast<E>(b) ? -1 : 0;         \
    return m;                                                                                         \
  }                                                                                                   \
  template <class E, class S> NMR_INLINE LaneArray<MaskElement<E>> operator op(S a, LaneArray<E> b) {  \
    LaneArray<MaskElement<E>> m;                                                                      \
    for (int64_t k = 0; k < kLanes; ++k) m.lane[k] = static_cast<E>(a) op b.lane[k] ? -1 : 0;         \
    return m;                                                                                         \
  }
NMR_LANE_COMPARISON(<)
NMR_LANE_COMPARISON(>)
NMR_LANE_COMPARISON(<=)
NMR_LANE_COMPARISON(>=)
#undef NMR_LANE_COMPARISON
template <class E>
NMR_INLINE LaneArray<E> operator~(LaneArray<E> a) {
  for (int64_t k = 0; k < kLanes; ++k) a.lane[k] = ~a.lane[k];
  return a;
}
template <class V, class U>
NMR_INLINE V load_lanes(const U* p) {
  V v;
  std::memcpy(v.lane, p, sizeof v);
  return v;
}
template <class V, class U>
NMR_INLINE void store_lanes(U* p, V v) {
  std::memcpy(p, v.lane, sizeof v);
}
template <class M, class V>
NMR_INLINE V select(M mask, V yes, V no) {
  for (int64_t k = 0; k < kLanes; ++k) yes.lane[k] = mask.lane[k] ? yes.lane[k] : no.lane[k];
  return yes;
}
template <class To, class From>
NMR_INLINE LaneArray<To> convert_lanes(LaneArray<From> v) {
  LaneArray<To> to;
  for (int64_t k = 0; k < kLanes; ++k) to.lane[k] = static_cast<To>(v.lane[k]);
  return to;
}
template <class M>
NMR_INLINE Lanes32 narrow_mask(M mask) {
  return convert_lanes<int32_t>(mask);
}
template <class T>
NMR_INLINE LaneMask<T> widen_mask(Lanes32 mask) {
  return convert_lanes<MaskElement<T>>(mask);
}
template <class T>
NMR_INLINE Lanes<T> to_values(Lanes32 v) {
  return convert_lanes<T>(v);
}
template <class V>
NMR_INLINE Lanes32 truncate(V v) {
  return convert_lanes<int32_t>(v);
}

#endif

// All lanes equal.
template <class T>
NMR_INLINE Lanes<T> splat(T v) {
  return Lanes<T>{v, v, v, v, v, v, v, v};
}
NMR_INLINE Lanes32 splat32(int32_t v) { return Lanes32{v, v, v, v, v, v, v, v}; }

// 0, 1, ..., 7
NMR_INLINE Lanes32 lane_numbers() {
  return Lanes32{0, 1, 2, 3, 4, 5, 6, 7};
}

// p[offset[0]], ..., p[offset[7]]
NMR_INLINE Lanes32 gather_lanes(const int32_t* p, const int32_t* offset) {
  return Lanes32{p[offset[0]], p[offset[1]], p[offset[2]], p[offset[3]],
                 p[offset[4]], p[offset[5]], p[offset[6]], p[offset[7]]};
}

// Bit k is set where lane k of the mask is.
NMR_INLINE uint32_t lane_bits(Lanes32 mask) {
#if defined(__SSE2__)
  __m128 halves[2];
  std::memcpy(halves, &mask, sizeof halves);
  return static_cast<uint32_t>(_mm_movemask_ps(halves[0]) | _mm_movemask_ps(halves[1]) << 4);
#else
  const Lanes32 bits = mask & Lanes32{1, 2, 4, 8, 16, 32, 64, 128};
  uint64_t words[kLanes / 2];
  std::memcpy(words, &bits, sizeof words);
  const uint64_t word = (words[0] | words[1]) | (words[2] | words[3]);
  return static_cast<uint32_t>(word | word >> 32) & 0xff;
#endif
}
template <class M>
NMR_INLINE uint32_t lane_bits(M mask) {
  return lane_bits(narrow_mask(mask));
}

// Sum of the lanes, always in this order.
template <class V>
NMR_INLINE auto sum_lanes(V v) {
  return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
}

template <class V>
NMR_INLINE auto min_lanes(V v) {
  auto least = v[0];
  for (int64_t k = 1; k < kLanes; ++k) least = v[k] < least ? v[k] : least;
  return least;
}

}  // namespace nmr
