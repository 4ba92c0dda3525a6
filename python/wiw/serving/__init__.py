# SPDX-License-Identifier: Apache-2.0
"""Models behind sockets: world models for other processes and machines, and a vision-language model for tests."""
