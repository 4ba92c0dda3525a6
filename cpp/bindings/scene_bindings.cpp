// SPDX-License-Identifier: Apache-2.0
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>
#include <pybind11/stl/filesystem.h>

#include <algorithm>
#include <cstring>
#include <limits>
#include <new>
#include <optional>

#include "arrays.hpp"
#include "gil.hpp"
#include "scene_builder.hpp"
#include "wiw/scene/cache.hpp"
#include "wiw/scene/describe.hpp"
#include "wiw/scene/import.hpp"
#include "wiw/scene/import/ply_surface.hpp"
#include "wiw/scene/measure.hpp"
#include "wiw/scene/sdf.hpp"

namespace py = pybind11;

namespace {

using wiw::scene::Scene;
using wiw::scene::ScenePtr;

template <class T, int N>
py::array_t<T> rows_to_array(const std::vector<Eigen::Matrix<T, N, 1>>& rows) {
  py::array_t<T> array({static_cast<py::ssize_t>(rows.size()), static_cast<py::ssize_t>(N)});
  if (!rows.empty()) std::memcpy(array.mutable_data(), rows.data(), rows.size() * sizeof(rows[0]));
  return array;
}

/// NaN for a box around nothing.
py::array_t<float> box_to_array(const Eigen::AlignedBox3f& box) {
  constexpr float kNone = std::numeric_limits<float>::quiet_NaN();
  py::array_t<float> array({2, 3});
  for (int axis = 0; axis < 3; ++axis) {
    array.mutable_at(0, axis) = box.isEmpty() ? kNone : box.min()[axis];
    array.mutable_at(1, axis) = box.isEmpty() ? kNone : box.max()[axis];
  }
  return array;
}

py::array_t<float> matrix_to_array(const Eigen::Matrix4f& matrix) {
  py::array_t<float> array({4, 4});
  for (int row = 0; row < 4; ++row) {
    for (int column = 0; column < 4; ++column) array.mutable_at(row, column) = matrix(row, column);
  }
  return array;
}

py::dict instance_to_dict(const Scene& scene, const wiw::scene::Instance& instance, const Eigen::AlignedBox3f& bounds) {
  std::size_t triangles = 0;
  for (const std::uint32_t mesh : instance.meshes) triangles += scene.meshes[mesh].triangles.size();
  py::dict result;
  result["id"] = instance.id;
  result["name"] = instance.name;
  result["category"] = instance.category == wiw::scene::kNone ? std::string() : scene.categories[instance.category];
  result["attributes"] = instance.attributes;
  result["T_world_instance"] = matrix_to_array(instance.T_world_instance.matrix());
  result["bounds"] = box_to_array(bounds);
  result["triangle_count"] = triangles;
  return result;
}

py::list instances_to_list(const Scene& scene) {
  std::vector<Eigen::AlignedBox3f> bounds;
  {
    const wiw::bindings::GilRelease release;  // every vertex is looked at
    for (const wiw::scene::Instance& instance : scene.instances) {
      bounds.push_back(wiw::scene::instance_bounds(scene, instance));
    }
  }
  py::list result;
  for (std::size_t i = 0; i < bounds.size(); ++i) result.append(instance_to_dict(scene, scene.instances[i], bounds[i]));
  return result;
}

py::list rooms_to_list(const Scene& scene) {
  py::list result;
  for (const wiw::scene::Room& room : scene.rooms) {
    py::dict entry;
    entry["name"] = room.name;
    entry["type"] = room.type;
    entry["bounds"] = box_to_array(room.bounds);
    result.append(entry);
  }
  return result;
}

py::object sun_to_dict(const Scene& scene) {
  if (!scene.sun) return py::none();
  py::dict result;
  result["direction"] = py::make_tuple(scene.sun->direction.x(), scene.sun->direction.y(), scene.sun->direction.z());
  result["strength"] = scene.sun->strength;
  result["ambient"] = scene.sun->ambient;
  return result;
}

py::tuple triangles_to_arrays(const Scene& scene) {
  wiw::scene::TriangleSoup soup;
  {
    const wiw::bindings::GilRelease release;
    soup = wiw::scene::world_triangles(scene);
  }
  py::array_t<std::uint32_t> instance(static_cast<py::ssize_t>(soup.instance.size()));
  std::ranges::copy(soup.instance, instance.mutable_data());
  return py::make_tuple(rows_to_array(soup.vertices), rows_to_array(soup.triangles), instance);
}

wiw::scene::Up up_from_text(const std::optional<std::string>& up) {
  if (!up || *up == "auto") return wiw::scene::Up::kAuto;
  if (*up == "y") return wiw::scene::Up::kY;
  if (*up == "z") return wiw::scene::Up::kZ;
  throw wiw::ArgumentError("up must be 'auto', 'y' or 'z', got '" + *up + "'");
}

void set_limits(const py::dict& values, wiw::scene::ImportLimits& limits) {
  for (const auto& [key, value] : values) {
    const auto name = key.cast<std::string>();
    const auto figure = value.cast<std::size_t>();
    if (name == "file_bytes")
      limits.file_bytes = figure;
    else if (name == "triangles")
      limits.triangles = figure;
    else if (name == "nodes")
      limits.nodes = figure;
    else if (name == "texture_pixels")
      limits.texture_pixels = figure;
    else if (name == "texture_bytes")
      limits.texture_bytes = figure;
    else
      throw wiw::ArgumentError("'" + name +
                               "' is no limit; expected file_bytes, triangles, nodes, texture_pixels or texture_bytes");
  }
}

/// Calls `decode` with the bytes of an image; called from any thread, without the interpreter's lock.
wiw::scene::BasisDecoder basis_decoder(const py::function& decode) {
  return [&decode](std::span<const std::uint8_t> bytes) {
    const py::gil_scoped_acquire lock;
    try {
      const auto image = decode(py::bytes(reinterpret_cast<const char*>(bytes.data()), bytes.size()))
                             .cast<wiw::bindings::Array<std::uint8_t>>();
      wiw::bindings::expect_shape(image, {-1, -1, 4}, "a decoded image uint8 [H, W, 4]");
      const wiw::Size size{static_cast<int>(image.shape(0)), static_cast<int>(image.shape(1))};
      std::vector<std::uint8_t> rgba(image.data(), image.data() + image.size());
      return wiw::scene::Texture{"", size, std::move(rgba), {}};
    } catch (py::error_already_set& error) {
      if (error.matches(PyExc_MemoryError)) throw std::bad_alloc();
      throw wiw::Error("cannot be decoded as Basis Universal (" + std::string(py::str(error.value())) + ")");
    }
  };
}

using Paths = std::vector<std::filesystem::path>;

py::tuple import_scene(const std::filesystem::path& path, const std::optional<std::string>& up,
                       const std::optional<float> ceiling, const py::dict& limits, const Paths& texture_folders,
                       const Paths& model_folders, const std::optional<py::function>& decode_basis) {
  wiw::scene::ImportTrace trace;
  wiw::scene::ImportOptions options;
  options.up = up_from_text(up);
  options.ceiling_height = ceiling;
  options.texture_folders = texture_folders;
  options.model_folders = model_folders;
  options.trace = &trace;
  if (decode_basis) options.decode_basis = basis_decoder(*decode_basis);
  set_limits(limits, options.limits);
  ScenePtr scene;
  {
    const wiw::bindings::GilRelease release;
    const std::string extension = path.extension().string();
    const bool world = extension == ".world" || extension == ".sdf";
    scene = world ? wiw::scene::load_sdf_world(path, options) : wiw::scene::load_mesh(path, options);
  }
  return py::make_tuple(std::const_pointer_cast<Scene>(scene), trace.read, trace.absent);
}

py::tuple read_ply_surface(const std::filesystem::path& path, const std::string& label, const py::dict& limits) {
  wiw::scene::ImportLimits most;
  set_limits(limits, most);
  wiw::scene::PlySurface surface;
  {
    const wiw::bindings::GilRelease release;
    surface = wiw::scene::read_ply_surface(path, label, most);
  }
  py::array_t<std::int64_t> labels(static_cast<py::ssize_t>(surface.labels.size()));
  std::ranges::copy(surface.labels, labels.mutable_data());
  py::object colors = py::none();
  if (!surface.colors.empty()) colors = rows_to_array(surface.colors);
  return py::make_tuple(rows_to_array(surface.vertices), rows_to_array(surface.triangles), labels, colors);
}

void bind_scene_class(py::module_& module) {
  py::class_<Scene, std::shared_ptr<Scene>>(module, "Scene", "A scene in memory: metres, Y up, immutable.")
      .def_static("from_arrays", &wiw::bindings::scene_from_arrays, py::arg("meshes"), py::kw_only(),
                  py::arg("name") = "arrays", py::arg("textures") = py::list(), py::arg("materials") = py::list(),
                  py::arg("sun") = py::none(), wiw::bindings::kFromArraysDoc)
      .def("relabelled", &wiw::bindings::relabelled_scene, py::arg("instances"), py::arg("labels"), py::kw_only(),
           py::arg("triangles") = py::none(), py::arg("corners") = py::none(), py::arg("rooms") = py::list(),
           wiw::bindings::kRelabelledDoc)
      .def_static("assembled", &wiw::bindings::assembled_scene, py::arg("parts"), py::arg("placements"),
                  py::arg("instances"), py::kw_only(), py::arg("rooms") = py::list(), wiw::bindings::kAssembledDoc)
      .def_property_readonly("name", [](const Scene& scene) { return scene.name; })
      .def_property_readonly(
          "categories", [](const Scene& scene) { return scene.categories; }, "Unique, lower case.")
      .def_property_readonly(
          "attributes", [](const Scene& scene) { return scene.attributes; },
          "Facts about the scene as text, e.g. which axis of the file was up and by which rule.")
      .def_property_readonly(
          "warnings", [](const Scene& scene) { return scene.warnings; },
          "What the importer had to leave out, one sentence each.")
      .def_property_readonly("triangle_count", &Scene::triangle_count, "Over all placements.")
      .def_property_readonly(
          "bounds",
          [](const Scene& scene) {
            return box_to_array([&] {
              const wiw::bindings::GilRelease release;
              return scene.bounds();
            }());
          },
          "float32 [2, 3]: least and greatest corner in the world, metres.")
      .def_property_readonly(
          "instances", &instances_to_list,
          "One dict a placed object: id (what the instance image holds), name, category, attributes, "
          "T_world_instance float32 [4, 4], bounds float32 [2, 3] in the world (NaN without triangles), "
          "triangle_count.")
      .def_property_readonly(
          "sun", &sun_to_dict,
          "The light that casts shadows: dict with direction (towards it), strength and ambient, or None.")
      .def_property_readonly("rooms", &rooms_to_list,
                             "One dict a room: name, type, bounds float32 [2, 3]; empty where unknown.")
      .def_property_readonly(
          "mesh_count", [](const Scene& scene) { return scene.meshes.size(); }, "Meshes; placements share them.")
      .def_property_readonly("material_count", [](const Scene& scene) { return scene.materials.size(); })
      .def_property_readonly("texture_count", [](const Scene& scene) { return scene.textures.size(); })
      .def_property_readonly("texture_bytes", &wiw::scene::texture_bytes, "Decoded textures in bytes.")
      .def_property_readonly("mesh_bytes", &wiw::scene::mesh_bytes, "Vertex and triangle arrays in bytes.")
      .def_property_readonly("missing_texture_share", &wiw::scene::missing_texture_share,
                             "Share of the surface, 0 to 1, whose texture could not be had.")
      .def("__repr__", [](const Scene& scene) { return "<" + wiw::scene::summary(scene) + ">"; })
      .def("describe", &wiw::scene::describe, "Several lines for a person: size, categories, memory, warnings.")
      .def("world_triangles", &triangles_to_arrays,
           "All placements in the world: vertices float32 [V, 3], triangles uint32 [T, 3], instance id uint32 [T].");
}

}  // namespace

void bind_apartment(py::module_& module);

void bind_scene(py::module_& module) {
  bind_scene_class(module);
  bind_apartment(module);
  module.def(
      "import_scene", &import_scene, py::arg("path"), py::kw_only(), py::arg("up") = py::none(),
      py::arg("ceiling") = py::none(), py::arg("limits") = py::dict(), py::arg("texture_folders") = Paths{},
      py::arg("model_folders") = Paths{}, py::arg("decode_basis") = py::none(),
      "Reads a mesh or a Gazebo world. `decode_basis` makes uint8 [H, W, 4] of a `.basis` or KTX2 image; without "
      "it such textures are missing. Returns (scene, files read, files looked for but absent).");
  module.def("read_ply_surface", &read_ply_surface, py::arg("path"), py::arg("label"), py::kw_only(),
             py::arg("limits") = py::dict(),
             "Reads a binary PLY file with a property `label` of faces. Returns vertices float32 [V, 3] in the file's "
             "axes, triangles uint32 [T, 3], labels int64 [T] and colours uint8 [V, 4] or None.");
  module.attr("IMPORTER_VERSION") = wiw::scene::importer_version();
  module.def("write_cache", &wiw::scene::write_scene_cache, py::arg("scene"), py::arg("path"),
             py::call_guard<wiw::bindings::GilRelease>(),
             "Writes a scene to a cache file, which appears whole or not at all.");
  module.def(
      "map_cache",
      [](const std::filesystem::path& path) {
        return std::const_pointer_cast<Scene>(wiw::scene::map_scene_cache(path));
      },
      py::arg("path"), py::call_guard<wiw::bindings::GilRelease>(),
      "Maps a cache file: a scene whose arrays lie in the file. Raises FileError if it is damaged or of another "
      "version.");
}
