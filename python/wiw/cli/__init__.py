# SPDX-License-Identifier: Apache-2.0
"""The `wiw` command."""

from wiw.cli.app import main

__all__ = ["main"]
