# SPDX-License-Identifier: Apache-2.0
"""Experiments on the loop: wrappers of a model or a policy, and observers of decisions."""
