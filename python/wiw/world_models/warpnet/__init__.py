# SPDX-License-Identifier: Apache-2.0
"""The built-in learned world model of navigation: a small network that warps panoramas and needs no depth."""
