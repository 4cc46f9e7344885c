// A main for the fuzz target without libFuzzer: runs every input of the files given as arguments, one per line in hexadecimal
// digits. After -v it names each before it does.
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <string>
#include <vector>

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);

int main(int argc, char** argv) {
  const bool verbose = argc > 1 && std::strcmp(argv[1], "-v") == 0;
  int inputs = 0;
  for (int n = verbose ? 2 : 1; n < argc; ++n) {
    std::ifstream file(argv[n]);
    for (std::string line; std::getline(file, line); ++inputs) {
      if (verbose) std::fprintf(stderr, "%s\n", line.c_str());
      std::vector<uint8_t> bytes;
      for (size_t k = 0; k + 1 < line.size(); k += 2) bytes.push_back(static_cast<uint8_t>(std::stoi(line.substr(k, 2), nullptr, 16)));
      LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
    }
  }
  std::printf("%d inputs replayed\n", inputs);
  return inputs == 0;
}
