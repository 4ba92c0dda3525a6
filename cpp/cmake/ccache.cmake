# SPDX-License-Identifier: Apache-2.0
# Paths are hashed relative to the checkout, so that every clone on a machine shares what any of them has compiled.
find_program(WIW_CCACHE ccache)
if(WIW_CCACHE)
  set(launcher ${CMAKE_COMMAND} -E env CCACHE_BASEDIR=${CMAKE_SOURCE_DIR} CCACHE_NOHASHDIR=1 ${WIW_CCACHE})
  set(CMAKE_C_COMPILER_LAUNCHER ${launcher})
  set(CMAKE_CXX_COMPILER_LAUNCHER ${launcher})
endif()
