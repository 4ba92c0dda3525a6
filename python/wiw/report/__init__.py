# SPDX-License-Identifier: Apache-2.0
"""Pages, plots, tables and recordings of a run."""
