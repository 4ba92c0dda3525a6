// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/texture_source.hpp"

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

struct TextureSource::Found {
  const ImageReference* image = nullptr;
  fs::path file;  // where it is not embedded
  Size size;      // by the image's header
  bool needs_basis = false;
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

}  // namespace

TextureSource::TextureSource(fs::path path, const ImportOptions& options) : path_(std::move(path)), options_(options) {}

std::vector<fs::path> TextureSource::candidates(const std::string& name) const {
  std::vector<fs::path> paths;
  for (const std::string& spelling : {name, to_utf8(name)}) {
    add_candidates(as_path(spelling), paths);
    if (is_utf8(name)) break;
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

TextureSource::Found TextureSource::look_for(const ImageReference& image) const {
  Found found{.image = &image};
  try {
    if (image.embedded) {
      found.size = image_size(*image.embedded);
      found.needs_basis = is_basis(*image.embedded);
    } else {
      find_file(image.name, found);
    }
    if (found.size.pixels() > options_.limits.texture_pixels) {
      throw Error("is " + size_text(found.size) + " pixels, more than the limit of " +
                  std::to_string(options_.limits.texture_pixels) + " (raise limits.texture_pixels to allow it)");
    }
    if (found.needs_basis && !options_.decode_basis) throw Error("is stored as Basis Universal");
  } catch (const Error& error) {
    found.problem = error.what();
  }
  return found;
}

void TextureSource::find_file(const std::string& name, Found& found) const {
  for (const fs::path& candidate : candidates(name)) {
    std::error_code ignored;
    if (!fs::is_regular_file(candidate, ignored)) {
      found.trace.absent.push_back(candidate);
      continue;
    }
    found.file = candidate;
    found.trace.read.push_back(candidate);
    check_limit(candidate.string(), "bytes", size_of_file(candidate), options_.limits.file_bytes, "file_bytes");
    const auto bytes = read_file(candidate);
    found.size = image_size(bytes);
    found.needs_basis = is_basis(bytes);
    return;
  }
  throw Error("was not found");
}

Texture TextureSource::decode(const Found& found) const {
  const ImageReference& image = *found.image;
  if (image.embedded) return decode_image(image.name, *image.embedded, options_.decode_basis);
  return decode_image(found.file.filename().string(), read_file(found.file), options_.decode_basis);
}

void TextureSource::check_bytes(const std::vector<Found>& found) const {
  std::size_t bytes = 0;
  for (const Found& image : found) bytes += image.problem.empty() ? 4 * image.size.pixels() : 0;
  const bool is_part = options_.texture_bytes != nullptr;
  const std::size_t all = is_part ? options_.texture_bytes->add(bytes) : bytes;
  check_limit(path_.string(), is_part ? "bytes of decoded textures with other models'" : "bytes of decoded textures",
              all, options_.limits.texture_bytes, "texture_bytes");
}

void TextureSource::warn(const std::vector<Found>& found, Scene& scene) const {
  const std::string file = path_.filename().string();
  std::size_t undecodable = 0;
  for (const Found& image : found) {
    if (image.problem.empty()) continue;
    if (image.needs_basis && !options_.decode_basis) {
      ++undecodable;
      continue;
    }
    std::string warning = image.image->embedded ? image.image->name : "texture '" + image.image->name + "'";
    warning += " of " + file + " ";
    warning += image.problem + "; drawn in a neutral colour";
    scene.warnings.push_back(std::move(warning));
  }
  if (undecodable == 0) return;
  scene.warnings.push_back(std::to_string(undecodable) + (undecodable == 1 ? " image of " : " images of ") + file +
                           (undecodable == 1 ? " is" : " are") +
                           " stored as Basis Universal, whose decoder is not installed (pip install 'wiw[hm3d]'); "
                           "drawn in a neutral colour");
}

void TextureSource::load(const std::vector<ImageReference>& images, Scene& scene) {
  std::vector<Found> found(images.size());
  parallel_for(images.size(), [&](std::size_t i) { found[i] = look_for(images[i]); });
  check_bytes(found);
  std::vector<Texture> textures(images.size());
  parallel_for(images.size(), [&](std::size_t i) {
    try {
      if (found[i].problem.empty()) textures[i] = decode(found[i]);
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
    if (found[i].problem.empty()) decoded_[images[i].name] = std::move(textures[i]);
  }
  warn(found, scene);
}

std::int32_t TextureSource::find(const std::string& image, const Sampling& sampling, Scene& scene) {
  const auto decoded = decoded_.find(image);
  if (decoded == decoded_.end()) return kNone;
  const auto index = static_cast<std::int32_t>(scene.textures.size());
  const auto [known, is_new] = indices_.try_emplace({image, sampling}, index);
  if (!is_new) return known->second;
  scene.textures.push_back(decoded->second);
  scene.textures.back().sampling = sampling;
  return index;
}

}  // namespace wiw::scene
