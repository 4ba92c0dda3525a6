// SPDX-License-Identifier: Apache-2.0
// A Gazebo world, beside which there is a mesh, part.obj, and a model, model://part.
#include "wiw/scene/sdf.hpp"

#include "reading.hpp"
#include "wiw/scene/describe.hpp"

namespace {

constexpr std::string_view kMesh = "o part\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
constexpr std::string_view kModel =
    "<sdf version='1.7'><model name='part'><pose>1 0 0 0 0 1</pose><link name='l'><visual name='v'><geometry>"
    "<sphere><radius>1</radius></sphere></geometry></visual></link></model></sdf>";

const wiw::fuzz::Folder& folder() {
  static const wiw::fuzz::Folder folder;
  static const bool is_filled = [] {
    folder.write("part.obj", kMesh);
    folder.make_folder("part");
    folder.write("part/model.sdf", kModel);
    return true;
  }();
  static_cast<void>(is_filled);
  return folder;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const auto world = folder().write("m.sdf", std::span(data, size));
  wiw::fuzz::read_or_refuse(world, [](const std::filesystem::path& file) {
    wiw::scene::ImportOptions options;
    options.limits = wiw::fuzz::small_limits();
    options.model_folders = {file.parent_path()};
    const auto scene = wiw::scene::load_sdf_world(file, options);
    scene->validate();
    wiw::scene::describe(*scene);
  });
  return 0;
}
