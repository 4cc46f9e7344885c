// The fuzz target: bytes -> a scene -> every stage, forward and backward. Beyond what the
// sanitizers find, it stops at a broken promise, and for some seeds at results that depend on the
// number of threads, on the other images of the batch, or on packing. Without libFuzzer it runs the
// inputs of files, one per line in hexadecimal digits:
//   fuzz FILE...
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <string>

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

// One byte for a coordinate on a grid of 1/64 (depth: 1/16), pixel centres and borders among them;
// or a special value; or raw bits.
template <class T>
T coordinate(Bytes& bytes, bool is_depth) {
  const int byte = bytes.next();
  if (byte < 232) return is_depth ? T(byte - 32) / 16 : T(byte - 116) / 64;
  if (byte < 247) return kSpecial<T>[byte - 232];
  if (byte < 252) return T(bytes.bits<int16_t>()) / 16384;
  return bytes.bits<T>();
}

// Mostly tiny: an input should cost microseconds. One of eight is large enough for several blocks
// of lanes.
int64_t side(int byte) { return byte < 224 ? 1 + byte % 6 : 7 + byte % 18; }

// Writes the scene over an earlier one, whose storage it uses again.
template <class T>
void decode(Bytes bytes, Scene<T>& s) {
  const int flags = bytes.next(), more = bytes.next(), also = bytes.next();
  const bool packed = flags & 1;
  s.faces_per_image = !packed && flags & 2;
  s.anti_aliasing = flags & 4;
  s.fill_back = flags & 8;
  s.per_image_values = flags & 16;
  s.perspective = flags & 32;
  s.distorted = flags & 64;
  s.foreign_face_index = more % 8 == 7;
  constexpr int64_t batches[] = {1, 1, 1, 1, 2, 2, 3, 9}, cubes[] = {1, 2, 2, 2, 3, 2, 2, 4};
  s.batch = batches[more / 8 % 8];
  if (more == 255) s.batch = 0;
  s.channels = 1 + also % 4;
  s.texture_size = cubes[also / 4 % 8];
  s.hostile_upstream = also / 32 == 7;
  const int omitted = bytes.next() % 16;
  s.no_grad_weights = omitted == 1 || omitted == 3;
  s.no_grad_depth = omitted == 2 || omitted == 3;
  const int64_t height = side(bytes.next());
  s.image = {height, side(bytes.next())};
  s.grid_size = 1 + bytes.next() % 5;
  const int planes = bytes.next();
  s.near = planes % 4 == 0 ? T(0.1) : T(planes % 16) / 8;
  s.far = planes / 16 == 0 ? T(100) : T(planes / 16) / 2;
  const int eps = bytes.next() % 8;
  s.eps = eps == 0 ? T(1e-4) : eps == 1 ? T(1e-3) : T(std::ldexp(1.0, -eps));
  s.seed = bytes.next();

  s.num_vertices = s.num_faces = 0;
  s.vertices.clear();
  s.faces.clear();
  s.starts.clear();
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
      for (int64_t n = 0; n < 3 * face_counts[m]; ++n)
        s.faces.push_back(bytes.next() % vertex_counts[m]);
  const int64_t rows = packed ? s.num_vertices : s.batch * s.num_vertices;
  for (int64_t n = 0; n < 3 * rows; ++n) s.vertices.push_back(coordinate<T>(bytes, n % 3 == 2));
#ifdef NMR_FRESH_SCRATCH
  s.vertices.shrink_to_fit();
  s.faces.shrink_to_fit();
  s.starts.shrink_to_fit();
#endif
}

void stop_unless_none(const char* which, const char* what) {
  if (!*which) return;
  std::fprintf(stderr, "%s: %s\n", what, which);
  std::abort();
}

template <class T>
void run(const Bytes& bytes) {
  static Scene<T> scene;
  static Results<T> one, other;
  decode<T>(bytes, scene);
  run_stages(scene, 1, one);
  stop_unless_none(broken_promise(scene, one), "broken promise");
  const uint64_t seed = scene.seed;  // a second run, or threads, not for every input
  if (seed == 7 || seed == 71) {
    run_stages(scene, 2, other);
    stop_unless_none(first_difference(one, other), "depends on the number of threads");
  } else if (seed >= 8 && seed < 12 && scene.batch > 1) {
    run_stages(first_image(scene), 1, other);
    stop_unless_none(depends_on_company(scene, one, other), "depends on the other images");
  } else if (seed >= 12 && seed < 16 && !scene.packed() &&
             (scene.per_image_values || scene.batch == 1)) {
    run_stages(packed(scene), 1, other);
    stop_unless_none(depends_on_packing(one, other), "depends on packing");
  }
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

#ifndef NMR_FUZZER
int main(int argc, char** argv) {
  int count = 0;
  for (int n = 1; n < argc; ++n) {
    std::ifstream file(argv[n]);
    for (std::string line; std::getline(file, line); ++count) {
      std::vector<uint8_t> input;
      for (size_t k = 0; k + 1 < line.size(); k += 2)
        input.push_back(static_cast<uint8_t>(std::stoi(line.substr(k, 2), nullptr, 16)));
      LLVMFuzzerTestOneInput(input.data(), input.size());
    }
  }
  std::printf("%d inputs replayed\n", count);
  return count == 0;
}
#endif
