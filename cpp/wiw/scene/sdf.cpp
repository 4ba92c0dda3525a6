// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf.hpp"

#include "wiw/scene/import/file.hpp"
#include "wiw/scene/sdf/assembler.hpp"
#include "wiw/scene/sdf/reader.hpp"

namespace wiw {

ScenePtr load_sdf_world(const std::filesystem::path& path, const ImportOptions& options) {
  return read_as_file(path, [&] {
    const sdf::World world = sdf::Reader(path, options).read();
    return sdf::Assembler(world, options).assemble(path);
  });
}

}  // namespace wiw
