// SPDX-License-Identifier: Apache-2.0
#include "wiw/core/rng.hpp"

#include <doctest/doctest.h>

#include <set>

using namespace wiw;

TEST_CASE("Philox4x32-10 gives the known answers of the Random123 distribution") {
  CHECK(philox4x32({0, 0, 0, 0}, {0, 0}) ==
        std::array<std::uint32_t, 4>{0x6627e8d5, 0xe169c58d, 0xbc57ac4c, 0x9b00dbd8});
  CHECK(philox4x32({0xffffffff, 0xffffffff, 0xffffffff, 0xffffffff}, {0xffffffff, 0xffffffff}) ==
        std::array<std::uint32_t, 4>{0x408f276d, 0x41c83b0e, 0xa20bc7c6, 0x6d5451fd});
  CHECK(philox4x32({0x243f6a88, 0x85a308d3, 0x13198a2e, 0x03707344}, {0xa4093822, 0x299f31d0}) ==
        std::array<std::uint32_t, 4>{0xd16cfe09, 0x94fdcceb, 0x5001e420, 0x24126ea1});
}

TEST_CASE("keys depend on order and on every part") {
  CHECK(fold_key({1, 2}) != fold_key({2, 1}));
  CHECK(fold_key({1}) != fold_key({1, 0}));
  CHECK(mix_key(1, 2) != mix_key(2, 1));
  std::set<std::uint64_t> keys;
  for (std::uint64_t episode = 0; episode < 100; ++episode) {
    for (std::uint64_t decision = 0; decision < 20; ++decision) keys.insert(fold_key({7, episode, decision}));
  }
  CHECK(keys.size() == 2000);
}

TEST_CASE("the key of a candidate is the one that runs on record were made with") {
  CHECK(fold_key({}) == kRootKey);
  CHECK(fold_key({0, 17, 3, 2}) == 15280227715066993766ull);
  CHECK(fold_key({~std::uint64_t{0}, 5}) == 5845624468492206058ull);
}

TEST_CASE("uniform numbers fill [0, 1) evenly") {
  Rng rng(42);
  double sum = 0;
  for (int i = 0; i < 100000; ++i) {
    const double value = rng.uniform();
    CHECK_UNARY(value >= 0 && value < 1);
    sum += value;
  }
  CHECK(sum / 100000 == doctest::Approx(0.5).epsilon(0.01));
  for (int i = 0; i < 1000; ++i) CHECK(rng.below(7) < 7);
}
