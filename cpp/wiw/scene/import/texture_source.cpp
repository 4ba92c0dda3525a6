// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/texture_source.hpp"

#include <assimp/scene.h>

#include <algorithm>
#include <array>
#include <cctype>
#include <cstdlib>

#include "wiw/core/error.hpp"
#include "wiw/core/thread_pool.hpp"
#include "wiw/core/utf8.hpp"
#include "wiw/scene/import/file.hpp"
#include "wiw/scene/import/image_file.hpp"

namespace wiw::scene {
namespace fs = std::filesystem;

/// Where a reference leads: to an image of the mesh file or a file of its own.
struct TextureSource::Found {
  const aiTexture* embedded = nullptr;
  fs::path file;
  Size size;            // by the image's header
  std::string problem;  // empty: usable
  ImportTrace trace;
};

namespace {

/// "file://C:\art\red%20wood.png" -> "C:/art/red wood.png".
std::string as_path(std::string reference) {
  constexpr std::string_view kScheme = "file://";
  if (reference.starts_with(kScheme)) reference.erase(0, kScheme.size());
  std::ranges::replace(reference, '\\', '/');
  std::string path;
  for (std::size_t i = 0; i < reference.size(); ++i) {
    const bool escaped = reference[i] == '%' && i + 2 < reference.size() &&
                         std::isxdigit(static_cast<unsigned char>(reference[i + 1])) &&
                         std::isxdigit(static_cast<unsigned char>(reference[i + 2]));
    if (escaped) {
      path += static_cast<char>(std::strtol(reference.substr(i + 1, 2).c_str(), nullptr, 16));
      i += 2;
    } else {
      path += reference[i];
    }
  }
  return path;
}

std::string size_text(Size size) { return std::to_string(size.width) + " x " + std::to_string(size.height); }

bool is_raw(const aiTexture& image) { return image.mHeight > 0; }

std::span<const std::uint8_t> encoded(const aiTexture& image) {
  return {reinterpret_cast<const std::uint8_t*>(image.pcData), image.mWidth};
}

Size raw_size(const aiTexture& image) { return {static_cast<int>(image.mHeight), static_cast<int>(image.mWidth)}; }

Texture raw_texture(const aiTexture& image, std::string name) {
  const Size size = raw_size(image);
  std::vector<std::uint8_t> rgba(4 * size.pixels());
  for (std::size_t i = 0; i < size.pixels(); ++i) {
    const aiTexel& texel = image.pcData[i];
    rgba[4 * i] = texel.r;
    rgba[4 * i + 1] = texel.g;
    rgba[4 * i + 2] = texel.b;
    rgba[4 * i + 3] = texel.a;
  }
  return {std::move(name), size, std::move(rgba)};
}

}  // namespace

TextureSource::TextureSource(const aiScene& file, fs::path path, const ImportOptions& options)
    : file_(file), path_(std::move(path)), options_(options) {}

std::vector<fs::path> TextureSource::candidates(const std::string& reference) const {
  std::vector<fs::path> paths;
  for (const std::string& spelling : {reference, to_utf8(reference)}) {
    add_candidates(as_path(spelling), paths);
    if (is_utf8(reference)) break;
  }
  return paths;
}

void TextureSource::add_candidates(const fs::path& wanted, std::vector<fs::path>& paths) const {
  const fs::path folder = path_.parent_path();
  paths.push_back(folder / wanted);
  constexpr std::array<const char*, 5> kFolders{"", "textures", "../textures", "materials/textures",
                                                "../materials/textures"};
  for (const char* name : kFolders) paths.push_back(folder / name / wanted.filename());
  for (const fs::path& extra : options_.texture_folders) paths.push_back(extra / wanted.filename());
}

TextureSource::Found TextureSource::look_for(const std::string& reference) const {
  Found found;
  try {
    found.embedded = file_.GetEmbeddedTexture(reference.c_str());
    if (found.embedded) {
      found.size = is_raw(*found.embedded) ? raw_size(*found.embedded) : image_size(encoded(*found.embedded));
    } else {
      find_file(reference, found);
    }
    if (found.size.pixels() > options_.limits.texture_pixels) {
      throw Error("is " + size_text(found.size) + " pixels, more than the limit of " +
                  std::to_string(options_.limits.texture_pixels) + " (raise limits.texture_pixels to allow it)");
    }
  } catch (const Error& error) {
    found.problem = error.what();
  }
  return found;
}

void TextureSource::find_file(const std::string& reference, Found& found) const {
  for (const fs::path& candidate : candidates(reference)) {
    std::error_code ignored;
    if (!fs::is_regular_file(candidate, ignored)) {
      found.trace.absent.push_back(candidate);
      continue;
    }
    found.file = candidate;
    found.trace.read.push_back(candidate);
    check_limit(candidate.string(), "bytes", size_of_file(candidate), options_.limits.file_bytes, "file_bytes");
    found.size = image_size(read_file(candidate));
    return;
  }
  throw Error("was not found");
}

Texture TextureSource::decode(const std::string& reference, const Found& found) {
  if (!found.embedded) return decode_image(found.file.filename().string(), read_file(found.file));
  const aiTexture& image = *found.embedded;
  const std::string name = image.mFilename.length > 0 ? image.mFilename.C_Str() : reference;
  return is_raw(image) ? raw_texture(image, name) : decode_image(name, encoded(image));
}

void TextureSource::check_bytes(const std::vector<Found>& found) const {
  std::size_t bytes = 0;
  for (const Found& image : found) bytes += image.problem.empty() ? 4 * image.size.pixels() : 0;
  const bool is_part = options_.texture_bytes != nullptr;
  const std::size_t all = is_part ? options_.texture_bytes->add(bytes) : bytes;
  check_limit(path_.string(), is_part ? "bytes of decoded textures with other models'" : "bytes of decoded textures",
              all, options_.limits.texture_bytes, "texture_bytes");
}

void TextureSource::load(const std::vector<std::string>& references, Scene& scene) {
  std::vector<Found> found(references.size());
  parallel_for(references.size(), [&](std::size_t i) { found[i] = look_for(references[i]); });
  check_bytes(found);
  std::vector<Texture> textures(references.size());
  parallel_for(references.size(), [&](std::size_t i) {
    try {
      if (found[i].problem.empty()) textures[i] = decode(references[i], found[i]);
    } catch (const Error& error) {
      found[i].problem = error.what();
    }
  });
  for (std::size_t i = 0; i < found.size(); ++i) {
    if (options_.trace) {
      auto& trace = *options_.trace;
      trace.read.insert(trace.read.end(), found[i].trace.read.begin(), found[i].trace.read.end());
      trace.absent.insert(trace.absent.end(), found[i].trace.absent.begin(), found[i].trace.absent.end());
    }
    if (!found[i].problem.empty()) {
      indices_[references[i]] = kNone;
      scene.warnings.push_back("texture '" + references[i] + "' of " + path_.filename().string() + " " +
                               found[i].problem + "; drawn in a neutral colour");
      continue;
    }
    indices_[references[i]] = static_cast<std::int32_t>(scene.textures.size());
    scene.textures.push_back(std::move(textures[i]));
  }
}

std::int32_t TextureSource::find(const std::string& reference) const {
  const auto found = indices_.find(reference);
  return found == indices_.end() ? kNone : found->second;
}

}  // namespace wiw::scene
