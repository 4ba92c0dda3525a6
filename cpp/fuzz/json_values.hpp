// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string_view>
#include <vector>

namespace wiw::fuzz {

/// A value, or the name of a member, where it stands in a JSON text.
struct JsonValue {
  std::size_t begin = 0, end = 0;
  bool is_name = false;
};

/// All values of a JSON text, those inside others too. A text that is not well-formed gives what can be made out.
std::vector<JsonValue> find_json_values(std::string_view text);

}  // namespace wiw::fuzz
