// SPDX-License-Identifier: Apache-2.0
// A robot, beside whose description there is a mesh, part.obj.
#include "reading.hpp"
#include "wiw/physics/articulation.hpp"

namespace {

constexpr std::string_view kMesh = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";

const wiw::fuzz::Folder& folder() {
  static const wiw::fuzz::Folder folder;
  static const auto mesh = folder.write("part.obj", kMesh);
  return folder;
}

void move(const wiw::physics::Articulation& robot) {
  const Eigen::VectorXd positions = robot.apply_mimics(Eigen::VectorXd::Zero(robot.dof()));
  static_cast<void>(robot.forward_kinematics(positions));
  static_cast<void>(robot.jacobian(positions, static_cast<int>(robot.links().size()) - 1));
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const auto description = folder().write("r.urdf", std::span(data, size));
  try {
    move(*wiw::physics::Articulation::load(description));
  } catch (const wiw::Error&) {  // NOLINT(bugprone-empty-catch): of the description, a link's mesh, or a number in it
  }
  return 0;
}
