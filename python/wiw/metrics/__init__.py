# SPDX-License-Identifier: Apache-2.0
"""What is measured: task scores in percent, distances between images, and distances between poses."""

from wiw.metrics.answers import aeqa_score, aeqa_spl
from wiw.metrics.image_quality import colourfulness, paper_quality, sharpness
from wiw.metrics.images import psnr, ssim
from wiw.metrics.lpips import Lpips
from wiw.metrics.navigation import mean_trajectory, path_efficiency, spl, success_rate
from wiw.metrics.poses import pose_error
from wiw.metrics.ranks import rank_agreement

__all__ = [
    "Lpips",
    "aeqa_score",
    "aeqa_spl",
    "colourfulness",
    "mean_trajectory",
    "paper_quality",
    "path_efficiency",
    "pose_error",
    "psnr",
    "rank_agreement",
    "sharpness",
    "spl",
    "ssim",
    "success_rate",
]
