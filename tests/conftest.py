# SPDX-License-Identifier: Apache-2.0
"""Fixtures for all tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real inputs: $WIW_TEST_DATA, or shared/data beside the checkout; tests that need it skip without."""
    root = Path(__file__).resolve().parents[1]
    folder = Path(os.environ.get("WIW_TEST_DATA", root.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real inputs at {folder}; set WIW_TEST_DATA to the folder that holds them")
    return folder
