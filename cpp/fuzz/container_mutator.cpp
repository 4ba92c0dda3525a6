// SPDX-License-Identifier: Apache-2.0
// The mutator of targets whose files have parts: it changes one of them, or now and then the whole.
#include <algorithm>

#include "mutation.hpp"

extern "C" std::size_t LLVMFuzzerMutate(std::uint8_t* data, std::size_t size, std::size_t most);

extern "C" std::size_t LLVMFuzzerCustomMutator(std::uint8_t* data, std::size_t size, std::size_t most, unsigned seed) {
  static const wiw::fuzz::Container container = wiw::fuzz::container();
  wiw::Rng rng(seed);
  std::vector<std::string> parts = container.split(std::string(data, data + size));
  if (parts.empty() || rng.chance(0.05)) return LLVMFuzzerMutate(data, size, most);
  const auto which = rng.below(static_cast<std::uint32_t>(parts.size()));
  const std::size_t room = parts[which].size() + most - size;
  const bool is_json = static_cast<int>(which) == container.json;
  parts[which] =
      is_json ? wiw::fuzz::mutate_json(parts[which], room, rng) : wiw::fuzz::mutate_bytes(parts[which], room);
  const std::string mutated = container.join(parts);
  if (mutated.size() > most) return LLVMFuzzerMutate(data, size, most);
  std::ranges::copy(mutated, data);
  return mutated.size();
}
