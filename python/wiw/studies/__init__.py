# SPDX-License-Identifier: Apache-2.0
"""Studies: run arms on the same episodes, compare runs, scale, attribute failures, check a model."""
