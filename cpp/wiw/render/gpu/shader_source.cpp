// SPDX-License-Identifier: Apache-2.0
#include "wiw/render/gpu/shader_source.hpp"

#include <array>
#include <utility>

namespace wiw::render::gpu {

namespace {

// One view of a batch. Axes are those of the camera in the world; a cube face has its own, beside the panorama's up.
constexpr const char* kViewBlock = R"(
layout(std140) uniform View {
  vec4 right;
  vec4 up;
  vec4 back;
  vec4 eye;
  vec4 projection;   // clip x and y per camera x and y over depth; shift of the sample from the pixel centre, clip units
  vec4 lens;         // near plane; pixel width at depth 1 (panorama: pi / H, then 2 pi / W); added to the level of detail
  vec4 panorama_up;
};
)";

constexpr const char* kSurfaceBlocks = R"(
layout(std140) uniform Instance {
  vec4 world_rows[3];
  vec4 normal_rows[3];
  uvec4 instance_id;
};
layout(std140) uniform Material {
  vec4 base_color;
  vec4 cutoff;
};
)";

constexpr const char* kSceneVertex = R"(
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;
layout(location = 3) in vec2 lightmap_uv;
layout(location = 4) in vec4 color;
out vec3 offset;   // from the eye, world axes
#ifdef SMOOTH
out vec3 smooth_normal;
#ifdef SUNLIT
out vec3 lift;     // onto the curved surface, world axes
#endif
#endif
#ifdef TEXTURED
out vec2 texture_uv;
#endif
#ifdef LIGHTMAPPED
out vec2 light_uv;
#endif
#ifdef VERTEX_COLORS
out vec3 vertex_color;
#endif
void main() {
  vec4 p = vec4(position, 1.0);
  offset = vec3(dot(world_rows[0], p), dot(world_rows[1], p), dot(world_rows[2], p)) - eye.xyz;
  float depth = -dot(back.xyz, offset);
  vec2 image = vec2(dot(right.xyz, offset), dot(up.xyz, offset)) * projection.xy - depth * projection.zw;
#ifdef PARALLEL
  gl_Position = vec4(dot(right.xyz, offset) * projection.x, dot(up.xyz, offset) * projection.y, -depth * lens.x, 1.0);
#else
  gl_Position = vec4(image, lens.x, depth);   // reversed depth with the far plane at infinity: near / depth
#endif
#ifdef SMOOTH
  smooth_normal = vec3(dot(normal_rows[0].xyz, normal), dot(normal_rows[1].xyz, normal), dot(normal_rows[2].xyz, normal));
#ifdef SUNLIT
  vec3 out_of = normal * lightmap_uv.x;
  lift = vec3(dot(world_rows[0].xyz, out_of), dot(world_rows[1].xyz, out_of), dot(world_rows[2].xyz, out_of));
#endif
#endif
#ifdef TEXTURED
  texture_uv = uv;
#endif
#ifdef LIGHTMAPPED
  light_uv = lightmap_uv;
#endif
#ifdef VERTEX_COLORS
  vertex_color = color.rgb;
#endif
}
)";

constexpr const char* kOutputs = R"(
#ifdef COLOR_OUT
layout(location = 0) out vec4 out_color;
#endif
#ifdef DEPTH_OUT
layout(location = 1) out float out_depth;
#ifdef CUBE_FACE
layout(location = 3) out vec2 out_slope;
#endif
#endif
#ifdef ID_OUT
layout(location = 2) out uint out_id;
#endif
)";

// The formulas of shading.hpp. Footprint and texel density come from the derivatives of position and texture
// coordinates across the pixel quad, which are exact on a triangle's plane.
constexpr const char* kShading = R"(
float ambient_light(vec3 n) {
  return 0.80 + 0.12 * n.y + 0.05 * (n.x * n.x - n.z * n.z) + 0.02 * n.x;
}
float pixel_depth() {
#ifdef CUBE_FACE
  return length(offset);
#else
  return 1.0 / gl_FragCoord.w;
#endif
}
float pixel_width(float depth) {
#ifdef CUBE_FACE
  float sine = dot(panorama_up.xyz, offset) / depth;
  return max(lens.y, lens.z * sqrt(max(0.0, 1.0 - sine * sine)));
#else
  return lens.y;
#endif
}
float level_of_detail(vec2 tx, vec2 ty, vec3 px, vec3 py, vec3 n) {
  float depth = pixel_depth();
  float area2 = max(dot(n, n), 1e-30);
  float footprint = pixel_width(depth) * max(depth, depth * depth * sqrt(area2) / abs(dot(n, offset)));
  // Largest singular value of d(texel)/d(world): largest eigenvalue of inverse(P'P) T'T for P = [px py], T = [tx ty].
  float half_trace = 0.5 * (dot(py, py) * dot(tx, tx) - 2.0 * dot(px, py) * dot(tx, ty) + dot(px, px) * dot(ty, ty)) / area2;
  float cross_texels = tx.x * ty.y - tx.y * ty.x;
  float determinant = cross_texels * cross_texels / area2;
  float density2 = half_trace + sqrt(max(0.0, half_trace * half_trace - determinant));
  return clamp(log2(footprint) + 0.5 * log2(density2) + lens.w, 0.0, 16.0);
}
)";

constexpr const char* kSceneFragment = R"(
in vec3 offset;
#ifdef SMOOTH
in vec3 smooth_normal;
#ifdef SUNLIT
in vec3 lift;
#endif
#endif
#ifdef TEXTURED
in vec2 texture_uv;
uniform sampler2D surface_texture;
#endif
#ifdef LIGHTMAPPED
in vec2 light_uv;
uniform sampler2D lightmap;
#endif
#ifdef VERTEX_COLORS
in vec3 vertex_color;
#endif
)";

// The map holds the greatest height towards the sun over each texel, as a share of the range of heights, in two squares
// one over the other; the second is the finer. A texel of the map shadows a point if it is above the point's tangent
// plane there: compared with the plane, a surface never shadows itself, however it slopes, and no offset tears shadows
// off what casts them. What is left is rounding: of vertices to 1/256 texel, which a slope magnifies, and of heights.
constexpr const char* kSunlight = R"(
#ifdef SUNLIT
layout(std140) uniform Sun {
  vec4 sun_right;
  vec4 sun_up;
  vec4 sun_direction;
  vec4 sun_corner[2];
  vec4 sun_grid[2];   // metres a texel across and along, range of heights, texels a side
  vec4 sun_share;     // ambient, strength
};
uniform sampler2DArray sun_map;
vec2 sun_texel(vec3 point, int square) {
  vec3 from_corner = point - sun_corner[square].xyz;
  return vec2(dot(sun_right.xyz, from_corner), dot(sun_up.xyz, from_corner)) / sun_grid[square].xy - 0.5;
}
float sun_visibility(vec3 point, vec3 n) {
  float last = sun_grid[0].w - 1.0;
  int square = 1;
  vec2 texel = sun_texel(point, square);
  if (any(lessThan(texel, vec2(1.0))) || any(greaterThan(texel, vec2(last - 2.0)))) {
    square = 0;
    texel = sun_texel(point, square);
  }
  vec4 grid = sun_grid[square];
  float height = dot(sun_direction.xyz, point - sun_corner[square].xyz);
  vec2 slope = -vec2(dot(sun_right.xyz, n), dot(sun_up.xyz, n)) / max(dot(sun_direction.xyz, n), 0.02) * grid.xy;
  float slack = 0.02 * (grid.x + grid.y + abs(slope.x) + abs(slope.y)) + 2e-6 * grid.z;
  vec2 first = floor(texel) - 1.0;
  vec2 part = texel - floor(texel);
  vec4 across = vec4(1.0 - part.x, 1.0, 1.0, part.x);
  vec4 along = vec4(1.0 - part.y, 1.0, 1.0, part.y);
  float lit = 0.0;
  for (int j = 0; j < 4; ++j) {
    for (int i = 0; i < 4; ++i) {
      vec2 at = first + vec2(i, j);
      vec2 inside = clamp(at, vec2(0.0), vec2(last));
      float blocker = texelFetch(sun_map, ivec3(inside.x, inside.y + float(square) * grid.w, 0), 0).x * grid.z;
      lit += blocker <= height + dot(slope, at - texel) + slack ? across[i] * along[j] : 0.0;
    }
  }
  return lit / 9.0;
}
float sun_light(vec3 point, vec3 n) {
  float cosine = dot(n, sun_direction.xyz);
  float direct = cosine > 0.0 ? cosine * sun_visibility(point, n) : 0.0;
  return min(sun_share.x * ambient_light(n) + sun_share.y * direct, 1.0);
}
#endif
)";

constexpr const char* kSceneMain = R"(
void main() {
#ifdef COLOR_OUT
  vec3 px = dFdx(offset);
  vec3 py = dFdy(offset);
  vec3 n = cross(px, py);
#endif
#ifdef CUTOUT
  float alpha = base_color.a;
#ifdef TEXTURED
  alpha *= textureLod(surface_texture, texture_uv, 0.0).a;
#endif
  bool hole = alpha < cutoff.x;
#endif
#ifdef COLOR_OUT
  vec3 shade = base_color.rgb;
#ifdef TEXTURED
  vec2 texels = vec2(textureSize(surface_texture, 0));
  float lod = level_of_detail(dFdx(texture_uv) * texels, dFdy(texture_uv) * texels, px, py, n);
  shade *= textureLod(surface_texture, texture_uv, lod).rgb;
#endif
#ifdef VERTEX_COLORS
  shade *= vertex_color;
#endif
#if defined(LIGHTMAPPED)
  shade *= 2.0 * textureLod(lightmap, light_uv, 0.0).rgb;
#elif !defined(EMISSIVE)
  vec3 facing = dot(n, offset) > 0.0 ? -n : n;
#ifdef SUNLIT
  vec3 point = eye.xyz + offset;
#endif
#ifdef SMOOTH
  bool turned = dot(smooth_normal, facing) < 0.0;
  facing = turned ? -smooth_normal : smooth_normal;
#ifdef SUNLIT
  if (!turned) point += lift;
#endif
#endif
#ifdef SUNLIT
  shade *= sun_light(point, normalize(facing));
#else
  shade *= ambient_light(normalize(facing));
#endif
#endif
  out_color = vec4(shade, 1.0);
#endif
#ifdef DEPTH_OUT
#ifdef CUBE_FACE
  // One over depth is linear across the image of a plane, so value and slope give the plane's depth at any nearby ray.
  out_depth = gl_FragCoord.w;
  out_slope = vec2(dFdx(gl_FragCoord.w), dFdy(gl_FragCoord.w));
#else
  out_depth = 1.0 / gl_FragCoord.w;
#endif
#endif
#ifdef ID_OUT
  out_id = instance_id.x;
#endif
#ifdef CUTOUT
  if (hole) discard;
#endif
}
)";

constexpr const char* kScreenVertex = R"(
out vec3 ray;
void main() {
  vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  gl_Position = vec4(corner, 0.0, 1.0);
  vec2 image = (corner + projection.zw) / projection.xy;
  ray = right.xyz * image.x + up.xyz * image.y - back.xyz;
}
)";

constexpr const char* kSky = R"(
uniform vec3 zenith;
uniform vec3 horizon;
vec4 sky(vec3 direction) {
  return vec4(mix(horizon, zenith, max(normalize(direction).y, 0.0)), 1.0);
}
)";

constexpr const char* kSkyMain = R"(
in vec3 ray;
void main() {
  out_color = sky(ray);
#ifdef DEPTH_OUT
  out_depth = 0.0;
#endif
#ifdef ID_OUT
  out_id = 0u;
#endif
}
)";

// Each layer holds one sample of every pixel.
constexpr const char* kAverageMain = R"(
layout(location = 0) out vec4 out_color;
uniform sampler2DArray color_map;
uniform int sample_count;
void main() {
  vec4 sum = vec4(0.0);
  for (int i = 0; i < sample_count; ++i) sum += texelFetch(color_map, ivec3(gl_FragCoord.xy, i), 0);
  out_color = sum / float(sample_count);
}
)";

// Layer f holds face f in the order of face_axes(): front, right, back, left, top, bottom.
constexpr const char* kPanoramaMain = R"(
uniform sampler2DArray color_map;
uniform sampler2DArray depth_map;
uniform usampler2DArray id_map;
uniform sampler2DArray slope_map;
uniform vec2 samples[16];
uniform int sample_count;
uniform int face_size;
uniform int width;
uniform int height;

vec3 direction(vec2 pixel) {
  float longitude = (pixel.x / float(width) - 0.5) * 6.283185307179586;
  float latitude = (0.5 - pixel.y / float(height)) * 3.141592653589793;
  return vec3(sin(longitude) * cos(latitude), sin(latitude), -cos(longitude) * cos(latitude));
}
// Column and row of a ray on the face it hits, and that face.
vec3 face_hit(vec3 d) {
  vec3 a = abs(d);
  vec4 hit = d.z < 0.0 ? vec4(d.x, d.y, a.z, 0.0) : vec4(-d.x, d.y, a.z, 2.0);
  if (a.x > a.z) hit = d.x > 0.0 ? vec4(d.z, d.y, a.x, 1.0) : vec4(-d.z, d.y, a.x, 3.0);
  if (a.y > max(a.x, a.z)) hit = d.y > 0.0 ? vec4(d.x, d.z, a.y, 4.0) : vec4(d.x, -d.z, a.y, 5.0);
  vec2 image = vec2(hit.x, -hit.y) / hit.z;
  return vec3(clamp((0.5 * image + 0.5) * float(face_size), 0.001, float(face_size) - 0.001), hit.w);
}
// Bilinear among the texels that show the same instance, so that outlines stay sharp.
vec4 surface_color(vec3 hit, uint id) {
  vec2 corner = floor(hit.xy - 0.5);
  vec2 part = hit.xy - 0.5 - corner;
  vec4 sum = vec4(0.0);
  float weights = 0.0;
  for (int i = 0; i < 4; ++i) {
    vec2 step = vec2(i & 1, i >> 1);
    ivec3 texel = ivec3(clamp(ivec2(corner + step), 0, face_size - 1), hit.z);
    vec2 share = mix(1.0 - part, part, step);
    float weight = texelFetch(id_map, texel, 0).x == id ? share.x * share.y : 0.0;
    sum += weight * texelFetch(color_map, texel, 0);
    weights += weight;
  }
  return sum / weights;
}
vec4 ray_color(vec3 d, vec3 hit) {
  uint id = texelFetch(id_map, ivec3(hit), 0).x;
  return id == 0u ? sky(right.xyz * d.x + up.xyz * d.y + back.xyz * d.z) : surface_color(hit, id);
}
void main() {
  vec3 d = direction(gl_FragCoord.xy);
  vec3 hit = face_hit(d);
#ifdef COLOR_OUT
#ifdef SAMPLED
  vec4 sum = vec4(0.0);
  for (int i = 0; i < sample_count; ++i) {
    vec3 ray = direction(gl_FragCoord.xy + samples[i]);
    sum += ray_color(ray, face_hit(ray));
  }
  out_color = sum / float(sample_count);
#else
  out_color = ray_color(d, hit);
#endif
#endif
#ifdef DEPTH_OUT
  float inverse = texelFetch(depth_map, ivec3(hit), 0).x;
  float at_ray = inverse + dot(texelFetch(slope_map, ivec3(hit), 0).xy, fract(hit.xy) - 0.5);
  at_ray = clamp(at_ray, 0.5 * inverse, 2.0 * inverse);
  out_depth = inverse == 0.0 ? 0.0 : 1.0 / (at_ray * max(abs(d.x), max(abs(d.y), abs(d.z))));
#endif
#ifdef ID_OUT
  out_id = texelFetch(id_map, ivec3(hit), 0).x;
#endif
}
)";

std::string header(ProgramKey key) {
  static constexpr std::array<std::pair<ProgramKey, const char*>, 13> kNames{{{kTextured, "TEXTURED"},
                                                                              {kLightmapped, "LIGHTMAPPED"},
                                                                              {kEmissive, "EMISSIVE"},
                                                                              {kVertexColors, "VERTEX_COLORS"},
                                                                              {kCutout, "CUTOUT"},
                                                                              {kSmooth, "SMOOTH"},
                                                                              {kColorOut, "COLOR_OUT"},
                                                                              {kDepthOut, "DEPTH_OUT"},
                                                                              {kIdOut, "ID_OUT"},
                                                                              {kCubeFace, "CUBE_FACE"},
                                                                              {kSampled, "SAMPLED"},
                                                                              {kSunlit, "SUNLIT"},
                                                                              {kParallel, "PARALLEL"}}};
  std::string text = "#version 330 core\n";
  for (const auto& [bit, name] : kNames) {
    if ((key & bit) != 0) text += std::string("#define ") + name + "\n";
  }
  return text;
}

}  // namespace

ProgramKey reduce(ProgramKey key) {
  if ((key & kColorOut) == 0) {
    key &= ~(kLightmapped | kEmissive | kVertexColors | kSmooth | kSunlit);
    if ((key & kCutout) == 0) key &= ~kTextured;
  }
  if ((key & kEmissive) != 0) key &= ~(kLightmapped | kSmooth);
  if ((key & kLightmapped) != 0) key &= ~kSmooth;
  return key;
}

std::string scene_vertex_source(ProgramKey key) { return header(key) + kViewBlock + kSurfaceBlocks + kSceneVertex; }

std::string scene_fragment_source(ProgramKey key) {
  return header(key) + kViewBlock + kSurfaceBlocks + kOutputs + kSceneFragment + kShading + kSunlight + kSceneMain;
}

std::string screen_vertex_source() { return header(0) + kViewBlock + kScreenVertex; }

std::string sky_fragment_source(ProgramKey outputs) { return header(outputs) + kOutputs + kSky + kSkyMain; }

std::string average_fragment_source() { return header(0) + kAverageMain; }

std::string panorama_fragment_source(ProgramKey key) {
  return header(key) + kViewBlock + kOutputs + kSky + kPanoramaMain;
}

}  // namespace wiw::render::gpu
