# SPDX-License-Identifier: Apache-2.0
"""The networks that `wiw train` trains, one command each."""

from __future__ import annotations

from collections.abc import Callable

from wiw.cli.train.armnet import train_armnet
from wiw.cli.train.diffuser import train_diffuser
from wiw.cli.train.navigator import train_navigator
from wiw.cli.train.perception import train_perception
from wiw.cli.train.pocket import train_pocket
from wiw.cli.train.recogniser import train_recogniser
from wiw.cli.train.video import VIDEO, make_command
from wiw.cli.train.warpnet import train_warpnet

TRAININGS: tuple[tuple[Callable[..., int], str, str], ...] = (
    (train_recogniser, "recogniser", "Policy for Active Recognition: names the object in a box. From scenes."),
    (train_navigator, "navigator", "Policy for Image-Goal Navigation: estimates where the goal is. From scenes."),
    (train_warpnet, "warpnet", "World model for navigation: the panorama from a place nearby. From scenes."),
    (train_pocket, "pocket", "World model for navigation: a small video diffusion model. From collected data."),
    (train_perception, "perception", "Labeller for question answering: categories and states of pixels. From scenes."),
    (train_armnet, "armnet", "World model for manipulation: the front view after each pose. From simulated plays."),
    (train_diffuser, "diffuser", "The 3D diffusion policy for manipulation. From demonstrations."),
    *(
        (make_command(name), name, f"{title}, post-trained to follow actions. From collected data.")
        for name, title in VIDEO.items()
    ),
)
"""Function, name and summary of each command."""
