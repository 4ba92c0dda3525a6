# SPDX-License-Identifier: Apache-2.0
"""Folders of the tests, and of the checkout that they are in."""

from __future__ import annotations

from pathlib import Path

PYTHON_TESTS = Path(__file__).resolve().parent
"""Models, tasks and files that tests share; each folder in it has the tests of one room of `python/wiw`."""
TESTS = PYTHON_TESTS.parent
ROOT = TESTS.parent
ROOM_FOLDERS = sorted({str(file.parent) for file in PYTHON_TESTS.glob("*/test_*.py")})
"""Folders of all rooms, for `sys.path`: some tests use parts of others."""
