// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/ray_tracer.hpp"

#include <limits>

#include "wiw/core/error.hpp"

namespace wiw::apartment {

RayTracer::RayTracer(std::vector<Vec3> vertices, std::vector<scene::Triangle> triangles)
    : vertices_(std::move(vertices)), triangles_(std::move(triangles)) {
  // One thread builds one and the same tree every time, so coplanar surfaces are always hit in the same order.
  device_ = rtcNewDevice("threads=1,set_affinity=0");
  if (device_ == nullptr)
    throw BackendError("Embree could not create a device (error " + std::to_string(rtcGetDeviceError(nullptr)) + ")");
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

template <class Rays>
void set_rays(Rays& rays, const Vec3& origin, const RayTracer::Directions& directions, float far) {
  for (int i = 0; i < RayTracer::kWidth; ++i) {
    const Vec3& d = directions[static_cast<std::size_t>(i)];
    rays.org_x[i] = origin.x(), rays.org_y[i] = origin.y(), rays.org_z[i] = origin.z();
    rays.dir_x[i] = d.x(), rays.dir_y[i] = d.y(), rays.dir_z[i] = d.z();
    rays.tnear[i] = 0.f, rays.tfar[i] = far;
    rays.mask[i] = 0xFFFFFFFFu, rays.flags[i] = 0, rays.time[i] = 0.f, rays.id[i] = 0;
  }
}

}  // namespace

std::array<bool, RayTracer::kWidth> RayTracer::blocked(const Vec3& origin, const Directions& directions,
                                                       const std::array<bool, kWidth>& active) const {
  alignas(64) RTCRay16 rays;
  alignas(64) std::array<int, kWidth> valid{};
  set_rays(rays, origin, directions, 0.999f);
  for (std::size_t i = 0; i < kWidth; ++i) valid[i] = active[i] ? -1 : 0;
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
  rtcOccluded16(valid.data(), scene_, &context, &rays);
  std::array<bool, kWidth> result{};
  for (std::size_t i = 0; i < kWidth; ++i) result[i] = !active[i] || rays.tfar[i] < 0.f;
  return result;
}

std::array<Hit, RayTracer::kWidth> RayTracer::trace(const Vec3& origin, const Directions& directions) const {
  alignas(64) RTCRayHit16 rays;
  alignas(64) std::array<int, kWidth> valid;
  valid.fill(-1);
  set_rays(rays.ray, origin, directions, std::numeric_limits<float>::infinity());
  for (int i = 0; i < kWidth; ++i)
    rays.hit.geomID[i] = RTC_INVALID_GEOMETRY_ID, rays.hit.instID[0][i] = RTC_INVALID_GEOMETRY_ID;
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  rtcIntersect16(valid.data(), scene_, &context, &rays);
  std::array<Hit, kWidth> hits;
  for (std::size_t i = 0; i < kWidth; ++i) {
    if (rays.hit.geomID[i] == RTC_INVALID_GEOMETRY_ID) continue;
    hits[i] = {static_cast<std::int32_t>(rays.hit.primID[i]), rays.hit.u[i], rays.hit.v[i], rays.ray.tfar[i]};
  }
  return hits;
}

}  // namespace wiw::apartment
