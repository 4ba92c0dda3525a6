# SPDX-License-Identifier: Apache-2.0
"""The built-in learned world model of manipulation: from one front view to that after each pose of a plan."""
