# SPDX-License-Identifier: Apache-2.0
"""What is done to the loop to learn about it: wrappers of a model or a policy, and observers of decisions."""
