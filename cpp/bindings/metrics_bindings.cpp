// SPDX-License-Identifier: Apache-2.0
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <cmath>

#include "arrays.hpp"
#include "gil.hpp"
#include "wiw/core/thread_pool.hpp"
#include "wiw/metrics/pose_error.hpp"
#include "wiw/metrics/psnr.hpp"
#include "wiw/metrics/scores.hpp"
#include "wiw/metrics/ssim.hpp"

namespace py = pybind11;
using namespace wiw;
using namespace wiw::metrics;
using namespace wiw::bindings;

namespace {

using Doubles = Array<double>;

std::span<const double> to_list(const Doubles& array, const char* name) {
  if (array.ndim() != 1)
    throw ArgumentError(std::string(name) + ": expected one number an episode [N], got " + shape_text(array));
  return {array.data(), static_cast<std::size_t>(array.size())};
}

Doubles to_array(const std::vector<double>& values) {
  return Doubles(static_cast<py::ssize_t>(values.size()), values.data());
}

Weighting to_weighting(const std::string& name) {
  if (name == "uniform") return Weighting::kUniform;
  if (name == "latitude") return Weighting::kLatitude;
  throw ArgumentError("weights: expected 'uniform' or 'latitude', got '" + name + "'");
}

/// float64 [B] of a measure over image pairs [B, H, W, C], images in parallel.
template <class T, class Measure>
Doubles compare(const Array<T>& a, const Array<T>& b, double range, const std::string& weights, Measure measure) {
  expect_shape(a, {-1, -1, -1, -1}, "images [B, H, W, C]");
  expect_shape(b, {a.shape(0), a.shape(1), a.shape(2), a.shape(3)}, "two batches of one shape [B, H, W, C]");
  if (!(range > 0 && std::isfinite(range)))
    throw ArgumentError("data_range: expected a positive number, got " + std::to_string(range));
  const Weighting weighting = to_weighting(weights);
  const Size size{.height = static_cast<int>(a.shape(1)), .width = static_cast<int>(a.shape(2))};
  const auto channels = static_cast<int>(a.shape(3));
  const auto count = static_cast<std::size_t>(a.shape(0));
  const std::size_t stride = size.pixels() * static_cast<std::size_t>(channels);
  Doubles values(a.shape(0));
  const T* from = a.data();
  const T* to = b.data();
  double* out = values.mutable_data();
  {
    const wiw::bindings::GilRelease release;
    parallel_for(count, [&](std::size_t i) {
      const ImageView<const T> left{from + i * stride, size, channels};
      const ImageView<const T> right{to + i * stride, size, channels};
      out[i] = measure(left, right, range, weighting);
    });
  }
  return values;
}

template <class T>
void bind_images(py::module_& module) {
  module.def(
      "psnr",
      [](const Array<T>& a, const Array<T>& b, double range, const std::string& weights) {
        return compare<T>(a, b, range, weights, [](auto... arguments) { return psnr(arguments...); });
      },
      py::arg("a"), py::arg("b"), py::arg("data_range"), py::arg("weights"), "float64 [B] dB for images [B, H, W, C].");
  module.def(
      "ssim",
      [](const Array<T>& a, const Array<T>& b, double range, const std::string& weights) {
        return compare<T>(a, b, range, weights, [](auto... arguments) { return ssim(arguments...); });
      },
      py::arg("a"), py::arg("b"), py::arg("data_range"), py::arg("weights"), "float64 [B] for images [B, H, W, C].");
}

}  // namespace

void bind_metrics(py::module_& module) {
  bind_images<std::uint8_t>(module);
  bind_images<float>(module);
  module.def(
      "path_efficiency",
      [](const Doubles& credit, const Doubles& shortest, const Doubles& travelled) {
        return to_array(path_efficiency(to_list(credit, "success"), to_list(shortest, "shortest"),
                                        to_list(travelled, "travelled")));
      },
      py::arg("success"), py::arg("shortest"), py::arg("travelled"), "float64 [N] in [0, 1].");
  module.def(
      "answer_credit", [](const Doubles& raw) { return to_array(answer_credit(to_list(raw, "scores"))); },
      py::arg("scores"), "float64 [N] in [0, 1] from raw scores in [1, 5].");
  module.def(
      "mean", [](const Doubles& values) { return mean(to_list(values, "values")); }, py::arg("values"),
      "Mean of finite numbers, at least one.");
  module.def(
      "pose_error",
      [](const Doubles& a, const Doubles& b) {
        const auto from = to_poses(a, "a");
        const auto to = to_poses(b, "b");
        if (from.size() != to.size()) throw ArgumentError("expected as many poses a as b");
        Doubles errors({static_cast<py::ssize_t>(from.size()), py::ssize_t{2}});
        double* out = errors.mutable_data();
        for (std::size_t i = 0; i < from.size(); ++i) {
          const PoseError error = pose_error(from[i], to[i]);
          *out++ = error.translation_m;
          *out++ = error.rotation_rad;
        }
        return errors;
      },
      py::arg("a"), py::arg("b"), "float64 [B, 2]: metres and radians between poses [B, 4, 4].");
}
