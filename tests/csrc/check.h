// The test harness: TEST(name) { CHECK(...); } registers itself; TEST_REAL(name) runs for T = float
// and T = double.
#pragma once

#include <functional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace nmr::test {

struct TestCase {
  std::string name;
  std::function<void()> body;
};

inline std::vector<TestCase>& all_tests() {
  static std::vector<TestCase> tests;
  return tests;
}

struct Registration {
  Registration(std::string name, std::function<void()> body) {
    all_tests().push_back({std::move(name), std::move(body)});
  }
};

template <class... Parts>
[[noreturn]] void fail(const char* file, int line, const Parts&... parts) {
  std::ostringstream text;
  text.precision(17);
  text << file << ":" << line << ": ";
  (text << ... << parts);
  throw std::runtime_error(text.str());
}

}  // namespace nmr::test

#define TEST(name)                                                  \
  static void name();                                               \
  static const ::nmr::test::Registration name##_entry(#name, name); \
  static void name()

#define TEST_REAL(name)                                                                 \
  template <class T>                                                                    \
  static void name();                                                                   \
  static const ::nmr::test::Registration name##_float(#name "<float>", name<float>);    \
  static const ::nmr::test::Registration name##_double(#name "<double>", name<double>); \
  template <class T>                                                                    \
  static void name()

#define CHECK(...) \
  if (!(__VA_ARGS__)) ::nmr::test::fail(__FILE__, __LINE__, "not true: ", #__VA_ARGS__)

#define CHECK_EQUAL(a, b)                                                               \
  do {                                                                                  \
    const auto left_ = (a);                                                             \
    const auto right_ = (b);                                                            \
    if (!(left_ == right_))                                                             \
      ::nmr::test::fail(__FILE__, __LINE__, #a " == " #b ": ", left_, " and ", right_); \
  } while (false)
