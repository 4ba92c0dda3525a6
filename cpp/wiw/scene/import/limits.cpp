// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/limits.hpp"

#include "wiw/core/error.hpp"

namespace wiw::scene {

void check_limit(const std::string& path, const char* what, std::size_t figure, std::size_t limit,
                 const char* limit_name) {
  if (figure <= limit) return;
  throw FileError(path, "has " + std::to_string(figure) + " " + what + ", more than the limit of " +
                            std::to_string(limit) + " (raise limits." + limit_name + " to allow it)");
}

}  // namespace wiw::scene
