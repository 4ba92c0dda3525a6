// SPDX-License-Identifier: Apache-2.0
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <map>
#include <memory>

#include "actions.hpp"
#include "gil.hpp"
#include "wiw/planner/assemble.hpp"

namespace py = pybind11;
using namespace wiw;
using namespace wiw::planner;
using namespace wiw::bindings;

namespace {

using Bytes = Array<std::uint8_t>;

/// A batch, and which of its candidates' steps show the same.
struct BoundBatch {
  Batch batch;
  ViewIndex index;
};

template <class T>
T choose(const std::string& value, const std::map<std::string, T>& choices, const char* name) {
  const auto found = choices.find(value);
  if (found != choices.end()) return found->second;
  std::string names;
  for (const auto& [choice, _] : choices) names += (names.empty() ? "'" : ", '") + choice + "'";
  throw ArgumentError(std::string(name) + ": expected one of " + names + ", got '" + value + "'");
}

Plans plans_of(const py::sequence& episodes) {
  Plans plans;
  for (const py::handle& episode : episodes) {
    auto& candidates = plans.emplace_back();
    for (const py::handle& plan : py::reinterpret_borrow<py::sequence>(episode))
      candidates.push_back(to_plan(to_array(plan)));
  }
  return plans;
}

template <class T, class Items, class Get>
py::array_t<T> column(const Items& items, Get get) {
  py::array_t<T> array(static_cast<py::ssize_t>(items.size()));
  T* out = array.mutable_data();
  for (const auto& item : items) *out++ = static_cast<T>(get(item));
  return array;
}

py::array_t<std::int64_t> integers(const std::vector<int>& values) {
  return column<std::int64_t>(values, [](int value) { return value; });
}

/// Start of each row of a part as (part, index, frame) into the rollouts made so far.
py::array_t<std::int64_t> start_places(const Batch& batch, const ModelCall& part) {
  py::array_t<std::int64_t> array({static_cast<py::ssize_t>(part.start.size()), py::ssize_t{3}});
  std::int64_t* out = array.mutable_data();
  for (const Source& source : part.start) {
    const Batch::FrameAddress place = batch.place(source);
    *out++ = place.call;
    *out++ = place.index;
    *out++ = place.frame;
  }
  return array;
}

py::object part_object(const py::object& type, const Batch& batch, const ModelCall& part) {
  const auto rows = static_cast<py::ssize_t>(part.rows.size());
  const auto steps = static_cast<py::ssize_t>(part.steps);
  action::ActionSequence actions;
  std::vector<action::PlanarPose> trajectories;
  for (const action::ActionSequence& row : part.actions) {
    actions.insert(actions.end(), row.begin(), row.end());
    const auto trajectory = action::to_trajectory(row, batch.spec().space);
    trajectories.insert(trajectories.end(), trajectory.begin(), trajectory.end());
  }
  std::vector<Pose> viewpoints;
  viewpoints.reserve(trajectories.size());
  for (const action::PlanarPose& pose : trajectories) viewpoints.push_back(action::to_viewpoint(pose));
  return type(part.first, part.steps, integers(part.rows), to_ids(actions).reshape({rows, steps}),
              planar_array(trajectories).reshape({rows, steps, py::ssize_t{3}}),
              matrix_array(viewpoints).reshape({rows, steps, py::ssize_t{4}, py::ssize_t{4}}), integers(part.length),
              integers(part.shared), start_places(batch, part));
}

/// Images of the episodes with the arrays that keep them alive.
template <class T>
struct EpisodeArrays {
  std::vector<Array<T>> arrays;
  EpisodeImages<T> images;
};

template <class T>
Size image_size(const Array<T>& array, py::ssize_t channels, const std::string& expected) {
  const bool fits = channels ? array.ndim() == 3 && array.shape(2) == channels : array.ndim() == 2;
  if (!fits) throw ArgumentError("expected " + expected + ", got an episode's " + shape_text(array));
  return {static_cast<int>(array.shape(0)), static_cast<int>(array.shape(1))};
}

/// One array of all episodes, or an iterable of one each, none of which is copied. `channels`: 0 for [H, W].
template <class T>
EpisodeArrays<T> to_episode_images(const py::iterable& items, py::ssize_t channels, const std::string& expected) {
  EpisodeArrays<T> episodes;
  for (const py::handle& item : items) {
    if (!py::isinstance<py::array_t<T>>(item)) {
      throw ArgumentError("expected " + expected + ", got an episode's " + given_text(item));
    }
    const Array<T> array(py::reinterpret_borrow<py::object>(item));  // copied only where it is not dense
    const Size size = image_size(array, channels, expected);
    if (episodes.arrays.empty()) episodes.images.size = size;
    if (!(size == episodes.images.size)) throw ArgumentError("expected " + expected + ", got images of several sizes");
    episodes.images.images.push_back(array.data());
    episodes.arrays.push_back(array);
  }
  return episodes;
}

EpisodeArrays<std::uint8_t> to_panoramas(const py::iterable& items) {
  return to_episode_images<std::uint8_t>(items, 3, "panoramas uint8 [episodes, H, W, 3]");
}

/// The answers of a model with the arrays that keep them alive.
struct Answers {
  Imagination imagination;
  std::vector<py::array> arrays;
};

/// Dense images; the axes in front of them may have any stride, so broadcast and sliced batches are not copied.
bool has_dense_images(const py::array& rollout) {
  return rollout.strides(4) == 1 && rollout.strides(3) == 3 && rollout.strides(2) == 3 * rollout.shape(3);
}

Answers to_answers(const py::sequence& rollouts, const std::string& frames) {
  Answers answers;
  answers.imagination.kind = choose<FrameKind>(
      frames, {{"panorama", FrameKind::kPanorama}, {"perspective", FrameKind::kPerspective}}, "frames");
  constexpr const char* kExpected = "rollouts uint8 [rows, frames, H, W, 3], one array a part";
  for (const py::handle& item : rollouts) {
    auto array = py::reinterpret_borrow<py::array>(item);
    if (!py::isinstance<py::array_t<std::uint8_t>>(item)) {
      throw ArgumentError(std::string("expected ") + kExpected + ", got " + given_text(item));
    }
    expect_shape(array, {-1, -1, -1, -1, 3}, kExpected);
    if (!has_dense_images(array)) array = Bytes(array);
    answers.imagination.rollouts.push_back(
        {.data = static_cast<const std::uint8_t*>(array.data()),
         .rows = static_cast<std::size_t>(array.shape(0)),
         .frames = static_cast<std::size_t>(array.shape(1)),
         .size = {static_cast<int>(array.shape(2)), static_cast<int>(array.shape(3))},
         .row_stride = array.strides(0),
         .frame_stride = array.strides(1)});
    answers.arrays.push_back(std::move(array));
  }
  return answers;
}

std::vector<py::ssize_t> with_view_shape(std::vector<py::ssize_t> shape, const ViewMaker& maker) {
  if (maker.count() > 1) shape.push_back(maker.count());
  shape.insert(shape.end(), {maker.spec().size.height, maker.spec().size.width, 3});
  return shape;
}

/// `out` if given and fitting, else a new array.
py::array_t<std::uint8_t> output(const std::optional<py::array>& out, const std::vector<py::ssize_t>& shape) {
  if (!out) return py::array_t<std::uint8_t>(shape);
  const bool fits = py::isinstance<py::array_t<std::uint8_t, py::array::c_style>>(*out) && out->writeable() &&
                    std::vector<py::ssize_t>(out->shape(), out->shape() + out->ndim()) == shape;
  if (!fits) {
    std::string wanted;
    for (const py::ssize_t length : shape) {
      if (!wanted.empty()) wanted += ", ";
      wanted += std::to_string(length);
    }
    throw ArgumentError("out: expected a writeable C-contiguous uint8 array [" + wanted + "], got " + shape_text(*out));
  }
  return py::reinterpret_borrow<py::array_t<std::uint8_t>>(*out);
}

using MakeViews = void (*)(const Batch&, const ViewIndex&, const Panoramas&, const Imagination&, const ViewMaker&,
                           std::uint8_t*);

py::array_t<std::uint8_t> views(const BoundBatch& self, const py::iterable& panoramas, const py::sequence& rollouts,
                                const ViewMaker& maker, const std::string& frames, const std::optional<py::array>& out,
                                bool dense) {
  const auto real = to_panoramas(panoramas);
  const Answers answers = to_answers(rollouts, frames);
  const auto steps = static_cast<py::ssize_t>(self.index.steps);
  const auto shape = dense ? with_view_shape({static_cast<py::ssize_t>(self.batch.candidates()), steps}, maker)
                           : with_view_shape({static_cast<py::ssize_t>(self.index.distinct.size())}, maker);
  py::array_t<std::uint8_t> images = output(out, shape);
  const MakeViews make = dense ? &make_dense_views : &make_views;
  std::uint8_t* pixels = images.mutable_data();
  const wiw::bindings::GilRelease release;
  make(self.batch, self.index, real.images, answers.imagination, maker, pixels);
  return images;
}

py::array_t<std::uint8_t> ends(const BoundBatch& self, const Array<std::int64_t>& candidates,
                               const py::iterable& panoramas, const py::sequence& rollouts, const ViewMaker& maker,
                               const std::string& frames) {
  expect_shape(candidates, {-1}, "candidates int64 [n]");
  const auto real = to_panoramas(panoramas);
  const Answers answers = to_answers(rollouts, frames);
  const ViewIndex index =
      index_ends(self.batch, std::span(candidates.data(), static_cast<std::size_t>(candidates.size())));
  py::array_t<std::uint8_t> images(with_view_shape({candidates.size()}, maker));
  std::uint8_t* pixels = images.mutable_data();
  const wiw::bindings::GilRelease release;
  make_views(self.batch, index, real.images, answers.imagination, maker, pixels);
  return images;
}

void expect_episodes(const Batch& batch, std::size_t count) {
  for (const Row& row : batch.rows()) {
    if (static_cast<std::size_t>(row.episode) >= count) {
      throw ArgumentError("expected one panorama an episode, got " + std::to_string(count) + " and plans for episode " +
                          std::to_string(row.episode));
    }
  }
}

py::array_t<std::uint8_t> observations(const BoundBatch& self, const py::iterable& panoramas, const ViewMaker& maker) {
  const auto real = to_panoramas(panoramas);
  expect_episodes(self.batch, real.arrays.size());
  py::array_t<std::uint8_t> images(with_view_shape({static_cast<py::ssize_t>(self.batch.rows().size())}, maker));
  std::uint8_t* pixels = images.mutable_data();
  const wiw::bindings::GilRelease release;
  make_observations(self.batch, real.images, maker, pixels);
  return images;
}

py::array_t<float> depths(const BoundBatch& self, const py::iterable& distances, const ViewMaker& maker) {
  const auto real = to_episode_images<float>(distances, 0, "distances float32 [episodes, H, W]");
  expect_episodes(self.batch, real.arrays.size());
  py::array_t<float> images({static_cast<py::ssize_t>(self.batch.rows().size()),
                             static_cast<py::ssize_t>(maker.spec().size.height),
                             static_cast<py::ssize_t>(maker.spec().size.width)});
  float* pixels = images.mutable_data();
  const wiw::bindings::GilRelease release;
  make_depths(self.batch, real.images, maker, pixels);
  return images;
}

py::array_t<std::int32_t> view_index(const BoundBatch& self) {
  py::array_t<std::int32_t> array(
      {static_cast<py::ssize_t>(self.batch.candidates()), static_cast<py::ssize_t>(self.index.steps)});
  std::copy(self.index.cells.begin(), self.index.cells.end(), array.mutable_data());
  return array;
}

py::array_t<bool> real_steps(const BoundBatch& self) {
  py::array_t<bool> array(
      {static_cast<py::ssize_t>(self.batch.candidates()), static_cast<py::ssize_t>(self.index.steps)});
  std::transform(self.index.cells.begin(), self.index.cells.end(), array.mutable_data(), [&](int view) {
    return view >= 0 && self.index.distinct[static_cast<std::size_t>(view)].source.row < 0;
  });
  return array;
}

py::array_t<std::int64_t> owners(const Batch& batch) {
  std::vector<std::int64_t> first;  // of each episode's candidates
  const auto& episodes = batch.episodes();
  for (std::size_t i = 0; i < episodes.size(); ++i) {
    while (first.size() <= static_cast<std::size_t>(episodes[i])) first.push_back(static_cast<std::int64_t>(i));
  }
  return column<std::int64_t>(
      batch.rows(), [&](const Row& row) { return first[static_cast<std::size_t>(row.episode)] + row.candidate; });
}

void bind_spec(py::module_& module) {
  py::class_<ModelSpec>(module, "ModelSpec", "What the planner has to know about a world model.")
      .def(py::init([](bool causal, int frames, const std::string& padding, const std::string& leading, int max_rows,
                       const action::ActionSpace& space, bool ends) {
             ModelSpec spec{
                 .causal = causal,
                 .frames = frames,
                 .padding = action::to_padding(padding),
                 .leading = choose<Leading>(
                     leading,
                     {{"none", Leading::kNone}, {"same_direction", Leading::kSameDirection}, {"any", Leading::kAny}},
                     "leading"),
                 .max_rows = max_rows,
                 .ends = ends,
                 .space = space};
             spec.check();
             return spec;
           }),
           py::arg("causal") = false, py::arg("frames") = 0, py::arg("padding") = "forward",
           py::arg("leading") = "same_direction", py::arg("max_rows") = 0, py::arg("space") = action::ActionSpace{},
           py::arg("ends") = false,
           "frames: length of a rollout with the observation, 0 any. leading: turns answered by the real panorama, "
           "'same_direction' (up to the first forward or reversing turn), 'any' or 'none'. max_rows: rows a call, 0 "
           "any. ends: of each plan only the last observation is read, and is its only step.")
      .def_readonly("causal", &ModelSpec::causal)
      .def_readonly("frames", &ModelSpec::frames)
      .def_readonly("max_rows", &ModelSpec::max_rows)
      .def_readonly("ends", &ModelSpec::ends)
      .def_readonly("space", &ModelSpec::space);
}

void bind_views(py::module_& module) {
  py::class_<ViewMaker>(module, "ViewMaker",
                        "Turns panoramas and frames into views; make it once, it keeps its tables. view: 'front', "
                        "'surround' (front, left, right, back) or 'panorama'; size (height, width).")
      .def(py::init([](const std::string& view, std::pair<int, int> size, double hfov_deg) {
             const auto kind = choose<ViewKind>(
                 view,
                 {{"front", ViewKind::kFront}, {"surround", ViewKind::kSurround}, {"panorama", ViewKind::kPanorama}},
                 "view");
             return std::make_unique<ViewMaker>(
                 ViewSpec{.kind = kind, .size = {size.first, size.second}, .hfov = radians(hfov_deg)});
           }),
           py::arg("view") = "front", py::arg("size") = std::pair<int, int>{384, 384}, py::arg("hfov_deg") = 90.0)
      .def_property_readonly(
          "size",
          [](const ViewMaker& maker) { return py::make_tuple(maker.spec().size.height, maker.spec().size.width); })
      .def_property_readonly("count", &ViewMaker::count, "Views an observation: 4 for 'surround', else 1.");
}

void bind_batch(py::module_& module) {
  module.attr("Part") =
      py::module_::import("collections")
          .attr("namedtuple")("Part", "first steps rows actions trajectories viewpoints length shared start",
                              py::arg("module") = module.attr("__name__"));
  module.attr("Part").attr("__doc__") =
      "One rectangular call of the model. rows int64 [r] index the batch's rows; first: frame of the rows the call "
      "begins "
      "at; actions int8 [r, steps] padded, trajectories float64 [r, steps, 3] and viewpoints [r, steps, 4, 4] from the "
      "call's start; length int64 [r] of own actions; shared int64 [r] leading frames an earlier row of the call "
      "answers; "
      "start int64 [r, 3] (part, index, frame) of the frame a later call begins with, empty where first is 0.";
  py::class_<BoundBatch>(module, "Batch", "The smallest set of rollouts that answers all candidates of one decision.")
      .def_static(
          "build",
          [](const py::sequence& plans, const ModelSpec& spec) {
            const Plans candidates = plans_of(plans);
            const wiw::bindings::GilRelease release;
            Batch batch(candidates, spec);
            ViewIndex index = index_views(batch);
            return BoundBatch{std::move(batch), std::move(index)};
          },
          py::arg("plans"), py::arg("spec") = ModelSpec{}, "plans[episode][candidate]: action ids [K].")
      .def_property_readonly("candidates", [](const BoundBatch& self) { return self.batch.candidates(); })
      .def_property_readonly("rows", [](const BoundBatch& self) { return self.batch.rows().size(); })
      .def_property_readonly("candidate_episode",
                             [](const BoundBatch& self) { return integers(self.batch.episodes()); })
      .def_property_readonly("lengths",
                             [](const BoundBatch& self) {
                               std::vector<int> lengths(self.batch.candidates());
                               for (std::size_t i = 0; i < lengths.size(); ++i) {
                                 lengths[i] = static_cast<int>(self.batch.sources(i).size());
                               }
                               return integers(lengths);
                             })
      .def_property_readonly("row_episode",
                             [](const BoundBatch& self) {
                               return column<std::int64_t>(self.batch.rows(),
                                                           [](const Row& row) { return row.episode; });
                             })
      .def_property_readonly(
          "row_owner", [](const BoundBatch& self) { return owners(self.batch); },
          "Candidate (counted over all episodes) whose seed the row uses.")
      .def_property_readonly(
          "row_turns",
          [](const BoundBatch& self) {
            return column<std::int64_t>(self.batch.rows(), [](const Row& row) { return row.turns; });
          },
          "Left turns between the real panorama and the row's observation.")
      .def_property_readonly("row_length",
                             [](const BoundBatch& self) {
                               return column<std::int64_t>(self.batch.rows(),
                                                           [](const Row& row) { return row.actions.size(); });
                             })
      .def_property_readonly("row_parent",
                             [](const BoundBatch& self) {
                               return column<std::int64_t>(self.batch.rows(),
                                                           [](const Row& row) { return row.parent; });
                             })
      .def_property_readonly("row_shared",
                             [](const BoundBatch& self) {
                               return column<std::int64_t>(self.batch.rows(),
                                                           [](const Row& row) { return row.shared; });
                             })
      .def_property_readonly(
          "parts",
          [type = py::object(module.attr("Part"))](const BoundBatch& self) {
            py::list parts;
            for (const ModelCall& part : self.batch.calls()) {
              parts.append(part_object(type, self.batch, part));
            }
            return parts;
          },
          "Calls to make, in this order; see Part.")
      .def_property_readonly("view_index", &view_index,
                             "int32 [candidates, steps]: which distinct observation a step shows, -1 behind the plan.")
      .def_property_readonly("real", &real_steps, "bool [candidates, steps]: shown by the real panorama.")
      .def("observations", &observations, py::arg("panoramas"), py::arg("maker"),
           "uint8 [rows, (4,) h, w, 3]: what each row begins with, the real panorama after its leading turns. "
           "panoramas: "
           "one array [episodes, H, W, 3], or one [H, W, 3] an episode, which saves a copy; likewise below.")
      .def(
          "depths", &depths, py::arg("distances"), py::arg("maker"),
          "float32 [rows, h, w] of distances float32 [episodes, H, W]: planar z in perspective, distance in panoramas.")
      .def(
          "views",
          [](const BoundBatch& self, const py::iterable& panoramas, const py::sequence& rollouts,
             const ViewMaker& maker, const std::string& frames, const std::optional<py::array>& out) {
            return views(self, panoramas, rollouts, maker, frames, out, true);
          },
          py::arg("panoramas"), py::arg("rollouts"), py::arg("maker"), py::arg("frames") = "panorama",
          py::arg("out") = py::none(),
          "uint8 [candidates, steps, (4,) h, w, 3], zeros behind a plan's end. rollouts: one uint8 [r, steps + 1, H, "
          "W, 3] "
          "a part; frames: 'panorama' or 'perspective'.")
      .def(
          "distinct_views",
          [](const BoundBatch& self, const py::iterable& panoramas, const py::sequence& rollouts,
             const ViewMaker& maker, const std::string& frames, const std::optional<py::array>& out) {
            return views(self, panoramas, rollouts, maker, frames, out, false);
          },
          py::arg("panoramas"), py::arg("rollouts"), py::arg("maker"), py::arg("frames") = "panorama",
          py::arg("out") = py::none(), "uint8 [distinct, (4,) h, w, 3], to be looked up by view_index.")
      .def("ends", &ends, py::arg("candidates"), py::arg("panoramas"), py::arg("rollouts"), py::arg("maker"),
           py::arg("frames") = "panorama",
           "uint8 [n, (4,) h, w, 3]: what each of the named candidates (counted over all episodes) ends with.");
}

}  // namespace

void bind_planner(py::module_& module) {
  bind_spec(module);
  bind_views(module);
  bind_batch(module);
}
