# SPDX-License-Identifier: Apache-2.0
# Every third-party library as one imported target, included as SYSTEM so that only own code is held to the warnings.
# Debian packages: see scripts/setup.
find_package(Threads REQUIRED)
find_package(Eigen3 3.4 REQUIRED CONFIG)
find_package(assimp REQUIRED CONFIG)
find_package(embree 3 REQUIRED CONFIG)
find_package(pugixml REQUIRED CONFIG)

# libopencv-dev carries OpenCV's CMake files and 1 GB of packages; core and imgproc alone are found by library.
find_path(WIW_OPENCV_INCLUDE opencv2/core.hpp PATH_SUFFIXES opencv4 REQUIRED)
find_library(WIW_OPENCV_CORE opencv_core REQUIRED)
find_library(WIW_OPENCV_IMGPROC opencv_imgproc REQUIRED)
add_library(wiw_opencv INTERFACE)
target_include_directories(wiw_opencv SYSTEM INTERFACE ${WIW_OPENCV_INCLUDE})
target_link_libraries(wiw_opencv INTERFACE ${WIW_OPENCV_IMGPROC} ${WIW_OPENCV_CORE})

# Recast ships neither CMake nor pkg-config files.
find_path(WIW_RECAST_INCLUDE Recast.h PATH_SUFFIXES recastnavigation REQUIRED)
find_library(WIW_RECAST Recast REQUIRED)
find_library(WIW_DETOUR Detour REQUIRED)
add_library(wiw_recast INTERFACE)
target_include_directories(wiw_recast SYSTEM INTERFACE ${WIW_RECAST_INCLUDE})
target_link_libraries(wiw_recast INTERFACE ${WIW_RECAST} ${WIW_DETOUR})

# Bullet's own CMake file names no double precision; pkg-config knows the libraries and the define that goes with them.
find_package(PkgConfig REQUIRED)
pkg_check_modules(WIW_BULLET REQUIRED bullet-float64)
add_library(wiw_bullet INTERFACE)
target_include_directories(wiw_bullet SYSTEM INTERFACE ${WIW_BULLET_INCLUDE_DIRS})
target_compile_options(wiw_bullet INTERFACE ${WIW_BULLET_CFLAGS_OTHER})
foreach(library BulletDynamics BulletCollision LinearMath)
  find_library(WIW_${library} ${library}-float64 HINTS ${WIW_BULLET_LIBRARY_DIRS} REQUIRED)
  target_link_libraries(wiw_bullet INTERFACE ${WIW_${library}})
endforeach()

find_path(WIW_URDFDOM_INCLUDE urdf_parser/urdf_parser.h PATH_SUFFIXES urdfdom REQUIRED)
find_library(WIW_URDFDOM urdfdom_model REQUIRED)
find_library(WIW_CONSOLE_BRIDGE console_bridge REQUIRED)
add_library(wiw_urdfdom INTERFACE)
target_include_directories(wiw_urdfdom SYSTEM INTERFACE ${WIW_URDFDOM_INCLUDE})
target_link_libraries(wiw_urdfdom INTERFACE ${WIW_URDFDOM} ${WIW_CONSOLE_BRIDGE})

# Headers only: stb_image decodes PNG and JPEG; EGL is opened at run time, so nothing links it.
find_path(WIW_STB_INCLUDE stb/stb_image.h REQUIRED)
find_path(WIW_EGL_INCLUDE EGL/egl.h REQUIRED)
