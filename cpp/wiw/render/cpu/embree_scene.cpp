// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/cpu/embree_scene.hpp"

#include "wiw/core/error.hpp"
#include "wiw/core/thread_pool.hpp"

namespace wiw::render::cpu {

namespace {

constexpr unsigned kVisible = 0xFFFFFFFF;  // to every ray

/// Embree's kernels must match ours in width: a packet wider than its native one is traced ray by ray. Its cache of
/// subdivision surfaces, which no scene has, takes 128 MB of addresses, and where there is no room for them Embree 3
/// leaves its locks locked: the next device to be released would wait for ever.
std::string device_options(Isa isa) {
  std::string options = "tessellation_cache_size=0,threads=" + std::to_string(ThreadPool::shared().size());
#if defined(__x86_64__)
  options += isa == Isa::kAvx512 ? ",isa=avx512" : isa == Isa::kAvx2 ? ",isa=avx2" : ",isa=sse2";
#endif
  return options;
}

RTCDeviceProperty native_packet(Isa isa) {
  if (isa == Isa::kAvx512) return RTC_DEVICE_PROPERTY_NATIVE_RAY16_SUPPORTED;
  return isa == Isa::kAvx2 ? RTC_DEVICE_PROPERTY_NATIVE_RAY8_SUPPORTED : RTC_DEVICE_PROPERTY_NATIVE_RAY4_SUPPORTED;
}

}  // namespace

EmbreeScene::EmbreeScene(const scene::Scene& scene, const ShadingScene& shading, Isa isa)
    : scene_(scene), shading_(shading), device_(rtcNewDevice(device_options(isa).c_str())) {
  if (device_ == nullptr) throw BackendError("render: Embree does not start on this processor; use the GPU back end");
  // An unknown instruction set in the options is not an error for Embree, it silently takes another one.
  if (rtcGetDeviceProperty(device_.get(), native_packet(isa)) == 0 ||
      rtcGetDeviceProperty(device_.get(), RTC_DEVICE_PROPERTY_RAY_MASK_SUPPORTED) == 0) {
    throw BackendError("render: this Embree lacks ray masks or " + isa_name(isa) +
                       " packets; set WIW_ISA to a lower one (scalar, avx2)");
  }
  for (const InstanceMesh& part : shading.parts()) cutouts_.push_back({shading.records(part), &shading.surface(part)});
  in_moved_.assign(shading.parts().size(), false);
  away_.assign(shading.parts().size(), false);
  fixed_.reset(rtcNewScene(device_.get()));
  moved_.reset(rtcNewScene(device_.get()));
  rtcSetSceneFlags(moved_.get(), RTC_SCENE_FLAG_DYNAMIC);
  rtcSetSceneBuildQuality(moved_.get(), RTC_BUILD_QUALITY_LOW);  // a tree for each geometry
  for (std::size_t i = 0; i < shading.parts().size(); ++i) {
    const auto geometry = make_geometry(i, scene.instances[shading.parts()[i].instance].T_world_instance);
    rtcAttachGeometryByID(fixed_.get(), geometry.get(), static_cast<unsigned>(i));
  }
  rtcCommitScene(fixed_.get());
  check("building the scene");
}

void EmbreeScene::check(const char* what) const {
  const RTCError error = rtcGetDeviceError(device_.get());
  if (error == RTC_ERROR_OUT_OF_MEMORY) throw Error(std::string("render: out of memory while ") + what);
  if (error != RTC_ERROR_NONE) {
    throw Error(std::string("render: Embree error ") + std::to_string(error) + " while " + what);
  }
}

EmbreeOwner<RTCGeometry> EmbreeScene::make_geometry(std::size_t number, const Eigen::Affine3f& T_world_instance) {
  const scene::Mesh& mesh = scene_.meshes[shading_.parts()[number].mesh];
  EmbreeOwner<RTCGeometry> owner(rtcNewGeometry(device_.get(), RTC_GEOMETRY_TYPE_TRIANGLE));
  RTCGeometry geometry = owner.get();
  rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, sizeof(Eigen::Vector3f),
                          mesh.positions.size());
  set_triangles(geometry, number);
  write_vertices(geometry, number, T_world_instance);
  if (cutouts_[number].surface->alpha_cutoff >= 0.f) {
    rtcSetGeometryUserData(geometry, &cutouts_[number]);
    rtcSetGeometryIntersectFilterFunction(geometry, pierce);
    rtcSetGeometryOccludedFilterFunction(geometry, pierce);
  }
  rtcCommitGeometry(geometry);
  return owner;
}

void EmbreeScene::set_triangles(RTCGeometry geometry, std::size_t number) const {
  const InstanceMesh& part = shading_.parts()[number];
  const scene::Mesh& mesh = scene_.meshes[part.mesh];
  const std::size_t count = mesh.triangles.size();
  if (!shading_.is_reordered(part)) {
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, mesh.triangles.data(), 0,
                               sizeof(scene::Triangle), count);
    return;
  }
  auto* triangles = static_cast<scene::Triangle*>(
      rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, sizeof(scene::Triangle), count));
  if (triangles == nullptr) throw Error("render: out of memory for the scene's triangles");
  for (std::size_t t = 0; t < count; ++t) triangles[shading_.place_of(part, t)] = mesh.triangles[t];
}

void EmbreeScene::write_vertices(RTCGeometry geometry, std::size_t number,
                                 const Eigen::Affine3f& T_world_instance) const {
  const scene::Mesh& mesh = scene_.meshes[shading_.parts()[number].mesh];
  if (mesh.positions.empty()) return;
  auto* vertices = static_cast<Eigen::Vector3f*>(rtcGetGeometryBufferData(geometry, RTC_BUFFER_TYPE_VERTEX, 0));
  if (vertices == nullptr) throw Error("render: out of memory for the scene's vertices");
  for (std::size_t i = 0; i < mesh.positions.size(); ++i) vertices[i] = T_world_instance * mesh.positions[i];
}

void EmbreeScene::pierce(const RTCFilterFunctionNArguments* arguments) {
  const auto& cutout = *static_cast<const Cutout*>(arguments->geometryUserPtr);
  for (unsigned lane = 0; lane < arguments->N; ++lane) {
    if (arguments->valid[lane] != -1) continue;
    const float* uv = cutout.records[RTCHitN_primID(arguments->hit, arguments->N, lane)].uv;
    const float b1 = RTCHitN_u(arguments->hit, arguments->N, lane);
    const float b2 = RTCHitN_v(arguments->hit, arguments->N, lane);
    float alpha = cutout.surface->base_alpha;
    if (cutout.surface->texture != nullptr) {
      alpha *= sample_alpha(*cutout.surface->texture, uv[0] + b1 * uv[2] + b2 * uv[4], uv[1] + b1 * uv[3] + b2 * uv[5]);
    }
    if (alpha < cutout.surface->alpha_cutoff) arguments->valid[lane] = 0;
  }
}

void EmbreeScene::move(std::span<const MeshPlacement> parts) {
  bool any_new = false;
  for (const MeshPlacement& part : parts) {
    if (!in_moved_[part.number] && !is_home(part)) adopt(part.number), any_new = true;
  }
  // Trees are built from the parts as the scene has them and fitted to every later pose, which is much faster than
  // building and leaves pictures a function of the poses alone.
  if (any_new) rtcCommitScene(moved_.get());
  bool any_placed = false;
  for (const MeshPlacement& part : parts) {
    if (!in_moved_[part.number]) continue;
    RTCGeometry geometry = rtcGetGeometry(moved_.get(), static_cast<unsigned>(part.number));
    write_vertices(geometry, part.number, *part.T_world_instance);
    rtcUpdateGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0);
    show(part.number, is_home(part));
    rtcCommitGeometry(geometry);
    any_placed = true;
  }
  if (!any_placed) return;
  rtcCommitScene(moved_.get());
  check("moving instances");
}

bool EmbreeScene::is_home(const MeshPlacement& part) const {
  return part.T_world_instance->matrix() ==
         scene_.instances[shading_.parts()[part.number].instance].T_world_instance.matrix();
}

/// A part that is back where the scene has it is drawn from the fixed scene again: the two trees break ties between
/// surfaces at equal distance differently, and a picture must depend on the poses alone.
void EmbreeScene::show(std::size_t number, bool from_fixed) {
  const auto id = static_cast<unsigned>(number);
  // Traversal reads a geometry's mask at every hit, so masking needs no rebuild of the fixed scene.
  rtcSetGeometryMask(rtcGetGeometry(fixed_.get(), id), from_fixed ? kVisible : 0);
  rtcSetGeometryMask(rtcGetGeometry(moved_.get(), id), from_fixed ? 0 : kVisible);
  if (away_[number] != from_fixed) return;
  away_[number] = !from_fixed;
  away_count_ += from_fixed ? -1 : 1;
}

void EmbreeScene::adopt(std::size_t number) {
  const auto id = static_cast<unsigned>(number);
  const auto geometry = make_geometry(number, scene_.instances[shading_.parts()[number].instance].T_world_instance);
  rtcSetGeometryBuildQuality(geometry.get(), RTC_BUILD_QUALITY_REFIT);
  rtcCommitGeometry(geometry.get());
  rtcAttachGeometryByID(moved_.get(), geometry.get(), id);
  in_moved_[number] = true;
}

std::string EmbreeScene::version() const {
  const auto version = rtcGetDeviceProperty(device_.get(), RTC_DEVICE_PROPERTY_VERSION);
  return std::to_string(version / 10000) + "." + std::to_string(version / 100 % 100) + "." +
         std::to_string(version % 100);
}

}  // namespace wiw::render::cpu
