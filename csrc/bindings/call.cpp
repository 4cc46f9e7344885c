#include "call.h"

#include <algorithm>
#include <cstdlib>

namespace nmr {
namespace {

std::vector<std::string_view> split(std::string_view text, std::string_view separator) {
  std::vector<std::string_view> parts;
  while (true) {
    const size_t end = std::min(text.find(separator), text.size());
    parts.push_back(text.substr(0, end));
    if (end == text.size()) return parts;
    text.remove_prefix(end + separator.size());
  }
}

// "[A, B]" as A and B.
std::vector<std::string_view> axes_of(std::string_view shape) {
  if (shape == "[]") return {};
  return split(shape.substr(1, shape.size() - 2), ", ");
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
  throw WrongType(argument.name + " must be a C-contiguous array of " + type_name(type) + ", got " +
                  (argument.type == type ? "one with gaps" : type_name(argument.type)));
}

[[noreturn]] void refuse_shape(const Argument& argument, const std::string& wanted) {
  throw std::invalid_argument(argument.name + " must have shape " + wanted + ", got " +
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

const Argument* Call::look_up(const std::string& name) const {
  for (const Argument& argument : arguments_)
    if (argument.name == name) return &argument;
  return nullptr;
}

bool Call::has(const std::string& name) const {
  const Argument* argument = look_up(name);
  return argument && argument->type != Type::none;
}

const Argument& Call::operator()(const std::string& name) const {
  const Argument* argument = look_up(name);
  if (!argument) throw WrongType("the argument " + name + " is missing");
  return *argument;
}

bool Call::is_double(const std::string& of) const {
  if (!of.empty()) return (*this)((backward ? "grad_" : "") + of).type == Type::float64;
  for (const Argument& argument : arguments_)
    if (argument.type == Type::float32 || argument.type == Type::float64)
      return argument.type == Type::float64;
  return false;
}

Argument& Call::find(const std::string& name, bool may_be_none) {
  Argument& argument = const_cast<Argument&>((*this)(name));
  argument.read = true;
  if (argument.type == Type::none && !may_be_none) throw WrongType(name + " must not be None");
  return argument;
}

double Call::number(const std::string& name) {
  const Argument& argument = find(name, false);
  if (argument.type != Type::number)
    throw WrongType(name + " must be a number, got " + type_name(argument.type));
  return argument.number;
}

// A number, or a size with a name; -1 if it is not known yet.
int64_t Call::value_of(std::string_view size) const {
  if (size[0] >= '0' && size[0] <= '9') return std::strtoll(std::string(size).c_str(), nullptr, 10);
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
  for (std::string_view choice : split(axis, "|")) {
    const int64_t value = value_of(choice);
    if (value == actual) return true;
    const auto [name, more] = name_and_more(choice);
    if (value >= 0 || actual < more) continue;
    let(name, actual - more);
    return true;
  }
  return false;
}

bool Call::fits(std::string_view shape, const Argument& argument) {
  std::vector<std::string_view> axes = axes_of(shape);
  const bool open = !axes.empty() && axes.back() == "...";
  if (open) axes.pop_back();
  if (open ? axes.size() > argument.shape.size() : axes.size() != argument.shape.size())
    return false;
  const size_t known = sizes_.size();
  for (size_t d = 0; d < axes.size(); ++d) {
    if (fits(axes[d], argument.shape[d])) continue;
    sizes_.resize(known);
    return false;
  }
  return true;
}

// Shapes as an error shows them: with the numbers that are known.
std::string Call::wanted(std::string_view shapes) const {
  std::string text;
  for (std::string_view shape : split(shapes, " or ")) {
    std::string sizes;
    for (std::string_view axis : axes_of(shape)) {
      sizes += sizes.empty() ? "" : ", ";
      for (std::string_view choice : split(axis, "|")) {
        const int64_t value = value_of(choice);
        sizes += (choice.data() == axis.data() ? "" : " or ") +
                 (value < 0 ? std::string(choice) : std::to_string(value));
      }
    }
    text += (text.empty() ? "[" : " or [") + sizes + "]";
  }
  return text;
}

Argument& Call::bind(std::string_view text, const char* prefix, Type type, bool may_be_none) {
  const std::string name(text.substr(0, text.find_first_of("? ")));
  Argument& argument = require_type(find(prefix + name, may_be_none), type);
  if (argument.type == Type::none) return argument;
  for (std::string_view shape : split(shapes_of(text), " or "))
    if (fits(shape, argument)) return argument;
  refuse_shape(argument, wanted(shapes_of(text)));
}

Argument& Call::bind_like(const std::string& of, const std::string& name, Type type,
                          bool may_be_none) {
  Argument& argument = require_type(find(name, may_be_none), type);
  const Argument& like = (*this)(of);
  if (argument.type != Type::none && argument.shape != like.shape)
    refuse_shape(argument, like.shape_text());
  return argument;
}

int64_t Call::count_of(std::string_view text) const {
  int64_t count = 1;
  for (std::string_view axis : axes_of(shapes_of(text))) count *= (*this)[axis];
  return count;
}

void Call::require_all_read() const {
  for (const Argument& argument : arguments_)
    if (!argument.read && argument.type > Type::number)
      throw WrongType("there is no argument " + argument.name);
}

}  // namespace nmr
