// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <mutex>
#include <string>

namespace wiw::scene {

/// What an import may cost before it is refused. A hostile or mistaken file ends in a FileError, not in swapping.
struct ImportLimits {
  std::size_t file_bytes = std::size_t{4} << 30;      // each file read
  std::size_t triangles = 50'000'000;                 // over all placements
  std::size_t nodes = 1'000'000;                      // of the scene graph
  std::size_t texture_pixels = std::size_t{1} << 28;  // one texture: 16384 x 16384
  std::size_t texture_bytes = std::size_t{8} << 30;   // all textures together, decoded to RGBA
};

/// A figure that several threads add to. A mutex, because GCC 12.2 at -O3 lost the addend of an atomic's
/// `fetch_add(n) + n` here.
class SharedCount {
 public:
  /// The figure with `more` in it.
  std::size_t add(std::size_t more) {
    const std::lock_guard lock(mutex_);
    return figure_ += more;
  }

 private:
  std::mutex mutex_;
  std::size_t figure_ = 0;
};

/// Throws FileError naming file, figure and limit if `figure` exceeds `limit`. `what` is plural: "triangles".
void check_limit(const std::string& path, const char* what, std::size_t figure, std::size_t limit,
                 const char* limit_name);

}  // namespace wiw::scene
