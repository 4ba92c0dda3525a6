// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/sun_map.hpp"

#include "wiw/render/gpu/program.hpp"

namespace wiw::render::gpu {

namespace {

/// What covers more of the scene than this, as the sun sees it, is not in the finer square.
constexpr float kLargeShare = 0.25f;

Eigen::AlignedBox3f bounds_along(const Eigen::Matrix3f& axes, const scene::Instance& instance,
                                 const Eigen::Affine3f& pose, const std::vector<MeshRange>& meshes) {
  Eigen::AlignedBox3f bounds;
  const Eigen::Affine3f T_map_instance = axes * pose;
  for (const std::uint32_t mesh : instance.meshes) {
    if (meshes[mesh].chunk_count == 0) continue;
    for (int corner = 0; corner < 8; ++corner) {
      bounds.extend(T_map_instance * meshes[mesh].box.corner(static_cast<Eigen::AlignedBox3f::CornerType>(corner)));
    }
  }
  return bounds;
}

float area(const Eigen::AlignedBox3f& box) { return box.isEmpty() ? 0.f : box.sizes().x() * box.sizes().y(); }

/// Bounds of the whole scene and of its small instances in the frame whose rows are `axes`; heights are the scene's.
std::array<Eigen::AlignedBox3f, kSunSquares> bounds_of_squares(const Eigen::Matrix3f& axes, const scene::Scene& scene,
                                                               const std::vector<MeshRange>& meshes,
                                                               const std::vector<Eigen::Affine3f>& poses) {
  std::vector<Eigen::AlignedBox3f> boxes;
  Eigen::AlignedBox3f whole;
  for (std::size_t i = 0; i < poses.size(); ++i) {
    whole.extend(boxes.emplace_back(bounds_along(axes, scene.instances[i], poses[i], meshes)));
  }
  Eigen::AlignedBox3f small;
  for (const Eigen::AlignedBox3f& box : boxes) {
    if (area(box) <= kLargeShare * area(whole)) small.extend(box);
  }
  if (small.isEmpty()) small = whole;
  small.min().z() = whole.min().z();
  small.max().z() = whole.max().z();
  return {whole, small};
}

}  // namespace

SunBlock sun_block(const scene::Sun& sun, const scene::Scene& scene, const std::vector<MeshRange>& meshes,
                   const std::vector<Eigen::Affine3f>& poses, int side) {
  const Eigen::Vector3f direction = sun.direction.normalized();
  const Eigen::Vector3f right = direction.unitOrthogonal();
  Eigen::Matrix3f axes;
  axes << right.transpose(), direction.cross(right).transpose(), direction.transpose();
  SunBlock block;
  block.right.head<3>() = axes.row(0);
  block.up.head<3>() = axes.row(1);
  block.direction.head<3>() = axes.row(2);
  block.light = {sun.ambient, sun.strength, 0, 0};
  const auto bounds = bounds_of_squares(axes, scene, meshes, poses);
  for (std::size_t i = 0; i < kSunSquares; ++i) {
    // Two texels on each side, so that edges blur within the square; heights start above zero, which means nothing.
    const Eigen::Vector3f size = bounds[i].sizes().cwiseMax(1e-3f);
    const Eigen::Vector2f texel = size.head<2>() / static_cast<float>(side - 4);
    const Eigen::Vector3f margin(2 * texel.x(), 2 * texel.y(), 1e-3f * size.z());
    const Eigen::Vector3f corner = axes.transpose() * (bounds[i].min() - margin);
    block.corner[i] = {corner.x(), corner.y(), corner.z(), 0};
    block.grid[i] = {texel.x(), texel.y(), size.z() + 2 * margin.z(), static_cast<float>(side)};
  }
  return block;
}

ViewBlock sun_view(const SunBlock& block, std::size_t square) {
  ViewBlock view;
  view.right = block.right;
  view.up = block.up;
  view.back = block.direction;
  const Eigen::Vector4f& grid = block.grid[square];
  const Eigen::Vector2f half = 0.5f * grid[3] * grid.head<2>();
  view.eye = block.corner[square] + half.x() * block.right + half.y() * block.up;
  view.projection = {1 / half.x(), 1 / half.y(), 0, 0};
  view.lens = {1 / grid[2], 0, 0, 0};
  return view;
}

SunMap::SunMap(GlContext& context, const scene::Sun& sun)
    : context_(context),
      sun_(sun),
      target_(context.gl()),
      block_(context.gl(), context.info().uniform_alignment),
      views_(context.gl(), context.info().uniform_alignment) {}

void SunMap::begin(const scene::Scene& scene, const std::vector<MeshRange>& meshes,
                   const std::vector<Eigen::Affine3f>& poses) {
  const SunBlock block = sun_block(sun_, scene, meshes, poses, kSunSide);
  const std::array<ViewBlock, kSunSquares> views{sun_view(block, 0), sun_view(block, 1)};
  block_.upload(std::span(&block, 1), GL_DYNAMIC_DRAW);
  views_.upload(views, GL_DYNAMIC_DRAW);
  constexpr ProgramKey kNoOutputs = 0;
  const Size size{static_cast<int>(kSunSquares) * kSunSide, kSunSide};
  target_.reserve(size, 1, kNoOutputs, true);
  target_.bind(0, kNoOutputs, true);
  const Gl& gl = context_.gl();
  gl.Scissor(0, 0, size.width, size.height);
  gl.Enable(GL_DEPTH_TEST);
  gl.DepthFunc(GL_GREATER);
  gl.DepthMask(GL_TRUE);
  target_.clear(kNoOutputs, true);
}

void SunMap::begin_square(std::size_t square) const {
  const Gl& gl = context_.gl();
  const int first_row = static_cast<int>(square) * kSunSide;
  gl.Viewport(0, first_row, kSunSide, kSunSide);
  gl.Scissor(0, first_row, kSunSide, kSunSide);
  views_.bind(kViewBinding, square);
}

void SunMap::bind() const {
  const Gl& gl = context_.gl();
  block_.bind(kSunBinding, 0);
  gl.ActiveTexture(GL_TEXTURE0 + kSunUnit);
  gl.BindTexture(GL_TEXTURE_2D_ARRAY, target_.depth_texture());
  gl.BindSampler(kSunUnit, 0);
}

}  // namespace wiw::render::gpu
