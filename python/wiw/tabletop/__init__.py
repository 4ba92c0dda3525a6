# SPDX-License-Identifier: Apache-2.0
"""What an arm does at a table: the workbench with its physics and pictures, and the tasks that are set there."""
