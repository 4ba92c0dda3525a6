# SPDX-License-Identifier: Apache-2.0
"""What a researcher asks: run arms on the same episodes, compare runs, scale, attribute failures, check a model."""
