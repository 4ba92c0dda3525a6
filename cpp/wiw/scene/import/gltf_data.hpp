// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/gltf_document.hpp"

namespace wiw::scene {

constexpr std::size_t kMostComponents = 16;  // of an accessor's element

/// Numbers of an accessor: `count` rows of `components`. Normalised integers are fractions.
struct GltfValues {
  std::size_t count = 0;
  std::size_t components = 0;
  std::vector<float> numbers;

  [[nodiscard]] const float* row(std::size_t i) const { return numbers.data() + i * components; }
  [[nodiscard]] float* row(std::size_t i) { return numbers.data() + i * components; }
};

/// A component of glTF's type `code` (5126: float) as a float, as a fraction where it is a normalised integer.
float component_value(const std::uint8_t* bytes, std::uint64_t code, bool normalized);

/// Reads the data of a glTF document that `check_gltf_layout` has let pass: buffers from the file, from beside it and
/// from data URIs, views of them, also compressed ones, and accessors.
class GltfData {
 public:
  GltfData(const GltfDocument& document, std::filesystem::path path, const ImportOptions& options)
      : document_(document), path_(std::move(path)), options_(options) {}

  // All throw FileError for a buffer that is missing or too short, and for data that do not fit.

  GltfValues read(std::size_t accessor);
  /// Throws FileError for what is no list of whole numbers.
  std::vector<std::uint32_t> read_indices(std::size_t accessor);
  /// The bytes of a view, decompressed.
  std::span<const std::uint8_t> view(std::size_t index);

 private:
  struct Elements;
  [[noreturn]] void fail(const std::string& cause) const;
  const std::vector<std::uint8_t>& buffer(std::size_t index);
  std::vector<std::uint8_t> load(const Json& buffer, std::size_t index) const;
  std::span<const std::uint8_t> part(const Json& place);
  Elements elements(const Json& place, const Json& type, std::size_t components);
  std::size_t checked_count(const Json& accessor) const;
  void read_sparse(const Json& accessor, GltfValues& values);

  const GltfDocument& document_;
  std::filesystem::path path_;
  const ImportOptions& options_;
  std::map<std::size_t, std::vector<std::uint8_t>> buffers_;
  std::map<std::size_t, std::vector<std::uint8_t>> decompressed_;  // views
};

/// "my%20scene.bin" -> "my scene.bin".
std::string decode_percent_escapes(std::string_view text);

/// The bytes of a data URI with base64 text; nothing if `uri` is none.
std::optional<std::vector<std::uint8_t>> decode_data_uri(std::string_view uri);

/// Index `name` of an object if it is below `size`.
std::optional<std::size_t> index_of(const Json& object, std::string_view name, std::size_t size);

/// The number of components of "VEC3" and other types of accessors.
std::size_t components_of(std::string_view type);

}  // namespace wiw::scene
