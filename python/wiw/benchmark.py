# SPDX-License-Identifier: Apache-2.0
"""The version of the benchmark, which every run records beside the version of the software."""

VERSION = 7
"""Raised with every change of a default, a size or a rule that changes decisions: runs of unlike versions are not
resumed, merged, verified or compared. docs/results.md says what each version changed.
"""
FIRST = 1
"""Version of runs that record none."""
