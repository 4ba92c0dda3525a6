// SPDX-License-Identifier: Apache-2.0
#pragma once

/// Lanes to and from Embree's packets. Included after a simd_*.hpp.

namespace wiw::render::cpu {
namespace {

inline void store(float* target, Floats values) { __builtin_memcpy(target, &values, sizeof values); }
inline void store(unsigned* target, Ints values) { __builtin_memcpy(target, &values, sizeof values); }
inline Floats load_floats(const float* source) {
  Floats values;
  __builtin_memcpy(&values, source, sizeof values);
  return values;
}
inline Ints load_ints(const unsigned* source) {
  Ints values;
  __builtin_memcpy(&values, source, sizeof values);
  return values;
}

/// Zero for components below 1e-15: Embree squares its approximate reciprocals, which overflows below about 5e-20, and
/// such rays miss everything.
inline Floats without_dust(Floats x) { return x * x > 1e-30f ? x : Floats{}; }

/// Packets are checked lane by lane: -1 is traced, 0 is not.
struct alignas(64) ValidLanes {
  explicit ValidLanes(Ints mask) { __builtin_memcpy(lanes, &mask, sizeof mask); }
  int lanes[kLanes];
};

}  // namespace
}  // namespace wiw::render::cpu
