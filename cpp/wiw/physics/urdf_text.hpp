// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

namespace wiw::physics {

/// A robot description as urdfdom can be trusted with it: well-formed UTF-8 whose numbers are finite numbers, separated
/// by single spaces, and without percent signs, for urdfdom prints what it quotes of a file as a format string. Throws
/// FileError naming `source`, the element and what was expected of it.
std::string check_urdf_text(const std::string& text, const std::string& source);

/// A name or message of urdfdom's with the percent signs back that `check_urdf_text` took out.
std::string restore_percent_signs(const std::string& text);

}  // namespace wiw::physics
