// SPDX-License-Identifier: Apache-2.0
#include "wiw/scene/import/json.hpp"

#include <algorithm>
#include <array>
#include <charconv>

#include "wiw/core/error.hpp"

namespace wiw::scene {
namespace {

constexpr int kMostNesting = 256;
constexpr std::string_view kDigits = "0123456789";

void append_utf8(std::string& text, std::uint32_t code) {
  const auto put = [&](std::uint32_t byte) { text += static_cast<char>(byte); };
  if (code < 0x80) {
    put(code);
  } else if (code < 0x800) {
    put(0xC0 | (code >> 6));
    put(0x80 | (code & 0x3F));
  } else if (code < 0x10000) {
    put(0xE0 | (code >> 12));
    put(0x80 | ((code >> 6) & 0x3F));
    put(0x80 | (code & 0x3F));
  } else {
    put(0xF0 | (code >> 18));
    put(0x80 | ((code >> 12) & 0x3F));
    put(0x80 | ((code >> 6) & 0x3F));
    put(0x80 | (code & 0x3F));
  }
}

class Parser {
 public:
  explicit Parser(std::string_view text) : text_(text.substr(0, text.find('\0'))) {}

  Json document() {
    Json root = value(0);
    if (peek() != '\0') fail("text behind the end");
    return root;
  }

 private:
  [[noreturn]] void fail(const std::string& cause) const {
    throw Error("is no valid JSON: " + cause + " at byte " + std::to_string(at_));
  }
  /// The next character that is no space; zero at the end.
  char peek() {
    at_ = std::min(text_.find_first_not_of(" \t\r\n", at_), text_.size());
    return at_ < text_.size() ? text_[at_] : '\0';
  }
  bool take(char wanted) {
    if (peek() != wanted) return false;
    ++at_;
    return true;
  }
  void expect(char wanted) {
    if (!take(wanted)) fail(std::string("expected '") + wanted + "'");
  }
  bool take_word(std::string_view word) {
    if (!text_.substr(at_).starts_with(word)) return false;
    at_ += word.size();
    return true;
  }

  Json value(int depth) {
    if (depth > kMostNesting) fail("values nested more than " + std::to_string(kMostNesting) + " deep");
    const char first = peek();
    if (first == '{') return object(depth);
    if (first == '[') return array(depth);
    if (first == '"') return Json(string());
    if (first == '-' || kDigits.find(first) != std::string_view::npos) return number();
    if (take_word("true")) return Json(true);
    if (take_word("false")) return Json(false);
    if (take_word("null")) return {};
    fail("expected a value");
  }

  Json object(int depth) {
    Json::Object members;
    expect('{');
    if (take('}')) return Json(std::move(members));
    do {
      if (peek() != '"') fail("expected a name");
      std::string name = string();
      expect(':');
      members.emplace_back(std::move(name), value(depth + 1));
    } while (take(','));
    expect('}');
    return Json(std::move(members));
  }

  Json array(int depth) {
    Json::Array items;
    expect('[');
    if (take(']')) return Json(std::move(items));
    do {
      items.push_back(value(depth + 1));
    } while (take(','));
    expect(']');
    return Json(std::move(items));
  }

  Json number() {
    const std::size_t end = std::min(text_.find_first_not_of("0123456789+-.eE", at_), text_.size());
    const std::string_view token = text_.substr(at_, end - at_);
    at_ = end;
    std::uint64_t whole = 0;
    const auto [rest, error] = std::from_chars(token.data(), token.data() + token.size(), whole);
    const bool is_whole = error == std::errc() && rest == token.data() + token.size();
    return is_whole ? Json(whole) : Json(Json::OtherNumber{std::string(token)});
  }

  std::string string() {
    std::string result;
    ++at_;
    while (true) {
      const std::size_t stop = text_.find_first_of("\"\\", at_);
      if (stop == std::string_view::npos) fail("a string without end");
      result += text_.substr(at_, stop - at_);
      at_ = stop + 1;
      if (text_[stop] == '"') return result;
      escaped(result);
    }
  }

  void escaped(std::string& result) {
    constexpr std::string_view kNames = "\"\\/bfnrt";
    constexpr std::string_view kCharacters = "\"\\/\b\f\n\r\t";
    const char name = at_ < text_.size() ? text_[at_++] : '\0';
    if (name == 'u') {
      append_utf8(result, code_point());
      return;
    }
    const std::size_t which = kNames.find(name);
    if (which == std::string_view::npos) fail("an unknown escape in a string");
    result += kCharacters[which];
  }

  /// \uD83D\uDE00 stands for one code point above 0xFFFF.
  std::uint32_t code_point() {
    const std::uint32_t high = hex4();
    if (high < 0xD800 || high > 0xDBFF) return high;
    if (!take_word("\\u")) fail("half a surrogate pair");
    const std::uint32_t low = hex4();
    if (low < 0xDC00 || low > 0xDFFF) fail("half a surrogate pair");
    return 0x10000 + ((high - 0xD800) << 10) + (low - 0xDC00);
  }

  std::uint32_t hex4() {
    std::uint32_t code = 0;
    const std::string_view token = text_.substr(at_, 4);
    const auto [rest, error] = std::from_chars(token.data(), token.data() + token.size(), code, 16);
    if (token.size() < 4 || error != std::errc() || rest != token.data() + 4) fail("expected four hex digits");
    at_ += 4;
    return code;
  }

  std::string_view text_;
  std::size_t at_ = 0;
};

}  // namespace

Json Json::parse(std::string_view text) { return Parser(text).document(); }

const Json& Json::operator[](std::string_view name) const {
  static const Json null;
  const Object& all = members();
  const auto found = std::ranges::find(all, name, &Object::value_type::first);
  return found == all.end() ? null : found->second;
}

const Json::Array& Json::items() const {
  static const Array none;
  const auto* array = std::get_if<Array>(&value_);
  return array ? *array : none;
}

const Json::Object& Json::members() const {
  static const Object none;
  const auto* object = std::get_if<Object>(&value_);
  return object ? *object : none;
}

std::optional<std::uint64_t> Json::whole() const {
  const auto* number = std::get_if<std::uint64_t>(&value_);
  return number ? std::optional(*number) : std::nullopt;
}

std::optional<double> Json::number() const {
  if (const auto* whole = std::get_if<std::uint64_t>(&value_)) return static_cast<double>(*whole);
  const auto* other = std::get_if<OtherNumber>(&value_);
  if (!other) return std::nullopt;
  double number = 0;
  const char* end = other->text.data() + other->text.size();
  const auto [rest, error] = std::from_chars(other->text.data(), end, number);
  return error == std::errc() && rest == end ? std::optional(number) : std::nullopt;
}

bool Json::is_true() const {
  const auto* truth = std::get_if<bool>(&value_);
  return truth && *truth;
}

std::string_view Json::text() const {
  const auto* string = std::get_if<std::string>(&value_);
  return string ? std::string_view(*string) : std::string_view();
}

}  // namespace wiw::scene
