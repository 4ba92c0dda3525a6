// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/sdf/xml.hpp"

#include "wiw/core/error.hpp"
#include "wiw/scene/import/file.hpp"

namespace wiw::scene::sdf {

pugi::xml_document read_xml(const std::filesystem::path& file, const ImportOptions& options) {
  check_limit(file.string(), "bytes", size_of_file(file), options.limits.file_bytes, "file_bytes");
  if (options.trace) options.trace->read.push_back(file);
  pugi::xml_document document;
  const pugi::xml_parse_result result = document.load_file(file.c_str());
  if (!result) {
    throw FileError(file.string(), "is not well-formed XML: " + std::string(result.description()) + " at byte " +
                                       std::to_string(result.offset));
  }
  return document;
}

}  // namespace wiw::scene::sdf
