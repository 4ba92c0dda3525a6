// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace wiw {

/// Whether bytes are well-formed UTF-8 (RFC 3629: no overlong forms, no surrogates, nothing above U+10FFFF).
bool is_utf8(std::string_view bytes);

/// The same text in UTF-8. Bytes that are not UTF-8 are taken as Latin-1, which older exporters write and which gives
/// every byte a character.
std::string to_utf8(std::string_view bytes);

}  // namespace wiw
