# SPDX-License-Identifier: Apache-2.0
"""Errors of looks: every frame shows the right place, but looks wrong. They work with any world model."""

from __future__ import annotations

from abc import abstractmethod

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.experiments.errors.base import Degradation, make_generator, per_space
from wiw.loop.imagination import Answer

WIDTH = 1024
"""Width in pixels that sizes are given for, that of a panorama; in frames of another width they are in proportion."""
FINE = 6.0
"""Pixels of standard deviation up to which a frame is blurred at its own size."""
PATCHES = 16
"""Patches of flicker across a frame, about."""

Image = NDArray[np.uint8]


class FrameDegradation(Degradation):
    """An error in single frames."""

    needs_simulator = False

    def retouch(self, answer: Answer) -> NDArray[np.uint8]:
        """Return the frames, each changed except frame 0."""
        frames = np.array(answer.frames)
        rows = zip(frames, answer.lengths, answer.shared, answer.seeds, strict=True)
        for row, length, shared, seed in rows:
            for k in range(1 + int(shared), 1 + int(length)):
                row[k] = self.degrade(row[k], int(seed), answer.first + k, answer.view == "panorama")
        return frames

    @abstractmethod
    def degrade(self, frame: Image, seed: int, index: int, panorama: bool) -> Image:
        """Return a frame, uint8 [H, W, 3], with the error.

        Args:
            frame: as the model imagines it.
            seed: of its rollout.
            index: of the frame in its plan, from 1.
            panorama: whether its left and right edges meet.
        """


class Blur(FrameDegradation):
    """Frames out of focus."""

    kind = "blur"
    family = "looks"
    about = "Blurs each frame with a Gaussian."
    unit = "standard deviation in pixels of a frame 1024 wide"
    doses = per_space((4.0, 16.0, 64.0))

    def degrade(self, frame: Image, seed: int, index: int, panorama: bool) -> Image:
        """Return the frame blurred; a panorama across its seam."""
        sigma = self.dose * frame.shape[1] / WIDTH
        margin = min(frame.shape[1], int(np.ceil(3 * sigma))) if panorama else 0
        padded = np.asarray(cv2.copyMakeBorder(frame, 0, 0, margin, margin, cv2.BORDER_WRAP), np.uint8)
        small = _shrink(padded, max(1.0, sigma / FINE))  # a wide Gaussian takes seconds, and leaves no fine detail
        soft = cv2.GaussianBlur(small, (0, 0), min(sigma, FINE), borderType=cv2.BORDER_REFLECT_101)
        found = cv2.resize(soft, (padded.shape[1], padded.shape[0]), interpolation=cv2.INTER_LINEAR)
        return np.asarray(found[:, margin : margin + frame.shape[1]], np.uint8)


class Resolution(FrameDegradation):
    """Frames with fewer pixels."""

    kind = "resolution"
    family = "looks"
    about = "Downsamples each frame by area averaging and upsamples it by linear interpolation."
    unit = "side of a low-resolution pixel, in pixels of a frame 1024 wide, minus one"
    doses = per_space((7.0, 31.0, 127.0))

    def degrade(self, frame: Image, seed: int, index: int, panorama: bool) -> Image:
        """Return the frame at its own size, with the details of fewer pixels."""
        height, width = frame.shape[:2]
        factor = max(1.0, (1 + self.dose) * width / WIDTH)
        shrunk = _shrink(frame, factor)
        return np.asarray(cv2.resize(shrunk, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)


class Noise(FrameDegradation):
    """Grainy frames."""

    kind = "noise"
    family = "looks"
    about = "Adds Gaussian noise, independent for each frame, to each channel of each pixel of a frame 1024 wide."
    unit = "standard deviation in grey levels of 255"
    doses = per_space((10.0, 40.0, 120.0))

    def degrade(self, frame: Image, seed: int, index: int, panorama: bool) -> Image:
        """Return the frame with noise; in a smaller one as much as is left of it once a large one is shrunk."""
        drawn = make_generator(seed, index).standard_normal(frame.shape, np.float32)
        return _add(frame, self.dose * min(1.0, frame.shape[1] / WIDTH) * drawn)


class Tint(FrameDegradation):
    """A colour cast."""

    kind = "tint"
    family = "looks"
    about = "Adds one colour, in a random direction of RGB, to all pixels of a future."
    unit = "length of the colour in grey levels of 255"
    doses = per_space((15.0, 40.0, 100.0))
    draws_future = True

    def degrade(self, frame: Image, seed: int, index: int, panorama: bool) -> Image:
        """Return the frame with the colour of its future."""
        color = make_generator(seed).standard_normal(3).astype(np.float32)
        return _add(frame, self.dose * color / np.linalg.norm(color))


class Flicker(FrameDegradation):
    """Frames that are inconsistent, as if each were generated with its own seed."""

    kind = "flicker"
    family = "flicker"
    about = "Adds soft patches of random colour, 16 across, to each frame independently."
    unit = "standard deviation in grey levels of 255"
    doses = per_space((8.0, 20.0, 60.0))

    def degrade(self, frame: Image, seed: int, index: int, panorama: bool) -> Image:
        """Return the frame with patches of its own."""
        height, width = frame.shape[:2]
        rows = max(2, round(PATCHES * height / width))
        drawn = make_generator(seed, index).standard_normal((rows, PATCHES, 3), np.float32)
        patches = cv2.resize(drawn, (width, height), interpolation=cv2.INTER_CUBIC)
        return _add(frame, self.dose * patches / patches.std())


def _shrink(frame: Image, factor: float) -> Image:
    """Return a frame that is smaller by a factor; the frame itself for 1."""
    height, width = frame.shape[:2]
    small = max(1, round(width / factor)), max(1, round(height / factor))
    return np.asarray(cv2.resize(frame, small, interpolation=cv2.INTER_AREA) if factor > 1 else frame, np.uint8)


def _add(frame: Image, change: NDArray[np.float32]) -> Image:
    return np.clip(np.rint(frame + change), 0, 255).astype(np.uint8)
