# SPDX-License-Identifier: Apache-2.0
"""A reference: a world model that is the world."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.types import GRIPPER_POSES, PRIMITIVES, Conditioning, Control, View
from wiw.world_models.base import SMALLEST_PANORAMA, WorldModel, accepts


class Oracle(WorldModel):
    """Carry the plan out in a fork of the simulator and return what it truly sees there.

    No model imagines better, so its score is the reference for what imagination is worth to a policy. It is not a
    strict ceiling: a policy may succeed by chance where futures are wrong. It alone is given the simulator.

    Args:
        size: height and width of its frames, whoever looks at them; where None, up to 576x1024 as the reviser needs,
            480x480 in front views and before a table.
        view: "perspective" for front views alone in place of panoramas; on a table there is no other view.

    Raises:
        ArgumentError: no size, or a view that the plans do not lead through.
    """

    accepts = accepts(
        control="action",
        view="panorama",
        needs=("simulator",),
        causal=True,
        best_batch=64,
        seeded=False,
        smallest=SMALLEST_PANORAMA,
    )

    def __init__(self, size: Sequence[int] | None = None, view: View | None = None) -> None:
        own = type(self).accepts
        if size is not None and (len(size) != 2 or min(size) < 1):
            raise ArgumentError(f"oracle: expected size [height, width] in pixels, got {size}")
        if size is not None:
            self.size = int(size[0]), int(size[1])
        if view == "panorama" and own.space != PRIMITIVES:
            raise ArgumentError(
                f"oracle: expected front views (view='perspective') of plans in {own.space}, got '{view}'"
            )
        if view not in (None, own.view):
            self.view = view
        if vars(self):  # view and size are named in the manifest where they are chosen
            shown = view or own.view
            usual = own.size if shown == own.view else accepts("image", shown).size
            self.accepts = replace(own, view=shown, size=usual if size is None else self.size, smallest=None)

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return true views; frames that another row answers and frames of padding are left unwritten."""
        assert observations.simulators is not None
        image = observations.image
        frames = np.empty((len(controls), 1 + len(controls[0].actions), *image.shape[1:]), np.uint8)
        frames[:, 0] = image
        jobs: dict[int, list[tuple[int, int, NDArray[np.float64]]]] = defaultdict(list)
        renderers = {}
        for row, (simulator, control) in enumerate(zip(observations.simulators, controls, strict=True)):
            poses = simulator.camera_poses_after(control.actions[: control.length])
            renderers[id(simulator.renderer)] = simulator.renderer
            jobs[id(simulator.renderer)] += [(row, 1 + k, poses[k]) for k in range(control.shared, control.length)]
        for name, views in jobs.items():
            if views:
                rows, steps, poses = zip(*views, strict=True)
                pictures = np.empty((len(views), *image.shape[1:]), np.uint8)
                self._draw(renderers[name], np.stack(poses), pictures)
                frames[list(rows), list(steps)] = pictures
        return frames

    def _draw(self, renderer: Any, poses: NDArray[np.float64], pictures: NDArray[np.uint8]) -> None:
        """Render the views from poses [N, 4, 4] into `pictures`, uint8 [N, H, W, 3]."""
        if self.accepts.view == "perspective":
            renderer.perspective(poses, pictures.shape[1:3], 90.0, pictures, None, None)
        else:
            renderer.panorama(poses, pictures.shape[1:3], pictures, None, None)


class ArmOracle(Oracle):
    """Send a fork of the physics to each pose of a plan, one after another, and return what it truly sees."""

    accepts = accepts(
        "action",
        space=GRIPPER_POSES,
        view="perspective",
        needs=("simulator",),
        causal=True,
        best_batch=64,
        seeded=False,
    )

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return the true front views after each pose; frames that are not read are left unwritten."""
        assert observations.simulators is not None
        image = observations.image
        frames = np.empty((len(controls), 1 + len(controls[0].actions), *image.shape[1:]), np.uint8)
        frames[:, 0] = image
        for row, (simulator, control) in enumerate(zip(observations.simulators, controls, strict=True)):
            assert control.ids is not None
            views = simulator.fork().render_fronts_after(control.ids[1:], image.shape[1:3], control.shared)
            frames[row, 1 + control.shared :] = views
        return frames


def make_oracle(space: str = PRIMITIVES, size: Sequence[int] | None = None, view: View | None = None) -> Oracle:
    """Execute each plan in a fork of the simulator.

    Return the model for plans of a space; `size` and `view` as for `Oracle`.
    """
    made = {PRIMITIVES: Oracle, GRIPPER_POSES: ArmOracle}.get(space)
    if made is None:
        raise ArgumentError(
            f"oracle: expected plans in {PRIMITIVES} or {GRIPPER_POSES}, got '{space}'; implement an oracle for yours"
        )
    return made(size, view)
