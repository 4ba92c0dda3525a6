# SPDX-License-Identifier: Apache-2.0
"""The program that serves the official networks of PathDreamer and SE3DS: Python 3.8, and nothing of wiw."""
