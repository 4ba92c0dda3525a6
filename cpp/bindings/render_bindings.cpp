// SPDX-License-Identifier: Apache-2.0
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <optional>

#include "arrays.hpp"
#include "gil.hpp"
#include "wiw/render/gpu/gpu_renderer.hpp"
#include "wiw/render/renderer.hpp"

namespace py = pybind11;

namespace {

using wiw::bindings::Array;
using wiw::render::Renderer;

wiw::render::Backend backend_from(const std::string& name) {
  if (name == "auto") return wiw::render::Backend::kAuto;
  if (name == "cpu") return wiw::render::Backend::kCpu;
  if (name == "gpu") return wiw::render::Backend::kGpu;
  throw wiw::ArgumentError("Renderer: expected backend 'auto', 'cpu' or 'gpu', got '" + name + "'");
}

/// The caller's array, which must be just right because it is written in place; None: not wanted.
template <class T>
T* target(const py::object& array, std::initializer_list<py::ssize_t> shape, const char* expected) {
  if (array.is_none()) return nullptr;
  if (!py::isinstance<py::array_t<T>>(array)) {
    throw wiw::ArgumentError(std::string("render: expected ") + expected + ", got " + wiw::bindings::given_text(array));
  }
  auto typed = py::reinterpret_borrow<py::array_t<T>>(array);
  wiw::bindings::expect_shape(typed, shape, expected);
  if ((typed.flags() & py::array::c_style) == 0) {
    throw wiw::ArgumentError(std::string("render: expected C-contiguous ") + expected + ", got other strides");
  }
  if (!typed.writeable()) throw wiw::ArgumentError(std::string("render: expected writeable ") + expected);
  return typed.mutable_data();
}

void render(Renderer& renderer, const Array<double>& T_world_camera, const wiw::render::Camera& camera,
            const py::object& color, const py::object& depth, const py::object& instance) {
  const auto poses = wiw::bindings::to_poses(T_world_camera, "T_world_camera");
  const auto batch = static_cast<py::ssize_t>(poses.size());
  const py::ssize_t height = camera.size.height;
  const py::ssize_t width = camera.size.width;
  wiw::render::RenderTargets targets;
  targets.color = target<std::uint8_t>(color, {batch, height, width, 3}, "color uint8 [B, H, W, 3]");
  targets.depth = target<float>(depth, {batch, height, width}, "depth float32 [B, H, W]");
  targets.instance = target<std::uint32_t>(instance, {batch, height, width}, "instance uint32 [B, H, W]");
  const wiw::bindings::GilRelease release;
  renderer.render(poses, camera, targets);
}

void set_poses(Renderer& renderer, const Array<std::uint32_t>& ids, const Array<float>& poses) {
  wiw::bindings::expect_shape(ids, {-1}, "instance_ids [N]");
  wiw::bindings::expect_shape(poses, {ids.shape(0), 4, 4}, "T_world_instance [N, 4, 4]");
  std::vector<Eigen::Affine3f> transforms(static_cast<std::size_t>(ids.shape(0)));
  for (std::size_t i = 0; i < transforms.size(); ++i) {
    const Eigen::Map<const Eigen::Matrix<float, 4, 4, Eigen::RowMajor>> matrix(poses.data() + 16 * i);
    if (!matrix.row(3).isApprox(Eigen::RowVector4f(0, 0, 0, 1), 1e-6f)) {
      throw wiw::ArgumentError("T_world_instance[" + std::to_string(i) +
                               "] is not affine: its last row is not 0 0 0 1");
    }
    transforms[i].matrix() = matrix;
  }
  const std::span<const std::uint32_t> id_span(ids.data(), transforms.size());
  const wiw::bindings::GilRelease release;
  renderer.set_poses(id_span, transforms);
}

py::list egl_devices() {
  std::vector<wiw::render::EglDeviceReport> reports;
  {
    const wiw::bindings::GilRelease release;
    reports = wiw::render::report_egl_devices();
  }
  py::list devices;
  for (const wiw::render::EglDeviceReport& report : reports) {
    py::dict device;
    device["index"] = report.index;
    device["vendor"] = report.vendor;
    device["renderer"] = report.renderer;
    device["version"] = report.version;
    device["software"] = report.software;
    device["error"] = report.error;
    devices.append(device);
  }
  return devices;
}

}  // namespace

void bind_render(py::module_& module) {
  py::class_<Renderer, std::shared_ptr<Renderer>>(module, "Renderer", "Draws one scene; see wiw.render.Renderer.")
      .def(py::init([](const std::shared_ptr<wiw::scene::Scene>& scene, const std::string& backend, int samples) {
             const wiw::render::Backend chosen = backend_from(backend);
             const wiw::bindings::GilRelease release;
             return wiw::render::make_renderer(scene, chosen, {.samples = samples});
           }),
           py::arg("scene"), py::arg("backend"), py::arg("samples"))
      .def(
          "perspective",
          [](Renderer& renderer, const Array<double>& T_world_camera, std::pair<int, int> size, double hfov_deg,
             const py::object& color, const py::object& depth, const py::object& instance) {
            render(renderer, T_world_camera,
                   {wiw::render::Projection::kPerspective, {size.first, size.second}, wiw::radians(hfov_deg)}, color,
                   depth, instance);
          },
          py::arg("T_world_camera"), py::arg("size"), py::arg("hfov_deg"), py::arg("color"), py::arg("depth"),
          py::arg("instance"))
      .def(
          "panorama",
          [](Renderer& renderer, const Array<double>& T_world_camera, std::pair<int, int> size, const py::object& color,
             const py::object& depth, const py::object& instance) {
            render(renderer, T_world_camera, {wiw::render::Projection::kEquirectangular, {size.first, size.second}},
                   color, depth, instance);
          },
          py::arg("T_world_camera"), py::arg("size"), py::arg("color"), py::arg("depth"), py::arg("instance"))
      .def("set_poses", &set_poses, py::arg("instance_ids"), py::arg("T_world_instance"))
      .def_property_readonly("description", &Renderer::description);
  module.def("egl_devices", &egl_devices,
             "Every EGL device, each tried: dicts with 'index' (for WIW_EGL_DEVICE; -1 is the surfaceless platform), "
             "'vendor', 'renderer', 'version', 'software' and 'error' (empty, or why it gives no OpenGL context). "
             "Raises BackendError when there is no EGL library.");
}
