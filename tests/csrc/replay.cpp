// A main for the fuzz target without libFuzzer.
// clang-format off
//   fuzz [-v] FILE...
//     runs every input of the files, one per line in hexadecimal digits; -v names each before it does
//   fuzz -mutate SECONDS SEED CURRENT FILE...
//     runs mutations of them for that long. CURRENT holds the input that is running, in the same digits: the culprit
//     after a crash
// clang-format on
#include <fcntl.h>
#include <sys/mman.h>
#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <string>
#include <vector>

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);

namespace {

using Input = std::vector<uint8_t>;
constexpr size_t kLongest = 512;

std::vector<Input> read_inputs(int argc, char** argv, int first) {
  std::vector<Input> inputs;
  for (int n = first; n < argc; ++n) {
    std::ifstream file(argv[n]);
    for (std::string line; std::getline(file, line);) {
      Input input;
      for (size_t k = 0; k + 1 < line.size(); k += 2)
        input.push_back(static_cast<uint8_t>(std::stoi(line.substr(k, 2), nullptr, 16)));
      inputs.push_back(input);
    }
  }
  return inputs;
}

struct Random {  // splitmix64
  uint64_t state;

  uint64_t next() {
    uint64_t x = state += 0x9e3779b97f4a7c15ull;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
    return x ^ (x >> 31);
  }
  size_t below(size_t n) { return next() % n; }
};

// One to eight changes: of a byte of the head (settings) or of any; of a run of bytes; bytes left out or repeated; the
// rest of another input.
void mutate(Random& random, const std::vector<Input>& inputs, Input& input) {
  constexpr size_t kHead = 12;
  for (size_t changes = 1 + random.below(8); changes > 0 && !input.empty(); --changes) {
    const size_t at = random.below(input.size());
    switch (random.below(8)) {
      case 0:
        input[random.below(input.size() < kHead ? input.size() : kHead)] = static_cast<uint8_t>(random.next());
        break;
      case 1: input[at] = static_cast<uint8_t>(random.next()); break;
      case 2: input[at] = static_cast<uint8_t>(input[at] ^ (1u << random.below(8))); break;
      case 3: input[at] = static_cast<uint8_t>(input[at] + random.below(5) - 2); break;
      case 4: input[at] = static_cast<uint8_t>(232 + random.below(24)); break;  // a special coordinate
      case 5: input[at] = input[random.below(input.size())]; break;
      case 6:
        if (random.below(2)) {
          input.erase(input.begin() + static_cast<std::ptrdiff_t>(at));
        } else if (input.size() < kLongest) {
          input.insert(input.begin() + static_cast<std::ptrdiff_t>(at), static_cast<uint8_t>(random.next()));
        }
        break;
      default: {
        const Input& other = inputs[random.below(inputs.size())];
        if (at < other.size()) {
          input.resize(at);
          input.insert(input.end(), other.begin() + static_cast<std::ptrdiff_t>(at), other.end());
        }
      }
    }
  }
}

// A file that survives the process, whatever ends it.
char* shared_file(const char* path, size_t size) {
  const int file = open(path, O_RDWR | O_CREAT | O_TRUNC, 0644);
  if (file < 0 || ftruncate(file, static_cast<off_t>(size)) != 0) return nullptr;
  void* memory = mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
  close(file);
  return memory == MAP_FAILED ? nullptr : static_cast<char*>(memory);
}

int fuzz(double seconds, uint64_t seed, const char* path, const std::vector<Input>& inputs) {
  using Clock = std::chrono::steady_clock;
  char* current = shared_file(path, 2 * kLongest + 1);
  if (!current || inputs.empty()) {
    std::fprintf(stderr, "cannot write %s, or there are no inputs\n", path);
    return 1;
  }
  Random random{seed};
  const Clock::time_point start = Clock::now();
  uint64_t executions = 0;
  double elapsed = 0, next_report = 60;
  Input input;
  for (; elapsed < seconds; ++executions) {
    input = inputs[random.below(inputs.size())];
    if (input.size() > kLongest) input.resize(kLongest);
    mutate(random, inputs, input);
    for (size_t k = 0; k < input.size(); ++k) {
      current[2 * k] = "0123456789abcdef"[input[k] / 16];
      current[2 * k + 1] = "0123456789abcdef"[input[k] % 16];
    }
    current[2 * input.size()] = '\n';
    std::memset(current + 2 * input.size() + 1, ' ', 2 * (kLongest - input.size()));
    LLVMFuzzerTestOneInput(input.data(), input.size());
    if (executions % 64 != 0) continue;
    elapsed = std::chrono::duration<double>(Clock::now() - start).count();
    if (elapsed < next_report) continue;
    std::printf("%llu executions in %.0f s\n", static_cast<unsigned long long>(executions), elapsed);
    std::fflush(stdout);
    next_report += 60;
  }
  std::printf("%llu executions in %.0f s, seed %llu, no finding\n", static_cast<unsigned long long>(executions),
              elapsed, static_cast<unsigned long long>(seed));
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc > 5 && std::strcmp(argv[1], "-mutate") == 0)
    return fuzz(std::atof(argv[2]), std::strtoull(argv[3], nullptr, 10), argv[4], read_inputs(argc, argv, 5));
  const bool verbose = argc > 1 && std::strcmp(argv[1], "-v") == 0;
  const std::vector<Input> inputs = read_inputs(argc, argv, verbose ? 2 : 1);
  for (const Input& input : inputs) {
    if (verbose) {
      for (uint8_t byte : input) std::fprintf(stderr, "%02x", byte);
      std::fprintf(stderr, "\n");
    }
    LLVMFuzzerTestOneInput(input.data(), input.size());
  }
  std::printf("%zu inputs replayed\n", inputs.size());
  return inputs.empty();
}
