// SPDX-License-Identifier: Apache-2.0
#include "wiw/physics/world.hpp"

#include <BulletDynamics/Featherstone/btMultiBodyFixedConstraint.h>

#include <cmath>
#include <utility>
#include <variant>

#include "wiw/core/error.hpp"
#include "wiw/physics/bullet/arm.hpp"
#include "wiw/physics/bullet/convert.hpp"
#include "wiw/physics/bullet/rigid.hpp"
#include "wiw/physics/bullet/simulation.hpp"

namespace wiw::physics {

namespace {

void append(std::vector<double>& numbers, const auto& values) {
  numbers.insert(numbers.end(), values.data(), values.data() + values.size());
}

class NumberReader {
 public:
  explicit NumberReader(const std::vector<double>& numbers) : numbers_(numbers) {}
  Eigen::VectorXd next(Eigen::Index count) {
    const Eigen::Map<const Eigen::VectorXd> values(numbers_.data() + at_, count);
    at_ += count;
    return values;
  }

 private:
  const std::vector<double>& numbers_;
  std::ptrdiff_t at_ = 0;
};

ContactSide side_of(const btCollisionObject& object, int part, const std::vector<std::unique_ptr<Arm>>& arms) {
  const int index = object.getUserIndex();
  if (index >= 0) return {.body = index};
  const int articulation = -1 - index;
  const std::vector<int>& links = arms[static_cast<std::size_t>(articulation)]
                                      ->model()
                                      ->groups[static_cast<std::size_t>(object.getUserIndex2())]
                                      .part_link;
  // Only compounds number their parts.
  const auto child = static_cast<std::size_t>(object.getCollisionShape()->isCompound() ? part : 0);
  return {.articulation = articulation, .link = links[child]};
}

}  // namespace

struct World::Impl {
  using Built = std::variant<std::shared_ptr<const RigidModel>, std::pair<std::shared_ptr<const ArmModel>, Pose>>;

  explicit Impl(const WorldOptions& wanted) : options(wanted), simulation(wanted) {}
  ~Impl() { drop_constraints(); }
  Impl(const Impl&) = delete;
  Impl& operator=(const Impl&) = delete;

  Rigid& body(int index) {
    if (index >= 0 && index < static_cast<int>(bodies.size())) return *bodies[static_cast<std::size_t>(index)];
    throw ArgumentError("no body " + std::to_string(index) + "; the world has " + std::to_string(bodies.size()));
  }
  Arm& arm(int index) {
    if (index >= 0 && index < static_cast<int>(arms.size())) return *arms[static_cast<std::size_t>(index)];
    throw ArgumentError("no articulation " + std::to_string(index) + "; the world has " + std::to_string(arms.size()));
  }

  int build(const std::shared_ptr<const RigidModel>& model) {
    bodies.push_back(std::make_unique<Rigid>(model, simulation.world(), static_cast<int>(bodies.size())));
    built.emplace_back(model);
    return static_cast<int>(bodies.size()) - 1;
  }
  int build(const std::shared_ptr<const ArmModel>& model, const Pose& base) {
    arms.push_back(std::make_unique<Arm>(model, base, simulation.world()));
    arms.back()->set_index(static_cast<int>(arms.size()) - 1);
    built.emplace_back(std::pair(model, base));
    return static_cast<int>(arms.size()) - 1;
  }

  void drop_constraints() {
    for (const auto& constraint : constraints) simulation.world().removeMultiBodyConstraint(constraint.get());
    constraints.clear();
  }

  /// Makes the constraints anew: their order is that of `attachments`, whatever happened before.
  void hold(std::vector<Attachment> wanted) {
    drop_constraints();
    attachments = std::move(wanted);
    for (const Attachment& each : attachments) {
      Arm& holder = arm(each.articulation);
      const int group = holder.model()->group_of_link[static_cast<std::size_t>(each.link)];
      const btTransform frame = to_bullet(each.T_frame_body);
      constraints.push_back(std::make_unique<btMultiBodyFixedConstraint>(
          &holder.multibody(), group - 1, &body(each.body).object(), frame.getOrigin(), btVector3(0, 0, 0),
          frame.getBasis(), btMatrix3x3::getIdentity()));
      constraints.back()->setMaxAppliedImpulse(kHoldingForce * options.time_step);
      simulation.world().addMultiBodyConstraint(constraints.back().get());
    }
  }

  std::vector<Contact> detect(double distance) {
    simulation.world().performDiscreteCollisionDetection();
    std::vector<Contact> contacts;
    btDispatcher& dispatcher = *simulation.world().getDispatcher();
    for (int m = 0; m < dispatcher.getNumManifolds(); ++m) {
      const btPersistentManifold& manifold = *dispatcher.getManifoldByIndexInternal(m);
      for (int p = 0; p < manifold.getNumContacts(); ++p) {
        const btManifoldPoint& point = manifold.getContactPoint(p);
        if (point.getDistance() > distance) continue;
        contacts.push_back({side_of(*manifold.getBody0(), point.m_index0, arms),
                            side_of(*manifold.getBody1(), point.m_index1, arms), to_eigen(point.getPositionWorldOnB()),
                            to_eigen(point.m_normalWorldOnB), point.getDistance()});
      }
    }
    return contacts;
  }

  [[nodiscard]] std::vector<double> numbers() const {
    std::vector<double> values;
    for (const auto& each : bodies) {
      append(values, each->frame_pose().matrix());
      append(values, each->velocity());
    }
    for (const auto& each : arms) {
      for (const Eigen::VectorXd& v : {each->positions(), each->velocities(), each->targets(), each->forces()}) {
        append(values, v);
      }
    }
    return values;
  }

  [[nodiscard]] std::vector<int> layout() const {
    std::vector<int> counts{static_cast<int>(bodies.size())};
    for (const auto& each : arms) {
      counts.push_back(each->articulation().dof());
      counts.push_back(static_cast<int>(each->articulation().links().size()));
    }
    return counts;
  }

  void set_numbers(const std::vector<double>& values) {
    NumberReader reader(values);
    for (const auto& each : bodies) {
      Pose pose;
      pose.matrix() = reader.next(16).reshaped(4, 4);
      each->set_frame_pose(pose);
      each->set_velocity(reader.next(6));
    }
    for (const auto& each : arms) {
      const Eigen::Index dof = each->articulation().dof();
      each->set_positions(reader.next(dof));
      each->set_velocities(reader.next(dof));
      each->set_targets(reader.next(dof));
      each->set_forces(reader.next(dof));
    }
  }

  /// Moves the bodies that the articulation holds to where its links are.
  void carry(int articulation) {
    for (const Attachment& each : attachments) {
      if (each.articulation != articulation) continue;
      Arm& holder = arm(articulation);
      const int group = holder.model()->group_of_link[static_cast<std::size_t>(each.link)];
      body(each.body).set_frame_pose(holder.frame_pose(group) * each.T_frame_body);
    }
  }

  static constexpr double kHoldingForce = 500;  // N and Nm; far above any weight that is lifted here

  const WorldOptions options;
  Simulation simulation;
  std::vector<Built> built;
  std::vector<std::unique_ptr<Rigid>> bodies;
  std::vector<std::unique_ptr<Arm>> arms;
  std::vector<Attachment> attachments;
  std::vector<std::unique_ptr<btMultiBodyFixedConstraint>> constraints;
  std::int64_t steps = 0;
  std::optional<std::vector<WorldState>> recording;
};

World::World(const WorldOptions& options) : impl_(std::make_unique<Impl>(options)) {}
World::~World() = default;

const WorldOptions& World::options() const { return impl_->options; }
double World::time() const { return static_cast<double>(impl_->steps) * impl_->options.time_step; }
int World::body_count() const { return static_cast<int>(impl_->bodies.size()); }
const Body& World::body(int body) const { return impl_->body(body).model().body; }
const ArticulationPtr& World::articulation(int articulation) const {
  return impl_->arm(articulation).model()->articulation;
}
const Pose& World::base_pose(int articulation) const { return impl_->arm(articulation).base(); }

int World::add_body(const Body& body) { return impl_->build(std::make_shared<const RigidModel>(body)); }

int World::add_articulation(ArticulationPtr articulation, const Pose& T_world_base) {
  check_pose(T_world_base, "T_world_base");
  return impl_->build(std::make_shared<const ArmModel>(std::move(articulation)), T_world_base);
}

void World::step(int count) {
  if (count < 0) throw ArgumentError("expected a number of steps of 0 or more, got " + std::to_string(count));
  for (int i = 0; i < count; ++i) {
    impl_->simulation.step();
    ++impl_->steps;
    if (impl_->recording) impl_->recording->push_back(snapshot());
  }
}

std::vector<Pose> World::body_poses() const {
  std::vector<Pose> poses;
  poses.reserve(impl_->bodies.size());
  for (const auto& body : impl_->bodies) poses.push_back(body->pose());
  return poses;
}

std::vector<Vector6> World::body_velocities() const {
  std::vector<Vector6> velocities;
  velocities.reserve(impl_->bodies.size());
  for (const auto& body : impl_->bodies) velocities.push_back(body->velocity());
  return velocities;
}

void World::set_body_pose(int body, const Pose& T_world_body) {
  check_pose(T_world_body, "T_world_body");
  Rigid& rigid = impl_->body(body);
  rigid.set_frame_pose(T_world_body * rigid.model().frame.pose);
  rigid.set_velocity(Vector6::Zero());
}

void World::set_body_velocity(int body, const Vector6& velocity) {
  if (!velocity.allFinite()) throw ArgumentError("velocity: expected finite numbers, got NaN or infinity");
  if (impl_->body(body).model().body.mass == 0) throw ArgumentError("a static body has no velocity to set");
  impl_->body(body).set_velocity(velocity);
}

Eigen::VectorXd World::joint_positions(int articulation) const { return impl_->arm(articulation).positions(); }
Eigen::VectorXd World::joint_velocities(int articulation) const { return impl_->arm(articulation).velocities(); }
Eigen::VectorXd World::joint_targets(int articulation) const { return impl_->arm(articulation).targets(); }
Eigen::VectorXd World::joint_forces(int articulation) const { return impl_->arm(articulation).forces(); }

std::vector<Pose> World::link_poses(int articulation) const {
  const Arm& arm = impl_->arm(articulation);
  std::vector<Pose> poses = arm.articulation().forward_kinematics(arm.positions());
  for (Pose& pose : poses) pose = arm.base() * pose;
  return poses;
}

std::vector<Pose> World::simulated_link_poses(int articulation) const {
  const Arm& arm = impl_->arm(articulation);
  const ArmModel& model = *arm.model();
  std::vector<Pose> poses;
  for (std::size_t link = 0; link < model.group_of_link.size(); ++link) {
    const int group = model.group_of_link[link];
    const Pose first =
        arm.simulated_frame_pose(group) * model.groups[static_cast<std::size_t>(group)].frame.pose.inverse();
    poses.push_back(first * model.T_group_link[link]);
  }
  return poses;
}

void World::set_joint_positions(int articulation, const Eigen::VectorXd& positions) {
  Arm& arm = impl_->arm(articulation);
  arm.articulation().check_within_limits(positions, "positions");
  const Eigen::VectorXd clamped = arm.articulation().apply_mimics(positions);
  arm.set_positions(clamped);
  arm.set_velocities(Eigen::VectorXd::Zero(clamped.size()));
  arm.set_targets(clamped);
}

void World::set_joint_velocities(int articulation, const Eigen::VectorXd& velocities) {
  Arm& arm = impl_->arm(articulation);
  arm.articulation().check_positions(velocities, "velocities");
  arm.set_velocities(velocities);
}

void World::set_joint_targets(int articulation, const Eigen::VectorXd& targets) {
  Arm& arm = impl_->arm(articulation);
  arm.articulation().check_within_limits(targets, "targets");
  arm.set_targets(arm.articulation().apply_mimics(targets));
}

void World::set_joint_forces(int articulation, const Eigen::VectorXd& forces) {
  Arm& arm = impl_->arm(articulation);
  arm.articulation().check_positions(forces, "forces");
  if ((forces.array() < 0).any()) throw ArgumentError("forces: expected 0 or more for every joint");
  arm.set_forces(forces);
}

std::vector<Contact> World::contacts(double distance) {
  if (!std::isfinite(distance)) throw ArgumentError("distance: expected a finite number of metres");
  return impl_->detect(distance);
}

std::optional<PathCollision> World::first_collision(int articulation, const std::vector<Eigen::VectorXd>& positions,
                                                    const Touchable& allowed, double tolerance) {
  Arm& arm = impl_->arm(articulation);
  for (const Eigen::VectorXd& each : positions) arm.articulation().check_positions(each, "positions");
  for (const int body : allowed.bodies) impl_->body(body);
  for (const int other : allowed.articulations) impl_->arm(other);
  const auto held = [&](const ContactSide& side) {
    return std::any_of(impl_->attachments.begin(), impl_->attachments.end(), [&](const Attachment& each) {
      return each.articulation == articulation && each.body == side.body;
    });
  };
  const auto ours = [&](const ContactSide& side) { return side.articulation == articulation || held(side); };
  const auto free = [&](const ContactSide& side) {
    return ours(side) || (side.body >= 0 && std::ranges::find(allowed.bodies, side.body) != allowed.bodies.end()) ||
           std::ranges::find(allowed.articulations, side.articulation) != allowed.articulations.end();
  };
  const std::vector<double> before = impl_->numbers();
  std::vector<Contact> begun;  // overlaps of the first position
  const auto deepens = [&](const Contact& contact) {
    return std::ranges::none_of(begun, [&](const Contact& first) {
      return first.a == contact.a && first.b == contact.b && contact.distance > first.distance - tolerance;
    });
  };
  std::optional<PathCollision> found;
  for (std::size_t i = 0; i < positions.size() && !found; ++i) {
    arm.set_positions(positions[i]);
    impl_->carry(articulation);
    for (const Contact& contact : impl_->detect(-tolerance)) {
      if (!((ours(contact.a) && !free(contact.b)) || (ours(contact.b) && !free(contact.a)))) continue;
      if (i == 0) {
        begun.push_back(contact);
      } else if (deepens(contact)) {
        found = PathCollision{static_cast<int>(i), contact};
        break;
      }
    }
  }
  impl_->set_numbers(before);
  return found;
}

void World::attach(int articulation, int link, int body) {
  Arm& arm = impl_->arm(articulation);
  Rigid& rigid = impl_->body(body);
  if (link < 0 || link >= static_cast<int>(arm.articulation().links().size())) {
    throw ArgumentError("no link " + std::to_string(link) + " in articulation " + std::to_string(articulation));
  }
  if (rigid.model().body.mass == 0)
    throw ArgumentError("body '" + rigid.model().body.name + "' is static and cannot be held");
  for (const Attachment& each : impl_->attachments) {
    if (each.body == body)
      throw ArgumentError("body '" + rigid.model().body.name + "' is held already; detach it first");
  }
  const int group = arm.model()->group_of_link[static_cast<std::size_t>(link)];
  std::vector<Attachment> wanted = impl_->attachments;
  wanted.push_back({articulation, link, body, arm.frame_pose(group).inverse() * rigid.frame_pose()});
  impl_->hold(std::move(wanted));
}

void World::detach(int articulation) {
  impl_->arm(articulation);
  std::vector<Attachment> kept = impl_->attachments;
  std::erase_if(kept, [articulation](const Attachment& each) { return each.articulation == articulation; });
  impl_->hold(std::move(kept));
}

const std::vector<Attachment>& World::attachments() const { return impl_->attachments; }

WorldState World::snapshot() const { return {impl_->steps, impl_->numbers(), impl_->attachments, impl_->layout()}; }

void World::restore(const WorldState& state) {
  if (state.layout != impl_->layout()) {
    const auto told = [](const std::vector<int>& layout) {
      return std::to_string(layout[0]) + " bodies and " + std::to_string(layout.size() / 2) + " articulations";
    };
    throw ArgumentError("the snapshot is of another world: expected one of " + told(impl_->layout()) +
                        " with the same joints and links, got one of " + told(state.layout));
  }
  impl_->set_numbers(state.numbers);
  impl_->hold(state.attachments);
  impl_->steps = state.steps;
}

void World::record() { impl_->recording = {snapshot()}; }

std::vector<WorldState> World::recorded() {
  return std::exchange(impl_->recording, std::nullopt).value_or(std::vector<WorldState>{});
}

std::unique_ptr<World> World::fork() const {
  auto other = std::make_unique<World>(impl_->options);
  for (const Impl::Built& each : impl_->built) {
    if (const auto* rigid = std::get_if<0>(&each)) {
      other->impl_->build(*rigid);
    } else {
      other->impl_->build(std::get<1>(each).first, std::get<1>(each).second);
    }
  }
  other->restore(snapshot());
  return other;
}

}  // namespace wiw::physics
