// SPDX-License-Identifier: Apache-2.0
// Builds the placed pieces, puts small objects on them and names everything.
#include <map>

#include "wiw/apartment/draft.hpp"
#include "wiw/apartment/placement.hpp"

namespace wiw::apartment {

namespace {

/// A support in the room with the rectangles already taken on it.
struct SupportSurface {
  Support support;
  Eigen::Affine3f pose;
  std::size_t object;
  std::vector<Eigen::AlignedBox2f> taken;
};

/// What a piece was set down on.
struct Below {
  std::int32_t object = scene::kNone;
  float headroom = 0.f;
};

class Furnisher {
 public:
  Furnisher(Draft& draft, std::int32_t room)
      : draft_(draft), room_(room), rng_(stream(draft.seed, Stream::kObjects, static_cast<std::uint64_t>(room))) {
    const auto has_window = [&](const Opening& o) { return o.kind == OpeningKind::kWindow && o.room_a == room_; };
    const auto& openings = draft_.plan.openings;
    lamps_on_ = rng_.chance(0.75) || std::none_of(openings.begin(), openings.end(), has_window);
  }

  void run() {
    std::vector<PlacedPiece> pieces = place_furniture(draft_.plan, room_, draft_.seed);
    std::vector<std::vector<std::size_t>> surfaces_of(pieces.size());
    for (std::size_t i = 0; i < pieces.size(); ++i) {
      if (pieces[i].parent >= 0 && !set_down(pieces[i], surfaces_of[static_cast<std::size_t>(pieces[i].parent)]))
        continue;
      const std::size_t first = surfaces_.size();
      build(pieces[i]);
      for (std::size_t s = first; s < surfaces_.size(); ++s) surfaces_of[i].push_back(s);
    }
    scatter();
  }

 private:
  const PlanRoom& plan() const { return draft_.plan.rooms[static_cast<std::size_t>(room_)]; }

  bool is_on(const Category& category) {
    if (category.mount == Mount::kCeiling) return lamps_on_;
    return rng_.chance(0.5);
  }

  void build(const PlacedPiece& piece) {
    const Design design{piece.category, piece.size, piece.key, room_, is_on(catalogue()[piece.category])};
    BuiltPiece built = build_piece(design, "", draft_.materials, draft_.palette);
    Eigen::Affine3f pose = Eigen::Affine3f::Identity();
    pose.translate(piece.position).rotate(Eigen::AngleAxisf(piece.yaw, Vec3::UnitY()));
    const std::size_t index = draft_.objects.size();
    built.object.pose = pose;
    built.object.support = below_.object;
    built.object.headroom = below_.headroom;
    draft_.objects.push_back(std::move(built.object));
    for (const Bulb& bulb : built.bulbs) {
      draft_.lights.push_back(
          {pose * bulb.position, Vec3::Zero(), Vec3::Zero(), Vec3::Zero(), bulb.strength * lamp_color(), room_, index});
    }
    for (const Support& support : built.supports) surfaces_.push_back({support, pose, index, {}});
    below_ = {};
  }

  /// Finds a free place on one of the surfaces and moves the piece there.
  bool set_down(PlacedPiece& piece, const std::vector<std::size_t>& candidates) {
    for (const std::size_t index : candidates) {
      SupportSurface& surface = surfaces_[index];
      const Vec2 half(0.5f * piece.size.x(), 0.5f * piece.size.z());
      if (piece.size.y() > surface.support.clearance) continue;
      const Vec2 slack = surface.support.half - half.cwiseMin(surface.support.half + Vec2::Constant(0.02f));
      if (slack.minCoeff() < -0.021f) continue;
      for (int attempt = 0; attempt < 6; ++attempt) {
        const float spread = piece.parent >= 0 ? 0.f : 1.f;  // what belongs on a piece stands in its middle
        const Vec2 at(spread * slack.x() * range(rng_, -1.f, 1.f), spread * slack.y() * range(rng_, -1.f, 1.f));
        const Eigen::AlignedBox2f area(Vec2(at - half), Vec2(at + half));
        if (std::any_of(surface.taken.begin(), surface.taken.end(),
                        [&](const auto& other) { return other.intersects(area); }))
          continue;
        surface.taken.push_back(area);
        below_ = {static_cast<std::int32_t>(surface.object), surface.support.clearance};
        piece.position = surface.pose * Vec3(surface.support.center + Vec3(at.x(), 0, at.y()));
        const Vec3 front = surface.pose.linear() * Vec3::UnitZ();
        piece.yaw = std::atan2(front.x(), front.z()) + (piece.parent >= 0 ? 0.f : range(rng_, -0.4f, 0.4f));
        return true;
      }
    }
    return false;
  }

  /// Small objects by the room's priors on whatever surfaces there are.
  void scatter() {
    std::uint64_t count = 0;
    const std::size_t fixed = surfaces_.size();
    for (std::size_t index = 0; index < catalogue().size(); ++index) {
      const Category& category = catalogue()[index];
      if (category.mount != Mount::kTop) continue;
      for (const Prior& prior : category.priors) {
        if (prior.room != plan().type) continue;
        for (int i = 0; i < prior.most && rng_.chance(prior.chance); ++i) {
          PlacedPiece piece{index, room_};
          piece.key = stream_key({draft_.seed, static_cast<std::uint64_t>(Stream::kObjects),
                                  static_cast<std::uint64_t>(room_), index, ++count});
          Rng own(piece.key);
          for (int axis = 0; axis < 3; ++axis)
            piece.size[axis] = range(own, category.smallest[axis], category.largest[axis]);
          std::vector<std::size_t> order(fixed);
          for (std::size_t s = 0; s < fixed; ++s) order[s] = s;
          shuffle(rng_, order);
          if (set_down(piece, order)) build(piece);
        }
      }
    }
  }

  Draft& draft_;
  std::int32_t room_;
  Rng rng_;
  bool lamps_on_ = true;
  std::vector<SupportSurface> surfaces_;
  Below below_;
};

void number_names(std::vector<Object>& objects) {
  std::map<std::string, int> count;
  for (Object& object : objects) {
    if (object.name == object.category) object.name.append(1, ' ').append(std::to_string(++count[object.category]));
  }
}

}  // namespace

Rgb lamp_color() { return to_linear({1.f, 0.95f, 0.88f}); }

BuiltPiece build_piece(const Design& design, const std::string& state, MaterialTable& materials,
                       const Palette& palette) {
  const Category& category = catalogue()[design.category];
  Rng rng(stream_key({design.key, 1}));
  FurnitureBuilder make{design.size, rng, materials, palette.rooms[static_cast<std::size_t>(design.room)]};
  make.on = state.empty() ? design.on : state == "on";
  make.state = state;
  category.make(make);
  Object object{category.name,
                category.name,
                std::move(make.attributes),
                design.room,
                Eigen::Affine3f::Identity(),
                std::move(make.shape),
                {},
                make.casts_shadow};
  object.color = make.main_color;
  object.design = design;
  object.leaves = std::move(make.leaves);
  return {std::move(object), std::move(make.bulbs), std::move(make.supports)};
}

void furnish(Draft& draft) {
  for (std::int32_t room = 0; room < static_cast<std::int32_t>(draft.plan.rooms.size()); ++room)
    Furnisher(draft, room).run();
  number_names(draft.objects);
}

}  // namespace wiw::apartment
