#include "call.h"

#include <algorithm>

namespace nmr {
namespace {

// Calls part(text) for the parts of a text until one gives true, and returns whether one did.
// Nothing is allocated: for small meshes that would take longer than the kernel.
template <class Part>
bool any_part(std::string_view text, std::string_view separator, const Part& part) {
  while (true) {
    const size_t end = std::min(text.find(separator), text.size());
    if (part(text.substr(0, end))) return true;
    if (end == text.size()) return false;
    text.remove_prefix(end + separator.size());
  }
}

// The same for the sizes A and B of "[A, B]".
template <class Part>
bool any_axis(std::string_view shape, const Part& part) {
  return shape != "[]" && any_part(shape.substr(1, shape.size() - 2), ", ", part);
}

std::string_view shapes_of(std::string_view text) { return text.substr(text.find('[')); }

// "B + 1" as B and 1, any other name as itself and 0.
std::pair<std::string_view, int64_t> name_and_more(std::string_view size) {
  const size_t plus = size.find(" + 1");
  return {size.substr(0, plus), plus != size.npos};
}

const char* type_name(Type type) {
  const char* names[] = {"None",  "a number", "float32", "float64",
                         "int32", "int64",    "bool",    "another type"};
  return names[static_cast<int>(type)];
}

Argument& require_type(Argument& argument, Type type) {
  if (argument.type == Type::none || (argument.type == type && argument.contiguous))
    return argument;
  throw WrongType(std::string(argument.name) + " must be a C-contiguous array of " +
                  type_name(type) + ", got " +
                  (argument.type == type ? "one with gaps" : type_name(argument.type)));
}

[[noreturn]] void refuse_shape(const Argument& argument, const std::string& wanted) {
  throw std::invalid_argument(std::string(argument.name) + " must have shape " + wanted + ", got " +
                              argument.shape_text());
}

}  // namespace

int64_t Argument::count() const {
  int64_t product = 1;
  for (int64_t size : shape) product *= size;
  return product;
}

std::string Argument::shape_text() const {
  std::string text;
  for (int64_t size : shape) text += (text.empty() ? "" : ", ") + std::to_string(size);
  return "[" + text + "]";
}

const Argument* Call::look_up(std::string_view name) const {
  for (const Argument& argument : arguments_)
    if (argument.name == name) return &argument;
  return nullptr;
}

bool Call::has(std::string_view name) const {
  const Argument* argument = look_up(name);
  return argument && argument->type != Type::none;
}

const Argument& Call::operator()(std::string_view name) const {
  const Argument* argument = look_up(name);
  if (!argument) throw WrongType("the argument " + std::string(name) + " is missing");
  return *argument;
}

bool Call::is_double(std::string_view of) const {
  if (!of.empty())
    return (*this)(backward ? gradient_of(of) : std::string(of)).type == Type::float64;
  for (const Argument& argument : arguments_)
    if (argument.type == Type::float32 || argument.type == Type::float64)
      return argument.type == Type::float64;
  return false;
}

Argument& Call::find(std::string_view name, bool may_be_none) {
  Argument& argument = const_cast<Argument&>((*this)(name));
  argument.read = true;
  if (argument.type == Type::none && !may_be_none)
    throw WrongType(std::string(name) + " must not be None");
  return argument;
}

double Call::number(std::string_view name) {
  const Argument& argument = find(name, false);
  if (argument.type != Type::number)
    throw WrongType(std::string(name) + " must be a number, got " + type_name(argument.type));
  return argument.number;
}

// A number, or a size with a name; -1 if it is not known yet.
int64_t Call::value_of(std::string_view size) const {
  if (size[0] >= '0' && size[0] <= '9') {
    int64_t number = 0;
    for (char digit : size) number = 10 * number + (digit - '0');
    return number;
  }
  const auto [name, more] = name_and_more(size);
  for (const auto& [known, value] : sizes_)
    if (known == name) return value + more;
  return -1;
}

int64_t Call::operator[](std::string_view size) const {
  const int64_t value = value_of(size);
  if (value < 0) throw std::logic_error("the size " + std::string(size) + " is not known yet");
  return value;
}

// One size of an array. An unknown name takes the actual size.
bool Call::fits(std::string_view axis, int64_t actual) {
  return any_part(axis, "|", [&](std::string_view choice) {
    const int64_t value = value_of(choice);
    if (value == actual) return true;
    const auto [name, more] = name_and_more(choice);
    if (value >= 0 || actual < more) return false;
    let(name, actual - more);
    return true;
  });
}

bool Call::fits(std::string_view shape, const Argument& argument) {
  const size_t known = sizes_.size(), axes = argument.shape.size();
  size_t d = 0;
  bool open = false;
  const bool differs = any_axis(shape, [&](std::string_view axis) {
    open = axis == "...";
    return !open && (d == axes || !fits(axis, argument.shape[d++]));
  });
  if (!differs && (open || d == axes)) return true;
  sizes_.resize(known);
  return false;
}

// Shapes as an error shows them: with the numbers that are known.
std::string Call::wanted(std::string_view shapes) const {
  std::string text;
  any_part(shapes, " or ", [&](std::string_view shape) {
    std::string sizes;
    any_axis(shape, [&](std::string_view axis) {
      sizes += sizes.empty() ? "" : ", ";
      return any_part(axis, "|", [&](std::string_view choice) {
        const int64_t value = value_of(choice);
        sizes += (choice.data() == axis.data() ? "" : " or ") +
                 (value < 0 ? std::string(choice) : std::to_string(value));
        return false;
      });
    });
    text += (text.empty() ? "[" : " or [") + sizes + "]";
    return false;
  });
  return text;
}

Argument& Call::bind(std::string_view text, const char* prefix, Type type, bool may_be_none) {
  const std::string_view name = text.substr(0, text.find_first_of("? "));
  Argument& found =
      *prefix ? find(prefix + std::string(name), may_be_none) : find(name, may_be_none);
  Argument& argument = require_type(found, type);
  if (argument.type == Type::none) return argument;
  if (any_part(shapes_of(text), " or ", [&](auto shape) { return fits(shape, argument); }))
    return argument;
  refuse_shape(argument, wanted(shapes_of(text)));
}

Argument& Call::bind_like(std::string_view of, std::string_view name, Type type, bool may_be_none) {
  Argument& argument = require_type(find(name, may_be_none), type);
  const Argument& like = (*this)(of);
  if (argument.type != Type::none && argument.shape != like.shape)
    refuse_shape(argument, like.shape_text());
  return argument;
}

int64_t Call::count_of(std::string_view text) const {
  int64_t count = 1;
  any_axis(shapes_of(text), [&](std::string_view axis) {
    count *= (*this)[axis];
    return false;
  });
  return count;
}

void Call::require_all_read() const {
  for (const Argument& argument : arguments_)
    if (!argument.read && argument.type > Type::number)
      throw WrongType("there is no argument " + std::string(argument.name));
}

}  // namespace nmr
