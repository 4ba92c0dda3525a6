// SPDX-License-Identifier: Apache-2.0
// A navigation mesh, which is then asked for points and paths: header and tile change apart.
#include "mutation.hpp"
#include "reading.hpp"
#include "wiw/nav/nav_mesh.hpp"

namespace {

constexpr std::size_t kHeader = 40, kSettings = 56, kTileHeader = 8;

std::vector<std::string> split(const std::string& bytes) {
  const bool has_settings = bytes.size() > kHeader && wiw::fuzz::number_at<std::int32_t>(bytes, 4) == 2;
  const std::size_t front = kHeader + (has_settings ? kSettings : 0);
  if (bytes.size() < front + kTileHeader) return {};
  return {bytes.substr(0, front), bytes.substr(front + kTileHeader)};
}

std::string join(const std::vector<std::string>& parts) {
  std::string bytes = parts[0];
  wiw::fuzz::append_number(bytes, std::uint32_t{0});
  wiw::fuzz::append_number(bytes, static_cast<std::int32_t>(parts[1].size()));
  return bytes + parts[1];
}

void query(const wiw::nav::NavMesh& mesh) {
  const std::vector<Eigen::Vector3f> points = mesh.sample(3, 1, -1);
  for (const auto metric : {wiw::nav::Metric::kExact, wiw::nav::Metric::kDetour, wiw::nav::Metric::kDetourUncapped}) {
    static_cast<void>(mesh.shortest_path(points[0], points[1], metric));
  }
  static_cast<void>(mesh.distance_matrix(points));
  static_cast<void>(mesh.try_step(points[0], points[0] + Eigen::Vector3f(0.25f, 0, 0.1f)));
  static_cast<void>(mesh.surface_length(std::vector{points[0], mesh.try_step(points[0], points[2])}));
  static_cast<void>(mesh.is_navigable(mesh.bounds().center()));
}

}  // namespace

wiw::fuzz::Container wiw::fuzz::container() { return {.split = split, .join = join}; }

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static const wiw::fuzz::Folder folder;
  std::shared_ptr<wiw::nav::NavMesh> mesh;
  wiw::fuzz::read_or_refuse(folder.write("m.navmesh", std::span(data, size)),
                            [&](const std::filesystem::path& file) { mesh = wiw::nav::NavMesh::load(file.string()); });
  if (mesh) query(*mesh);
  return 0;
}
