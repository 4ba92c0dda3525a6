// SPDX-License-Identifier: Apache-2.0
#include "wiw/apartment/lighting.hpp"

#include <doctest/doctest.h>

#include <cstdlib>

#include "wiw/apartment/edits.hpp"

using namespace wiw;
using namespace wiw::apartment;
using scene::Scene;

namespace {

/// Differences of bytes in grey levels.
class Differences {
 public:
  template <class Bytes>
  void add(const Bytes& left, const Bytes& right, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i) {
      const int by = std::abs(static_cast<int>(left[i]) - static_cast<int>(right[i]));
      sum_ += by, wide_ += by > 4, ++count_;
    }
  }
  [[nodiscard]] double mean() const { return sum_ / count_; }
  [[nodiscard]] double share_above_four() const { return wide_ / count_; }

 private:
  double sum_ = 0., wide_ = 0., count_ = 0.;
};

}  // namespace

TEST_CASE("few rays of bounced light show what many show") {
  const Draft draft = make_draft(7, Split::kVal, {});
  ThreadPool& pool = ThreadPool::shared();
  const Scene few = bake(draft, pool), many = bake(draft, pool, {4, 12});
  Differences texels, vertices;
  const auto& lightmap = few.textures[few.textures.size() - 2].rgba;
  texels.add(lightmap, many.textures[many.textures.size() - 2].rgba, lightmap.size());
  for (std::size_t mesh = 0; mesh < few.meshes.size(); ++mesh) {
    const auto &left = few.meshes[mesh].colors, &right = many.meshes[mesh].colors;
    for (std::size_t i = 0; i < left.size(); ++i) vertices.add(left[i], right[i], 3);
  }
  CHECK(texels.mean() < 0.3);
  CHECK(texels.share_above_four() < 0.001);
  CHECK(vertices.mean() < 1.1);
  CHECK(vertices.share_above_four() < 0.02);
}
