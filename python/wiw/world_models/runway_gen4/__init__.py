# SPDX-License-Identifier: Apache-2.0
"""Runway Gen-4, a paid service."""
