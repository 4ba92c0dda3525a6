# SPDX-License-Identifier: Apache-2.0
# Fails if an object built for one instruction set defines anything but its own entry point: a weak function compiled
# there with AVX-512 could be the copy the linker keeps for every processor. Call with -DNM= -DOBJECTS=.
foreach(object IN LISTS OBJECTS)
  if(NOT object MATCHES "kernel_(scalar|avx2|avx512)")
    continue()
  endif()
  set(set_name ${CMAKE_MATCH_1})
  execute_process(COMMAND ${NM} --defined-only -C ${object} OUTPUT_VARIABLE symbols COMMAND_ERROR_IS_FATAL ANY)
  string(REGEX MATCHALL "[^\n]* [A-Zuvw] [^\n]*" shared "${symbols}")
  list(LENGTH shared count)
  if(NOT count EQUAL 1 OR NOT shared MATCHES "render_tile_${set_name}")
    message(FATAL_ERROR "${object} shares more than its entry point:\n${symbols}")
  endif()
  math(EXPR checked "${checked} + 1")
endforeach()
if(NOT checked)
  message(FATAL_ERROR "no kernel object among ${OBJECTS}")
endif()
