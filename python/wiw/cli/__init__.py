# SPDX-License-Identifier: Apache-2.0
"""The `wiw` command."""

from wiw.cli.app import main, run_process

__all__ = ["main", "run_process"]
