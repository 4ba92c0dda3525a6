# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests of servers."""

from __future__ import annotations

import socket

import pytest


@pytest.fixture
def ipv6() -> None:
    """Skip where this machine has no IPv6."""
    try:
        with socket.socket(socket.AF_INET6) as found:
            found.bind(("::1", 0))
    except OSError:
        pytest.skip("this machine has no IPv6")
