// SPDX-License-Identifier: Apache-2.0
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "arrays.hpp"
#include "gil.hpp"
#include "wiw/annotate/strip.hpp"

namespace py = pybind11;
using namespace wiw;
using namespace wiw::annotate;

namespace {

using Pixels = bindings::Array<std::uint8_t>;

/// A copy of the image to draw into.
std::pair<py::array_t<std::uint8_t>, Image> copy_of(const Pixels& image) {
  bindings::expect_shape(image, {-1, -1, 3}, "image [H, W, 3]");
  py::array_t<std::uint8_t> copy({image.shape(0), image.shape(1), py::ssize_t{3}}, image.data());
  const Size size{static_cast<int>(image.shape(0)), static_cast<int>(image.shape(1))};
  return {copy, {copy.mutable_data(), size, 3}};
}

py::array box(const Pixels& image, const std::array<double, 4>& edges, const Color& color, int thickness,
              const std::string& label) {
  const auto [copy, view] = copy_of(image);
  draw_box(view, {edges[0], edges[1], edges[2], edges[3]}, color, thickness, label);
  return copy;
}

py::array mark(const Pixels& image, const std::array<double, 2>& center, const Color& color, int radius,
               const std::string& label, int gap) {
  const auto [copy, view] = copy_of(image);
  draw_mark(view, {center[0], center[1]}, color, radius, label, gap);
  return copy;
}

py::array axes(const Pixels& image, const std::array<double, 2>& origin,
               const std::array<std::array<double, 2>, 3>& ends, int thickness) {
  const auto [copy, view] = copy_of(image);
  std::array<Point, 3> points;
  for (std::size_t axis = 0; axis < 3; ++axis) points[axis] = {ends[axis][0], ends[axis][1]};
  draw_axes(view, {origin[0], origin[1]}, points, thickness);
  return copy;
}

py::array strip(const Pixels& frames, const std::vector<std::string>& titles, int columns, int bar, int gap) {
  bindings::expect_shape(frames, {static_cast<py::ssize_t>(titles.size()), -1, -1, 3},
                         ("frames [T = " + std::to_string(titles.size()) + " titles, H, W, 3]").c_str());
  const Size frame{static_cast<int>(frames.shape(1)), static_cast<int>(frames.shape(2))};
  const StripStyle style{columns, bar, gap};
  const Size size = StripLayout(frame, titles.size(), style).size();
  py::array_t<std::uint8_t> out({size.height, size.width, 3});
  std::uint8_t* to = out.mutable_data();
  const std::uint8_t* from = frames.data();
  const wiw::bindings::GilRelease release;
  draw_strip(from, frame, titles, style, to);
  return out;
}

}  // namespace

void bind_annotate(py::module_& module) {
  module.def("box", &box, py::arg("image"), py::arg("box"), py::arg("color"), py::arg("thickness"), py::arg("label"),
             "Copy of uint8 [H, W, 3] with the box (left, top, right, bottom).");
  module.def("mark", &mark, py::arg("image"), py::arg("center"), py::arg("color"), py::arg("radius"), py::arg("label"),
             py::arg("gap"), "Copy of uint8 [H, W, 3] with a disc at (x, y).");
  module.def("axes", &axes, py::arg("image"), py::arg("origin"), py::arg("ends"), py::arg("thickness"),
             "Copy of uint8 [H, W, 3] with three arrows.");
  module.def("strip", &strip, py::arg("frames"), py::arg("titles"), py::arg("columns"), py::arg("bar"), py::arg("gap"),
             "uint8 [T, H, W, 3] and T titles -> one image.");
}
