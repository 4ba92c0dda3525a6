# SPDX-License-Identifier: Apache-2.0
if(WIW_SANITIZE STREQUAL "address")
  add_compile_options(-fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer -g1)
  add_link_options(-fsanitize=address,undefined)
elseif(WIW_SANITIZE STREQUAL "thread")
  add_compile_options(-fsanitize=thread -fno-omit-frame-pointer -g1)
  add_link_options(-fsanitize=thread)
elseif(NOT WIW_SANITIZE STREQUAL "")
  message(FATAL_ERROR "WIW_SANITIZE is '${WIW_SANITIZE}'; expected '', 'address' or 'thread'")
endif()

# libFuzzer is Clang's. The definition, a convention of its documentation, lets damaged bytes past checksums.
if(WIW_FUZZ)
  if(NOT CMAKE_CXX_COMPILER_ID STREQUAL "Clang")
    message(FATAL_ERROR "WIW_FUZZ needs Clang, got ${CMAKE_CXX_COMPILER_ID}; set CMAKE_CXX_COMPILER, or run scripts/fuzz_compiled")
  endif()
  add_compile_options(-fsanitize=fuzzer-no-link,address,undefined,float-cast-overflow -fno-sanitize-recover=all
    -fno-omit-frame-pointer -g1)
  add_compile_definitions(FUZZING_BUILD_MODE_UNSAFE_FOR_PRODUCTION _GLIBCXX_ASSERTIONS)
  add_link_options(-fsanitize=address,undefined)
endif()
