// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/gpu_renderer.hpp"

#include <algorithm>
#include <optional>
#include <tuple>
#include <utility>

#include "wiw/core/error.hpp"
#include "wiw/render/gpu/draw_list.hpp"
#include "wiw/render/gpu/scene_buffers.hpp"
#include "wiw/render/gpu/sun_map.hpp"
#include "wiw/render/gpu/workspace.hpp"
#include "wiw/render/request.hpp"
#include "wiw/render/shading.hpp"

namespace wiw::render::gpu {

namespace {

/// Views drawn before one read-back: drivers give at least 256 layers.
constexpr std::size_t kBatchViews = 256;

int grid_side(int samples) { return samples == 16 ? 4 : samples == 9 ? 3 : samples == 4 ? 2 : 1; }

std::vector<Eigen::Vector2f> sample_offsets(int samples) {
  const int n = grid_side(samples);
  std::vector<Eigen::Vector2f> offsets;
  for (int j = 0; j < n; ++j) {
    for (int i = 0; i < n; ++i) {
      offsets.emplace_back(shading::sample_offset(i, j, n), shading::sample_offset(j, n - 1 - i, n));
    }
  }
  return offsets;
}

ProgramKey outputs_of(const RenderTargets& targets) {
  return (targets.color != nullptr ? kColorOut : 0u) | (targets.depth != nullptr ? kDepthOut : 0u) |
         (targets.instance != nullptr ? kIdOut : 0u);
}

/// What one renderer keeps on the device. Make, use and destroy while the context is current.
struct GraphicsMemory {
  GraphicsMemory(GlContext& context, const scene::Scene& content, const SceneGeometry& geometry)
      : scene(context, content, geometry),
        views(context.gl(), context.info().uniform_alignment),
        no_vertices(context.gl()) {
    if (content.sun) sun.emplace(context, *content.sun);
  }

  SceneBuffers scene;
  UniformSlots<ViewBlock> views;
  GlVertexArray no_vertices;
  std::optional<SunMap> sun;
};

}  // namespace

class GpuRenderer final : public Renderer {
 public:
  GpuRenderer(scene::ScenePtr scene, const RenderOptions& options)
      : scene_(std::move(scene)), samples_(options.samples), context_(GlContext::shared()) {
    if (scene_->triangle_count() == 0) throw ArgumentError("render: scene '" + scene_->name + "' has no triangles");
    SceneGeometry geometry = build_geometry(*scene_);
    for (const scene::Instance& instance : scene_->instances) poses_.push_back(instance.T_world_instance);
    const GlContext::Current current(*context_);
    gl_ = &context_->gl();
    memory_ = std::make_unique<GraphicsMemory>(*context_, *scene_, geometry);
    chunks_ = std::move(geometry.chunks);
    meshes_ = std::move(geometry.meshes);
  }

  ~GpuRenderer() override {
    try {
      const GlContext::Current current(*context_);
      memory_.reset();
    } catch (const Error&) {
      // The context is lost or belongs to the parent process: its objects are gone or not ours to delete.
      std::ignore = memory_.release();
    }
  }

  GpuRenderer(const GpuRenderer&) = delete;
  GpuRenderer& operator=(const GpuRenderer&) = delete;

  void render(std::span<const Pose> T_world_camera, const Camera& camera, const RenderTargets& targets) override {
    check_request(T_world_camera, camera);
    if (outputs_of(targets) == 0 || T_world_camera.empty()) return;
    check_size(camera);
    const GlContext::Current current(*context_);
    prepare_state();
    if (auto& sun = memory_->sun; sun && targets.color != nullptr) prepare_sun(*sun);
    std::size_t step = std::clamp<std::size_t>(kBatchPixels / camera.size.pixels(), 1, kBatchViews);
    for (std::size_t first = 0; first < T_world_camera.size();) {
      const auto part = T_world_camera.subspan(first, std::min(step, T_world_camera.size() - first));
      try {
        render_part(part, first, camera, targets);
        first += part.size();
      } catch (const OutOfGraphicsMemory&) {
        context_->workspace().release();
        if (part.size() == 1) throw;
        step = part.size() / 2;
      }
    }
  }

  void set_poses(std::span<const std::uint32_t> ids, std::span<const Eigen::Affine3f> poses) override {
    check_poses(*scene_, ids, poses);
    const GlContext::Current current(*context_);
    for (std::size_t i = 0; i < ids.size(); ++i) {
      poses_[ids[i] - 1] = poses[i];
      memory_->scene.set_pose(ids[i], poses[i]);
    }
    sun_is_drawn_ = false;
    context_->check("moving instances");
  }

  [[nodiscard]] const scene::Scene& scene() const override { return *scene_; }

  [[nodiscard]] std::string description() const override {
    const GlContext::Info& info = context_->info();
    return "gpu (" + info.renderer + ", OpenGL " + info.version.substr(0, info.version.find(' ')) + ")";
  }

 private:
  void check_size(const Camera& camera) const {
    const int limit = context_->info().max_texture_size;
    const bool panorama = camera.projection == Projection::kEquirectangular;
    const int side = std::max({camera.size.width, camera.size.height, panorama ? face_size(camera.size, samples_) : 0});
    if (side > limit) {
      throw ArgumentError("render: " + std::to_string(camera.size.height) + " x " + std::to_string(camera.size.width) +
                          " with " + std::to_string(samples_) + " samples needs a target of side " +
                          std::to_string(side) + ", but this OpenGL driver gives at most " + std::to_string(limit) +
                          "; ask for less or use backend=\"cpu\"");
    }
  }

  void prepare_state() {
    // Not every state below is the context's default, and renderers share it.
    gl_->ClipControl(GL_LOWER_LEFT, GL_ZERO_TO_ONE);
    gl_->Disable(GL_CULL_FACE);
    gl_->Disable(GL_BLEND);
    gl_->Disable(GL_DITHER);
    gl_->Enable(GL_SCISSOR_TEST);
    gl_->PixelStorei(GL_PACK_ALIGNMENT, 1);
  }

  /// Draws the sun's map, if instances have moved since, and binds it.
  void prepare_sun(SunMap& sun) {
    if (!sun_is_drawn_) {
      sun.begin(*scene_, meshes_, poses_);
      memory_->scene.bind_geometry();
      draws_.gather_all(*scene_, meshes_);
      for (std::size_t square = 0; square < kSunSquares; ++square) {
        sun.begin_square(square);
        draw_chunks(kParallel);
      }
      context_->check("drawing shadows");
      sun_is_drawn_ = true;
    }
    sun.bind();
  }

  void bind_layer(Framebuffer& target, int layer, Size size, ProgramKey outputs, bool depth_test) {
    target.bind(layer, outputs, depth_test);
    gl_->Viewport(0, 0, size.width, size.height);
    gl_->Scissor(0, 0, size.width, size.height);
    gl_->DepthMask(GL_TRUE);
    if (depth_test) {
      gl_->Enable(GL_DEPTH_TEST);
      target.clear(outputs, depth_test);
    } else {
      gl_->Disable(GL_DEPTH_TEST);
    }
  }

  /// Views that are drawn together and read back at once, to the targets' places from `first` on.
  void render_part(std::span<const Pose> part, std::size_t first, const Camera& camera, const RenderTargets& targets) {
    if (camera.projection == Projection::kPerspective) {
      draw_perspective(part, camera, outputs_of(targets));
    } else {
      draw_panoramas(part, camera, outputs_of(targets));
    }
    read_back(camera.size, part.size(), first, targets);
    context_->check("rendering");
  }

  void draw_perspective(std::span<const Pose> poses, const Camera& camera, ProgramKey outputs) {
    const std::vector<Eigen::Vector2f> offsets = sample_offsets(samples_);
    const bool sampled = samples_ > 1 && (outputs & kColorOut) != 0;
    Framebuffer& batch = context_->workspace().batch;
    batch.reserve(camera.size, static_cast<int>(poses.size()), outputs, true);
    if (sampled) context_->workspace().samples.reserve(camera.size, samples_, kColorOut, true);
    std::vector<ViewBlock> views;
    for (const Pose& pose : poses) views.push_back(perspective_view(pose, camera, Eigen::Vector2f::Zero(), 1));
    if (sampled) {
      for (const Pose& pose : poses) {
        for (const auto& offset : offsets) views.push_back(perspective_view(pose, camera, offset, samples_));
      }
    }
    memory_->views.upload(views, GL_STREAM_DRAW);
    const ProgramKey direct = sampled ? outputs & ~kColorOut : outputs;
    for (std::size_t i = 0; i < poses.size() && direct != 0; ++i) {
      bind_layer(batch, static_cast<int>(i), camera.size, direct, true);
      draw_view(views, i, direct);
    }
    for (std::size_t i = 0; i < poses.size() && sampled; ++i) {
      draw_samples(views, poses.size() + i * offsets.size(), camera.size);
      bind_layer(batch, static_cast<int>(i), camera.size, kColorOut, false);
      average_samples();
    }
  }

  void draw_samples(const std::vector<ViewBlock>& views, std::size_t first_view, Size size) {
    Framebuffer& target = context_->workspace().samples;
    for (int i = 0; i < samples_; ++i) {
      bind_layer(target, i, size, kColorOut, true);
      draw_view(views, first_view + static_cast<std::size_t>(i), kColorOut);
    }
  }

  void average_samples() {
    const GLuint program = context_->programs().average();
    gl_->UseProgram(program);
    set_integer(program, "sample_count", samples_);
    bind_map(kColorUnit, context_->workspace().samples.texture(kColorTarget));
    draw_screen(0);
  }

  void draw_panoramas(std::span<const Pose> poses, const Camera& camera, ProgramKey outputs) {
    const int side = face_size(camera.size, samples_);
    const ProgramKey face_outputs = outputs | kIdOut | kCubeFace;
    Framebuffer& batch = context_->workspace().batch;
    Framebuffer& faces = context_->workspace().faces;
    batch.reserve(camera.size, static_cast<int>(poses.size()), outputs, false);
    faces.reserve({side, side}, kFaces, face_outputs, true);
    std::vector<ViewBlock> views;
    for (const Pose& pose : poses) {
      for (int face = 0; face < kFaces; ++face) views.push_back(face_view(pose, face, camera.size, samples_));
    }
    memory_->views.upload(views, GL_STREAM_DRAW);
    for (std::size_t i = 0; i < poses.size(); ++i) {
      for (int face = 0; face < kFaces; ++face) {
        bind_layer(faces, face, {side, side}, face_outputs, true);
        draw_view(views, i * kFaces + static_cast<std::size_t>(face), face_outputs);
      }
      bind_layer(batch, static_cast<int>(i), camera.size, outputs, false);
      resolve_panorama(i * kFaces, camera.size, side, outputs);
    }
  }

  void resolve_panorama(std::size_t front_view, Size size, int side, ProgramKey outputs) {
    const GLuint program = context_->programs().panorama(outputs | (samples_ > 1 ? kSampled : 0u));
    gl_->UseProgram(program);
    set_integer(program, "face_size", side);
    set_integer(program, "width", size.width);
    set_integer(program, "height", size.height);
    set_integer(program, "sample_count", samples_);
    const auto offsets = sample_offsets(samples_);
    gl_->Uniform2fv(context_->programs().uniform(program, "samples"), samples_, offsets.front().data());
    set_sky(program);
    const Framebuffer& faces = context_->workspace().faces;
    bind_map(kColorUnit, faces.texture(kColorTarget));
    bind_map(kDepthUnit, faces.texture(kDepthTarget));
    bind_map(kIdUnit, faces.texture(kIdTarget));
    bind_map(kSlopeUnit, faces.texture(kSlopeTarget));
    draw_screen(front_view);
  }

  /// The scene as `view` sees it, and the sky behind it.
  void draw_view(const std::vector<ViewBlock>& views, std::size_t view, ProgramKey outputs) {
    gl_->DepthFunc(GL_GREATER);
    memory_->views.bind(kViewBinding, view);
    memory_->scene.bind_geometry();
    draws_.gather(views[view], *scene_, meshes_, chunks_, poses_);
    draw_chunks(outputs);
    // A panorama adds the sky where no face has a surface.
    if ((outputs & kColorOut) == 0 || (outputs & kCubeFace) != 0) return;
    const GLuint program = context_->programs().sky(outputs);
    gl_->UseProgram(program);
    set_sky(program);
    gl_->DepthFunc(GL_GEQUAL);
    draw_screen(view);
  }

  void draw_chunks(ProgramKey outputs) {
    ProgramKey key = ~0u;
    std::uint32_t instance = ~0u;
    std::int32_t material = scene::kNone - 1;
    std::int32_t texture = scene::kNone;
    std::int32_t lightmap = scene::kNone;
    for (const Draw& draw : draws_.draws()) {
      const MeshRange& mesh = meshes_[draw.mesh];
      const ProgramKey wanted = reduce(mesh.appearance | outputs);
      if (std::exchange(key, wanted) != wanted) gl_->UseProgram(context_->programs().scene(wanted));
      if (std::exchange(instance, draw.instance) != draw.instance) memory_->scene.bind_instance(draw.instance);
      if (std::exchange(material, mesh.material) != mesh.material) memory_->scene.bind_material(mesh.material);
      if ((wanted & kTextured) != 0 && std::exchange(texture, mesh.texture) != mesh.texture) {
        memory_->scene.bind_texture(mesh.texture);
      }
      if ((wanted & kLightmapped) != 0 && std::exchange(lightmap, mesh.lightmap) != mesh.lightmap) {
        memory_->scene.bind_lightmap(mesh.lightmap);
      }
      const MeshChunk& chunk = chunks_[draw.chunk];
      gl_->DrawElements(GL_TRIANGLES, static_cast<GLsizei>(chunk.index_count), GL_UNSIGNED_INT,
                        buffer_offset(chunk.first_index * sizeof(std::uint32_t)));
    }
  }

  void draw_screen(std::size_t view) {
    memory_->views.bind(kViewBinding, view);
    gl_->BindVertexArray(memory_->no_vertices.id());
    gl_->DepthMask(GL_FALSE);
    gl_->DrawArrays(GL_TRIANGLES, 0, 3);
    gl_->DepthMask(GL_TRUE);
  }

  void bind_map(GLint unit, GLuint texture) {
    gl_->ActiveTexture(GL_TEXTURE0 + static_cast<GLenum>(unit));
    gl_->BindTexture(GL_TEXTURE_2D_ARRAY, texture);
    gl_->BindSampler(static_cast<GLuint>(unit), 0);
  }

  void set_integer(GLuint program, const char* name, int value) {
    gl_->Uniform1i(context_->programs().uniform(program, name), value);
  }

  void set_sky(GLuint program) {
    gl_->Uniform3fv(context_->programs().uniform(program, "zenith"), 1, scene_->sky.zenith.data());
    gl_->Uniform3fv(context_->programs().uniform(program, "horizon"), 1, scene_->sky.horizon.data());
  }

  /// Packs all views of a batch into one buffer of the driver's first, so that the device is waited for once.
  void read_back(Size size, std::size_t count, std::size_t first, const RenderTargets& targets) {
    struct Output {
      std::size_t target;
      GLenum format;
      GLenum type;
      std::size_t view_bytes;
      void* to;
    };
    const std::size_t pixels = size.pixels();
    std::vector<Output> outputs;
    const auto want = [&](auto* to, std::size_t channels, std::size_t target, GLenum format, GLenum type) {
      if (to == nullptr) return;
      outputs.push_back({target, format, type, channels * sizeof(*to) * pixels, to + channels * first * pixels});
    };
    want(targets.depth, 1, kDepthTarget, GL_RED, GL_FLOAT);
    want(targets.instance, 1, kIdTarget, GL_RED_INTEGER, GL_UNSIGNED_INT);
    want(targets.color, 3, kColorTarget, GL_RGB, GL_UNSIGNED_BYTE);
    std::size_t total = 0;
    for (const Output& output : outputs) total += count * output.view_bytes;

    GlBuffer& packed = context_->workspace().packed;
    if (packed.id() == 0) packed = GlBuffer(*gl_);
    gl_->BindBuffer(GL_PIXEL_PACK_BUFFER, packed.id());
    gl_->BufferData(GL_PIXEL_PACK_BUFFER, static_cast<GLsizeiptr>(total), nullptr, GL_STREAM_READ);
    for (std::size_t i = 0; i < count; ++i) {
      context_->workspace().batch.bind(static_cast<int>(i), outputs_of(targets), false);
      std::size_t start = 0;
      for (const Output& output : outputs) {
        gl_->ReadBuffer(GL_COLOR_ATTACHMENT0 + static_cast<GLenum>(output.target));
        gl_->ReadPixels(0, 0, size.width, size.height, output.format, output.type,
                        buffer_offset(start + i * output.view_bytes));
        start += count * output.view_bytes;
      }
    }
    std::size_t start = 0;
    for (const Output& output : outputs) {
      const std::size_t bytes = count * output.view_bytes;
      gl_->GetBufferSubData(GL_PIXEL_PACK_BUFFER, static_cast<GLintptr>(start), static_cast<GLsizeiptr>(bytes),
                            output.to);
      start += bytes;
    }
    gl_->BindBuffer(GL_PIXEL_PACK_BUFFER, 0);
  }

  scene::ScenePtr scene_;
  int samples_;
  std::shared_ptr<GlContext> context_;
  const Gl* gl_ = nullptr;
  std::vector<Eigen::Affine3f> poses_;
  std::vector<MeshChunk> chunks_;
  std::vector<MeshRange> meshes_;
  std::unique_ptr<GraphicsMemory> memory_;
  DrawList draws_;
  bool sun_is_drawn_ = false;
};

}  // namespace wiw::render::gpu

namespace wiw::render {

std::shared_ptr<Renderer> make_gpu_renderer(scene::ScenePtr scene, const RenderOptions& options) {
  check_options(options);
  return std::make_shared<gpu::GpuRenderer>(std::move(scene), options);
}

}  // namespace wiw::render
