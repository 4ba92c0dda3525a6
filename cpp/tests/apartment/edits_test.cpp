// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/edits.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <set>
#include <string>

#include "wiw/core/error.hpp"
#include "wiw/scene/measure.hpp"

using namespace wiw;
using namespace wiw::apartment;
using scene::Instance;
using scene::Scene;

namespace {

constexpr std::uint64_t kSeed = 3;
constexpr Split kSplit = Split::kVal;

Scene outline_with(const std::string& edit) { return outline_apartment(kSeed, kSplit, parse_edits({edit})); }

const Scene& plain() {
  static const Scene kScene = outline_apartment(kSeed, kSplit, {});
  return kScene;
}

const std::vector<Edit>& all_edits() {
  static const std::vector<Edit> kEdits = possible_edits(kSeed, kSplit, {});
  return kEdits;
}

/// Instances by name, those of one name by their order.
std::map<std::string, const Instance*> by_label(const Scene& scene) {
  std::map<std::string, int> count;
  std::map<std::string, const Instance*> found;
  for (const Instance& instance : scene.instances)
    found[instance.name + "." + std::to_string(++count[instance.name])] = &instance;
  return found;
}

bool same_shape(const Scene& a, const Instance& x, const Scene& b, const Instance& y) {
  if (x.meshes.size() != y.meshes.size() || x.T_world_instance.matrix() != y.T_world_instance.matrix()) return false;
  for (std::size_t i = 0; i < x.meshes.size(); ++i) {
    const scene::Mesh &m = a.meshes[x.meshes[i]], &n = b.meshes[y.meshes[i]];
    if (!std::equal(m.positions.begin(), m.positions.end(), n.positions.begin(), n.positions.end())) return false;
    if (!std::equal(m.triangles.begin(), m.triangles.end(), n.triangles.begin(), n.triangles.end())) return false;
  }
  return true;
}

/// Materials that an edit needs come after all others, so those of the others keep their places.
bool same_paint(const Scene& a, const Instance& x, const Scene& b, const Instance& y) {
  for (std::size_t i = 0; i < x.meshes.size(); ++i) {
    const scene::Mesh &m = a.meshes[x.meshes[i]], &n = b.meshes[y.meshes[i]];
    if (m.material != n.material || !std::equal(m.colors.begin(), m.colors.end(), n.colors.begin(), n.colors.end()))
      return false;
  }
  return true;
}

/// Labels of what differs in any way; what is missing in one of them counts.
std::set<std::string> changed(const Scene& a, const Scene& b) {
  const auto left = by_label(a), right = by_label(b);
  std::set<std::string> labels;
  for (const auto& [label, instance] : left) {
    const auto other = right.find(label);
    if (other == right.end() || instance->attributes != other->second->attributes ||
        !same_shape(a, *instance, b, *other->second) || !same_paint(a, *instance, b, *other->second))
      labels.insert(label);
  }
  for (const auto& [label, instance] : right) {
    if (!left.contains(label)) labels.insert(label);
  }
  return labels;
}

std::string as_label(const std::string& name) {
  const bool numbered = name.find('.') != std::string::npos;
  return numbered ? name : name + ".1";
}

std::string message_of(const std::string& edit) {
  try {
    outline_with(edit);
  } catch (const ArgumentError& error) {
    return error.what();
  }
  return "";
}

bool has(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

}  // namespace

TEST_CASE("edits have one text, whatever their order and spelling") {
  const std::vector<Edit> edits =
      parse_edits({"swap:plant 1,floor+lamp_2", "state:curtain_1=half+drawn", "color:sofa_1=blue", "remove:vase_1"});
  std::vector<std::string> texts;
  for (const Edit& edit : edits) texts.push_back(to_text(edit));
  CHECK(texts == std::vector<std::string>{"color:sofa_1=blue", "remove:vase_1", "state:curtain_1=half_drawn",
                                          "swap:floor_lamp_2,plant_1"});
  for (const Edit& edit : edits) CHECK(parse_edit(to_text(edit)) == edit);
}

TEST_CASE("texts that are no edits, and edits that contradict each other, are refused") {
  for (const char* text : {"", "sofa_1", "paint:sofa_1=blue", "color:sofa_1", "color:=blue", "color:sofa_1=", "remove:",
                           "remove:sofa_1=blue", "swap:sofa_1", "swap:sofa_1,", "swap:sofa_1,sofa_1"}) {
    CAPTURE(text);
    CHECK_THROWS_AS(parse_edit(text), ArgumentError);
  }
  CHECK_THROWS_AS(parse_edits({"color:sofa_1=blue", "color:sofa_1=red"}), ArgumentError);
  CHECK_THROWS_AS(parse_edits({"color:sofa_1=blue", "remove:sofa_1"}), ArgumentError);
  CHECK_THROWS_AS(parse_edits({"remove:plant_1", "swap:plant_1,plant_2"}), ArgumentError);
  CHECK_THROWS_AS(parse_edits({"swap:plant_3,plant_2", "swap:plant_1,plant_2"}), ArgumentError);
  CHECK(parse_edits({"color:sofa_1=blue", "state:sofa_1=on"}).size() == 2);
}

TEST_CASE("colours drawn by name have that name, on each split's raster") {
  CHECK(color_names().size() == 13);
  std::array<std::set<std::array<float, 3>>, 3> drawn;
  for (const Split split : {Split::kTrain, Split::kVal, Split::kTest}) {
    Rng rng(5);
    for (const std::string& name : color_names()) {
      for (int i = 0; i < 40; ++i) {
        const Rgb color = draw_color(name, split, rng);
        CHECK(color_name(color) == name);
        drawn[static_cast<std::size_t>(split)].insert({color.x(), color.y(), color.z()});
      }
    }
  }
  for (const auto& color : drawn[0]) CHECK_FALSE((drawn[1].contains(color) || drawn[2].contains(color)));
  for (const auto& color : drawn[1]) CHECK_FALSE(drawn[2].contains(color));
  Rng rng(5);
  CHECK_THROWS_AS(draw_color("mauve", Split::kVal, rng), ArgumentError);
}

TEST_CASE("every possible edit changes what it names and nothing else") {
  std::set<std::string> done;  // one colour an object
  std::map<EditKind, int> count;
  for (const Edit& edit : all_edits()) {
    if (edit.kind == EditKind::kColor && !done.insert(edit.name).second) continue;
    if (edit.kind == EditKind::kSwap && count[edit.kind]++ % 4 != 0) continue;
    if (edit.kind != EditKind::kSwap) ++count[edit.kind];
    const std::string text = to_text(edit);
    CAPTURE(text);
    const Scene scene = outline_apartment(kSeed, kSplit, {edit});
    CHECK_NOTHROW(scene.validate());
    CHECK(scene.attributes.at("edits") == text);
    std::set<std::string> names = changed(plain(), scene);
    CHECK(names.erase(as_label(edit.name)) == 1);
    if (edit.kind == EditKind::kSwap) {
      CHECK(names.erase(as_label(edit.value)) == 1);
      const auto before = by_label(plain()), after = by_label(scene);
      for (const std::string& name : names)  // what stands on them has moved with them
        CHECK(before.at(name)->attributes.at("color") == after.at(name)->attributes.at("color"));
      continue;
    }
    CHECK_MESSAGE(names.empty(), *names.begin());
    const auto after = by_label(scene);
    if (edit.kind == EditKind::kRemove) {
      CHECK_FALSE(after.contains(as_label(edit.name)));
      continue;
    }
    const char* key = edit.kind == EditKind::kColor ? "color" : "state";
    const Instance &old = *by_label(plain()).at(as_label(edit.name)), &now = *after.at(as_label(edit.name));
    CHECK(now.attributes.at(key) == edit.value);
    std::map<std::string, std::string> restored = now.attributes;
    restored[key] = old.attributes.at(key);
    CHECK(restored == old.attributes);
    CHECK(!(same_shape(plain(), old, scene, now) && same_paint(plain(), old, scene, now)));
  }
  CHECK(count[EditKind::kColor] > 80);
  CHECK(count[EditKind::kRemove] > 40);
  CHECK(count[EditKind::kState] > 15);
  CHECK(count[EditKind::kSwap] > 60);
}

TEST_CASE("colours leave shapes as they are") {
  std::set<std::string> done;
  for (const Edit& edit : all_edits()) {
    if (edit.kind != EditKind::kColor || !done.insert(edit.name).second) continue;
    CAPTURE(edit.name);
    const Scene scene = outline_apartment(kSeed, kSplit, {edit});
    CHECK(same_shape(plain(), *by_label(plain()).at(as_label(edit.name)), scene,
                     *by_label(scene).at(as_label(edit.name))));
  }
}

TEST_CASE("a thing swapped to another room takes that room's name, and what stands on it follows") {
  Draft draft = make_draft(kSeed, kSplit, {});
  for (const Edit& edit : all_edits()) {
    if (edit.kind != EditKind::kSwap) continue;
    const auto before = by_label(plain());
    const Instance &a = *before.at(as_label(edit.name)), &b = *before.at(as_label(edit.value));
    if (a.attributes.at("room") == b.attributes.at("room")) continue;
    const Scene scene = outline_apartment(kSeed, kSplit, {edit});
    const auto after = by_label(scene);
    CHECK(after.at(as_label(edit.name))->attributes.at("room") == b.attributes.at("room"));
    CHECK(after.at(as_label(edit.value))->attributes.at("room") == a.attributes.at("room"));
    const std::string text = to_text(edit);
    CAPTURE(text);
    for (const Object& object : draft.objects) {
      if (object.support == scene::kNone) continue;
      const Object& below = draft.objects[static_cast<std::size_t>(object.support)];
      if (below.name != edit.name && below.name != edit.value) continue;
      if (object.name == edit.name || object.name == edit.value) continue;
      const Instance &rider = *after.at(as_label(object.name)), &carrier = *after.at(as_label(below.name));
      CHECK(rider.attributes.at("room") == carrier.attributes.at("room"));
      const auto relative = [](const Instance& x, const Instance& y) {
        return Eigen::Affine3f(x.T_world_instance.inverse() * y.T_world_instance).matrix().eval();
      };
      CHECK(relative(carrier, rider)
                .isApprox(relative(*before.at(as_label(below.name)), *before.at(as_label(object.name))), 1e-4f));
    }
  }
}

TEST_CASE("a lamp switched off gives no light, and other lights stay as bright") {
  const Draft before = make_draft(kSeed, kSplit, {});
  Draft after = make_draft(kSeed, kSplit, {});
  apply_edits(after, parse_edits({"state:floor_lamp_1=off"}));
  const auto lamp = static_cast<std::size_t>(std::find_if(before.objects.begin(), before.objects.end(),
                                                          [](const auto& o) { return o.name == "floor lamp 1"; }) -
                                             before.objects.begin());
  REQUIRE(lamp < before.objects.size());
  CHECK(after.lights.size() + 1 == before.lights.size());
  std::size_t next = 0;
  for (const Light& light : before.lights) {
    if (light.source == lamp) continue;
    REQUIRE(next < after.lights.size());
    CHECK(after.lights[next].strength == light.strength);
    CHECK(after.lights[next++].center == light.center);
  }
}

TEST_CASE("a lamp switched on shines, at most as brightly as the room's lamps together") {
  Draft draft = make_draft(kSeed, kSplit, {});
  const std::size_t lights = draft.lights.size();
  apply_edits(draft, parse_edits({"state:pendant_lamp_3=on"}));
  REQUIRE(draft.lights.size() == lights + 1);
  const Light& lamp = draft.lights.back();
  CHECK(draft.objects[lamp.source].name == "pendant lamp 3");
  const LampLight& room = draft.lamp_light[static_cast<std::size_t>(lamp.room)];
  CHECK(lamp.strength.y() > 0.2f * room.share * lamp_color().y());
  CHECK(lamp.strength.y() <= 1.001f * room.share * lamp_color().y());
}

TEST_CASE("removed things take their light with them, and indices of the others stay right") {
  const Draft before = make_draft(kSeed, kSplit, {});
  Draft after = make_draft(kSeed, kSplit, {});
  apply_edits(after, parse_edits({"remove:floor_lamp_1"}));
  CHECK(after.objects.size() + 1 == before.objects.size());
  CHECK(after.lights.size() + 1 == before.lights.size());
  std::map<std::string, std::string> supports;
  for (const Object& object : before.objects) {
    if (object.support != scene::kNone)
      supports[object.name] = before.objects[static_cast<std::size_t>(object.support)].name;
  }
  CHECK(supports.size() > 10);
  for (const Object& object : after.objects) {
    if (object.support != scene::kNone)
      CHECK(supports.at(object.name) == after.objects[static_cast<std::size_t>(object.support)].name);
  }
  for (const Light& light : after.lights) CHECK(after.objects[light.source].room == light.room);
}

TEST_CASE("a closed curtain lets some of the window's light through") {
  const Draft before = make_draft(kSeed, kSplit, {});
  Draft after = make_draft(kSeed, kSplit, {});
  apply_edits(after, parse_edits({"state:curtain_1=closed"}));
  REQUIRE(after.lights.size() == before.lights.size());
  int dimmed = 0;
  for (std::size_t i = 0; i < before.lights.size(); ++i) {
    if (after.lights[i].strength == before.lights[i].strength) continue;
    ++dimmed;
    CHECK(after.lights[i].strength.y() == doctest::Approx(0.35f * before.lights[i].strength.y()));
    CHECK(after.lights[i].one_sided());
    const float moved = (after.lights[i].center - before.lights[i].center).dot(before.lights[i].axis);
    CHECK(moved > 0.05f);
  }
  CHECK(dimmed == 1);
}

TEST_CASE("edits that cannot be say what can") {
  CHECK(has(message_of("color:sofa_7=blue"), "has no 'sofa 7'; did you mean 'sofa 1'"));
  CHECK(has(message_of("color:sofa_1=bleu"), "did you mean 'blue'"));
  CHECK(has(message_of("color:sofa_1=green"), "it is green already; expected 'beige', 'black'"));
  CHECK(has(message_of("color:picture_1=blue"), "no colour of its own"));
  CHECK(has(message_of("state:sofa_1=on"), "has no states"));
  CHECK(has(message_of("state:floor_lamp_1=on"), "it is on already; expected 'off'"));
  CHECK(has(message_of("state:curtain_1=shut"), "expected 'closed' or 'half drawn'"));
  CHECK(has(message_of("state:door_of_kitchen=closed"), "no states"));
  CHECK(has(message_of("remove:walls_of_kitchen"), "part of the building"));
  CHECK(has(message_of("remove:toilet_1"), "part of the building"));
  CHECK(has(message_of("swap:sofa_1,cup_1"), "both stand on the floor"));
  CHECK(has(message_of("swap:sofa_1,armchair_1"), "differ by more than 15 cm"));
  CHECK(has(message_of("color:window_of_kitchen=blue"), "expected 'window of kitchen.1' or 'window of kitchen.2'"));
}

TEST_CASE("a table goes when all that stands on it goes too") {
  const std::string refusal = message_of("remove:coffee_table_1");
  REQUIRE(has(refusal, "something stands on it; remove "));
  std::vector<std::string> texts{"remove:coffee_table_1"};
  for (std::size_t at = refusal.find("remove '"); (at = refusal.find('\'', at)) != std::string::npos;) {
    const std::size_t end = refusal.find('\'', at + 1);
    texts.push_back("remove:" + refusal.substr(at + 1, end - at - 1));
    at = end + 1;
  }
  REQUIRE(texts.size() > 1);
  const Scene scene = outline_apartment(kSeed, kSplit, parse_edits(texts));
  CHECK(scene.instances.size() + texts.size() == plain().instances.size());
}

TEST_CASE("possible edits of an edited apartment leave out what was edited, and can be added") {
  const std::vector<Edit> first = parse_edits({"color:sofa_1=blue", "remove:floor_lamp_1"});
  const std::vector<Edit> more = possible_edits(kSeed, kSplit, first);
  CHECK(more.size() > 1000);
  std::size_t tried = 0;
  for (std::size_t i = 0; i < more.size(); i += 97, ++tried) {
    CHECK_FALSE((more[i].kind == EditKind::kColor && more[i].name == "sofa 1"));
    CHECK(more[i].name != "floor lamp 1");
    CHECK_NOTHROW(
        outline_apartment(kSeed, kSplit, parse_edits({to_text(first[0]), to_text(first[1]), to_text(more[i])})));
  }
  CHECK(tried > 10);
}

TEST_CASE("open doors keep clear of other things") {
  int opened = 0;
  for (std::uint64_t seed = 0; seed < 8; ++seed) {
    for (const Edit& edit : possible_edits(seed, Split::kVal, {})) {
      if (edit.kind != EditKind::kState || edit.value != "open") continue;
      Draft draft = make_draft(seed, Split::kVal, {});
      apply_edits(draft, {edit});
      const auto owner = std::find_if(draft.objects.begin(), draft.objects.end(),
                                      [&](const Object& object) { return object.name == edit.name; });
      REQUIRE(owner != draft.objects.end());
      opened += owner->leaves.empty() ? 0 : 1;
      for (const auto& leaf : owner->leaves) {
        const auto place = leaf.transformed(owner->pose);
        const auto room = draft.plan.rooms[static_cast<std::size_t>(owner->room)].inside();
        CHECK(room.grown(0.001f).contains(
            {place.min().x() + 0.01f, place.min().z() + 0.01f, place.max().x() - 0.01f, place.max().z() - 0.01f}));
        for (const Object& other : draft.objects) {
          if (&other == &*owner || !other.design || other.category == "rug" || other.shape.bounds().isEmpty()) continue;
          const auto overlap = place.intersection(other.shape.bounds().transformed(other.pose));
          CHECK_MESSAGE((overlap.isEmpty() || overlap.sizes().minCoeff() <= 0.011f), edit.name, " ", other.name);
        }
      }
    }
  }
  CHECK(opened > 15);
}
