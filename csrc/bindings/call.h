// The arguments of a kernel, by name. A text says how each array is shaped, such as "attributes
// [1|B, N, C]": the first array that names a size fixes it, all others must agree. Nothing here
// knows Python (module.cpp does), so the GIL is not held while arguments are checked and kernels
// run.
#pragma once

#include <cstdint>
#include <functional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace nmr {

inline void require(bool condition, const std::string& message) {
  if (!condition) throw std::invalid_argument(message);
}

// An argument of the wrong kind: Python's TypeError.
struct WrongType : std::invalid_argument {
  using std::invalid_argument::invalid_argument;
};

enum class Type { none, number, float32, float64, int32, int64, boolean, other };

constexpr Type type_of(const float*) { return Type::float32; }
constexpr Type type_of(const double*) { return Type::float64; }
constexpr Type type_of(const int32_t*) { return Type::int32; }
constexpr Type type_of(const int64_t*) { return Type::int64; }
constexpr Type type_of(const bool*) { return Type::boolean; }

// An array, a number, or None. Its memory belongs to the caller.
struct Argument {
  std::string_view name;
  Type type = Type::none;
  double number = 0;
  void* data = nullptr;
  bool contiguous = true;
  std::vector<int64_t> shape;
  bool read = false;

  int64_t count() const;
  std::string shape_text() const;
};

class Call {
 public:
  const bool backward;  // a backward pass: results are not computed, but come with their gradients

  Call(std::vector<Argument> arguments, bool backward)
      : backward(backward), arguments_(std::move(arguments)) {}

  // Whether the floats are float64: those of a result, or else those of the first array that has
  // floats.
  bool is_double(std::string_view of) const;
  bool has(std::string_view name) const;  // an array is given, and not None
  const Argument& operator()(std::string_view name) const;
  int64_t operator[](std::string_view size) const;  // a size that is known by now
  void let(std::string_view size, int64_t value) { sizes_.emplace_back(size, value); }
  double number(std::string_view name);
  bool flag(std::string_view name) { return number(name) != 0; }

  // Binds an array to a field of the kernel's struct: "name [sizes] or [sizes]". A size is a
  // number, a name, a name + 1, or several of these with | between them; "..." at the end stands
  // for any more. With "name?" the array may be None; the field is then nullptr.
  template <class P>
  const Argument& read(std::string_view text, P*& field) {
    return assign(bind(text, "", type_of(field), text.find('?') != text.npos), field);
  }

  // The same shape as another array.
  template <class P>
  void read_like(std::string_view of, std::string_view name, P*& field) {
    assign(bind_like(of, name, type_of(field), false), field);
  }

  // A result in the forward pass; in the backward pass its gradient, an input. If that is None, it
  // is an array of zeros or, with "name?", nullptr.
  template <class T>
  void result(std::string_view text, T*& out, const T*& grad) {
    if (!backward) {
      assign(bind(text, "", type_of(out), false), out);
      return;
    }
    assign(bind(text, "grad_", type_of(grad), true), grad);
    if (!grad && text.find('?') == text.npos) {
      zeros_.emplace_back(count_of(text));  // doubles, also for floats
      grad = reinterpret_cast<const T*>(zeros_.back().data());
    }
  }

  // In the backward pass: where the gradient of an argument goes, or nullptr if it is not wanted.
  template <class T>
  void gradient(std::string_view of, T*& grad) {
    if (backward) assign(bind_like(of, gradient_of(of), type_of(grad), true), grad);
  }

  // The same for a kernel with one differentiable argument: its gradient must be wanted.
  template <class T>
  void only_gradient(std::string_view of, T*& grad) {
    if (backward) assign(bind_like(of, gradient_of(of), type_of(grad), false), grad);
  }

  void skip(std::string_view name) { find(name, true); }  // an array that only the other pass needs
  void require_all_read() const;

 private:
  std::vector<Argument> arguments_;
  std::vector<std::pair<std::string, int64_t>> sizes_;
  std::vector<std::vector<double>> zeros_;

  template <class P>
  static const Argument& assign(const Argument& argument, P*& field) {
    field = static_cast<P*>(argument.data);
    return argument;
  }
  static std::string gradient_of(std::string_view name) { return "grad_" + std::string(name); }
  const Argument* look_up(std::string_view name) const;
  Argument& find(std::string_view name, bool may_be_none);
  Argument& bind(std::string_view text, const char* prefix, Type type, bool may_be_none);
  Argument& bind_like(std::string_view of, std::string_view name, Type type, bool may_be_none);
  int64_t value_of(std::string_view size) const;
  bool fits(std::string_view axis, int64_t actual);
  bool fits(std::string_view shape, const Argument& argument);
  std::string wanted(std::string_view shapes) const;
  int64_t count_of(std::string_view text) const;
};

// All kernels by name. Those with a backward pass are in the module twice: as "name" and as
// "name_backward".
struct Kernel {
  std::string name;
  std::function<void(Call&)> run;
  bool has_backward;
};

class Kernels : public std::vector<Kernel> {
 public:
  // run(T(), call) reads the arguments and calls the kernel, for the T of the call's floats (see
  // is_double).
  template <class Run>
  void add(const char* name, Run run) {
    push_back({name, either(run, ""), false});
  }
  template <class Run>
  void add_with_backward(const char* name, Run run, const char* of = "") {
    push_back({name, either(run, of), true});
  }

 private:
  template <class Run>
  static std::function<void(Call&)> either(Run run, const char* of) {
    return [run, of](Call& call) { call.is_double(of) ? run(double(), call) : run(float(), call); };
  }
};

// A stage with a backward pass: read_<name> reads its arguments, which <name>_forward and
// <name>_backward take.
#define NMR_ADD_STAGE(kernels, name)                              \
  kernels.add_with_backward(#name, [](auto zero, Call& call) {    \
    const auto args = read_##name<decltype(zero)>(call);          \
    call.backward ? name##_backward(args) : name##_forward(args); \
  })

// The kernels of each file.
void add_camera(Kernels& kernels);
void add_raster(Kernels& kernels);
void add_soft(Kernels& kernels);
void add_fragments(Kernels& kernels);
void add_edges(Kernels& kernels);
void add_shade(Kernels& kernels);
void add_texture(Kernels& kernels);
void add_clip_space(Kernels& kernels);
void add_lights(Kernels& kernels);
void add_mesh(Kernels& kernels);

}  // namespace nmr
