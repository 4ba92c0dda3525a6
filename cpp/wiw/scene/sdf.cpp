// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf.hpp"

#include "wiw/scene/import/file.hpp"
#include "wiw/scene/sdf/assembler.hpp"
#include "wiw/scene/sdf/reader.hpp"

namespace wiw::scene {

ScenePtr load_sdf_world(const std::filesystem::path& path, const ImportOptions& options) {
  return read_as_file(path, [&] {
    const sdf::SdfWorld world = sdf::SdfReader(path, options).read();
    return sdf::Assembler(world, options).assemble(path);
  });
}

}  // namespace wiw::scene
