// nmr._C: the kernels as functions of NumPy arrays and numbers, given by name. The only file that knows Python.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include "../scratch.h"
#include "call.h"

namespace py = pybind11;

namespace nmr {
namespace {

Type type_of(const py::dtype& dtype) {
  const auto size = dtype.itemsize();
  switch (dtype.kind()) {
    case 'f': return size == 4 ? Type::float32 : size == 8 ? Type::float64 : Type::other;
    case 'i': return size == 4 ? Type::int32 : size == 8 ? Type::int64 : Type::other;
    case 'b': return Type::boolean;
    default: return Type::other;
  }
}

Argument argument_of(const py::handle& name, const py::handle& value) {
  Argument argument;
  argument.name = py::cast<std::string>(name);
  if (value.is_none()) return argument;
  if (py::isinstance<py::array>(value)) {
    const auto array = py::reinterpret_borrow<py::array>(value);
    argument.type = type_of(array.dtype());
    argument.data = const_cast<void*>(array.data());
    argument.contiguous = array.flags() & py::array::c_style;
    argument.shape.assign(array.shape(), array.shape() + array.ndim());
  } else if (PyFloat_Check(value.ptr()) || PyLong_Check(value.ptr())) {
    argument.type = Type::number;
    argument.number = value.cast<double>();
  } else {
    argument.type = Type::other;
  }
  return argument;
}

void define(py::module_& m, const std::string& name, const Kernel& kernel, bool backward) {
  m.def(name.c_str(), [run = kernel.run, backward](const py::kwargs& given) {
    std::vector<Argument> arguments;
    arguments.reserve(given.size());
    for (const auto& [key, value] : given) arguments.push_back(argument_of(key, value));
    Call call(std::move(arguments), backward);
    try {
      const py::gil_scoped_release release;
      run(call);
      call.require_all_read();
    } catch (const WrongType& error) {
      throw py::type_error(error.what());
    }
  });
}

}  // namespace
}  // namespace nmr

PYBIND11_MODULE(_C, m) {
  m.doc() = "Compiled kernels of nmr. Use the functions of the package nmr, which validate and document.";
  m.def("free_scratch", &nmr::ThreadScratch::free_all, py::call_guard<py::gil_scoped_release>(),
        "Frees the memory that threads keep between calls, except that of threads at work.");
  nmr::Kernels kernels;
  nmr::add_camera(kernels);
  nmr::add_raster(kernels);
  nmr::add_soft(kernels);
  nmr::add_fragments(kernels);
  nmr::add_edges(kernels);
  nmr::add_shade(kernels);
  nmr::add_texture(kernels);
  nmr::add_clip_space(kernels);
  nmr::add_lights(kernels);
  nmr::add_mesh(kernels);
  for (const nmr::Kernel& kernel : kernels) {
    nmr::define(m, kernel.name, kernel, false);
    if (kernel.has_backward) nmr::define(m, kernel.name + "_backward", kernel, true);
  }
}
