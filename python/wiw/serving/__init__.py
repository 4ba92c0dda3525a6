# SPDX-License-Identifier: Apache-2.0
"""World models for other processes and machines: rows of many clients become full batches of one model."""
