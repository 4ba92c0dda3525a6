// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <variant>
#include <vector>

namespace wiw::scene {

/// A JSON value (RFC 8259), read, changed and written. Whole numbers from 0 to 2^64 - 1 are kept as such, others as
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
  static Json from(std::size_t whole) { return Json(Value(std::uint64_t{whole})); }
  static Json from(double number);
  static Json from(std::string_view text) { return Json(Value(std::string(text))); }
  /// An array of numbers.
  static Json from(std::initializer_list<double> numbers);

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

  /// The member of that name, made where there is none; what is no object becomes one.
  Json& member(std::string_view name);
  /// The elements; what is no array becomes one.
  Array& list();
  void erase(std::string_view name);
  [[nodiscard]] std::string write() const;

 private:
  void write_to(std::string& text) const;

  Value value_;
};

}  // namespace wiw::scene
