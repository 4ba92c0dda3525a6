// SPDX-License-Identifier: Apache-2.0
#include <pybind11/eigen.h>
#include <pybind11/native_enum.h>
#include <pybind11/operators.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "actions.hpp"
#include "wiw/action/length.hpp"
#include "wiw/action/resample.hpp"
#include "wiw/action/text.hpp"
#include "wiw/action/vocabulary.hpp"

namespace py = pybind11;
using namespace wiw;
using namespace wiw::action;
using namespace wiw::bindings;

namespace {

std::vector<PlanarPose> to_planar(const Array<double>& array) {
  expect_shape(array, {-1, 3}, "poses [K, 3] (x, y, azimuth)");
  std::vector<PlanarPose> poses;
  for (const double* p = array.data(); p != array.data() + array.size(); p += 3) poses.push_back({p[0], p[1], p[2]});
  return poses;
}

std::vector<GripperPose> to_gripper(const Array<double>& array) {
  expect_shape(array, {-1, 7}, "poses [K, 7] (x, y, z, roll, pitch, yaw, gripper)");
  std::vector<GripperPose> poses;
  for (const double* p = array.data(); p != array.data() + array.size(); p += 7) {
    poses.push_back({{p[0], p[1], p[2]}, {p[3], p[4], p[5]}, p[6]});
  }
  return poses;
}

py::array_t<double> gripper_array(std::span<const GripperPose> poses) {
  py::array_t<double> array({static_cast<py::ssize_t>(poses.size()), py::ssize_t{7}});
  double* out = array.mutable_data();
  for (const GripperPose& pose : poses) {
    out = std::copy(pose.position.begin(), pose.position.end(), out);
    out = std::copy(pose.rpy.begin(), pose.rpy.end(), out);
    *out++ = pose.gripper;
  }
  return array;
}

/// The trajectory of each plan of a batch [..., K], with the start in front where asked for.
std::vector<PlanarPose> trajectories(const ActionArray& actions, const ActionSpace& space, bool start) {
  const auto length = static_cast<std::size_t>(actions.shape.back());
  std::size_t plans = 1;
  for (std::size_t axis = 0; axis + 1 < actions.shape.size(); ++axis) {
    plans *= static_cast<std::size_t>(actions.shape[axis]);
  }
  std::vector<PlanarPose> poses;
  for (std::size_t i = 0; i < plans; ++i) {
    if (start) poses.emplace_back();
    const auto path = to_trajectory(std::span(actions.values).subspan(i * length, length), space);
    poses.insert(poses.end(), path.begin(), path.end());
  }
  return poses;
}

std::vector<py::ssize_t> batch_shape(const ActionArray& actions, bool start, std::initializer_list<py::ssize_t> tail) {
  std::vector<py::ssize_t> shape = actions.shape;
  shape.back() += start ? 1 : 0;
  shape.insert(shape.end(), tail);
  return shape;
}

ActionArray to_batch(const py::array& ids) {
  ActionArray actions = to_actions(ids);
  if (actions.shape.empty()) throw ArgumentError("expected action ids [K] or [..., K], got " + shape_text(ids));
  return actions;
}

template <class T>
std::optional<T> single(const std::optional<std::vector<T>>& poses) {
  if (!poses) return std::nullopt;
  if (poses->size() != 1) throw ArgumentError("start: expected one pose, got " + std::to_string(poses->size()));
  return poses->front();
}

std::map<Action, std::string> phrases_of(const TextTemplate& words) {
  std::map<Action, std::string> phrases;
  for (int id = 0; id < kActionCount; ++id) {
    phrases[static_cast<Action>(id)] = words.phrases[static_cast<std::size_t>(id)];
  }
  return phrases;
}

void bind_spaces(py::module_& module) {
  py::native_enum<Action>(module, "Action", "enum.IntEnum", "Navigation primitives.")
      .value("NULL", Action::kNull)
      .value("FORWARD", Action::kForward)
      .value("TURN_LEFT", Action::kTurnLeft)
      .value("TURN_RIGHT", Action::kTurnRight)
      .value("STOP", Action::kStop)
      .finalize();
  py::class_<ActionSpace>(module, "ActionSpace", "How far one primitive moves: metres forward, degrees a turn.")
      .def(py::init([](double forward_m, double turn_deg) {
             ActionSpace space{.forward_m = forward_m, .turn_rad = radians(turn_deg)};
             space.check();
             return space;
           }),
           py::arg("forward_m") = 0.2, py::arg("turn_deg") = 22.5)
      .def_readonly("forward_m", &ActionSpace::forward_m)
      .def_property_readonly("turn_deg", [](const ActionSpace& space) { return degrees(space.turn_rad); })
      .def_readonly("turn_rad", &ActionSpace::turn_rad)
      .def(
          "__eq__", [](const ActionSpace& a, const ActionSpace& b) { return a == b; }, py::is_operator())
      .def("__hash__",
           [](const ActionSpace& space) { return py::hash(py::make_tuple(space.forward_m, space.turn_rad)); })
      .def(py::pickle([](const ActionSpace& space) { return py::make_tuple(space.forward_m, space.turn_rad); },
                      [](const py::tuple& state) {
                        return ActionSpace{.forward_m = state[0].cast<double>(), .turn_rad = state[1].cast<double>()};
                      }))
      .def("__repr__", [](const ActionSpace& space) {
        return py::str("ActionSpace(forward_m={:g}, turn_deg={:g})").format(space.forward_m, degrees(space.turn_rad));
      });
}

void bind_text(py::module_& module) {
  py::class_<TextTemplate>(
      module, "TextTemplate",
      "Words for a navigation plan. `prompt` holds {actions}; a phrase may hold {metres}, {degrees}, "
      "{count}; phrases not given keep their default.")
      .def(py::init([](std::optional<std::string> prompt, const std::map<Action, std::string>& phrases,
                       std::optional<std::string> separator, bool merge_runs) {
             TextTemplate words;
             if (prompt) words.prompt = *prompt;
             if (separator) words.separator = *separator;
             for (const auto& [action, phrase] : phrases) words.phrases[static_cast<std::size_t>(action)] = phrase;
             words.merge_runs = merge_runs;
             return words;
           }),
           py::arg("prompt") = py::none(), py::arg("phrases") = py::dict(), py::arg("separator") = py::none(),
           py::arg("merge_runs") = false)
      .def_readonly("prompt", &TextTemplate::prompt)
      .def_property_readonly("phrases", &phrases_of)
      .def_readonly("separator", &TextTemplate::separator)
      .def_readonly("merge_runs", &TextTemplate::merge_runs)
      .def(py::self == py::self)
      .def("__hash__", [](const TextTemplate& words) { return py::hash(py::str(words.prompt)); })
      .def("__repr__",
           [](const TextTemplate& words) {
             return py::str("TextTemplate(prompt={!r}, phrases={!r}, separator={!r}, merge_runs={!r})")
                 .format(words.prompt, phrases_of(words), words.separator, words.merge_runs);
           })
      .def(py::pickle(
          [](const TextTemplate& words) {
            return py::make_tuple(words.prompt, words.phrases, words.separator, words.merge_runs);
          },
          [](const py::tuple& state) {
            return TextTemplate{state[0].cast<std::string>(), state[1].cast<decltype(TextTemplate::phrases)>(),
                                state[2].cast<std::string>(), state[3].cast<bool>()};
          }));
  py::class_<GripperTextTemplate>(
      module, "GripperTextTemplate",
      "Words for a plan of 7-DoF poses. `prompt` holds {actions}; `phrase` may hold {x} {y} {z} "
      "(metres), {roll} {pitch} {yaw} (degrees) and {gripper}.")
      .def(py::init([](std::optional<std::string> prompt, std::optional<std::string> phrase,
                       std::optional<std::string> separator) {
             GripperTextTemplate words;
             if (prompt) words.prompt = *prompt;
             if (phrase) words.phrase = *phrase;
             if (separator) words.separator = *separator;
             return words;
           }),
           py::arg("prompt") = py::none(), py::arg("phrase") = py::none(), py::arg("separator") = py::none())
      .def_readonly("prompt", &GripperTextTemplate::prompt)
      .def_readonly("phrase", &GripperTextTemplate::phrase)
      .def_readonly("separator", &GripperTextTemplate::separator)
      .def(py::self == py::self)
      .def("__hash__", [](const GripperTextTemplate& words) { return py::hash(py::str(words.prompt)); })
      .def("__repr__",
           [](const GripperTextTemplate& words) {
             return py::str("GripperTextTemplate(prompt={!r}, phrase={!r}, separator={!r})")
                 .format(words.prompt, words.phrase, words.separator);
           })
      .def(py::pickle(
          [](const GripperTextTemplate& words) { return py::make_tuple(words.prompt, words.phrase, words.separator); },
          [](const py::tuple& state) {
            return GripperTextTemplate{state[0].cast<std::string>(), state[1].cast<std::string>(),
                                       state[2].cast<std::string>()};
          }));
  module.def(
      "to_text",
      [](const py::array& actions, const TextTemplate& words, const ActionSpace& space) {
        return to_text(to_plan(actions), words, space);
      },
      py::arg("actions"), py::arg("template"), py::arg("space"), "Prompt for one plan of ids [K].");
  module.def(
      "gripper_to_text",
      [](const Array<double>& poses, const GripperTextTemplate& words) { return to_text(to_gripper(poses), words); },
      py::arg("poses"), py::arg("template"), "Prompt for one plan of poses [K, 7].");
}

void bind_controls(py::module_& module) {
  module.def(
      "to_trajectory",
      [](const py::array& ids, const ActionSpace& space, bool start) {
        const ActionArray actions = to_batch(ids);
        return planar_array(trajectories(actions, space, start)).reshape(batch_shape(actions, start, {3}));
      },
      py::arg("actions"), py::arg("space"), py::arg("include_start"), "float64 [..., K, 3].");
  module.def(
      "to_viewpoints",
      [](const py::array& ids, const ActionSpace& space, bool start) {
        const ActionArray actions = to_batch(ids);
        std::vector<Pose> poses;
        for (const PlanarPose& pose : trajectories(actions, space, start)) poses.push_back(to_viewpoint(pose));
        return matrix_array(poses).reshape(batch_shape(actions, start, {4, 4}));
      },
      py::arg("actions"), py::arg("space"), py::arg("include_start"), "float64 [..., K, 4, 4] T_start_camera.");
  module.def(
      "encode",
      [](const py::array& ids, const std::map<Action, std::vector<double>>& vocabulary) {
        const ActionArray actions = to_batch(ids);
        const Vocabulary words(vocabulary);
        const std::vector<double> values = words.encode(actions.values);
        py::array_t<double> array(static_cast<py::ssize_t>(values.size()), values.data());
        return array.reshape(batch_shape(actions, false, {static_cast<py::ssize_t>(words.width())}));
      },
      py::arg("actions"), py::arg("vocabulary"), "float64 [..., K, width] in a model's own numbers.");
  py::native_enum<RotationCode>(module, "RotationCode", "enum.Enum", "Rotation as numbers.")
      .value("EULER", RotationCode::kEuler)
      .value("SIN_COS", RotationCode::kSinCos)
      .value("MATRIX_6D", RotationCode::kMatrix6d)
      .value("QUATERNION_WXYZ", RotationCode::kQuaternionWxyz)
      .value("QUATERNION_XYZW", RotationCode::kQuaternionXyzw)
      .finalize();
  module.def(
      "encode_gripper",
      [](const Array<double>& poses, RotationCode rotation, std::optional<std::array<Eigen::Vector3d, 2>> bounds) {
        GripperVocabulary words{.rotation = rotation};
        if (bounds) words.bounds.emplace((*bounds)[0], (*bounds)[1]);
        words.check();
        std::vector<double> values;
        const auto plan = to_gripper(poses);
        for (const GripperPose& pose : plan) words.encode(pose, values);
        py::array_t<double> array({static_cast<py::ssize_t>(plan.size()), static_cast<py::ssize_t>(words.width())});
        std::copy(values.begin(), values.end(), array.mutable_data());
        return array;
      },
      py::arg("poses"), py::arg("rotation"), py::arg("bounds"), "float64 [K, width].");
}

void bind_lengths(py::module_& module) {
  py::native_enum<Padding>(module, "Padding", "enum.Enum", "What fills a short discrete plan.")
      .value("FORWARD", Padding::kForward)
      .value("REPEAT", Padding::kRepeat)
      .value("NULL", Padding::kNull)
      .finalize();
  module.def("to_padding", &to_padding, py::arg("name"));
  module.def(
      "pad",
      [](const py::array& actions, std::size_t length, const std::string& padding) {
        return to_ids(pad(to_plan(actions), length, to_padding(padding)));
      },
      py::arg("actions"), py::arg("length"), py::arg("padding"), "int8 [length].");
  module.def(
      "chunk",
      [](const py::array& actions, std::size_t length, const std::string& padding) {
        const auto pieces = chunk(to_plan(actions), length, to_padding(padding));
        py::array_t<std::int8_t> array({static_cast<py::ssize_t>(pieces.size()), static_cast<py::ssize_t>(length)});
        auto* out = array.mutable_data();
        for (const ActionSequence& piece : pieces) {
          out = std::transform(piece.begin(), piece.end(), out, [](Action a) { return static_cast<std::int8_t>(a); });
        }
        return array;
      },
      py::arg("actions"), py::arg("length"), py::arg("padding"), "int8 [chunks, length].");
  module.def(
      "frames_of_actions",
      [](std::size_t count, std::size_t frames, const std::string& fit) {
        const std::map<std::string, Fit> fits = {
            {"pad", Fit::kPad}, {"resample", Fit::kResample}, {"chunk", Fit::kChunk}};
        const auto chosen = fits.find(fit);
        if (chosen == fits.end()) throw ArgumentError("fit: expected 'pad', 'resample' or 'chunk', got '" + fit + "'");
        const auto found = frames_of_actions(count, frames, chosen->second);
        py::array_t<std::int64_t> array({static_cast<py::ssize_t>(count), py::ssize_t{2}});
        auto* out = array.mutable_data();
        for (const FrameIndex& index : found) {
          *out++ = index.chunk;
          *out++ = index.frame;
        }
        return array;
      },
      py::arg("count"), py::arg("frames"), py::arg("fit"), "int64 [count, 2]: chunk and frame.");
}

void bind_resample(py::module_& module) {
  module.def(
      "resample_planar",
      [](const Array<double>& poses, std::size_t length, const std::optional<Array<double>>& start) {
        const auto first = start ? std::optional(to_planar(*start)) : std::nullopt;
        return planar_array(resample(to_planar(poses), length, single(first)));
      },
      py::arg("poses"), py::arg("length"), py::arg("start"), "float64 [length, 3].");
  module.def(
      "resample_gripper",
      [](const Array<double>& poses, std::size_t length, const std::optional<Array<double>>& start,
         const std::string& gripper) {
        if (gripper != "step" && gripper != "nearest") {
          throw ArgumentError("gripper: expected 'step' or 'nearest', got '" + gripper + "'");
        }
        const auto rule = gripper == "step" ? GripperRule::kStep : GripperRule::kNearest;
        const auto first = start ? std::optional(to_gripper(*start)) : std::nullopt;
        return gripper_array(resample(to_gripper(poses), length, single(first), rule));
      },
      py::arg("poses"), py::arg("length"), py::arg("start"), py::arg("gripper"), "float64 [length, 7].");
  module.def(
      "resample_viewpoints",
      [](const Array<double>& poses, std::size_t length, const std::optional<Array<double>>& start) {
        const auto first = start ? std::optional(to_poses(*start, "start")) : std::nullopt;
        return matrix_array(resample(to_poses(poses, "poses"), length, single(first)));
      },
      py::arg("poses"), py::arg("length"), py::arg("start"), "float64 [length, 4, 4].");
}

}  // namespace

void bind_action(py::module_& module) {
  bind_spaces(module);
  bind_text(module);
  bind_controls(module);
  bind_lengths(module);
  bind_resample(module);
}
