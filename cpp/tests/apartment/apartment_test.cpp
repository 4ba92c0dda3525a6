// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/apartment.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <set>

#include "wiw/apartment/floor_plan.hpp"
#include "wiw/apartment/placement.hpp"
#include "wiw/core/error.hpp"

using namespace wiw;
using namespace wiw::apartment;
using scene::Scene;

namespace {

constexpr std::array<Split, 3> kSplits{Split::kTrain, Split::kVal, Split::kTest};

/// Readable check of the ways through a finished apartment: a 5 cm raster of all triangles that a person of height
/// 1.5 m could bump into, grown by his radius, flooded from the middle of the first door.
class WalkCheck {
 public:
  WalkCheck(const Scene& scene, float radius) : box_(scene.bounds()) {
    columns_ = static_cast<int>(box_.sizes().x() / kCell) + 1;
    rows_ = static_cast<int>(box_.sizes().z() / kCell) + 1;
    std::vector<bool> solid(static_cast<std::size_t>(columns_ * rows_), false);
    const scene::TriangleSoup soup = scene::world_triangles(scene);
    for (const auto& t : soup.triangles) mark(solid, soup.vertices[t[0]], soup.vertices[t[1]], soup.vertices[t[2]]);
    free_ = solid;
    grow(solid, radius);
  }

  void flood(float x, float z) {
    reached_.assign(free_.size(), false);
    std::vector<int> open{cell(x, z)};
    reached_[static_cast<std::size_t>(open[0])] = true;
    while (!open.empty()) {
      const int at = open.back();
      open.pop_back();
      for (const int step : {-1, 1, -columns_, columns_}) {
        const int to = at + step;
        if (to < 0 || to >= columns_ * rows_ || !free_[static_cast<std::size_t>(to)] ||
            reached_[static_cast<std::size_t>(to)])
          continue;
        reached_[static_cast<std::size_t>(to)] = true;
        open.push_back(to);
      }
    }
  }

  bool is_free(float x, float z) const { return free_[static_cast<std::size_t>(cell(x, z))]; }
  bool is_reached(float x, float z) const { return reached_[static_cast<std::size_t>(cell(x, z))]; }

 private:
  static constexpr float kCell = 0.05f;

  int cell(float x, float z) const {
    return static_cast<int>((z - box_.min().z()) / kCell) * columns_ + static_cast<int>((x - box_.min().x()) / kCell);
  }

  void mark(std::vector<bool>& solid, const Eigen::Vector3f& a, const Eigen::Vector3f& b, const Eigen::Vector3f& c) {
    const float low = std::min({a.y(), b.y(), c.y()}), high = std::max({a.y(), b.y(), c.y()});
    if (high < 0.1f || low > 1.5f) return;
    const float longest = std::max({(b - a).norm(), (c - a).norm(), (c - b).norm()});
    const int steps = static_cast<int>(longest / (0.5f * kCell)) + 1;
    for (int i = 0; i <= steps; ++i) {
      for (int j = 0; i + j <= steps; ++j) {
        const Eigen::Vector3f p = a + (b - a) * (static_cast<float>(i) / static_cast<float>(steps)) +
                                  (c - a) * (static_cast<float>(j) / static_cast<float>(steps));
        if (p.y() > 0.1f && p.y() < 1.5f) solid[static_cast<std::size_t>(cell(p.x(), p.z()))] = true;
      }
    }
  }

  void grow(const std::vector<bool>& solid, float radius) {
    const int reach = static_cast<int>(radius / kCell);
    free_.assign(solid.size(), true);
    for (int row = 0; row < rows_; ++row) {
      for (int column = 0; column < columns_; ++column) {
        if (!solid[static_cast<std::size_t>(row * columns_ + column)]) continue;
        for (int r = std::max(0, row - reach); r <= std::min(rows_ - 1, row + reach); ++r) {
          for (int c = std::max(0, column - reach); c <= std::min(columns_ - 1, column + reach); ++c) {
            if (std::hypot(r - row, c - column) * kCell <= radius)
              free_[static_cast<std::size_t>(r * columns_ + c)] = false;
          }
        }
      }
    }
  }

  Eigen::AlignedBox3f box_;
  int columns_ = 0, rows_ = 0;
  std::vector<bool> free_, reached_;
};

template <class Check>
void for_plans(std::uint64_t seeds, const Check& check) {
  for (const Split split : kSplits) {
    for (std::uint64_t seed = 0; seed < seeds; ++seed) {
      CAPTURE(seed);
      CAPTURE(split_name(split));
      check(seed, make_floor_plan(seed, split));
    }
  }
}

/// One apartment a split, built once for all tests with two threads.
const Scene& example(Split split) {
  static const std::array<Scene, 3> kScenes = [] {
    ThreadPool two(2);
    return std::array<Scene, 3>{make_apartment(7, Split::kTrain, two), make_apartment(7, Split::kVal, two),
                                make_apartment(7, Split::kTest, two)};
  }();
  return kScenes[static_cast<std::size_t>(split)];
}

bool same_bytes(const Scene& a, const Scene& b) {
  const auto equal = [](const auto& x, const auto& y) {
    if (x.size() != y.size()) return false;
    return x.empty() || std::memcmp(x.data(), y.data(), x.size() * sizeof(x[0])) == 0;
  };
  if (a.meshes.size() != b.meshes.size() || a.textures.size() != b.textures.size() ||
      a.instances.size() != b.instances.size())
    return false;
  for (std::size_t i = 0; i < a.meshes.size(); ++i) {
    const scene::Mesh &m = a.meshes[i], &n = b.meshes[i];
    if (!equal(m.positions, n.positions) || !equal(m.uv, n.uv) || !equal(m.colors, n.colors) ||
        !equal(m.lightmap_uv, n.lightmap_uv))
      return false;
    if (!equal(m.triangles, n.triangles) || !equal(m.normals, n.normals) || m.material != n.material) return false;
  }
  for (std::size_t i = 0; i < a.textures.size(); ++i) {
    if (!equal(a.textures[i].rgba, b.textures[i].rgba)) return false;
  }
  for (std::size_t i = 0; i < a.instances.size(); ++i) {
    if (a.instances[i].name != b.instances[i].name || a.instances[i].attributes != b.instances[i].attributes)
      return false;
  }
  return true;
}

}  // namespace

TEST_CASE("apartment plans have 5 to 9 rooms on 60 to 130 square metres that tile without overlap") {
  for_plans(60, [](std::uint64_t, const FloorPlan& plan) {
    CHECK(plan.rooms.size() >= 5);
    CHECK(plan.rooms.size() <= 9);
    CHECK(plan.area() >= 60.f);
    CHECK(plan.area() <= 130.f);
    CHECK(plan.ceiling >= 2.5f);
    CHECK(plan.ceiling <= 2.9f);
    std::set<std::string> names;
    for (std::size_t i = 0; i < plan.rooms.size(); ++i) {
      names.insert(plan.rooms[i].name);
      for (std::size_t j = 0; j < i; ++j)
        CHECK_FALSE(plan.rooms[i].cell.grown(-0.01f).overlaps(plan.rooms[j].cell.grown(-0.01f)));
    }
    CHECK(names.size() == plan.rooms.size());
  });
}

TEST_CASE("apartment doors join all rooms, are wide enough, and most plans have a loop") {
  int loops = 0, plans = 0;
  for_plans(60, [&](std::uint64_t, const FloorPlan& plan) {
    std::vector<bool> reached(plan.rooms.size(), false);
    reached[0] = true;
    for (std::size_t round = 0; round < plan.rooms.size(); ++round) {
      for (const Opening& o : plan.openings) {
        if (!o.passable()) continue;
        const auto a = static_cast<std::size_t>(o.room_a), b = static_cast<std::size_t>(o.room_b);
        if (reached[a] || reached[b]) reached[a] = reached[b] = true;
      }
    }
    CHECK(std::all_of(reached.begin(), reached.end(), [](bool value) { return value; }));
    for (const Opening& o : plan.openings) {
      if (o.passable()) CHECK(o.width() >= 0.75f + 0.1f);  // frame and leaf take up to 0.1 m
    }
    loops += plan.loops() > 0;
    ++plans;
  });
  CHECK(loops >= plans * 9 / 10);
}

TEST_CASE("apartment furniture stands clear of doors and of other furniture") {
  for_plans(12, [](std::uint64_t seed, const FloorPlan& plan) {
    for (std::int32_t room = 0; room < static_cast<std::int32_t>(plan.rooms.size()); ++room) {
      for (const PlacedPiece& piece : place_furniture(plan, room, seed)) {
        const Category& category = catalogue()[piece.category];
        if (piece.position.y() > 0.f || piece.parent >= 0 || std::string(category.name) == "rug") continue;
        const std::string name = category.name;
        CAPTURE(name);
        const Rect body = footprint(piece);
        CHECK(plan.rooms[static_cast<std::size_t>(room)].inside().grown(0.001f).contains(body));
        for (const Opening& o : plan.openings) {
          if (o.kind == OpeningKind::kWindow || (o.room_a != room && o.room_b != room)) continue;
          CHECK_FALSE(body.overlaps(threshold(plan, o, room, 0.7f)));
          if (o.room_a == room) CHECK_FALSE(body.overlaps(swing(plan, o)));
        }
      }
    }
  });
}

TEST_CASE("apartment splits share neither layouts nor palettes") {
  std::array<std::set<std::string>, 3> layouts, colors;
  for (std::size_t s = 0; s < 3; ++s) {
    for (std::uint64_t seed = 0; seed < 50; ++seed) {
      const ApartmentIdentity identity = apartment_identity(seed, kSplits[s]);
      layouts[s].insert(identity.layout);
      colors[s].insert(identity.palette.begin(), identity.palette.end());
    }
    CHECK(layouts[s].size() >= 15);
  }
  for (std::size_t a = 0; a < 3; ++a) {
    for (std::size_t b = 0; b < a; ++b) {
      for (const std::string& layout : layouts[a]) CHECK_MESSAGE(!layouts[b].contains(layout), layout);
      for (const std::string& color : colors[a]) CHECK_MESSAGE(!colors[b].contains(color), color);
    }
  }
}

TEST_CASE("apartment scenes are valid, rich, and every room can be walked to") {
  std::set<std::string> categories;
  for (const Split split : kSplits) {
    const Scene& scene = example(split);
    CHECK_NOTHROW(scene.validate());
    CHECK(scene.triangle_count() > 40000);
    CHECK(scene.triangle_count() < 300000);
    CHECK(scene.attributes.at("split") == split_name(split));
    for (const scene::Instance& instance : scene.instances) {
      categories.insert(scene.categories[static_cast<std::size_t>(instance.category)]);
      CHECK(instance.attributes.contains("room"));
      CHECK_MESSAGE(instance.attributes.contains("color"), instance.name);
    }
    WalkCheck walk(scene, 0.2f);
    std::size_t reachable = 0;
    bool started = false;
    for (const scene::Room& room : scene.rooms) {
      // The freest point of each room, by trying a raster of its floor.
      const Eigen::Vector3f low = room.bounds.min(), size = room.bounds.sizes();
      bool reached = false;
      for (float fx = 0.1f; fx < 0.95f && !reached; fx += 0.1f) {
        for (float fz = 0.1f; fz < 0.95f && !reached; fz += 0.1f) {
          const float x = low.x() + fx * size.x(), z = low.z() + fz * size.z();
          if (!started && walk.is_free(x, z)) walk.flood(x, z), started = true;
          reached = started && walk.is_reached(x, z);
        }
      }
      CHECK_MESSAGE(reached, room.name);
      reachable += reached;
    }
    CHECK(reachable == scene.rooms.size());
  }
  CHECK(categories.size() >= 35);
}

TEST_CASE("apartment light is smooth on a bare ceiling and neither murky nor blown out") {
  const Scene& scene = example(Split::kTrain);
  const auto& lightmap = scene.textures[scene.textures.size() - 2];
  REQUIRE(lightmap.name == "lightmap");
  double steps = 0., total = 0.;
  std::size_t count = 0, texels = 0, wild = 0;
  for (const scene::Instance& instance : scene.instances) {
    if (scene.categories[static_cast<std::size_t>(instance.category)] != "ceiling") continue;
    const scene::Mesh& mesh = scene.meshes[instance.meshes[0]];
    const auto w = static_cast<float>(lightmap.size.width), h = static_cast<float>(lightmap.size.height);
    float x0 = w, x1 = 0, y0 = h, y1 = 0;
    for (const auto& uv : mesh.lightmap_uv) {
      x0 = std::min(x0, uv.x() * w), x1 = std::max(x1, uv.x() * w), y0 = std::min(y0, uv.y() * h),
      y1 = std::max(y1, uv.y() * h);
    }
    const auto at = [&](int x, int y) {
      return static_cast<int>(lightmap.rgba[4 * static_cast<std::size_t>(y * lightmap.size.width + x) + 1]);
    };
    for (int y = static_cast<int>(y0 + 2); y < static_cast<int>(y1 - 2); ++y) {
      for (int x = static_cast<int>(x0 + 2); x < static_cast<int>(x1 - 2); ++x) {
        // Second difference: a smooth gradient has none, a blotch has.
        const int bend = std::abs(at(x - 1, y) - 2 * at(x, y) + at(x + 1, y));
        steps += bend, ++count;
        wild += bend > 6;
        total += at(x, y), ++texels;
      }
    }
  }
  REQUIRE(count > 500);
  CHECK(steps / static_cast<double>(count) < 1.2);
  CHECK(static_cast<double>(wild) < 0.01 * static_cast<double>(count));
  CHECK(total / static_cast<double>(texels) > 70.);
  CHECK(total / static_cast<double>(texels) < 150.);
}

TEST_CASE("apartment bytes depend on seed and split alone, not on threads") {
  ThreadPool one(1);
  CHECK(same_bytes(example(Split::kVal), make_apartment(7, Split::kVal, one)));
  CHECK_FALSE(same_bytes(example(Split::kVal), example(Split::kTest)));
}

TEST_CASE("apartment split names are checked") {
  CHECK(split_from_name("val") == Split::kVal);
  CHECK_THROWS_AS(split_from_name("dev"), ArgumentError);
}
