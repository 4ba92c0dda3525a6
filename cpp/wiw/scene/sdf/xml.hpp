// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <pugixml.hpp>

#include "wiw/scene/import.hpp"

namespace wiw::scene::sdf {

/// Parses a file within the size limit and notes it in the trace. Throws FileError saying where it is not well-formed.
pugi::xml_document read_xml(const std::filesystem::path& file, const ImportOptions& options);

}  // namespace wiw::scene::sdf
