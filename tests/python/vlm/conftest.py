# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests of vision-language models."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a model with random weights."""
    pytest.importorskip("transformers")
    from wiw.vlm.tiny import make_tiny

    return make_tiny(tmp_path_factory.mktemp("vlm") / "tiny")
