// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/lighting.hpp"

#include <array>
#include <cmath>

#include "wiw/apartment/random.hpp"
#include "wiw/core/intrinsics.hpp"

namespace wiw::apartment {

namespace {

constexpr float kTurn = 6.2831853f;
constexpr float kLift = 0.004f;       // of samples above their surface
constexpr float kLampRadius = 0.14f;  // of the ball that stands for a lamp, for soft shadows
constexpr float kSoftening = 0.12f;   // square metres added to squared distances: no hot spots beside lamps
constexpr std::size_t kBlock = 256;   // samples a job

/// Additive recurrence of the plastic number: the most even simple sequence of points in the unit square
/// (M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018).
Vec2 even_point(std::uint32_t i) {
  const double x = 0.5 + 0.7548776662466927 * i, y = 0.5 + 0.5698402909980532 * i;
  return {static_cast<float>(x - std::floor(x)), static_cast<float>(y - std::floor(y))};
}

/// Phases have `count` successive points each. Thus all sixteen together, whose light smoothing mixes in every texel,
/// are as even as those of one.
Vec2 point_of_phase(std::uint32_t phase, std::size_t i, std::size_t count) {
  return even_point(static_cast<std::uint32_t>(count * phase + i));
}

/// Sets a direction around Z. Even points of the unit square become directions as many as the cosine says.
void set_direction(std::vector<Vec3x16>& packets, std::size_t i, const Vec2& square) {
  Vec3x16& packet = packets[i / RayTracer::kWidth];
  const std::size_t lane = i % RayTracer::kWidth;
  const float r = std::sqrt(square.x());
  packet.x[lane] = r * std::cos(kTurn * square.y());
  packet.y[lane] = r * std::sin(kTurn * square.y());
  packet.z[lane] = std::sqrt(1.f - square.x());
}

std::vector<Vec3x16> directions_of_phase(std::uint32_t phase, std::size_t packets) {
  std::vector<Vec3x16> made(packets);
  const std::size_t count = packets * RayTracer::kWidth;
  for (std::size_t i = 0; i < count; ++i) set_direction(made, i, point_of_phase(phase, i, count));
  return made;
}

/// Directions for samples that nothing smooths: a spiral by the golden angle, the evenest for a fixed number
/// (H. Vogel, "A better way to construct the sunflower head", 1979).
std::vector<Vec3x16> spiral_directions(std::size_t packets) {
  std::vector<Vec3x16> made(packets);
  const std::size_t count = packets * RayTracer::kWidth;
  for (std::size_t i = 0; i < count; ++i) {
    const double turn = 0.6180339887498949 * static_cast<double>(i);
    const float ring = (static_cast<float>(i) + 0.5f) / static_cast<float>(count);
    set_direction(made, i, Vec2(ring, static_cast<float>(turn - std::floor(turn))));
  }
  return made;
}

/// Maps the unit square to the unit ball's surface, areas in proportion.
Vec3 on_ball(const Vec2& square) {
  const float z = 2.f * square.x() - 1.f, r = std::sqrt(1.f - z * z);
  return {r * std::cos(kTurn * square.y()), z, r * std::sin(kTurn * square.y())};
}

struct Frame {
  Vec3 x, y, z;
};

/// Orthonormal basis around a normal (T. Duff et al., "Building an orthonormal basis, revisited", JCGT 2017).
Frame frame_around(const Vec3& n) {
  const float sign = std::copysign(1.f, n.z()), a = -1.f / (sign + n.z()), b = n.x() * n.y() * a;
  return {Vec3(1.f + sign * n.x() * n.x() * a, sign * b, -sign * n.x()), Vec3(b, sign + n.y() * n.y() * a, -n.y()), n};
}

/// Whether the segment from a to b passes the opening's wall inside the opening, or does not pass that wall.
bool passes(const Opening& o, const Vec3& a, const Vec3& b) {
  const int across = runs_along_x(o.side) ? 2 : 0, along = 2 - across;
  const float da = a[across] - o.line, db = b[across] - o.line;
  if (da * db >= 0.f) return true;
  const Vec3 at = a + (b - a) * (da / (da - db));
  return at[along] > o.low && at[along] < o.high && at.y() > o.bottom && at.y() < o.top;
}

float surface_area(const FloorPlan& plan, std::int32_t room) {
  const Rect r = plan.rooms[static_cast<std::size_t>(room)].inside();
  return 2.f * r.area() + 2.f * (r.width() + r.depth()) * plan.ceiling;
}

}  // namespace

LightSolver::LightSolver(const Draft& draft, const Atlas& atlas, const std::vector<scene::Texture>& textures,
                         const BounceRays& rays)
    : atlas_(atlas), charts_(draft.charts), vertex_rays_(spiral_directions(rays.vertex_packets)) {
  for (std::uint32_t phase = 0; phase < kPhases; ++phase)
    texel_rays_[phase] = directions_of_phase(phase, rays.texel_packets);
  std::vector<Rgb> albedo;
  for (MaterialId id = 0; id < draft.materials.size(); ++id) {
    const Finish& finish = draft.materials.finish(id);
    Rgb color = to_linear(finish.color);
    if (finish.texture != scene::kNone)
      color = color.cwiseProduct(mean_linear(textures[static_cast<std::size_t>(finish.texture)]));
    albedo.push_back(finish.emissive ? Rgb(Rgb::Zero()) : color);
  }
  add_texels(draft);
  for (const Object& object : draft.objects) add_object(draft, object, albedo);
  lights_ = draft.lights;
  place_targets();
  find_reach(draft);
  tracer_ = std::make_unique<RayTracer>(std::move(vertices_), std::move(triangles_));
}

void LightSolver::add_texels(const Draft& draft) {
  samples_.resize(atlas_.texels);
  std::vector<std::int32_t> rooms(charts_.size(), kOutside);
  for (const Object& object : draft.objects) {
    for (const Panel& panel : object.panels) rooms[panel.chart] = object.room;
  }
  for (std::size_t c = 0; c < charts_.size(); ++c) {
    const Chart& chart = charts_[c];
    const ChartPlace& place = atlas_.places[c];
    const Vec3 normal = chart.u.cross(chart.v);
    const Vec2 step = chart.size.cwiseQuotient(Vec2(static_cast<float>(place.columns), static_cast<float>(place.rows)));
    for (int row = 0; row < place.rows; ++row) {
      for (int column = 0; column < place.columns; ++column) {
        const Vec3 at = chart.origin + (static_cast<float>(column) + 0.5f) * step.x() * chart.u +
                        (static_cast<float>(row) + 0.5f) * step.y() * chart.v;
        const auto phase = static_cast<std::uint32_t>((column % 4) + 4 * (row % 4));
        samples_[place.first + static_cast<std::size_t>(row * place.columns + column)] = {at + kLift * normal, normal,
                                                                                          rooms[c], phase};
      }
    }
  }
}

/// Samples a little inside the faces around each vertex: right at an edge the neighbour's surface would block them.
void LightSolver::add_vertices(const Submesh& part, const Object& object) {
  std::vector<Vec3> middle(part.positions.size(), Vec3::Zero());
  std::vector<float> count(part.positions.size(), 0.f);
  for (const scene::Triangle& t : part.triangles) {
    const Vec3 center = (part.positions[t[0]] + part.positions[t[1]] + part.positions[t[2]]) / 3.f;
    for (const std::uint32_t corner : {t[0], t[1], t[2]}) middle[corner] += center, count[corner] += 1.f;
  }
  for (std::size_t i = 0; i < part.positions.size(); ++i) {
    const Vec3 inward = count[i] > 0.f ? Vec3(middle[i] / count[i] - part.positions[i]) : Vec3(Vec3::Zero());
    const float reach = inward.norm();
    const Vec3 at =
        part.positions[i] + inward * (reach > 0.f ? std::min(0.25f, 0.015f / reach) : 0.f) + kLift * part.normals[i];
    samples_.push_back({object.pose * at, object.pose.linear() * part.normals[i], object.room, 0});
  }
}

void LightSolver::add_object(const Draft& draft, const Object& object, const std::vector<Rgb>& albedo) {
  const auto add_part = [&](const Submesh& part, const Eigen::Affine3f& pose, std::int32_t chart,
                            std::size_t first_sample) {
    const auto base = static_cast<std::uint32_t>(vertices_.size());
    for (const Vec3& position : part.positions) vertices_.emplace_back(pose * position);
    for (const scene::Triangle& t : part.triangles) {
      const auto sample = static_cast<std::uint32_t>(first_sample);
      triangles_.emplace_back((t.array() + base).matrix());
      faces_.push_back({albedo[part.material].cwiseProduct(to_linear(part.tint[t[0]])),
                        chart,
                        {sample + t[0], sample + t[1], sample + t[2]}});
      face_room_.push_back(object.room);
    }
  };
  for (const Panel& panel : object.panels)
    add_part(panel.part, Eigen::Affine3f::Identity(), static_cast<std::int32_t>(panel.chart), 0);
  for (const Submesh& part : object.shape.parts()) {
    const std::size_t first = samples_.size();
    add_vertices(part, object);
    if (object.casts_shadow && !draft.materials.finish(part.material).emissive)
      add_part(part, object.pose, scene::kNone, first);
  }
}

void balance_lights(Draft& draft) {
  const auto rooms = static_cast<std::int32_t>(draft.plan.rooms.size());
  draft.lamp_light.resize(static_cast<std::size_t>(rooms));
  for (std::int32_t room = 0; room < rooms; ++room) {
    Rng rng = stream(draft.seed, Stream::kLight, static_cast<std::uint64_t>(room));
    float lamps = 0.f, windows = 0.f;
    for (const Light& light : draft.lights) {
      if (light.room == room) (light.one_sided() ? windows : lamps) += light.strength.y();
    }
    const float level = range(rng, 0.44f, 0.54f), area = surface_area(draft.plan, room);
    const float mixed = windows <= 0.f ? 0.f : range(rng, 0.4f, 0.6f);
    const float day = windows > 0.f && lamps <= 0.f ? 1.f : mixed;
    const Rgb sky(0.9f, 0.98f, 1.1f);
    for (Light& light : draft.lights) {
      if (light.room != room) continue;
      if (light.one_sided())
        light.strength = sky * (light.strength.y() / windows * day * level * area * 2.f / kTurn);
      else
        light.strength = light.strength * ((1.f - day) * level * area / (lamps * 2.f * kTurn));
    }
    draft.lamp_light[static_cast<std::size_t>(room)] = {(1.f - mixed) * level * area / (2.f * kTurn),
                                                        lamps / lamp_color().y()};
  }
}

/// Chooses the points of each light that samples of each phase look at.
void LightSolver::place_targets() {
  targets_.resize(lights_.size());
  for (std::size_t number = 0; number < lights_.size(); ++number) {
    const Light& light = lights_[number];
    for (std::uint32_t phase = 0; phase < kPhases; ++phase) {
      Vec3x16& targets = targets_[number][phase];
      for (std::size_t i = 0; i < RayTracer::kWidth; ++i) {
        const Vec2 p = point_of_phase(phase, i, RayTracer::kWidth);
        const Vec3 target = light.one_sided()
                                ? Vec3(light.center + (2.f * p.x() - 1.f) * light.u + (2.f * p.y() - 1.f) * light.v)
                                : Vec3(light.center + kLampRadius * on_ball(p));
        targets.x[i] = target.x(), targets.y[i] = target.y(), targets.z[i] = target.z();
      }
    }
  }
}

/// Finds which rooms each light reaches.
void LightSolver::find_reach(const Draft& draft) {
  const auto rooms = static_cast<std::int32_t>(draft.plan.rooms.size());
  lit_.resize(static_cast<std::size_t>(rooms));
  for (std::int32_t room = 0; room < rooms; ++room) {
    for (std::size_t i = 0; i < lights_.size(); ++i) {
      if (lights_[i].room == room) lit_[static_cast<std::size_t>(room)].push_back({i});
    }
  }
  for (const Opening& o : draft.plan.openings) {
    if (!o.passable()) continue;
    for (std::size_t i = 0; i < lights_.size(); ++i) {
      if (lights_[i].room == o.room_a) lit_[static_cast<std::size_t>(o.room_b)].push_back({i, &o});
      if (lights_[i].room == o.room_b) lit_[static_cast<std::size_t>(o.room_a)].push_back({i, &o});
    }
  }
}

Rgb LightSolver::from_light(const Sample& sample, const VisibleLight& lit) const {
  const Light& light = lights_[lit.light];
  const Vec3x16& targets = targets_[lit.light][sample.phase];
  const Vec3 &from = sample.position, &normal = sample.normal, &axis = light.axis;
  const bool one_sided = light.one_sided();
  Vec3x16 to;
  Vec3x16::Row weight, here, there;
  for (std::size_t i = 0; i < RayTracer::kWidth; ++i) {  // without branches, so that compilers vectorise it
    to.x[i] = targets.x[i] - from.x(), to.y[i] = targets.y[i] - from.y(), to.z[i] = targets.z[i] - from.z();
    const float square = to.x[i] * to.x[i] + (to.y[i] * to.y[i] + to.z[i] * to.z[i]), distance = std::sqrt(square);
    here[i] = (to.x[i] * normal.x() + (to.y[i] * normal.y() + to.z[i] * normal.z())) / distance;
    const float ahead = -(to.x[i] * axis.x() + (to.y[i] * axis.y() + to.z[i] * axis.z())) / distance;
    const float around = 0.6f + 0.4f * to.y[i] / distance;
    there[i] = one_sided ? ahead : around;
    weight[i] = here[i] * there[i] / (square + kSoftening);
  }
  std::array<bool, RayTracer::kWidth> active;
  bool any = false;
  for (std::size_t i = 0; i < RayTracer::kWidth; ++i) {
    active[i] = here[i] > 0.f && there[i] > 0.f && (lit.through == nullptr || passes(*lit.through, from, targets[i]));
    any = any || active[i];
  }
  if (!any) return Rgb::Zero();
  const auto blocked = tracer_->blocked(from, to, active);
  float sum = 0.f;
  for (std::size_t i = 0; i < RayTracer::kWidth; ++i) sum += blocked[i] ? 0.f : weight[i];
  return light.strength * (sum / RayTracer::kWidth);
}

Rgb LightSolver::direct(const Sample& sample) const {
  Rgb sum = Rgb::Zero();
  if (sample.room == kOutside) return sum;
  for (const VisibleLight& lit : lit_[static_cast<std::size_t>(sample.room)]) sum += from_light(sample, lit);
  return sum;
}

Rgb LightSolver::bounced(const Sample& sample, const std::vector<Vec3x16>& hemisphere,
                         const std::vector<Rgb>& direct_light, const std::vector<Rgb>& ambient) const {
  const Frame frame = frame_around(sample.normal);
  Rgb sum = Rgb::Zero();
  for (const Vec3x16& local : hemisphere) {
    Vec3x16 directions;
    for (std::size_t i = 0; i < RayTracer::kWidth; ++i) {
      directions.x[i] = local.x[i] * frame.x.x() + local.y[i] * frame.y.x() + local.z[i] * frame.z.x();
      directions.y[i] = local.x[i] * frame.x.y() + local.y[i] * frame.y.y() + local.z[i] * frame.z.y();
      directions.z[i] = local.x[i] * frame.x.z() + local.y[i] * frame.y.z() + local.z[i] * frame.z.z();
    }
    const auto hits = tracer_->trace(sample.position, directions);
    for (std::size_t i = 0; i < RayTracer::kWidth; ++i) {
      if (hits[i].triangle < 0) continue;
      const Face& face = faces_[static_cast<std::size_t>(hits[i].triangle)];
      Rgb light;
      if (face.chart != scene::kNone) {
        const auto chart = static_cast<std::size_t>(face.chart);
        light = direct_light[atlas_.texel_at(charts_[chart], atlas_.places[chart],
                                             sample.position + hits[i].distance * directions[i])];
      } else {
        light = (1.f - hits[i].u - hits[i].v) * direct_light[face.vertices[0]] +
                hits[i].u * direct_light[face.vertices[1]] + hits[i].v * direct_light[face.vertices[2]];
      }
      const std::int32_t room = face_room_[static_cast<std::size_t>(hits[i].triangle)];
      if (room != kOutside) light += ambient[static_cast<std::size_t>(room)];
      sum += face.albedo.cwiseProduct(light);
    }
  }
  return sum / static_cast<float>(hemisphere.size() * RayTracer::kWidth);
}

/// Light of the second and later bounces: a geometric series with the mean light and a middling albedo.
std::vector<Rgb> LightSolver::ambient(const std::vector<Rgb>& direct_light, std::size_t rooms) const {
  std::vector<Rgb> sum(rooms, Rgb::Zero());
  std::vector<float> count(rooms, 0.f);
  for (std::size_t i = 0; i < atlas_.texels; ++i) {
    if (samples_[i].room == kOutside) continue;
    const auto room = static_cast<std::size_t>(samples_[i].room);
    sum[room] += direct_light[i];
    count[room] += 1.f;
  }
  constexpr float kAlbedo = 0.45f;
  for (std::size_t room = 0; room < rooms; ++room) sum[room] *= kAlbedo / (1.f - kAlbedo) / std::max(count[room], 1.f);
  return sum;
}

std::vector<Rgb> LightSolver::solve(ThreadPool& pool) const {
  const std::size_t blocks = (samples_.size() + kBlock - 1) / kBlock;
  std::vector<Rgb> first(samples_.size()), total(samples_.size());
  const auto for_all = [&](const auto& body) {
    pool.parallel_for(blocks, [&](std::size_t block) {
      for (std::size_t i = block * kBlock; i < std::min(samples_.size(), (block + 1) * kBlock); ++i) body(i);
    });
  };
  for_all([&](std::size_t i) { first[i] = direct(samples_[i]); });
  const std::vector<Rgb> later = ambient(first, lit_.size());
  for_all([&](std::size_t i) {
    const std::vector<Vec3x16>& hemisphere = i < atlas_.texels ? texel_rays_[samples_[i].phase] : vertex_rays_;
    total[i] = first[i] + bounced(samples_[i], hemisphere, first, later);
  });
  return total;
}

}  // namespace wiw::apartment
