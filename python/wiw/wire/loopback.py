# SPDX-License-Identifier: Apache-2.0
"""Addresses of this machine alone: listening there needs no token, and they are reached past any proxy."""

from __future__ import annotations

import ipaddress


def is_loopback(host: str) -> bool:
    """Return whether a host's name or address is of this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
