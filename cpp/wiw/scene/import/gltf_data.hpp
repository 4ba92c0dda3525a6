// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <map>
#include <string>
#include <string_view>
#include <vector>

#include "wiw/scene/import.hpp"
#include "wiw/scene/import/gltf_document.hpp"

namespace wiw::scene {

/// Numbers of an accessor: `count` rows of `components`. Normalised integers are fractions.
struct GltfValues {
  std::size_t count = 0;
  std::size_t components = 0;
  std::vector<float> numbers;

  [[nodiscard]] const float* row(std::size_t i) const { return numbers.data() + i * components; }
  [[nodiscard]] float* row(std::size_t i) { return numbers.data() + i * components; }
};

/// Reads the data of a glTF document that `check_gltf_layout` has let pass.
class GltfData {
 public:
  GltfData(const GltfDocument& document, std::filesystem::path path, const ImportOptions& options)
      : document_(document), path_(std::move(path)), options_(options) {}

  /// Throws FileError for a buffer that is missing or too short, and for sparse entries that are not there.
  GltfValues read(std::size_t accessor);

  /// The bytes of a GLB's binary chunk.
  std::vector<std::uint8_t> body() const;

 private:
  struct Elements;
  [[noreturn]] void fail(const std::string& cause) const;
  const std::vector<std::uint8_t>& buffer(std::size_t index);
  std::vector<std::uint8_t> load(const Json& buffer, std::size_t index) const;
  Elements elements(const Json& place, const Json& type, std::size_t components);
  void read_sparse(const Json& accessor, GltfValues& values);

  const GltfDocument& document_;
  std::filesystem::path path_;
  const ImportOptions& options_;
  std::map<std::size_t, std::vector<std::uint8_t>> buffers_;
};

/// "my%20scene.bin" -> "my scene.bin".
std::string decode_percent_escapes(std::string_view text);

}  // namespace wiw::scene
