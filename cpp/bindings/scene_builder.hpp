// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pybind11/pybind11.h>

#include <memory>
#include <optional>
#include <string>

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

}  // namespace wiw::bindings
