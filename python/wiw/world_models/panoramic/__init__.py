# SPDX-License-Identifier: Apache-2.0
"""PathDreamer and SE3DS: panoramic RGB-D models whose official code is served from a separate environment."""
