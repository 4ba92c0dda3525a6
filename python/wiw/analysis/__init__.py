# SPDX-License-Identifier: Apache-2.0
"""Numbers of a run: estimates with intervals, paired tests, utility, costs, power, attribution."""
