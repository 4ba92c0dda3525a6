// SPDX-License-Identifier: Apache-2.0
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <optional>

#include "arrays.hpp"
#include "gil.hpp"
#include "wiw/reproject/warp.hpp"

namespace py = pybind11;
using namespace wiw;
using namespace wiw::reproject;

namespace {

View to_view(std::pair<int, int> size, std::optional<double> hfov_deg) {
  return {!hfov_deg.has_value(), {size.first, size.second}, radians(hfov_deg.value_or(90.0))};
}

/// float64 [B, T, 4, 4] as poses, row by row.
std::vector<Pose> batch_poses(const bindings::Array<double>& poses, py::ssize_t sources) {
  bindings::expect_shape(poses, {sources, -1, 4, 4},
                         ("T_source_target [B = " + std::to_string(sources) + ", T, 4, 4]").c_str());
  bindings::Array<double> flat = poses;
  flat = flat.reshape({sources * poses.shape(1), py::ssize_t{4}, py::ssize_t{4}});
  return bindings::to_poses(flat, "T_source_target");
}

py::dict run(const Warp& warp, const bindings::Array<std::uint8_t>& color, const bindings::Array<float>& depth,
             const bindings::Array<double>& T_source_target, bool with_depth, bool with_hole) {
  const Size& from = warp.source().size;
  const Size& to = warp.target().size;
  const std::string shape = std::to_string(from.height) + ", " + std::to_string(from.width);
  bindings::expect_shape(color, {-1, from.height, from.width, 3}, ("color [B, " + shape + ", 3]").c_str());
  const py::ssize_t sources = color.shape(0);
  bindings::expect_shape(depth, {sources, from.height, from.width},
                         ("depth [B = " + std::to_string(sources) + ", " + shape + "]").c_str());
  const std::vector<Pose> poses = batch_poses(T_source_target, sources);
  const std::vector<py::ssize_t> frame{sources, T_source_target.shape(1), to.height, to.width};
  py::array_t<std::uint8_t> out_color({frame[0], frame[1], frame[2], frame[3], py::ssize_t{3}});
  WarpTargets targets{out_color.mutable_data()};
  py::dict result;
  result["color"] = out_color;
  if (with_depth) {
    py::array_t<float> out(frame);
    targets.depth = out.mutable_data();
    result["depth"] = out;
  }
  if (with_hole) {
    py::array_t<bool> out(frame);
    targets.hole = reinterpret_cast<std::uint8_t*>(out.mutable_data());
    result["hole"] = out;
  }
  const wiw::bindings::GilRelease release;
  warp(color.data(), depth.data(), static_cast<std::size_t>(sources), poses, targets);
  return result;
}

}  // namespace

void bind_reproject(py::module_& module) {
  py::class_<Warp>(module, "Warp", "Shows RGB-D images from other poses; reusable for images of one size.")
      .def(py::init([](std::pair<int, int> source_size, std::optional<double> source_hfov_deg,
                       std::pair<int, int> target_size, std::optional<double> target_hfov_deg, float cut) {
             return std::make_unique<Warp>(to_view(source_size, source_hfov_deg), to_view(target_size, target_hfov_deg),
                                           cut);
           }),
           py::arg("source_size"), py::arg("source_hfov_deg"), py::arg("target_size"), py::arg("target_hfov_deg"),
           py::arg("cut"), "A field of view of None means a panorama.")
      .def("__call__", &run, py::arg("color"), py::arg("depth"), py::arg("T_source_target"),
           py::arg("with_depth") = false, py::arg("with_hole") = false,
           "uint8 [B, H, W, 3], float32 [B, H, W], float64 [B, T, 4, 4] -> {name: [B, T, h, w, ...]}.");
}
