// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/mesh_format.hpp"

#include <assimp/BaseImporter.h>

#include <algorithm>
#include <array>
#include <assimp/Importer.hpp>
#include <cctype>
#include <set>
#include <string_view>
#include <vector>

#include "wiw/core/error.hpp"
#include "wiw/scene/import/file.hpp"

namespace wiw::scene {
namespace {

struct FormatRow {
  MeshFormat format;
  const char* extension;
  const char* name;
};

constexpr std::array<FormatRow, 5> kFormats{{{MeshFormat::kGlb, ".glb", "binary glTF"},
                                             {MeshFormat::kGltf, ".gltf", "glTF"},
                                             {MeshFormat::kObj, ".obj", "Wavefront OBJ"},
                                             {MeshFormat::kPly, ".ply", "PLY"},
                                             {MeshFormat::kDae, ".dae", "COLLADA"}}};

bool looks_like(MeshFormat format, std::string_view head) {
  switch (format) {
    case MeshFormat::kGlb: return head.starts_with("glTF");
    case MeshFormat::kGltf: return head.find('{') != std::string_view::npos;
    case MeshFormat::kObj: return head.find('\0') == std::string_view::npos;
    case MeshFormat::kPly: return head.starts_with("ply");
    case MeshFormat::kDae: return head.find("<COLLADA") != std::string_view::npos;
  }
  return false;
}

}  // namespace

std::string supported_formats() {
  std::string text;
  for (const FormatRow& row : kFormats) text += (text.empty() ? "" : ", ") + std::string(row.extension);
  return text;
}

MeshFormat mesh_format_of(const std::filesystem::path& path) {
  std::string extension = path.extension().string();
  std::ranges::transform(extension, extension.begin(), [](unsigned char c) { return std::tolower(c); });
  for (const FormatRow& row : kFormats) {
    if (extension == row.extension) return row.format;
  }
  throw FileError(path.string(), "'" + extension + "' is not a supported mesh format; expected one of " +
                                     supported_formats() + ", or a Gazebo .world or .sdf file");
}

void check_signature(const std::filesystem::path& path, MeshFormat format) {
  const auto bytes = read_file(path, 4096);
  if (bytes.empty()) throw FileError(path.string(), "is empty");
  if (looks_like(format, {reinterpret_cast<const char*>(bytes.data()), bytes.size()})) return;
  const auto* row = std::ranges::find(kFormats, format, &FormatRow::format);
  throw FileError(path.string(), std::string("does not begin like a ") + row->name + " file (damaged, or named '" +
                                     row->extension + "' by mistake)");
}

std::unique_ptr<Assimp::Importer> make_importer() {
  auto importer = std::make_unique<Assimp::Importer>();
  std::vector<Assimp::BaseImporter*> others;
  for (std::size_t i = 0; i < importer->GetImporterCount(); ++i) {
    Assimp::BaseImporter* loader = importer->GetImporter(i);
    std::set<std::string> extensions;
    loader->GetExtensionList(extensions);
    const bool wanted =
        std::ranges::any_of(kFormats, [&](const FormatRow& row) { return extensions.contains(row.extension + 1); });
    if (!wanted) others.push_back(loader);
  }
  for (Assimp::BaseImporter* loader : others) {
    importer->UnregisterLoader(loader);
    delete loader;  // NOLINT(cppcoreguidelines-owning-memory): unregistering hands ownership to the caller
  }
  return importer;
}

}  // namespace wiw::scene
