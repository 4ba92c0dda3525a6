// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "wiw/panorama/remap.hpp"

namespace wiw::panorama {

/// Faces in the order front (-Z), right (+X), back (+Z), left (-X), up (+Y), down (-Y). Each is a square view of 90
/// degrees between pixel edges. The side faces stand upright; the lower edge of `up` and the upper edge of `down`
/// meet the front face.
constexpr int kCubeFaces = 6;

/// Six faces as one image of 6 S rows and S columns.
Size cube_stack(int face_size);

/// Tables that cut the faces out of a panorama; output pixels are the face stack's.
BilinearTable bilinear_to_cube(const Size& panorama, int face_size);
NearestTable nearest_to_cube(const Size& panorama, int face_size);

/// Tables that look a panorama up in a face stack. A 2x2 block that leaves a face continues with the texels of the
/// face it is glued to; at a cube corner, where only three texels meet, the missing one counts as their mean (as in
/// seamless cube maps of OpenGL).
BilinearTable bilinear_from_cube(int face_size, const Size& panorama);
NearestTable nearest_from_cube(int face_size, const Size& panorama);

}  // namespace wiw::panorama
