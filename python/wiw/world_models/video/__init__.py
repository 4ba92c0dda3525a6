# SPDX-License-Identifier: Apache-2.0
"""Image-to-video pipelines of `diffusers` as world models."""
