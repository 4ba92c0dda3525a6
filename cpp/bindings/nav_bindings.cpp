// SPDX-License-Identifier: Apache-2.0
#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/operators.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>
#include <pybind11/stl/filesystem.h>

#include <limits>
#include <optional>

#include "arrays.hpp"
#include "gil.hpp"
#include "wiw/nav/distance_field.hpp"
#include "wiw/nav/ground.hpp"
#include "wiw/nav/nav_mesh.hpp"
#include "wiw/nav/waypoints.hpp"

namespace py = pybind11;
using namespace wiw;
using namespace wiw::nav;
using wiw::bindings::Array;

namespace {

/// float32 [N, 3], or [3] for a single point, whose results then lose their first axis too.
struct Points {
  std::vector<Eigen::Vector3f> values;
  bool single = false;
};

Points to_points(const Array<float>& array, const char* name) {
  Points points;
  points.single = array.ndim() == 1;
  const std::string expected = std::string(name) + " [N, 3] or [3]";
  if (points.single) {
    bindings::expect_shape(array, {3}, expected.c_str());
  } else {
    bindings::expect_shape(array, {-1, 3}, expected.c_str());
  }
  points.values.resize(static_cast<std::size_t>(array.size() / 3));
  if (array.size() > 0) std::copy(array.data(), array.data() + array.size(), points.values[0].data());
  return points;
}

/// Two batches of which one may be a single point.
struct Pairs {
  Points a, b;
  [[nodiscard]] bool single() const { return a.single && b.single; }
  [[nodiscard]] std::size_t size() const { return a.single ? b.values.size() : a.values.size(); }
  [[nodiscard]] const Eigen::Vector3f& first(std::size_t i) const { return a.values[a.single ? 0 : i]; }
  [[nodiscard]] const Eigen::Vector3f& second(std::size_t i) const { return b.values[b.single ? 0 : i]; }
};

Pairs to_pairs(const Array<float>& a, const char* name_a, const Array<float>& b, const char* name_b) {
  Pairs pairs{to_points(a, name_a), to_points(b, name_b)};
  if (!pairs.a.single && !pairs.b.single && pairs.a.values.size() != pairs.b.values.size()) {
    throw ArgumentError(std::string("expected as many ") + name_a + " as " + name_b + ", got " +
                        std::to_string(pairs.a.values.size()) + " and " + std::to_string(pairs.b.values.size()));
  }
  return pairs;
}

py::array_t<float> point_array(const std::vector<Eigen::Vector3f>& points, std::vector<py::ssize_t> shape) {
  py::array_t<float> array(std::move(shape));
  if (!points.empty()) std::copy(points[0].data(), points[0].data() + 3 * points.size(), array.mutable_data());
  return array;
}

py::array_t<float> point_array(const Points& like, const std::vector<Eigen::Vector3f>& points) {
  const auto count = static_cast<py::ssize_t>(points.size());
  return like.single ? point_array(points, {3}) : point_array(points, {count, 3});
}

template <class T>
py::object value_array(bool single, const std::vector<T>& values) {
  if (single) return py::cast(static_cast<T>(values[0]));
  py::array_t<T> array(static_cast<py::ssize_t>(values.size()));
  std::copy(values.begin(), values.end(), array.mutable_data());
  return array;
}

py::array_t<float> box_array(const Eigen::AlignedBox3f& box) { return point_array({box.min(), box.max()}, {2, 3}); }

Metric to_metric(const std::string& name) {
  if (name == "exact") return Metric::kExact;
  if (name == "detour") return Metric::kDetour;
  if (name == "detour-uncapped") return Metric::kDetourUncapped;
  throw ArgumentError("expected metric 'exact', 'detour' or 'detour-uncapped', got '" + name + "'");
}

py::array_t<float> snap(const NavMesh& mesh, const Array<float>& array) {
  Points points = to_points(array, "points");
  {
    const wiw::bindings::GilRelease release;
    const Eigen::Vector3f nowhere = Eigen::Vector3f::Constant(std::numeric_limits<float>::quiet_NaN());
    for (Eigen::Vector3f& point : points.values) point = mesh.snap(point).value_or(nowhere);
  }
  return point_array(points, points.values);
}

py::object is_navigable(const NavMesh& mesh, const Array<float>& array, float max_dy) {
  const Points points = to_points(array, "points");
  std::vector<std::uint8_t> result;
  {
    const wiw::bindings::GilRelease release;
    for (const Eigen::Vector3f& point : points.values) result.push_back(mesh.is_navigable(point, max_dy));
  }
  if (points.single) return py::bool_(result[0] != 0);
  py::array_t<bool> flags(static_cast<py::ssize_t>(result.size()));
  std::copy(result.begin(), result.end(), flags.mutable_data());
  return flags;
}

py::object island_of(const NavMesh& mesh, const Array<float>& array) {
  const Points points = to_points(array, "points");
  std::vector<std::int64_t> result;
  {
    const wiw::bindings::GilRelease release;
    for (const Eigen::Vector3f& point : points.values) result.push_back(mesh.island_of(point));
  }
  return value_array(points.single, result);
}

/// An island to the C++ core, where -1 stands for all; in Python that is None, since island_of gives -1 off the mesh.
int to_island(const NavMesh& mesh, std::optional<int> island) {
  if (!island) return -1;
  const auto islands = static_cast<int>(mesh.surface().islands.size());
  if (*island < 0 || *island >= islands) {
    throw ArgumentError("sample: expected an island from 0 to " + std::to_string(islands - 1) +
                        ", or None for all of them, got " + std::to_string(*island));
  }
  return *island;
}

py::array_t<float> sample(const NavMesh& mesh, std::size_t count, std::uint64_t seed, std::optional<int> island) {
  const int index = to_island(mesh, island);
  std::vector<Eigen::Vector3f> points;
  {
    const wiw::bindings::GilRelease release;
    points = mesh.sample(count, seed, index);
  }
  return point_array(points, {static_cast<py::ssize_t>(count), 3});
}

py::array_t<float> try_step(const NavMesh& mesh, const Array<float>& start, const Array<float>& end, bool sliding) {
  const Pairs pairs = to_pairs(start, "start", end, "end");
  std::vector<Eigen::Vector3f> reached(pairs.size());
  {
    const wiw::bindings::GilRelease release;
    for (std::size_t i = 0; i < reached.size(); ++i) {
      reached[i] = mesh.try_step(pairs.first(i), pairs.second(i), sliding);
    }
  }
  return point_array(pairs.a.single ? pairs.b : pairs.a, reached);
}

py::object geodesic_distance(const NavMesh& mesh, const Array<float>& a, const Array<float>& b,
                             const std::string& metric_name, bool return_reason) {
  const Pairs pairs = to_pairs(a, "a", b, "b");
  const Metric metric = to_metric(metric_name);
  std::vector<double> metres(pairs.size());
  std::vector<std::string> reasons(pairs.size());
  {
    const wiw::bindings::GilRelease release;
    for (std::size_t i = 0; i < metres.size(); ++i) {
      const Distance distance = mesh.geodesic_distance(pairs.first(i), pairs.second(i), metric);
      metres[i] = distance.metres;
      reasons[i] = reason_text(distance.reason);
    }
  }
  py::object distances = value_array(pairs.single(), metres);
  if (!return_reason) return distances;
  return py::make_tuple(distances, pairs.single() ? py::cast(reasons[0]) : py::cast(reasons));
}

py::object shortest_path(const NavMesh& mesh, const Array<float>& a, const Array<float>& b,
                         const std::string& metric_name, bool return_length) {
  const Points start = to_points(a, "a"), end = to_points(b, "b");
  if (!start.single || !end.single) throw ArgumentError("expected one start and one end, each [3]");
  const Metric metric = to_metric(metric_name);
  Path path;
  {
    const wiw::bindings::GilRelease release;
    path = mesh.shortest_path(start.values[0], end.values[0], metric);
  }
  if (path.reason != NoPathReason::kNone) {
    throw NavigationError(std::string("no way from start to end: ") + reason_text(path.reason));
  }
  py::array_t<float> points = point_array(path.points, {static_cast<py::ssize_t>(path.points.size()), 3});
  if (return_length) return py::make_tuple(points, path.length);
  return points;
}

double surface_length(const NavMesh& mesh, const Array<float>& array, float step) {
  const Points points = to_points(array, "points");
  const wiw::bindings::GilRelease release;
  return mesh.surface_length(points.values, step);
}

py::array_t<double> distance_matrix(const NavMesh& mesh, const Array<float>& array, const std::string& metric_name) {
  const Points points = to_points(array, "points");
  const Metric metric = to_metric(metric_name);
  const auto n = static_cast<py::ssize_t>(points.values.size());
  auto metres = std::make_unique<std::vector<double>>();
  {
    const wiw::bindings::GilRelease release;
    *metres = mesh.distance_matrix(points.values, metric);
  }
  const double* data = metres->data();
  const py::capsule owner(metres.release(), [](void* p) { delete static_cast<std::vector<double>*>(p); });
  return py::array_t<double>({n, n}, data, owner);
}

py::object field_distance(const DistanceField& field, const Array<float>& array, bool return_reason) {
  const Points points = to_points(array, "points");
  std::vector<double> metres;
  std::vector<std::string> reasons;
  {
    const wiw::bindings::GilRelease release;
    for (const Eigen::Vector3f& point : points.values) {
      const Distance distance = field.distance(point);
      metres.push_back(distance.metres);
      reasons.emplace_back(reason_text(distance.reason));
    }
  }
  py::object distances = value_array(points.single, metres);
  if (!return_reason) return distances;
  return py::make_tuple(distances, points.single ? py::cast(reasons[0]) : py::cast(reasons));
}

py::object select_among(const Array<double>& distances, double mean_weight, double spacing) {
  bindings::expect_shape(distances, {-1, distances.ndim() == 2 ? distances.shape(0) : -1}, "distances [N, N]");
  const auto n = static_cast<std::size_t>(distances.shape(0));
  RankedPlaces places;
  {
    const wiw::bindings::GilRelease release;
    places = select_waypoints(std::span(distances.data(), n * n), n, {.mean_weight = mean_weight, .spacing = spacing});
  }
  const std::vector<std::int64_t> index(places.index.begin(), places.index.end());
  return py::make_tuple(value_array(false, index), value_array(false, places.score));
}

py::array_t<float> select_on_mesh(const NavMesh& mesh, std::uint64_t seed, double density, std::size_t min_samples,
                                  double mean_weight, double spacing, const std::string& metric) {
  const WaypointOptions options{density, min_samples, mean_weight, spacing, to_metric(metric)};
  std::vector<Eigen::Vector3f> points;
  {
    const wiw::bindings::GilRelease release;
    points = select_waypoints(mesh, seed, options);
  }
  return point_array(points, {static_cast<py::ssize_t>(points.size()), 3});
}

std::shared_ptr<NavMesh> from_triangles(const Array<float>& vertices, const py::object& indices,
                                        const NavMeshSettings& settings) {
  const auto faces = bindings::to_integers<std::int64_t>(indices, "faces int [F, 3]");
  bindings::expect_shape(vertices, {-1, 3}, "vertices [V, 3]");
  bindings::expect_shape(faces, {-1, 3}, "faces [F, 3]");
  const Points points = to_points(vertices, "vertices");
  std::vector<Eigen::Matrix<std::uint32_t, 3, 1>> triangles(static_cast<std::size_t>(faces.shape(0)));
  const std::int64_t* index = faces.data();
  for (auto& triangle : triangles) {
    for (int k = 0; k < 3; ++k, ++index) {
      if (*index < 0 || *index >= vertices.shape(0)) {
        throw ArgumentError("faces: expected indices in [0, " + std::to_string(vertices.shape(0)) + "), got " +
                            std::to_string(*index));
      }
      triangle[k] = static_cast<std::uint32_t>(*index);
    }
  }
  const wiw::bindings::GilRelease release;
  return NavMesh::from_triangles(points.values, triangles, settings);
}

void bind_settings(py::module_& module) {
  const NavMeshSettings defaults;
  py::class_<NavMeshSettings> settings(module, "NavMeshSettings", R"(How walkable surfaces become polygons.

Lengths in metres, angles in degrees; the defaults are Habitat's. `region_min_size`, `region_merge_size`,
`edge_max_error` and `detail_sample_distance` count cells of `cell_size`.)");
  settings.def(py::init([](const py::kwargs& values) {
    py::object result = py::cast(NavMeshSettings{});
    for (const auto& [name, value] : values) {
      if (!py::hasattr(result, name)) {
        throw ArgumentError("NavMeshSettings has no field '" + name.cast<std::string>() + "'");
      }
      py::setattr(result, name, value);
    }
    result.cast<const NavMeshSettings&>().validate();
    return result.cast<NavMeshSettings>();
  }));
#define FIELD(name) settings.def_readwrite(#name, &NavMeshSettings::name);
  FIELD(cell_size)
  FIELD(cell_height)
  FIELD(agent_height)
  FIELD(agent_radius)
  FIELD(agent_max_climb)
  FIELD(agent_max_slope)
  FIELD(region_min_size)
  FIELD(region_merge_size)
  FIELD(edge_max_length)
  FIELD(edge_max_error)
  FIELD(vertices_per_polygon)
  FIELD(detail_sample_distance)
  FIELD(detail_sample_max_error)
  FIELD(filter_low_hanging_obstacles)
  FIELD(filter_ledge_spans)
  FIELD(filter_walkable_low_height_spans)
  FIELD(include_static_objects)
#undef FIELD
  settings.def(py::self == py::self);
}

py::array_t<float> on_ground(const Ground& ground, const Array<float>& array) {
  Points points = to_points(array, "points");
  {
    const wiw::bindings::GilRelease release;
    for (Eigen::Vector3f& point : points.values) {
      point.y() = static_cast<float>(ground.height(point.cast<double>()));
    }
  }
  return point_array(points, points.values);
}

void bind_ground(py::module_& module) {
  py::class_<Ground, std::shared_ptr<Ground>>(module, "Ground", R"(Heights of the floor that is drawn.

Recast rounds floors up by as much as a cell (0.2 m at Habitat's settings): points on a navigation mesh lie above the
floor, by another amount in every scene. What stands or is seen from there has to be put down first.)")
      .def(py::init<const scene::Scene&>(), py::arg("scene"), py::call_guard<wiw::bindings::GilRelease>())
      .def("put_down", &on_ground, py::arg("points"),
           "float32 [N, 3] (or [3]): points of a navigation mesh (metres) with the floor's height; the highest surface "
           "from 0.45 m below to 0.1 m above counts. Points without any stay where they are, NaN included.");
}

void bind_construction(py::class_<NavMesh, std::shared_ptr<NavMesh>>& mesh) {
  mesh.def_static("build", &NavMesh::build, py::arg("scene"), py::arg("settings") = NavMeshSettings{},
                  py::call_guard<wiw::bindings::GilRelease>(),
                  "Navigation mesh of a `wiw.scenes` scene. ArgumentError if nothing in it is walkable.");
  mesh.def_static("from_triangles", &from_triangles, py::arg("vertices"), py::arg("faces"),
                  py::arg("settings") = NavMeshSettings{},
                  "Navigation mesh of a triangle soup: vertices float [V, 3] (metres, Y up), faces int [F, 3], "
                  "counter-clockwise from above where one can walk.");
  mesh.def_static(
      "load", [](const std::filesystem::path& path) { return NavMesh::load(path.string()); }, py::arg("path"),
      py::call_guard<wiw::bindings::GilRelease>(),
      "Reads a Habitat `.navmesh` file, version 1 or 2. FileError names the file and what is wrong with it.");
  mesh.def(
      "save",
      [](const NavMesh& self, const std::filesystem::path& path, int version) { self.save(path.string(), version); },
      py::arg("path"), py::arg("version") = 2, py::call_guard<wiw::bindings::GilRelease>(),
      "Writes a Habitat `.navmesh` file; version 1 leaves the settings out.");
}

void bind_geometry(py::class_<NavMesh, std::shared_ptr<NavMesh>>& mesh) {
  mesh.def_property_readonly(
      "settings", [](const NavMesh& self) { return self.settings(); },
      "Settings of the build; defaults where a version 1 file does not tell.");
  mesh.def_property_readonly("area", &NavMesh::area, "Walkable surface of all islands, m2.");
  mesh.def_property_readonly(
      "islands", [](const NavMesh& self) { return self.surface().islands; },
      "Connected parts, largest first: list of Island(area, polygons, bounds).");
  mesh.def_property_readonly(
      "bounds", [](const NavMesh& self) { return box_array(self.bounds()); },
      "float32 [2, 3]: lowest and highest corner.");
  mesh.def(
      "triangles",
      [](const NavMesh& self) {
        const auto& corners = self.surface().corners;
        return py::make_tuple(point_array(corners, {static_cast<py::ssize_t>(corners.size() / 3), 3, 3}),
                              value_array(false, self.surface().triangle_island));
      },
      "The surface as float32 [T, 3, 3] triangles, and the island of each as int32 [T].");
  mesh.def(
      "outline",
      [](const NavMesh& self) {
        const auto& ends = self.surface().outline;
        return py::make_tuple(point_array(ends, {static_cast<py::ssize_t>(ends.size() / 2), 2, 3}),
                              value_array(false, self.surface().outline_island));
      },
      "Walls and drops: float32 [S, 2, 3] segments around all islands, and the island of each as int32 [S].");
}

void bind_queries(py::class_<NavMesh, std::shared_ptr<NavMesh>>& mesh) {
  mesh.def("snap", &snap, py::arg("points"),
           "Nearest points on the mesh, float32 like `points` ([N, 3] or [3]); NaN where there is none within 2 m "
           "sideways and 4 m up or down.");
  mesh.def("is_navigable", &is_navigable, py::arg("points"), py::arg("max_dy") = 0.5f,
           "bool [N]: on the mesh within `max_dy` metres vertically and 1 cm horizontally.");
  mesh.def("island_of", &island_of, py::arg("points"),
           "int64 [N]: index into `islands` of the island nearest to each point, -1 off the mesh.");
  mesh.def("sample", &sample, py::arg("n"), py::arg("seed"), py::arg("island") = 0,
           "float32 [n, 3], uniform over the surface of one island (0 is the largest; None: of all); a function of "
           "`seed` alone. ArgumentError for an island that does not exist.");
  mesh.def("try_step", &try_step, py::arg("start"), py::arg("end"), py::arg("sliding") = true,
           "Where straight steps from `start` towards `end` (float [N, 3] or [3]) come to stand: at a wall they slide "
           "along it, or stop with sliding=False. `start` itself where there is no way at all.");
  mesh.def("geodesic_distance", &geodesic_distance, py::arg("a"), py::arg("b"), py::arg("metric") = "exact",
           py::arg("return_reason") = false,
           "Length in metres of the shortest way between `a` and `b` (float [N, 3] or [3] each; one may be a single "
           "point): float64 [N] or float, inf where there is none. With return_reason also why: '' or 'start off "
           "mesh', 'end off mesh', 'other island', 'disconnected mesh' (a damaged file), or for metric='detour' "
           "its search limit.");
  mesh.def("distance_matrix", &distance_matrix, py::arg("points"), py::arg("metric") = "exact",
           "float64 [N, N]: length in metres of the shortest way between any two of `points` (float [N, 3]), inf where "
           "there is none. Far faster than asking for each pair.");
  mesh.def("shortest_path", &shortest_path, py::arg("a"), py::arg("b"), py::arg("metric") = "exact",
           py::arg("return_length") = false,
           "float32 [P, 3]: the bends of the shortest way, ends included; with return_length also its length in the "
           "metric asked for. NavigationError says why there is none.");
  mesh.def("surface_length", &surface_length, py::arg("points"), py::arg("step") = 0.05f,
           "Metres of a polyline (float [P, 3]) laid onto the surface, climbs included: what an agent walks along a "
           "path. Heights are followed every `step` metres.");
}

void bind_fields(py::module_& module, py::class_<NavMesh, std::shared_ptr<NavMesh>>& mesh) {
  bind_ground(module);
  py::class_<DistanceField>(module, "DistanceField",
                            "Exact distance to the nearest of fixed goals, made by NavMesh.distances_from.")
      .def(
          "__call__", &field_distance, py::arg("points"), py::arg("return_reason") = false,
          "float64 [N] metres from `points` (float [N, 3] or [3]) to the nearest goal, inf where there is no way; with "
          "return_reason also why: '', 'start off mesh', 'other island' or 'disconnected mesh' (a damaged "
          "file).");
  mesh.def(
      "distances_from",
      [](const std::shared_ptr<NavMesh>& self, const Array<float>& array) {
        const Points goals = to_points(array, "goals");
        const wiw::bindings::GilRelease release;
        return DistanceField(self, goals.values);
      },
      py::arg("goals"),
      "A DistanceField of one goal ([3]) or the nearest of several ([N, 3]): what the goals see is computed once, each "
      "later point costs some ten microseconds. NavigationError if a goal is off the mesh.");
}

void bind_waypoints(py::module_& module, py::class_<NavMesh, std::shared_ptr<NavMesh>>& mesh) {
  const WaypointOptions defaults;
  module.def(
      "select_waypoints", &select_among, py::arg("distances"), py::arg("mean_weight") = defaults.mean_weight,
      py::arg("spacing") = defaults.spacing,
      "Peripheral places, spread out (World-in-World, Algorithm 1, stage 1): from finite `distances` [N, N], the "
      "indices int64 [W] in descending order of leaf score, eccentricity + mean_weight x mean distance, of which "
      "no two are closer than `spacing`, and their scores float64 [W].");
  mesh.def("select_waypoints", &select_on_mesh, py::arg("seed"), py::kw_only(), py::arg("density") = defaults.density,
           py::arg("min_samples") = defaults.min_samples, py::arg("mean_weight") = defaults.mean_weight,
           py::arg("spacing") = defaults.spacing, py::arg("metric") = "exact",
           "float32 [W, 3]: waypoints of the largest island, chosen by wiw.nav.select_waypoints among max(min_samples, "
           "density x area) samples.");
}

}  // namespace

void bind_nav(py::module_& module) {
  bind_settings(module);
  py::class_<Island>(module, "Island", "A connected part of a navigation mesh.")
      .def_readonly("area", &Island::area, "Surface in m2.")
      .def_readonly("polygons", &Island::polygons, "Number of polygons.")
      .def_property_readonly("bounds", [](const Island& self) { return box_array(self.bounds); }, "float32 [2, 3].");
  py::class_<NavMesh, std::shared_ptr<NavMesh>> mesh(
      module, "NavMesh", "Where an agent can stand, for one body size. Immutable; safe to share between threads.");
  bind_construction(mesh);
  bind_geometry(mesh);
  bind_queries(mesh);
  bind_fields(module, mesh);
  bind_waypoints(module, mesh);
}
