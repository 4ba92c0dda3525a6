// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/ray_tracer.hpp"

#include <limits>

#include "wiw/core/error.hpp"

namespace wiw::apartment {

RayTracer::RayTracer(std::vector<Vec3> vertices, std::vector<scene::Triangle> triangles)
    : vertices_(std::move(vertices)), triangles_(std::move(triangles)) {
  // One thread builds one and the same tree every time, so coplanar surfaces are always hit in the same order.
  device_ = rtcNewDevice("threads=1,set_affinity=0,tessellation_cache_size=0");  // as in the renderer
  if (device_ == nullptr)
    throw BackendError("Embree could not create a device (error " + std::to_string(rtcGetDeviceError(nullptr)) + ")");
  wide_ = rtcGetDeviceProperty(device_, RTC_DEVICE_PROPERTY_NATIVE_RAY16_SUPPORTED) != 0;
  vertices_.emplace_back(Vec3::Zero());  // Embree reads vertices 16 bytes at a time
  scene_ = rtcNewScene(device_);
  RTCGeometry geometry = rtcNewGeometry(device_, RTC_GEOMETRY_TYPE_TRIANGLE);
  rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, vertices_.data(), 0, sizeof(Vec3),
                             vertices_.size() - 1);
  rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, triangles_.data(), 0,
                             sizeof(scene::Triangle), triangles_.size());
  rtcCommitGeometry(geometry);
  rtcAttachGeometry(scene_, geometry);
  rtcReleaseGeometry(geometry);
  rtcCommitScene(scene_);
}

RayTracer::~RayTracer() {
  rtcReleaseScene(scene_);
  rtcReleaseDevice(device_);
}

namespace {

/// So many rays as Embree takes them, and its functions for them.
template <std::size_t kRays, class RaysOfEmbree, class RayHitsOfEmbree, auto kOccludedOfEmbree, auto kIntersectOfEmbree>
struct Packet {
  static constexpr std::size_t kSize = kRays;
  using Rays = RaysOfEmbree;
  using RayHits = RayHitsOfEmbree;
  static constexpr auto kOccluded = kOccludedOfEmbree;
  static constexpr auto kIntersect = kIntersectOfEmbree;
};
using Packet8 = Packet<8, RTCRay8, RTCRayHit8, rtcOccluded8, rtcIntersect8>;
using Packet16 = Packet<16, RTCRay16, RTCRayHit16, rtcOccluded16, rtcIntersect16>;

/// Sets as many rays as a packet has, from the first-th direction on.
template <class Packet>
void set_rays(typename Packet::Rays& rays, const Vec3& origin, const Vec3x16& to, std::size_t first, float far) {
  for (std::size_t i = 0; i < Packet::kSize; ++i) {
    rays.org_x[i] = origin.x(), rays.org_y[i] = origin.y(), rays.org_z[i] = origin.z();
    rays.dir_x[i] = to.x[first + i], rays.dir_y[i] = to.y[first + i], rays.dir_z[i] = to.z[first + i];
    rays.tnear[i] = 0.f, rays.tfar[i] = far;
    rays.mask[i] = 0xFFFFFFFFu, rays.flags[i] = 0, rays.time[i] = 0.f, rays.id[i] = 0;
  }
}

using Blocked = std::array<bool, RayTracer::kWidth>;

template <class Packet>
Blocked find_blocked(RTCScene scene, const Vec3& origin, const Vec3x16& directions, const Blocked& active) {
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
  alignas(64) typename Packet::Rays rays;
  alignas(64) std::array<int, Packet::kSize> valid;
  Blocked result;
  for (std::size_t first = 0; first < RayTracer::kWidth; first += Packet::kSize) {
    set_rays<Packet>(rays, origin, directions, first, 0.999f);
    for (std::size_t i = 0; i < Packet::kSize; ++i) valid[i] = active[first + i] ? -1 : 0;
    Packet::kOccluded(valid.data(), scene, &context, &rays);
    for (std::size_t i = 0; i < Packet::kSize; ++i) result[first + i] = !active[first + i] || rays.tfar[i] < 0.f;
  }
  return result;
}

template <class Packet>
std::array<Hit, RayTracer::kWidth> find_hits(RTCScene scene, const Vec3& origin, const Vec3x16& directions) {
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  alignas(64) typename Packet::RayHits rays;
  alignas(64) std::array<int, Packet::kSize> valid;
  valid.fill(-1);
  std::array<Hit, RayTracer::kWidth> hits;
  for (std::size_t first = 0; first < RayTracer::kWidth; first += Packet::kSize) {
    set_rays<Packet>(rays.ray, origin, directions, first, std::numeric_limits<float>::infinity());
    for (std::size_t i = 0; i < Packet::kSize; ++i)
      rays.hit.geomID[i] = RTC_INVALID_GEOMETRY_ID, rays.hit.instID[0][i] = RTC_INVALID_GEOMETRY_ID;
    Packet::kIntersect(valid.data(), scene, &context, &rays);
    for (std::size_t i = 0; i < Packet::kSize; ++i) {
      if (rays.hit.geomID[i] == RTC_INVALID_GEOMETRY_ID) continue;
      hits[first + i] = {static_cast<std::int32_t>(rays.hit.primID[i]), rays.hit.u[i], rays.hit.v[i], rays.ray.tfar[i]};
    }
  }
  return hits;
}

}  // namespace

// Embree splits packets that are wider than the CPU's registers into single rays, which takes longer.
std::array<bool, RayTracer::kWidth> RayTracer::blocked(const Vec3& origin, const Vec3x16& directions,
                                                       const std::array<bool, kWidth>& active) const {
  const auto find = wide_ ? find_blocked<Packet16> : find_blocked<Packet8>;
  return find(scene_, origin, directions, active);
}

std::array<Hit, RayTracer::kWidth> RayTracer::trace(const Vec3& origin, const Vec3x16& directions) const {
  return (wide_ ? find_hits<Packet16> : find_hits<Packet8>)(scene_, origin, directions);
}

}  // namespace wiw::apartment
