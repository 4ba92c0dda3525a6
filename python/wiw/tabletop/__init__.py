# SPDX-License-Identifier: Apache-2.0
"""Robotic manipulation at a table: the workbench with its physics and rendering, and the tasks that are set there."""
