# SPDX-License-Identifier: Apache-2.0
"""The networks that `wiw train` trains, a command each."""

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
    (train_recogniser, "recogniser", "Policy of Active Recognition: names the object in a box. On scenes."),
    (train_navigator, "navigator", "Policy of Image-Goal Navigation: where the goal is. On scenes."),
    (train_warpnet, "warpnet", "World model of navigation: the panorama from a place nearby. On scenes."),
    (train_pocket, "pocket", "World model of navigation: a small video diffusion model. On collected data."),
    (train_perception, "perception", "Labeller of question answering: categories and states of pixels. On scenes."),
    (train_armnet, "armnet", "World model of manipulation: the front view after each pose. On simulated plays."),
    (train_diffuser, "diffuser", "The 3D diffusion policy of manipulation. On demonstrations."),
    *(
        (make_command(name), name, f"{title}, post-trained to follow actions. On collected data.")
        for name, title in VIDEO.items()
    ),
)
"""Function, name and summary of each command."""
