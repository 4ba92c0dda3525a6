# SPDX-License-Identifier: Apache-2.0
"""A world model that another process or machine computes; `wiw serve` is the other end."""
