// nmr._C: the kernels as functions of tensors (or NumPy arrays) and numbers. The only file that
// knows Python.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "../scratch.h"
#include "call.h"

namespace py = pybind11;

namespace nmr {
namespace {

Type type_of(const py::dtype& dtype) {
  const auto size = dtype.itemsize();
  switch (dtype.kind()) {
    case 'f':
      return size == 4 ? Type::float32 : size == 8 ? Type::float64 : Type::other;
    case 'i':
      return size == 4 ? Type::int32 : size == 8 ? Type::int64 : Type::other;
    case 'b':
      return Type::boolean;
    default:
      return Type::other;
  }
}

Kernels all_kernels() {
  Kernels kernels;
  add_camera(kernels);
  add_raster(kernels);
  add_soft(kernels);
  add_fragments(kernels);
  add_edges(kernels);
  add_shade(kernels);
  add_texture(kernels);
  add_clip_space(kernels);
  add_lights(kernels);
  add_mesh(kernels);
  return kernels;
}

// What is asked of tensors. They belong to the interpreter, and are never freed.
struct Torch {
  py::handle tensor = of_torch("Tensor");
  std::vector<std::pair<py::handle, Type>> dtypes;
  py::handle is_cpu = name("is_cpu"), is_contiguous = name("is_contiguous"),
             is_neg = name("is_neg"), data_ptr = name("data_ptr"), shape = name("shape"),
             dtype = name("dtype");

  Torch() {
    const std::pair<const char*, Type> names[] = {{"float32", Type::float32},
                                                  {"float64", Type::float64},
                                                  {"int32", Type::int32},
                                                  {"int64", Type::int64},
                                                  {"bool", Type::boolean}};
    for (const auto& [name, type] : names) dtypes.emplace_back(of_torch(name), type);
  }
  static py::handle of_torch(const char* name) {
    return py::object(py::module_::import("torch").attr(name)).release();
  }
  static py::handle name(const char* text) { return PyUnicode_InternFromString(text); }
  static const Torch& get() {
    static const Torch* torch = new Torch;
    return *torch;
  }
};

py::object checked(PyObject* answer) {
  if (!answer) throw py::error_already_set();
  return py::reinterpret_steal<py::object>(answer);
}

py::object attribute(const py::handle& value, const py::handle& name) {
  return checked(PyObject_GetAttr(value.ptr(), name.ptr()));
}

py::object ask(const py::handle& value, const py::handle& method) {
  return checked(PyObject_CallMethodNoArgs(value.ptr(), method.ptr()));
}

// A tensor in host memory. One with gaps is copied; `copies` holds the copy during the call.
void read_tensor(py::handle tensor, Argument& argument, std::vector<py::object>& copies) {
  const Torch& torch = Torch::get();
  const auto replace = [&](const char* method) {
    copies.push_back(tensor.attr(method)());
    tensor = copies.back();
  };
  if (attribute(tensor, torch.is_cpu).ptr() != Py_True)
    throw py::type_error(std::string(argument.name) + " must be in host memory");
  if (ask(tensor, torch.is_neg).ptr() == Py_True) replace("resolve_neg");
  if (ask(tensor, torch.is_contiguous).ptr() != Py_True) replace("contiguous");
  argument.data = PyLong_AsVoidPtr(ask(tensor, torch.data_ptr).ptr());
  const py::tuple shape = attribute(tensor, torch.shape);
  argument.shape.reserve(shape.size());
  for (const py::handle& size : shape) argument.shape.push_back(PyLong_AsLongLong(size.ptr()));
  argument.type = Type::other;
  const py::object dtype = attribute(tensor, torch.dtype);
  for (const auto& [known, type] : torch.dtypes)
    if (dtype.is(known)) argument.type = type;
}

// The value belongs to the caller.
Argument argument_of(std::string_view name, const py::handle& value,
                     std::vector<py::object>& copies) {
  Argument argument;
  argument.name = name;
  if (value.is_none()) return argument;
  if (PyFloat_Check(value.ptr()) || PyLong_Check(value.ptr())) {
    argument.type = Type::number;
    argument.number = PyFloat_AsDouble(value.ptr());
    if (argument.number == -1 && PyErr_Occurred()) throw py::error_already_set();
  } else if (PyObject_TypeCheck(value.ptr(),
                                reinterpret_cast<PyTypeObject*>(Torch::get().tensor.ptr()))) {
    read_tensor(value, argument, copies);
  } else if (py::isinstance<py::array>(value)) {
    const auto array = py::reinterpret_borrow<py::array>(value);
    argument.type = type_of(array.dtype());
    argument.data = const_cast<void*>(array.data());
    argument.contiguous = array.flags() & py::array::c_style;
    argument.shape.assign(array.shape(), array.shape() + array.ndim());
  } else {
    argument.type = Type::other;
  }
  return argument;
}

void run_kernel(const Kernel& kernel, bool backward, const std::vector<std::string>& names,
                const py::args& values) {
  if (values.size() != names.size())
    throw py::type_error(kernel.name + " takes " + std::to_string(names.size()) +
                         " arguments, got " + std::to_string(values.size()));
  std::vector<py::object> copies;
  std::vector<Argument> arguments;
  arguments.reserve(names.size());
  for (size_t k = 0; k < names.size(); ++k)
    arguments.push_back(argument_of(names[k], PyTuple_GET_ITEM(values.ptr(), k), copies));
  Call call(std::move(arguments), backward);
  try {
    const py::gil_scoped_release release;
    kernel.run(call);
    call.require_all_read();
  } catch (const WrongType& error) {
    throw py::type_error(error.what());
  }
}

// The kernel of a name, or with "<name>_backward" its backward pass, as a function of arguments
// with these names, given by position.
py::cpp_function bind(const std::string& name, const std::vector<std::string>& names) {
  for (const Kernel& kernel : all_kernels()) {
    const bool backward = name == kernel.name + "_backward";
    if (name == kernel.name || (backward && kernel.has_backward))
      return py::cpp_function([kernel, backward, names](const py::args& values) {
        run_kernel(kernel, backward, names, values);
      });
  }
  throw py::attribute_error("nmr._C has no kernel " + name);
}

}  // namespace
}  // namespace nmr

PYBIND11_MODULE(_C, m) {
  m.doc() =
      "Compiled kernels of nmr. Use the functions of the package nmr, which validate and document.";
  m.def("free_scratch", &nmr::ThreadScratch::free_all, py::call_guard<py::gil_scoped_release>(),
        "Frees the memory that threads keep between calls, except that of threads at work.");
  m.def("bind", &nmr::bind, "A kernel as a function of arguments with the given names.");
}
