# SPDX-License-Identifier: Apache-2.0
find_program(WIW_CCACHE ccache)
if(WIW_CCACHE)
  set(CMAKE_C_COMPILER_LAUNCHER ${WIW_CCACHE})
  set(CMAKE_CXX_COMPILER_LAUNCHER ${WIW_CCACHE})
endif()
