// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <cstring>
#include <string>
#include <vector>

#include "scene/files.hpp"

// Small files of every supported format, written here byte by byte: two triangles of a unit square, or what a test
// asks for.

template <class T>
void append(std::string& bytes, const T& value) {
  const char* raw = reinterpret_cast<const char*>(&value);
  bytes.append(raw, sizeof(value));
}

/// A 2 x 2 image, rows from the top: red green / blue white. Its header may claim another width and height.
inline std::string sample_bmp(std::uint32_t claimed = 2) {
  std::string bytes = "BM";
  for (const std::uint32_t word : {70U, 0U, 54U, 40U, claimed, claimed}) append(bytes, word);
  for (const std::uint16_t half : {std::uint16_t{1}, std::uint16_t{24}}) append(bytes, half);
  for (const std::uint32_t word : {0U, 16U, 2835U, 2835U, 0U, 0U}) append(bytes, word);
  const unsigned char bottom[8] = {255, 0, 0, 255, 255, 255, 0, 0};  // blue white, as BGR, padded to 4 bytes
  const unsigned char top[8] = {0, 0, 255, 0, 255, 0, 0, 0};         // red green
  for (const unsigned char byte : bottom) bytes += static_cast<char>(byte);
  for (const unsigned char byte : top) bytes += static_cast<char>(byte);
  return bytes;
}

/// A KTX2 image of 2 x 2 pixels as far as its sizes; what follows takes a decoder.
inline std::string sample_ktx2() {
  std::string bytes = "\xABKTX 20\xBB\r\n\x1A\n";
  for (const std::uint32_t word : {0U, 1U, 2U, 2U, 0U, 0U, 1U, 1U, 1U}) append(bytes, word);
  return bytes;
}

inline const std::vector<float>& square_positions() {
  static const std::vector<float> positions{0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0};
  return positions;
}

struct GlbParts {
  std::string nodes = R"([{"mesh":0,"name":"Chair_01"}])";
  std::string scene_nodes = "[0]";
  std::string material =
      R"({"name":"m","pbrMetallicRoughness":{"baseColorFactor":[1,1,1,1],"baseColorTexture":{"index":0}}})";
  std::string texture = R"({"source":0})";
  std::vector<float> positions = square_positions();
  std::vector<std::uint16_t> triangles{0, 1, 2, 0, 2, 3};
  std::string image = sample_bmp();
};

/// JSON and binary chunk of a square with texture coordinates and an embedded image.
inline std::string sample_glb(const GlbParts& parts = {}) {
  std::string binary;
  for (const float value : parts.positions) append(binary, value);
  for (const float value : {0.f, 1.f, 1.f, 1.f, 1.f, 0.f, 0.f, 0.f}) append(binary, value);
  for (const std::uint16_t value : parts.triangles) append(binary, value);
  const std::size_t uv = 4 * parts.positions.size();
  const std::size_t indices = uv + 32;
  const std::size_t image = indices + 2 * parts.triangles.size();
  binary += parts.image;
  while (binary.size() % 4 != 0) binary += '\0';
  const auto text = [](std::size_t value) { return std::to_string(value); };
  std::string json =
      R"({"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":)" + parts.scene_nodes + R"(}],"nodes":)" +
      parts.nodes +
      R"(,"meshes":[{"primitives":[{"attributes":{"POSITION":0,"TEXCOORD_0":1},"indices":2,"material":0}]}],"materials":[)" +
      parts.material + R"(],"textures":[)" + parts.texture +
      R"(],"images":[{"mimeType":"image/bmp","bufferView":3}],)" +
      R"("accessors":[{"bufferView":0,"componentType":5126,"count":)" + text(parts.positions.size() / 3) +
      R"(,"type":"VEC3","min":[0,0,0],"max":[1,1,1]},{"bufferView":1,"componentType":5126,"count":4,"type":"VEC2"},)" +
      R"({"bufferView":2,"componentType":5123,"count":)" + text(parts.triangles.size()) + R"(,"type":"SCALAR"}],)" +
      R"("bufferViews":[{"buffer":0,"byteOffset":0,"byteLength":)" + text(uv) + R"(},{"buffer":0,"byteOffset":)" +
      text(uv) + R"(,"byteLength":32},{"buffer":0,"byteOffset":)" + text(indices) + R"(,"byteLength":)" +
      text(2 * parts.triangles.size()) + R"(},{"buffer":0,"byteOffset":)" + text(image) + R"(,"byteLength":)" +
      text(parts.image.size()) + R"(}],"buffers":[{"byteLength":)" + text(binary.size()) + "}]}";
  while (json.size() % 4 != 0) json += ' ';
  std::string bytes = "glTF";
  append(bytes, std::uint32_t{2});
  append(bytes, static_cast<std::uint32_t>(28 + json.size() + binary.size()));
  append(bytes, static_cast<std::uint32_t>(json.size()));
  bytes += "JSON" + json;
  append(bytes, static_cast<std::uint32_t>(binary.size()));
  bytes += std::string("BIN\0", 4) + binary;
  return bytes;
}

inline std::string sample_obj() {
  return "mtllib sample.mtl\no Table_02\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl "
         "wood\n"
         "f 1/1 2/2 3/3 4/4\n";
}

inline std::string sample_mtl() { return "newmtl wood\nKd 0.5 0.25 1\nmap_Kd sample.bmp\n"; }

inline std::string sample_ply() {
  std::string bytes =
      "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
      "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n"
      "property list uchar int vertex_indices\nend_header\n";
  for (int i = 0; i < 4; ++i) {
    for (int axis = 0; axis < 3; ++axis) append(bytes, square_positions()[static_cast<std::size_t>(3 * i + axis)]);
    for (const int channel : {10 * i, 20, 255}) bytes += static_cast<char>(channel);
  }
  bytes += '\4';
  for (const std::int32_t index : {0, 1, 2, 3}) append(bytes, index);
  return bytes;
}

inline std::string sample_dae(const std::string& asset = "<unit meter=\"0.01\"/><up_axis>Z_UP</up_axis>",
                              const std::string& positions = "0 0 0 100 0 0 100 100 0 0 100 0") {
  return R"(<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>)" +
         asset +
         R"(</asset><library_geometries><geometry id="g" name="g"><mesh><source id="p"><float_array id="a" count="12">)" +
         positions +
         R"(</float_array><technique_common><accessor source="#a" count="4" stride="3"><param name="X" type="float"/>)"
         R"(<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>)"
         R"(<vertices id="v"><input semantic="POSITION" source="#p"/></vertices><triangles count="2">)"
         R"(<input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2 0 2 3</p></triangles></mesh></geometry></library_geometries>)"
         R"(<library_visual_scenes><visual_scene id="s"><node id="n" name="Lamp"><instance_geometry url="#g"/></node>)"
         R"(</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>)";
}

/// Writes sample.glb, .obj (with its material and image), .ply and .dae.
inline std::vector<std::filesystem::path> write_samples(const Folder& folder) {
  folder.write("sample.mtl", sample_mtl());
  folder.write("sample.bmp", sample_bmp());
  return {folder.write("sample.glb", sample_glb()), folder.write("sample.obj", sample_obj()),
          folder.write("sample.ply", sample_ply()), folder.write("sample.dae", sample_dae())};
}
