// Runs the tests whose names contain the first argument (all without one); exit status 1 if one
// fails.
#include <cstdio>
#include <cstring>
#include <exception>

#include "check.h"

int main(int argc, char** argv) {
  int ran = 0, failed = 0;
  for (const nmr::test::TestCase& test : nmr::test::all_tests()) {
    if (argc > 1 && !std::strstr(test.name.c_str(), argv[1])) continue;
    ++ran;
    try {
      test.body();
    } catch (const std::exception& error) {
      ++failed;
      std::printf("FAILED %s\n  %s\n", test.name.c_str(), error.what());
    }
  }
  std::printf("%d tests, %d failed\n", ran, failed);
  return ran == 0 || failed != 0;
}
