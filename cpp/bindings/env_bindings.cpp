// SPDX-License-Identifier: Apache-2.0
#include <pybind11/eigen.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "actions.hpp"
#include "gil.hpp"
#include "wiw/env/vector_env.hpp"

namespace py = pybind11;
using namespace wiw;
using namespace wiw::env;
using namespace wiw::bindings;

namespace {

/// Allocates what `outputs` names, batch-major with `batch` as first axis, or without it when `batch` is 0.
struct Images {
  py::dict arrays;
  ObservationTargets targets;

  Images(const NavigationConfig& config, const std::vector<std::string>& outputs, py::ssize_t batch) {
    for (const std::string& name : outputs) {
      if (name == "panorama") {
        targets.panorama = add<std::uint8_t>(name, batch, {config.panorama.height, config.panorama.width, 3});
      } else if (name == "front") {
        targets.front = add<std::uint8_t>(name, batch, {config.front.height, config.front.width, 3});
      } else if (name == "depth") {
        targets.depth = add<float>(name, batch, {config.panorama.height, config.panorama.width});
      } else if (name == "panorama_ids") {
        targets.panorama_ids = add<std::uint32_t>(name, batch, {config.panorama.height, config.panorama.width});
      } else if (name == "front_ids") {
        targets.front_ids = add<std::uint32_t>(name, batch, {config.front.height, config.front.width});
      } else {
        throw ArgumentError("observe: expected outputs among panorama, front, depth, panorama_ids, front_ids, got '" +
                            name + "'");
      }
    }
  }

  template <class T>
  T* add(const std::string& name, py::ssize_t batch, std::vector<py::ssize_t> shape) {
    if (batch > 0) shape.insert(shape.begin(), batch);
    py::array_t<T> array(shape);
    arrays[py::str(name)] = array;
    return array.mutable_data();
  }
};

/// What can be seen from where an environment stands now, and nothing else of it.
struct Outlook {
  NavigationEnv env;
};

py::dict draw(const NavigationEnv& env, const std::vector<std::string>& outputs) {
  Images images(env.config(), outputs, 0);
  {
    const wiw::bindings::GilRelease release;
    env.observe(images.targets);
  }
  return images.arrays;
}

}  // namespace

void bind_env(py::module_& module) {
  py::enum_<Motion>(module, "Motion").value("refuse", Motion::kRefuse).value("slide", Motion::kSlide);

  py::class_<NavigationConfig>(module, "NavigationConfig")
      .def(py::init([](double forward_m, double turn_deg, Motion motion, double camera_height,
                       std::pair<int, int> panorama, std::pair<int, int> front, double front_hfov_deg) {
             NavigationConfig config;
             config.actions = {.forward_m = forward_m, .turn_rad = radians(turn_deg)};
             config.motion = motion;
             config.camera_height = camera_height;
             config.panorama = {panorama.first, panorama.second};
             config.front = {front.first, front.second};
             config.front_hfov = radians(front_hfov_deg);
             return config;
           }),
           py::arg("forward_m") = 0.2, py::arg("turn_deg") = 22.5, py::arg("motion") = Motion::kRefuse,
           py::arg("camera_height") = 1.0, py::arg("panorama") = std::pair(576, 1024),
           py::arg("front") = std::pair(480, 480), py::arg("front_hfov_deg") = 90.0);

  py::class_<Outlook>(module, "Outlook", "The view from one place. It draws pictures, and tells and moves nothing.")
      .def(
          "draw",
          [](const Outlook& outlook, const std::vector<std::string>& outputs) { return draw(outlook.env, outputs); },
          py::arg("outputs"), "As NavigationEnv.observe.");

  py::class_<NavigationEnv>(module, "NavigationEnv")
      .def(py::init([](std::shared_ptr<render::Renderer> renderer, std::shared_ptr<nav::NavMesh> navmesh,
                       std::shared_ptr<nav::Ground> ground, const NavigationConfig& config) {
             return NavigationEnv({std::move(renderer), std::move(navmesh), std::move(ground)}, config);
           }),
           py::arg("renderer"), py::arg("navmesh"), py::arg("ground"), py::arg("config") = NavigationConfig{})
      .def("reset", &NavigationEnv::reset, py::arg("position"), py::arg("yaw"), py::arg("tolerance") = 0.3,
           "Puts the agent on the mesh at `position` (metres), heading `yaw` (radians, left positive).")
      .def(
          "step", [](NavigationEnv& env, int action) { return env.step(action::to_action(action)); }, py::arg("action"),
          "Carries out one primitive; True if the pose changed.")
      .def_property_readonly(
          "position", [](const NavigationEnv& env) { return Eigen::Vector3d(env.position()); },
          "float64 [3] world metres, on the floor.")
      .def_property_readonly("yaw", &NavigationEnv::yaw, "Heading in radians, left positive.")
      .def_property_readonly("odometry", &NavigationEnv::odometry,
                             "float64 [3]: x forward, y left, azimuth, in the frame of the reset.")
      .def_property_readonly("T_world_camera",
                             [](const NavigationEnv& env) { return Eigen::Matrix4d(env.T_world_camera().matrix()); })
      .def_property_readonly("renderer", [](const NavigationEnv& env) { return env.world().renderer; })
      .def(
          "fork", [](const NavigationEnv& env) { return NavigationEnv(env); },
          "A copy that moves on its own in the same world.")
      .def(
          "camera_poses_after",
          [](const NavigationEnv& env, const py::object& actions) {
            return matrix_array(env.camera_poses_after(to_plan(to_array(actions))));
          },
          py::arg("actions"), "float64 [K, 4, 4]: camera poses after each of [K] integer primitives; nothing moves.")
      .def(
          "outlook", [](const NavigationEnv& env) { return Outlook{env}; },
          "What can be seen from here, to be drawn later; the environment may have moved on by then.")
      .def("observe", &draw, py::arg("outputs") = std::vector<std::string>{"panorama", "front"},
           "{name: array}: panorama uint8 [H, W, 3], front uint8 [h, w, 3], depth float32 [H, W] (distance along the "
           "ray), panorama_ids uint32 [H, W] and front_ids uint32 [h, w] (instances, 0 where nothing is hit).");

  py::class_<VectorEnv>(module, "VectorEnv")
      .def(py::init<std::vector<NavigationEnv>>(), py::arg("envs"))
      .def("__len__", &VectorEnv::size)
      .def("__getitem__", &VectorEnv::env, py::return_value_policy::reference_internal)
      .def("__setitem__", &VectorEnv::replace, "Puts a copy of another environment in a place.")
      .def(
          "step",
          [](VectorEnv& envs, const py::object& ids) {
            const std::vector<action::Action> actions = to_plan(to_array(ids));
            py::array_t<bool> moved(static_cast<py::ssize_t>(envs.size()));
            const std::span<bool> view(moved.mutable_data(), envs.size());
            {
              const wiw::bindings::GilRelease release;
              envs.step(actions, view);
            }
            return moved;
          },
          py::arg("actions"), "[N] integer primitives, one each; bool [N]: whose pose changed.")
      .def(
          "observe",
          [](VectorEnv& envs, const std::vector<std::string>& outputs) {
            Images images(envs.env(0).config(), outputs, static_cast<py::ssize_t>(envs.size()));
            {
              const wiw::bindings::GilRelease release;
              envs.observe(images.targets);
            }
            return images.arrays;
          },
          py::arg("outputs") = std::vector<std::string>{"panorama", "front"},
          "As NavigationEnv.observe, with [N] in front.");
}
