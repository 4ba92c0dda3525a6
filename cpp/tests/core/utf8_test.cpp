// SPDX-License-Identifier: Apache-2.0
#include "wiw/core/utf8.hpp"

#include <doctest/doctest.h>

#include <string>

TEST_CASE("UTF-8 is told from other bytes") {
  for (const char* text : {"", "plain", "t\xC3\xBCr", "\xE2\x82\xAC", "\xF0\x9F\x98\x80", "\xF4\x8F\xBF\xBF"}) {
    CAPTURE(text);
    CHECK(wiw::is_utf8(text));
    CHECK(wiw::to_utf8(text) == text);
  }
  // A byte that begins nothing, one cut short, overlong forms, a surrogate, beyond the last code point.
  for (const char* text :
       {"\xFC", "t\xFCr", "\xC3", "\xC3(", "\xC0\xAF", "\xE0\x80\xAF", "\xED\xA0\x80", "\xF4\x90\x80\x80"}) {
    CAPTURE(text);
    CHECK_FALSE(wiw::is_utf8(text));
    CHECK(wiw::is_utf8(wiw::to_utf8(text)));
  }
  CHECK(wiw::to_utf8("t\xFCr") == "t\xC3\xBCr");
  CHECK(wiw::to_utf8("\xFF\x80") == "\xC3\xBF\xC2\x80");
}
