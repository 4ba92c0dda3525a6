# SPDX-License-Identifier: Apache-2.0
"""Runs: configuration, the run store, workers, resuming and verifying."""
