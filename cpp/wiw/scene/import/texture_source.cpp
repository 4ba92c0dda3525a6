// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/texture_source.hpp"

#include <assimp/scene.h>

#include <algorithm>
#include <array>
#include <cctype>
#include <cstdlib>

#include "wiw/core/error.hpp"
#include "wiw/core/thread_pool.hpp"
#include "wiw/scene/import/file.hpp"
#include "wiw/scene/import/image_file.hpp"

namespace wiw {
namespace fs = std::filesystem;

struct TextureSource::Result {
  Texture texture;
  std::string problem;  // empty: decoded
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

/// Checks the header against the limit before the pixels are decoded.
Texture decode_within(const std::string& name, std::span<const std::uint8_t> bytes, const ImportLimits& limits) {
  const Size size = image_size(bytes);
  if (size.pixels() > limits.texture_pixels) {
    throw Error("is " + size_text(size) + " pixels, more than the limit of " + std::to_string(limits.texture_pixels) +
                " (raise limits.texture_pixels to allow it)");
  }
  return decode_image(name, bytes);
}

Texture decode_embedded(const aiTexture& image, const std::string& name, const ImportLimits& limits) {
  const auto* data = reinterpret_cast<const std::uint8_t*>(image.pcData);
  if (image.mHeight == 0) return decode_within(name, {data, image.mWidth}, limits);
  const Size size{static_cast<int>(image.mHeight), static_cast<int>(image.mWidth)};
  std::vector<std::uint8_t> rgba(4 * size.pixels());
  for (std::size_t i = 0; i < size.pixels(); ++i) {
    const aiTexel& texel = image.pcData[i];
    rgba[4 * i] = texel.r;
    rgba[4 * i + 1] = texel.g;
    rgba[4 * i + 2] = texel.b;
    rgba[4 * i + 3] = texel.a;
  }
  return {name, size, std::move(rgba)};
}

}  // namespace

TextureSource::TextureSource(const aiScene& file, fs::path path, const ImportOptions& options)
    : file_(file), path_(std::move(path)), options_(options) {}

std::vector<fs::path> TextureSource::candidates(const std::string& reference) const {
  const fs::path wanted = as_path(reference);
  const fs::path folder = path_.parent_path();
  std::vector<fs::path> paths{folder / wanted};
  constexpr std::array<const char*, 5> kFolders{"", "textures", "../textures", "materials/textures",
                                                "../materials/textures"};
  for (const char* name : kFolders) paths.push_back(folder / name / wanted.filename());
  for (const fs::path& extra : options_.texture_folders) paths.push_back(extra / wanted.filename());
  return paths;
}

TextureSource::Result TextureSource::decode(const std::string& reference) const {
  Result result;
  try {
    if (const aiTexture* image = file_.GetEmbeddedTexture(reference.c_str())) {
      const std::string name = image->mFilename.length > 0 ? image->mFilename.C_Str() : reference;
      result.texture = decode_embedded(*image, name, options_.limits);
      return result;
    }
    for (const fs::path& candidate : candidates(reference)) {
      std::error_code ignored;
      if (!fs::is_regular_file(candidate, ignored)) {
        result.trace.absent.push_back(candidate);
        continue;
      }
      result.trace.read.push_back(candidate);
      check_limit(candidate.string(), "bytes", size_of_file(candidate), options_.limits.file_bytes, "file_bytes");
      result.texture = decode_within(candidate.filename().string(), read_file(candidate), options_.limits);
      return result;
    }
    result.problem = "was not found";
  } catch (const Error& error) {
    result.problem = error.what();
  }
  return result;
}

void TextureSource::load(const std::vector<std::string>& references, Scene& scene) {
  std::vector<Result> results(references.size());
  parallel_for(references.size(), [&](std::size_t i) { results[i] = decode(references[i]); });
  std::size_t bytes = 0;
  for (std::size_t i = 0; i < results.size(); ++i) {
    Result& result = results[i];
    if (options_.trace) {
      auto& trace = *options_.trace;
      trace.read.insert(trace.read.end(), result.trace.read.begin(), result.trace.read.end());
      trace.absent.insert(trace.absent.end(), result.trace.absent.begin(), result.trace.absent.end());
    }
    if (!result.problem.empty()) {
      indices_[references[i]] = kNone;
      scene.warnings.push_back("texture '" + references[i] + "' of " + path_.filename().string() + " " +
                               result.problem + "; drawn in a neutral colour");
      continue;
    }
    bytes += result.texture.rgba.size();
    indices_[references[i]] = static_cast<std::int32_t>(scene.textures.size());
    scene.textures.push_back(std::move(result.texture));
  }
  check_limit(path_.string(), "bytes of decoded textures", bytes, options_.limits.texture_bytes, "texture_bytes");
}

std::int32_t TextureSource::find(const std::string& reference) const {
  const auto found = indices_.find(reference);
  return found == indices_.end() ? kNone : found->second;
}

}  // namespace wiw
