// The fuzz target: bytes -> a scene -> every stage, forward and backward, on one thread and on three. Beyond what the sanitizers
// find, it stops at a broken promise and at results that depend on the number of threads. corpus.py writes such bytes.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "scene.h"

namespace nmr::test {
namespace {

struct Bytes {
  const uint8_t* data;
  size_t size;

  uint8_t next() {  // 0 when there are no more
    if (size == 0) return 0;
    --size;
    return *data++;
  }

  template <class Number>
  Number bits() {
    uint8_t raw[sizeof(Number)];
    for (uint8_t& byte : raw) byte = next();
    Number number;
    std::memcpy(&number, raw, sizeof(Number));
    return number;
  }
};

// One byte for a coordinate on a grid of 1/64 (depth: 1/16), pixel centres and borders among them; or a special value; or raw bits.
template <class T>
T coordinate(Bytes& bytes, bool is_depth) {
  using Limits = std::numeric_limits<T>;
  const T special[] = {Limits::quiet_NaN(), Limits::infinity(), -Limits::infinity(), Limits::max(), Limits::lowest(), Limits::denorm_min(),
                       Limits::min(), -Limits::min(), Limits::epsilon(), 1 + Limits::epsilon(), 1 - Limits::epsilon(), T(-0.0),
                       T(1e10), T(-1e20), T(1e-20)};
  const int byte = bytes.next();
  if (byte < 232) return is_depth ? T(byte - 32) / 16 : T(byte - 116) / 64;
  if (byte < 247) return special[byte - 232];
  if (byte < 252) return T(bytes.bits<int16_t>()) / 16384;
  return bytes.bits<T>();
}

template <class T>
Scene<T> decode(Bytes bytes) {
  Scene<T> s;
  const int flags = bytes.next(), more = bytes.next();
  const bool packed = flags & 1;
  s.faces_per_image = !packed && flags & 2;
  s.anti_aliasing = flags & 4;
  s.fill_back = flags & 8;
  s.per_image_values = flags & 16;
  s.perspective = flags & 32;
  s.distorted = flags & 64;
  s.foreign_owner = more % 8 == 7;
  constexpr int64_t batches[] = {0, 1, 2, 9};
  s.batch = batches[more / 8 % 4];
  s.channels = 1 + more / 32 % 4;
  s.image = square(1 + bytes.next() % (s.anti_aliasing ? 10 : 20));
  s.texture_size = 1 + bytes.next() % 4;
  s.grid_size = 1 + bytes.next() % 6;
  const int planes = bytes.next();
  s.near = planes % 4 == 0 ? T(0.1) : T(planes % 16) / 8;
  s.far = planes / 16 == 0 ? T(100) : T(planes / 16) / 2;
  const int eps = bytes.next() % 8;
  s.eps = eps == 0 ? T(1e-4) : eps == 1 ? T(1e-3) : T(std::ldexp(1.0, -eps));
  s.seed = bytes.next();

  const int64_t meshes = packed ? s.batch : 1;
  int64_t vertex_counts[9] = {}, face_counts[9] = {};
  for (int64_t m = 0; m < meshes; ++m) {
    const int counts = bytes.next();
    vertex_counts[m] = counts % 16;
    face_counts[m] = vertex_counts[m] == 0 ? 0 : counts / 16;
    if (packed) s.add_start();
    s.num_vertices += vertex_counts[m];
    s.num_faces += face_counts[m];
  }
  if (packed) s.add_start();
  const int64_t face_lists = s.faces_per_image ? s.batch : 1;
  for (int64_t list = 0; list < face_lists; ++list)
    for (int64_t m = 0; m < meshes; ++m)
      for (int64_t n = 0; n < 3 * face_counts[m]; ++n) s.faces.push_back(bytes.next() % vertex_counts[m]);
  const int64_t rows = packed ? s.num_vertices : s.batch * s.num_vertices;
  for (int64_t n = 0; n < 3 * rows; ++n) s.vertices.push_back(coordinate<T>(bytes, n % 3 == 2));
  return s;
}

void stop(const char* what, const char* which) {
  std::fprintf(stderr, "%s: %s\n", what, which);
  std::abort();
}

template <class T>
void run(const Bytes& bytes) {
  const Scene<T> scene = decode<T>(bytes);
  const Results<T> one = run_stages(scene, 1);
  if (const char* broken = broken_promise(scene, one)) stop("broken promise", broken);
  if (scene.seed % 8 != 7) return;  // threads take time to start: not for every input
  if (const char* name = first_difference(one, run_stages(scene, 3))) stop("depends on the number of threads", name);
}

}  // namespace
}  // namespace nmr::test

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  if (size < 2) return 0;
  if (data[0] % 2)
    nmr::test::run<float>({data + 1, size - 1});
  else
    nmr::test::run<double>({data + 1, size - 1});
  return 0;
}
