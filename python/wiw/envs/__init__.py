# SPDX-License-Identifier: Apache-2.0
"""The gymnasium face of the C++ environments."""
