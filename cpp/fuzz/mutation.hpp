// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "wiw/core/rng.hpp"

namespace wiw::fuzz {

/// libFuzzer's own mutation, to at most `most` bytes.
std::string mutate_bytes(std::string bytes, std::size_t most);

/// Exchanges one value or name of a JSON text for another, which leaves it well-formed, or leaves it to libFuzzer.
std::string mutate_json(std::string text, std::size_t most, Rng& rng);

/// A file as parts that change their lengths apart.
struct Container {
  /// The parts, or nothing where the bytes are no such file.
  std::function<std::vector<std::string>(const std::string& bytes)> split;
  /// A file of these parts, with the lengths that it states set right.
  std::function<std::string(const std::vector<std::string>& parts)> join;
  /// Which part is JSON; -1: none.
  int json = -1;
};

/// The format of a target that is linked with container_mutator.cpp, which defines it.
Container container();

/// A little-endian number in a file's header.
template <class T>
T number_at(const std::string& bytes, std::size_t at) {
  T value{};
  bytes.copy(reinterpret_cast<char*>(&value), sizeof(value), at);
  return value;
}

template <class T>
void append_number(std::string& bytes, T value) {
  bytes.append(reinterpret_cast<const char*>(&value), sizeof(value));
}

}  // namespace wiw::fuzz
