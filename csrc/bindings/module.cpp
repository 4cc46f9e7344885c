// nmr._C: the stages as functions of NumPy arrays.
#include "../scratch.h"
#include "arrays.h"

PYBIND11_MODULE(_C, m) {
  m.doc() = "Compiled kernels of nmr. Use the functions of the package nmr, which validate and document.";
  m.def("free_scratch", &nmr::ThreadScratch::free_all, py::call_guard<py::gil_scoped_release>(),
        "Frees the memory that threads keep between calls, except that of threads at work.");
  nmr::bind_camera(m);
  nmr::bind_clip(m);
  nmr::bind_raster(m);
  nmr::bind_soft(m);
  nmr::bind_fragments(m);
  nmr::bind_edges(m);
  nmr::bind_shade(m);
  nmr::bind_texture(m);
  nmr::bind_clip_space(m);
  nmr::bind_lights(m);
  nmr::bind_mesh(m);
}
