// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <string>

namespace wiw::apartment {

/// Display-encoded red, green, blue in [0, 1].
using Rgb = Eigen::Vector3f;

/// Colour by OKLCh lightness, chroma and hue in degrees (B. Ottosson, "A perceptual color space for image
/// processing", 2020); what the display cannot show is clipped.
Rgb oklch(float lightness, float chroma, float hue);

/// Everyday English name, e.g. "blue" or "brown".
std::string color_name(const Rgb& color);

std::string hex_code(const Rgb& color);

/// Pure power law of the display encoding that light and colour share.
constexpr float kGamma = 2.2f;
Rgb to_linear(const Rgb& encoded);
Rgb to_encoded(const Rgb& linear);

}  // namespace wiw::apartment
