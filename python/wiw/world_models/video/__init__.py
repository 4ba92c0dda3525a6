# SPDX-License-Identifier: Apache-2.0
"""Image-to-video pipelines of `diffusers` as world models: what they have in common."""

from wiw.world_models.video.model import Clips, VideoModel

PACKAGES = ("torch", "diffusers", "transformers", "accelerate")
"""What every pipeline needs."""

__all__ = ["PACKAGES", "Clips", "VideoModel"]
