# SPDX-License-Identifier: Apache-2.0
# Every third-party library as one imported target, included as SYSTEM so that only own code is held to the warnings.
# All of them are looked for before anything fails, so that one message names every Debian package to install.
set(WIW_MISSING_PACKAGES "")

# Note the Debian package of a library unless each of the variables is true.
macro(wiw_require package)
  foreach(found IN ITEMS ${ARGN})
    if(NOT ${found})
      list(APPEND WIW_MISSING_PACKAGES ${package})
    endif()
  endforeach()
endmacro()

find_package(Threads REQUIRED)
find_package(Eigen3 3.4 CONFIG QUIET)
wiw_require(libeigen3-dev Eigen3_FOUND)
find_package(assimp CONFIG QUIET)
wiw_require(libassimp-dev assimp_FOUND)
find_package(embree 3 CONFIG QUIET)
wiw_require(libembree-dev embree_FOUND)
find_package(pugixml CONFIG QUIET)
wiw_require(libpugixml-dev pugixml_FOUND)

# libopencv-dev carries OpenCV's CMake files and 1 GB of packages; core and imgproc alone are found by library.
find_path(WIW_OPENCV_INCLUDE opencv2/core.hpp PATH_SUFFIXES opencv4)
find_library(WIW_OPENCV_CORE opencv_core)
find_library(WIW_OPENCV_IMGPROC opencv_imgproc)
wiw_require(libopencv-core-dev WIW_OPENCV_INCLUDE WIW_OPENCV_CORE)
wiw_require(libopencv-imgproc-dev WIW_OPENCV_IMGPROC)

# Recast ships neither CMake nor pkg-config files.
find_path(WIW_RECAST_INCLUDE Recast.h PATH_SUFFIXES recastnavigation)
find_library(WIW_RECAST Recast)
find_library(WIW_DETOUR Detour)
wiw_require(librecast-dev WIW_RECAST_INCLUDE WIW_RECAST WIW_DETOUR)

# Bullet's own CMake file names no double precision; pkg-config knows the libraries and the define that goes with them.
find_package(PkgConfig QUIET)
wiw_require(pkgconf PkgConfig_FOUND)
if(PkgConfig_FOUND)
  pkg_check_modules(WIW_BULLET QUIET bullet-float64)
endif()
foreach(library BulletDynamics BulletCollision LinearMath)
  find_library(WIW_${library} ${library}-float64 HINTS ${WIW_BULLET_LIBRARY_DIRS})
  wiw_require(libbullet-dev WIW_${library})
endforeach()
if(PkgConfig_FOUND)
  wiw_require(libbullet-dev WIW_BULLET_FOUND)
endif()

find_path(WIW_URDFDOM_INCLUDE urdf_parser/urdf_parser.h PATH_SUFFIXES urdfdom)
find_library(WIW_URDFDOM urdfdom_model)
find_library(WIW_CONSOLE_BRIDGE console_bridge)
wiw_require(liburdfdom-dev WIW_URDFDOM_INCLUDE WIW_URDFDOM WIW_CONSOLE_BRIDGE)

# Compressed meshes and images of glTF.
find_path(WIW_DRACO_INCLUDE draco/compression/decode.h)
find_library(WIW_DRACO draco)
wiw_require(libdraco-dev WIW_DRACO_INCLUDE WIW_DRACO)
find_path(WIW_MESHOPTIMIZER_INCLUDE meshoptimizer.h)
find_library(WIW_MESHOPTIMIZER meshoptimizer)
wiw_require(libmeshoptimizer-dev WIW_MESHOPTIMIZER_INCLUDE WIW_MESHOPTIMIZER)
find_path(WIW_WEBP_INCLUDE webp/decode.h)
find_library(WIW_WEBP webp)
wiw_require(libwebp-dev WIW_WEBP_INCLUDE WIW_WEBP)

# Headers only: stb_image decodes PNG and JPEG; EGL is opened at run time, so nothing links it.
find_path(WIW_STB_INCLUDE stb/stb_image.h)
wiw_require(libstb-dev WIW_STB_INCLUDE)
find_path(WIW_EGL_INCLUDE EGL/egl.h)
wiw_require(libegl-dev WIW_EGL_INCLUDE)

if(WIW_BUILD_PYTHON)
  find_package(Python 3.10 QUIET COMPONENTS Interpreter Development.Module)
  wiw_require(python3-dev Python_FOUND)
endif()

if(WIW_MISSING_PACKAGES)
  list(REMOVE_DUPLICATES WIW_MISSING_PACKAGES)
  list(JOIN WIW_MISSING_PACKAGES " " packages)
  message(FATAL_ERROR
    "wiw: libraries that the C++ core needs are missing. On Debian or Ubuntu, install all of them with\n"
    "    apt-get install ${packages}\n"
    "and run the same command again. In a clone, `scripts/setup` installs them and wiw in one go.\n")
endif()

add_library(wiw_opencv INTERFACE)
target_include_directories(wiw_opencv SYSTEM INTERFACE ${WIW_OPENCV_INCLUDE})
target_link_libraries(wiw_opencv INTERFACE ${WIW_OPENCV_IMGPROC} ${WIW_OPENCV_CORE})

add_library(wiw_recast INTERFACE)
target_include_directories(wiw_recast SYSTEM INTERFACE ${WIW_RECAST_INCLUDE})
target_link_libraries(wiw_recast INTERFACE ${WIW_RECAST} ${WIW_DETOUR})

add_library(wiw_bullet INTERFACE)
target_include_directories(wiw_bullet SYSTEM INTERFACE ${WIW_BULLET_INCLUDE_DIRS})
target_compile_options(wiw_bullet INTERFACE ${WIW_BULLET_CFLAGS_OTHER})
target_link_libraries(wiw_bullet INTERFACE ${WIW_BulletDynamics} ${WIW_BulletCollision} ${WIW_LinearMath})

add_library(wiw_urdfdom INTERFACE)
target_include_directories(wiw_urdfdom SYSTEM INTERFACE ${WIW_URDFDOM_INCLUDE})
target_link_libraries(wiw_urdfdom INTERFACE ${WIW_URDFDOM} ${WIW_CONSOLE_BRIDGE})

foreach(library draco meshoptimizer webp)
  string(TOUPPER WIW_${library} found)
  add_library(wiw_${library} INTERFACE)
  target_include_directories(wiw_${library} SYSTEM INTERFACE ${${found}_INCLUDE})
  target_link_libraries(wiw_${library} INTERFACE ${${found}})
endforeach()
