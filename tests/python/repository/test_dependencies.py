# SPDX-License-Identifier: Apache-2.0
"""A build without its libraries names every Debian package at once."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from locations import ROOT

PROJECT = """cmake_minimum_required(VERSION 3.22)
project(dependencies LANGUAGES CXX)
set(WIW_BUILD_PYTHON ON)
include({folder}/dependencies.cmake)
"""
NO_SYSTEM = ("-DCMAKE_FIND_USE_CMAKE_SYSTEM_PATH=OFF", "-DCMAKE_FIND_USE_SYSTEM_ENVIRONMENT_PATH=OFF")
"""CMake looks for libraries nowhere; the compiler is given by its path."""


def configure(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    (folder / "CMakeLists.txt").write_text(PROJECT.format(folder=ROOT / "cpp/cmake"))
    bin_folder = Path(sys.executable).parent
    cmake = shutil.which("cmake", path=f"{bin_folder}:/usr/bin:/usr/local/bin")
    ninja, compiler = shutil.which("ninja", path=f"{bin_folder}:/usr/bin"), shutil.which("c++")
    if not (cmake and ninja and compiler):
        pytest.skip("no CMake, Ninja or C++ compiler")
    tools = f"-DCMAKE_MAKE_PROGRAM={ninja}", f"-DCMAKE_CXX_COMPILER={compiler}", f"-DPython_EXECUTABLE={sys.executable}"
    command = [cmake, "-S", str(folder), "-B", str(folder / "build"), "-G", "Ninja", *tools, *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def packages(run: subprocess.CompletedProcess[str]) -> list[str]:
    """The packages that the message says to install."""
    found = re.findall(r"apt-get install (.*)", run.stderr)
    assert run.returncode != 0 and len(found) == 1 and "scripts/setup" in run.stderr, run.stderr
    return found[0].split()


def test_a_machine_with_the_packages_of_the_setup_is_ready(tmp_path: Path) -> None:
    assert "CMake Error" not in configure(tmp_path).stderr


def test_one_missing_library_is_named_by_its_package(tmp_path: Path) -> None:
    assert packages(configure(tmp_path, "-DCMAKE_DISABLE_FIND_PACKAGE_Eigen3=ON")) == ["libeigen3-dev"]


def test_all_missing_libraries_are_named_at_once(tmp_path: Path) -> None:
    missing = packages(configure(tmp_path, *NO_SYSTEM))
    setup = subprocess.run([ROOT / "scripts/setup", "--print"], capture_output=True, text=True, check=True)
    needed = [name for name in setup.stdout.split() if name.startswith("lib") and name.endswith("-dev")]
    assert {"libeigen3-dev", "librecast-dev", "libbullet-dev", "libstb-dev", "pkgconf"} <= set(missing)
    assert set(needed) - {"libgl-dev"} <= set(missing) <= set(setup.stdout.split())
