// SPDX-License-Identifier: Apache-2.0
#include "mutation.hpp"

#include <algorithm>
#include <array>
#include <string_view>

#include "json_values.hpp"

extern "C" std::size_t LLVMFuzzerMutate(std::uint8_t* data, std::size_t size, std::size_t most);

namespace wiw::fuzz {
namespace {

constexpr std::array<std::string_view, 22> kLiterals{
    "null",       "true",     "false", "0",          "1",
    "2",          "3",        "4",     "255",        "65535",
    "4294967295", "-1",       "1e308", "2147483648", "18446744073709551615",
    "-0.5",       "1e-45",    "\"\"",  "[]",         "{}",
    "[0]",        "{\"a\":1}"};

std::size_t below(Rng& rng, std::size_t end) { return rng.below(static_cast<std::uint32_t>(end)); }

std::string text_of(const std::string& text, const JsonValue& value) {
  return text.substr(value.begin, value.end - value.begin);
}

/// What a value may become.
std::string exchange(const std::string& text, const JsonValue& value, const std::vector<JsonValue>& all, Rng& rng) {
  const std::string own = text_of(text, value);
  const std::string other = text_of(text, all[below(rng, all.size())]);
  switch (below(rng, 4)) {
    case 0: return std::string(kLiterals[below(rng, kLiterals.size())]);
    case 1: return other;
    case 2:
      if (own.size() > 2 && own.front() == '[') return own.substr(0, own.size() - 1) + "," + own.substr(1);
      return "[" + own + "," + other + "]";
    default: return mutate_bytes(own, own.size() + 8);
  }
}

}  // namespace

std::string mutate_bytes(std::string bytes, std::size_t most) {
  const std::size_t size = std::min(bytes.size(), most);
  bytes.resize(std::max<std::size_t>(most, 1));
  bytes.resize(LLVMFuzzerMutate(reinterpret_cast<std::uint8_t*>(bytes.data()), size, bytes.size()));
  return bytes;
}

std::string mutate_json(std::string text, std::size_t most, Rng& rng) {
  const std::vector<JsonValue> all = find_json_values(text);
  if (all.empty() || rng.chance(0.25)) return mutate_bytes(std::move(text), most);
  for (std::size_t changes = 1 + below(rng, 3); changes > 0; --changes) {
    const std::vector<JsonValue> values = find_json_values(text);
    if (values.empty()) break;
    const JsonValue value = values[below(rng, values.size())];
    std::vector<JsonValue> others;
    std::ranges::copy_if(values, std::back_inserter(others),
                         [&](const JsonValue& v) { return v.is_name == value.is_name; });
    const std::string with =
        value.is_name ? text_of(text, others[below(rng, others.size())]) : exchange(text, value, others, rng);
    if (text.size() + with.size() <= most) text.replace(value.begin, value.end - value.begin, with);
  }
  return text;
}

}  // namespace wiw::fuzz
