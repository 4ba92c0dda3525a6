// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cstdlib>
#include <ctime>
#include <new>

#include "scene/samples.hpp"
#include "wiw/core/error.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/scene/import.hpp"
#include "wiw/scene/sdf.hpp"

namespace {

/// Rounds per format; WIW_FUZZ_ROUNDS asks for more.
int rounds() {
  const char* text = std::getenv("WIW_FUZZ_ROUNDS");
  return text ? std::atoi(text) : 60;
}

/// Loads, or is refused with a typed error that names the file, within ten seconds of CPU. Anything else fails the test, a
/// crash included.
void load_or_refuse(const std::filesystem::path& file) {
  const std::clock_t begin = std::clock();
  try {
    const std::string extension = file.extension().string();
    (extension == ".sdf" ? wiw::scene::load_sdf_world(file) : wiw::scene::load_mesh(file))->validate();
  } catch (const wiw::FileError& error) {
    CHECK(std::string(error.what()).find(file.filename().string()) != std::string::npos);
  } catch (const std::bad_alloc&) {  // NOLINT(bugprone-empty-catch): the importing process reports it as the file's
  }
  CHECK(std::clock() - begin < 10 * CLOCKS_PER_SEC);
}

/// Small files of every format, or those of the folder that WIW_FUZZ_FILES names, which may refer to sample.mtl.
std::vector<std::filesystem::path> subjects(const Folder& folder) {
  std::vector<std::filesystem::path> files = write_samples(folder);
  const char* others = std::getenv("WIW_FUZZ_FILES");
  if (others == nullptr) return files;
  files.clear();
  for (const auto& entry : std::filesystem::directory_iterator(others)) files.push_back(entry.path());
  std::ranges::sort(files);
  return files;
}

std::string bytes_of(const std::filesystem::path& file) {
  std::ifstream stream(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), {}};
}

/// Flips a bit, sets a byte, removes some bytes or adds some.
void mutate(std::string& bytes, wiw::Rng& rng) {
  const auto below = [&](std::size_t end) {
    return static_cast<std::size_t>(rng.uniform() * static_cast<double>(end));
  };
  if (bytes.empty()) return;
  const std::size_t at = below(bytes.size());
  switch (below(4)) {
    case 0: bytes[at] = static_cast<char>(bytes[at] ^ (1 << below(8))); break;
    case 1: bytes[at] = static_cast<char>(below(256)); break;
    case 2: bytes.erase(at, 1 + below(5)); break;
    default: bytes.insert(at, 1 + below(4), static_cast<char>(below(256)));
  }
}

}  // namespace

TEST_CASE("truncated files of every format load or are refused") {
  const Folder folder;
  for (const auto& file : subjects(folder)) {
    const std::string whole = bytes_of(file);
    for (int round = 0; round < rounds(); ++round) {
      const std::size_t length = whole.size() * static_cast<std::size_t>(round) / static_cast<std::size_t>(rounds());
      CAPTURE(file);
      CAPTURE(length);
      load_or_refuse(folder.write("cut" + file.extension().string(), whole.substr(0, length)));
    }
  }
}

TEST_CASE("mutated files of every format load or are refused") {
  const Folder folder;
  for (const auto& file : subjects(folder)) {
    const std::string whole = bytes_of(file);
    for (int round = 0; round < rounds(); ++round) {
      wiw::Rng rng(wiw::fold_key({static_cast<std::uint64_t>(round)}));
      std::string bytes = whole;
      for (int change = 0; change <= round % 4; ++change) mutate(bytes, rng);
      CAPTURE(file);
      CAPTURE(round);
      load_or_refuse(folder.write("flip" + file.extension().string(), bytes));
    }
  }
}
