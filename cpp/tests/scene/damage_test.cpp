// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cstdlib>

#include "scene/samples.hpp"
#include "wiw/core/error.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/scene/import.hpp"

namespace {

/// Rounds per format; WIW_FUZZ_ROUNDS asks for more.
int rounds() {
  const char* text = std::getenv("WIW_FUZZ_ROUNDS");
  return text ? std::atoi(text) : 60;
}

/// Loads, or is refused with a typed error that names the file. Anything else fails the test, a crash included.
void load_or_refuse(const std::filesystem::path& file) {
  try {
    wiw::scene::load_mesh(file)->validate();
  } catch (const wiw::FileError& error) {
    CHECK(std::string(error.what()).find(file.filename().string()) != std::string::npos);
  }
}

std::string bytes_of(const std::filesystem::path& file) {
  std::ifstream stream(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), {}};
}

}  // namespace

TEST_CASE("truncated files of every format load or are refused") {
  const Folder folder;
  for (const auto& file : write_samples(folder)) {
    const std::string whole = bytes_of(file);
    for (int round = 0; round < rounds(); ++round) {
      const std::size_t length = whole.size() * static_cast<std::size_t>(round) / static_cast<std::size_t>(rounds());
      CAPTURE(file);
      CAPTURE(length);
      load_or_refuse(folder.write("cut" + file.extension().string(), whole.substr(0, length)));
    }
  }
}

TEST_CASE("files of every format with flipped bits load or are refused") {
  const Folder folder;
  for (const auto& file : write_samples(folder)) {
    const std::string whole = bytes_of(file);
    for (int round = 0; round < rounds(); ++round) {
      wiw::Rng rng(wiw::fold_key({static_cast<std::uint64_t>(round)}));
      std::string bytes = whole;
      for (int flip = 0; flip <= round % 4; ++flip) {
        const auto at = static_cast<std::size_t>(rng.uniform() * static_cast<double>(8 * bytes.size()));
        bytes[at / 8] = static_cast<char>(bytes[at / 8] ^ (1 << (at % 8)));
      }
      CAPTURE(file);
      CAPTURE(round);
      load_or_refuse(folder.write("flip" + file.extension().string(), bytes));
    }
  }
}
