// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "wiw/scene/scene.hpp"

namespace wiw::bindings {

inline constexpr const char* kFromArraysDoc =
    "Builds a scene from arrays, which are copied. `meshes` is a list of dicts, one instance each:\n\n"
    "    positions float32 [V, 3], triangles uint32 [T, 3];\n"
    "    optional: normals float32 [V, 3], uv float32 [V, 2], lightmap_uv float32 [V, 2], colors uint8 [V, 4],\n"
    "    material (index into `materials`), lightmap (index into `textures`), name, category, attributes (dict of "
    "str),\n"
    "    T_world_instance float [4, 4], or [N, 4, 4] to place the mesh N times.\n\n"
    "`textures` are uint8 [H, W, 4] images, row 0 on top. `materials` are dicts: name, base_color (4 floats, "
    "display-encoded), texture (index), alpha_cutoff, emissive.\n\n"
    "`sun` is a light from one direction that casts shadows, for surfaces without a lightmap: a dict with direction "
    "(towards the light, of any length but zero), strength of the direct light and ambient (what is left of the "
    "ambient light), both in [0, 1]; keys left out keep their defaults. "
    "Raises ArgumentError for shapes that do not fit and values out of range.";

std::shared_ptr<scene::Scene> scene_from_arrays(const pybind11::list& meshes, const std::string& name,
                                                const pybind11::list& textures, const pybind11::list& materials,
                                                const std::optional<pybind11::dict>& sun);

inline constexpr const char* kRelabelledDoc =
    "Returns the same surface with other instances.\n\n"
    "`labels` uint32 [P] names the instance (from 1) of each triangle of `world_triangles`; or of each piece of one, "
    "where `triangles` uint32 [P] says of which and `corners` float32 [P, 3, 3] has the barycentric coordinates of the "
    "piece's corners. `instances` are dicts: name, category, attributes (dict of str); those without triangles stay in "
    "the list. `rooms` are dicts: name, type, bounds float [2, 3]. `name` replaces the scene's, `attributes` and "
    "`warnings` are added to its own, `flat` draws its materials as they are, because their light is in them. "
    "Raises ArgumentError for a piece of no triangle or no instance.";

std::shared_ptr<scene::Scene> relabelled_scene(const scene::Scene& scene, const pybind11::list& instances,
                                               const pybind11::array& labels, const pybind11::object& triangles,
                                               const pybind11::object& corners, const pybind11::list& rooms,
                                               const pybind11::kwargs& about);

inline constexpr const char* kAssembledDoc =
    "Builds one scene of several.\n\n"
    "`placements` are tuples: index into `parts`, instance (from 1), T_world_part float [4, 4], which may scale. "
    "`instances`, `rooms` and what is said of the scene are as for `relabelled`; textures, materials and warnings are "
    "those of the parts. Raises ArgumentError for a placement of no part or no instance.";

std::shared_ptr<scene::Scene> assembled_scene(const std::vector<std::shared_ptr<scene::Scene>>& parts,
                                              const pybind11::list& placements, const pybind11::list& instances,
                                              const pybind11::list& rooms, const pybind11::kwargs& about);

}  // namespace wiw::bindings
