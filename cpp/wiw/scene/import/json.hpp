// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <variant>
#include <vector>

namespace wiw::scene {

/// A JSON value (RFC 8259). Whole numbers from 0 to 2^64 - 1 are kept as such, others as
/// they stand in the text.
class Json {
 public:
  using Array = std::vector<Json>;
  using Object = std::vector<std::pair<std::string, Json>>;
  struct OtherNumber {
    std::string text;
  };
  using Value = std::variant<std::monostate, bool, std::uint64_t, OtherNumber, std::string, Array, Object>;

  Json() = default;
  explicit Json(Value value) : value_(std::move(value)) {}

  /// Throws Error naming the byte at which `text` stops being JSON. A zero byte ends the text.
  static Json parse(std::string_view text);

  /// First member of that name; null if there is none or this is no object.
  [[nodiscard]] const Json& operator[](std::string_view name) const;
  /// Empty unless this is an array, or an object.
  [[nodiscard]] const Array& items() const;
  [[nodiscard]] const Object& members() const;

  [[nodiscard]] bool is_null() const { return std::holds_alternative<std::monostate>(value_); }
  [[nodiscard]] bool is_object() const { return std::holds_alternative<Object>(value_); }
  [[nodiscard]] std::optional<std::uint64_t> whole() const;
  /// Any number.
  [[nodiscard]] std::optional<double> number() const;
  [[nodiscard]] bool is_true() const;
  /// Empty unless this is a string.
  [[nodiscard]] std::string_view text() const;

 private:
  Value value_;
};

}  // namespace wiw::scene
