# SPDX-License-Identifier: Apache-2.0
"""Which episodes of a run keep their pictures.

Pictures are written while an episode runs, and which ones tell most is known at the end. So a pool of episodes keeps
them during the run, and those that are not chosen lose them when every arm has ended.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from wiw.metrics.metric import is_success
from wiw.runs.recipes import CHANGES
from wiw.runs.store import RunStore
from wiw.types import Episode

POOL = 12
"""Episodes that keep pictures during a run; more if more are to keep them after it."""
FLOORS, CEILING = ("copy", "none"), "oracle"
"""Names of arms that are not models under test; of the floors the first that the run has counts."""


def spread_evenly(episodes: Sequence[Episode], count: int) -> list[int]:
    """Return `count` indices spread evenly over the episodes, and the first of each group that has none among them."""
    count, last = min(count, len(episodes)), len(episodes) - 1
    chosen = {round(i * last / max(1, count - 1)) for i in range(count)}
    groups = {episodes[index].group for index in chosen}
    for index, episode in enumerate(episodes):
        if count and episode.group not in groups:
            chosen.add(index)
            groups.add(episode.group)
    return sorted(chosen)


def pool_episodes(episodes: Sequence[Episode], count: int) -> list[int]:
    """Return the episodes that keep pictures during a run after which `count` keep them."""
    if count == 0:
        return []
    return sorted({*spread_evenly(episodes, count), *spread_evenly(episodes, max(count, POOL))})


def choose_episodes(
    episodes: Sequence[Episode],
    pool: Sequence[int],
    outcomes: Sequence[Mapping[str, Any]],
    count: int,
    controls: Collection[str] = (),
) -> list[int]:
    """Return the episodes that keep their pictures, the first of them being the one to show first.

    They are spread evenly over the run as far as the pool reaches; an episode of the pool in which a model succeeds and
    the floor fails takes the place of the nearest of its group, unless there is such an episode among them. Arms that
    are `controls` count for nothing.
    """
    chosen = spread_evenly(episodes[: max(pool, default=-1) + 1], count)
    found: dict[int, dict[str, bool]] = {index: {} for index in sorted({*pool, *chosen})}
    for row in outcomes:
        if row["episode"] in found and row["status"] == "done" and row["arm"] not in controls:
            found[row["episode"]][row["arm"]] = is_success(row["metrics"])
    gains, spread = {index: _rate_gain(success) for index, success in found.items()}, set(chosen)
    best = max(gains, key=lambda index: (gains[index], index in spread), default=None)
    if best is None or gains[best] == (0, 0):
        return chosen
    rivals = [index for index in chosen if episodes[index].group == episodes[best].group]
    if best not in chosen and rivals:
        chosen.remove(min(rivals, key=lambda index: abs(index - best)))
    return [best, *(index for index in chosen if index != best)]


def choose_pictured_episodes(store: RunStore) -> list[int]:
    """Return the episodes to show with pictures; during a run those that would be chosen if it ended now."""
    info = store.info
    if "keep_images" not in info:
        return [int(index) for index in info["pictures"]]
    last = info["stopped"]["episodes"] if "stopped" in info else None
    pool = [index for index in info["pictures"] if last is None or index < last]
    controls = {arm["name"] for arm in store.config["arms"] if arm["agent"].keys() & set(CHANGES)}
    return choose_episodes(store.episodes()[:last], pool, store.outcomes(), info["keep_images"], controls)


def drop_spare_pictures(store: RunStore) -> None:
    """Drop the pictures of the episodes that are not chosen, once every arm has ended every episode."""
    if "keep_images" not in store.info or any(store.pending(arm["name"]) for arm in store.config["arms"]):
        return
    store.keep_pictures(choose_pictured_episodes(store))


def _rate_gain(success: Mapping[str, bool]) -> tuple[int, int]:
    """Return how many models, and whether the ceiling, succeed in an episode in which the floor fails.

    Args:
        success: of the episode, by arm.
    """
    floor = next((success[arm] for arm in FLOORS if arm in success), True)
    if floor:
        return 0, 0
    models = [arm for arm in success if arm not in (*FLOORS, CEILING)]
    return sum(success[arm] for arm in models), int(success.get(CEILING, False))
