# SPDX-License-Identifier: Apache-2.0
"""What PathDreamer and SE3DS share: a memory of points, and the program that serves their official networks."""
