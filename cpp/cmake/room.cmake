# SPDX-License-Identifier: Apache-2.0
# wiw_room(NAME SOURCES a.cpp ... DEPENDS room ... LIBRARIES lib ...): one static library `wiw_NAME` for one folder of
# cpp/wiw. DEPENDS names other rooms and may only point down (see docs/architecture.md).
add_library(wiw_warnings INTERFACE)
target_compile_options(wiw_warnings INTERFACE
  -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wno-sign-conversion -Wnon-virtual-dtor
  -Wno-missing-field-initializers -fno-math-errno
  $<$<BOOL:${WIW_WERROR}>:-Werror>)

function(wiw_room name)
  cmake_parse_arguments(ROOM "" "" "SOURCES;DEPENDS;LIBRARIES" ${ARGN})
  add_library(wiw_${name} STATIC ${ROOM_SOURCES})
  target_include_directories(wiw_${name} PUBLIC ${PROJECT_SOURCE_DIR}/cpp)
  target_link_libraries(wiw_${name} PRIVATE wiw_warnings)
  foreach(room IN LISTS ROOM_DEPENDS)
    target_link_libraries(wiw_${name} PUBLIC wiw_${room})
  endforeach()
  foreach(library IN LISTS ROOM_LIBRARIES)
    target_link_libraries(wiw_${name} PUBLIC ${library})
    if(TARGET ${library})
      get_target_property(dirs ${library} INTERFACE_INCLUDE_DIRECTORIES)
      if(dirs)
        target_include_directories(wiw_${name} SYSTEM PUBLIC ${dirs})
      endif()
    endif()
  endforeach()
endfunction()

# wiw_test(ROOM SOURCES a_test.cpp ...): one doctest executable a room, run by ctest as `ROOM`.
function(wiw_test name)
  cmake_parse_arguments(TEST "" "" "SOURCES;LIBRARIES" ${ARGN})
  add_executable(${name}_test ${PROJECT_SOURCE_DIR}/cpp/tests/main.cpp ${TEST_SOURCES})
  target_link_libraries(${name}_test PRIVATE wiw_${name} wiw_warnings ${TEST_LIBRARIES})
  target_include_directories(${name}_test PRIVATE ${PROJECT_SOURCE_DIR}/cpp/tests)
  add_test(NAME ${name} COMMAND ${name}_test)
endfunction()
