// SPDX-License-Identifier: Apache-2.0
#include "wiw/nav/geodesics.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <limits>
#include <queue>

#include "nav/rooms.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/nav/distance_field.hpp"
#include "wiw/nav/nav_mesh.hpp"
#include "wiw/nav/step.hpp"

using namespace wiw;
using namespace wiw::nav;
using Eigen::Vector3f;

namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

std::shared_ptr<NavMesh> mesh_of(const test::Soup& soup) {
  return NavMesh::from_triangles(soup.vertices, soup.triangles);
}

/// Two flights of a stair around a shaft, and a gallery above the lower floor.
test::Soup stairwell() {
  test::Soup soup;
  soup.floor(0, 0, 12, 6);
  soup.ramp(3, 6, 9, 8, 0, 2.4f);
  soup.floor(0, 6, 3.05f, 8);
  soup.floor(8.95f, 6, 11, 10.5f, 2.4f);
  soup.quad({9, 2.4f, 8.5f}, {3, 4.8f, 8.5f}, {3, 4.8f, 10.5f}, {9, 2.4f, 10.5f});
  soup.floor(1, 0, 3.05f, 10.5f, 4.8f);
  soup.floor(3, 1, 11, 5, 4.8f);
  soup.block(5, 2, 6, 4);
  return soup;
}

/// The slow twin: straight hops inside polygons between closely spaced points on their common sides. An upper bound
/// that approaches the exact length from above.
class SteinerGraph {
 public:
  explicit SteinerGraph(const PolygonGraph& graph) : graph_(graph), members_(graph.polygons().size()) {
    for (int i = 0; i < static_cast<int>(graph.polygons().size()); ++i) {
      const Polygon& p = graph.polygons()[i];
      for (int k = 0; k < p.sides; ++k) {
        if (p.next[k] > i) add_side(i, p.next[k], p.at[k], p.at[p.after(k)]);
      }
    }
  }

  double metres(const Site& start, const Site& end) const {
    std::vector<double> reached(points_.size(), kInfinity);
    using Item = std::pair<double, int>;
    std::priority_queue<Item, std::vector<Item>, std::greater<>> open;
    const auto offer_all = [&](int polygon, Point2 from, double so_far) {
      for (const int other : members_[polygon]) {
        const double metres = so_far + graph_.scale() * length(points_[other] - from);
        if (metres >= reached[other]) continue;
        reached[other] = metres;
        open.emplace(metres, other);
      }
    };
    double best = start.polygon == end.polygon ? graph_.scale() * length(end.at - start.at) : kInfinity;
    offer_all(start.polygon, start.at, 0);
    while (!open.empty()) {
      const auto [metres, at] = open.top();
      open.pop();
      if (metres > reached[at]) continue;
      for (const int polygon : {sides_[at].first, sides_[at].second}) {
        if (polygon == end.polygon) best = std::min(best, metres + graph_.scale() * length(end.at - points_[at]));
        offer_all(polygon, points_[at], metres);
      }
    }
    return best;
  }

 private:
  void add_side(int a, int b, Point2 from, Point2 to) {
    const int steps = std::max(1, static_cast<int>(length(to - from) / 2));
    for (int s = 0; s <= steps; ++s) {
      members_[a].push_back(static_cast<int>(points_.size()));
      members_[b].push_back(static_cast<int>(points_.size()));
      points_.push_back(from + static_cast<double>(s) / steps * (to - from));
      sides_.emplace_back(a, b);
    }
  }

  const PolygonGraph& graph_;
  std::vector<Point2> points_;
  std::vector<std::pair<int, int>> sides_;
  std::vector<std::vector<int>> members_;
};

std::vector<Site> sites_of(const NavMesh& mesh, const std::vector<Vector3f>& points) {
  std::vector<Site> sites;
  for (const Vector3f& point : points) sites.push_back(mesh.geodesics().site(*mesh.project(point)));
  return sites;
}

}  // namespace

TEST_CASE("distances over several floors approach the slow twin's from below") {
  const auto mesh = mesh_of(stairwell());
  REQUIRE(mesh->island_of({2, 0.2f, 2}) == 0);
  REQUIRE(mesh->island_of({2, 5, 2}) == 0);
  const auto points = mesh->sample(40, 5);
  const auto sites = sites_of(*mesh, points);
  const SteinerGraph twin(mesh->geodesics().graph());
  const auto matrix = mesh->distance_matrix(points);
  int floors_apart = 0;
  for (std::size_t i = 0; i < sites.size(); ++i) {
    for (std::size_t j = 0; j < i; ++j) {
      const double exact = matrix[i * sites.size() + j];
      const double slow = twin.metres(sites[i], sites[j]);
      CHECK(exact <= slow + 1e-6);
      CHECK(exact >= 0.995 * slow - 0.01);
      floors_apart += std::abs(points[i].y() - points[j].y()) > 4 ? 1 : 0;
    }
  }
  CHECK(floors_apart > 50);
}

TEST_CASE("points above each other are as far apart as the stairs are long") {
  const auto mesh = mesh_of(stairwell());
  const Distance down = mesh->geodesic_distance({2, 0.2f, 3}, {2, 5, 3});
  CHECK(down.reason == NoPathReason::kNone);
  CHECK(down.metres > 18);
  const Path path = mesh->shortest_path({2, 0.2f, 3}, {2, 5, 3});
  CHECK(mesh->surface_length(path.points) > down.metres + 0.5);
}

TEST_CASE("one pillar has corners that are taut from outside, and its shadow hides what is behind") {
  test::Soup soup;
  soup.floor(0, 0, 10, 10);
  soup.block(4, 4, 6, 6);
  const auto mesh = mesh_of(soup);
  const Geodesics& exact = mesh->geodesics();
  CHECK(exact.corners().list.size() >= 4);
  for (const Corner& corner : exact.corners().list) {
    CHECK(orient(corner.at, corner.first, corner.last) < 0);
    CHECK(corner.is_taut(corner.first));
    CHECK(corner.is_taut(corner.last));
    CHECK(corner.fan.size() >= 1);
  }
  CHECK(mesh->shortest_path({5, 0.2f, 2}, {2, 0.2f, 5}).points.size() == 2);
  CHECK(mesh->shortest_path({5, 0.2f, 2}, {5, 0.2f, 8}).points.size() >= 4);
}

TEST_CASE("with fewer sites than corners the matrix takes its other way and agrees") {
  test::Soup soup;
  soup.floor(0, 0, 14, 14);
  for (int i = 0; i < 4; ++i) {
    for (int k = 0; k < 4; ++k) {
      const auto x = static_cast<float>(2 + 3 * i), z = static_cast<float>(2 + 3 * k);
      soup.block(x, z, x + 1, z + 1.3f);
    }
  }
  const auto mesh = mesh_of(soup);
  const std::size_t corners = mesh->geodesics().corners().list.size();
  REQUIRE(corners > 30);
  const auto many = mesh->sample(corners + 10, 1);
  const std::vector<Vector3f> few(many.begin(), many.begin() + 20);
  const auto all = mesh->distance_matrix(many), some = mesh->distance_matrix(few);
  for (std::size_t i = 0; i < few.size(); ++i) {
    for (std::size_t j = 0; j < few.size(); ++j) {
      CHECK(some[i * few.size() + j] == doctest::Approx(all[i * many.size() + j]).epsilon(1e-12));
    }
  }
}

TEST_CASE("a straight walk ends at its target or on a wall, and the two see each other alike") {
  const auto mesh = mesh_of(stairwell());
  const auto points = mesh->sample(60, 9);
  const auto sites = sites_of(*mesh, points);
  const PolygonGraph& graph = mesh->geodesics().graph();
  int blocked = 0;
  for (const Site& a : sites) {
    for (const Site& b : sites) {
      const Stop there = walk_straight(graph, a.polygon, a.eye, b.eye);
      const bool seen = there.fraction == 1 && there.polygon == b.polygon;
      const Stop back = walk_straight(graph, b.polygon, b.eye, a.eye);
      CHECK(seen == (back.fraction == 1 && back.polygon == a.polygon));
      const bool straight = mesh->geodesics().way(a, b).corners.empty();
      CHECK(seen == straight);
      blocked += seen ? 0 : 1;
    }
  }
  CHECK(blocked > 100);
}

TEST_CASE("a corner touched by a point in its sharpest place still sees the room") {
  test::Soup soup;
  soup.floor(0, 0, 6, 6);
  soup.block(1, 1, 5, 1.2f);
  const auto mesh = mesh_of(soup);
  const auto& outline = mesh->surface().outline;
  for (std::size_t s = 0; s < outline.size(); ++s) {
    if (mesh->surface().outline_island[s / 2] != 0) continue;
    CHECK(std::isfinite(mesh->geodesic_distance(outline[s], {3, 0.2f, 3}).metres));
  }
}
