# SPDX-License-Identifier: Apache-2.0
"""Evaluation: run arms on the same episodes, record every decision, and say what the numbers can bear."""
