# SPDX-License-Identifier: Apache-2.0
"""Inference-time scaling: does more imagination help, and what does it cost? (paper, "Inference-time scaling").

One run with an arm for each amount of imagination, all on the same episodes. The amounts are nested: an agent with
fewer candidates keeps the first of those of the largest one, and the decisions of a smaller share are among those of a
larger one. With the rollout cache, a model computes only once what several arms imagine.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from wiw.analysis.costs import costs
from wiw.analysis.statistics import Estimate
from wiw.analysis.summary import show_estimate
from wiw.errors import ArgumentError
from wiw.files import write_files
from wiw.report.tables import print_stacked
from wiw.runs.config import RunConfig, name_folder, take_settings
from wiw.runs.recipes import AgentRecipe, agent_recipe
from wiw.runs.rows import to_json
from wiw.studies.evaluate import run_arms
from wiw.studies.run_log import RunLog

EPISODES = 20
"""Default number of episodes."""
CANDIDATES = (1, 2, 4, 8)
"""Default values of the sweep."""


@dataclass(frozen=True)
class ScalePoint:
    """One amount of imagination."""

    arm: str
    sweep: str
    """"candidates" or "imagine_fraction"."""
    value: float
    success: Estimate
    rollouts: float
    """Imagined futures per episode, from the model or the cache: the paper's world-model inferences."""
    consultations: float
    """Decisions per episode that consulted the model."""
    calls: float
    """Batches per episode sent to the model, without rollouts from the cache."""
    cached: float
    """Share of the rollouts that came from the cache."""
    seconds: float
    """Wall time per episode, all stages."""


@dataclass(frozen=True)
class Scaling:
    """The result of `wiw.scale`."""

    log: RunLog
    points: tuple[ScalePoint, ...]

    def to_json(self) -> str:
        """Return the points as JSON."""
        return json.dumps({"points": json.loads(to_json([asdict(point) for point in self.points]))}, indent=2)

    def svg(self) -> str:
        """Return the plot of success against imagined futures, with intervals."""
        from wiw.report.plots import success_by_rollouts

        series: dict[str, list[tuple[float, Estimate, str]]] = {}
        for point in sorted(self.points, key=lambda point: point.rollouts):
            series.setdefault(point.sweep, []).append((point.rollouts, point.success, f"{point.value:g}"))
        return str(success_by_rollouts({name.replace("_", " "): points for name, points in series.items()}))

    def save(self) -> tuple[Path, Path]:
        """Write scale.json and scale.svg into the run's folder, and return their paths.

        Raises:
            FileError: they cannot be written.
        """
        written = self.log.path / "scale.json", self.log.path / "scale.svg"
        write_files(self.log.path, {"scale.json": self.to_json(), "scale.svg": self.svg()})
        return written

    def summary(self) -> None:
        """Print the table."""
        rows = [
            [
                show_estimate(point.success),
                *(f"{value:.1f}" for value in (point.rollouts, point.consultations, point.calls)),
                f"{100 * point.cached:.0f} %",
                f"{point.seconds:.2f}",
            ]
            for point in self.points
        ]
        titles = ["SR % ↑", "rollouts", "consulted", "calls", "cached", "s"]
        print_stacked("Inference-time scaling, per episode", [point.arm for point in self.points], titles, rows)


def scale(
    env_or_task: Any,
    agent: Any,
    candidates: Sequence[int] | None = None,
    imagine_fraction: Sequence[float] | None = None,
    *,
    config: RunConfig | None = None,
    **settings: Any,
) -> Scaling:
    """Run an agent with different amounts of imagination on the same episodes.

        found = wiw.scale("imagenav", wiw.Agent("matcher", "warp"), candidates=[1, 2, 4, 8], scenes="apartments:val")
        found.summary()

    Args:
        env_or_task: an environment, a task, a `TaskRecipe`, or a task's name.
        agent: a `wiw.Agent` with a world model, or an `AgentRecipe`.
        candidates: numbers of plans imagined at each decision; 1, 2, 4, 8 if this and `imagine_fraction` are None.
        imagine_fraction: shares of decisions for which the model is consulted, with the agent's own candidates; 0 uses
            the proposer's own preference.
        config: settings of the run; with a folder as `cache`, any model computes only once what several amounts
            imagine.
        settings: settings of `RunConfig` that override the config's, and options of a task given by name. No episode
            keeps images where `keep_images` is left at its default.

    Raises:
        ArgumentError: an agent without a world model, or of another method than `wiw.Agent`'s; a shard; or amounts that
            are missing, repeated or out of range.
    """
    recipe = agent_recipe(agent)
    if not isinstance(recipe, AgentRecipe):
        raise ArgumentError(
            f"scale: expected a wiw.Agent or an AgentRecipe, whose amount of imagination can be changed, got a "
            f"{type(agent).__name__}"
        )
    if recipe.model is None:
        raise ArgumentError("scale: expected an agent with a world model, got one without")
    amounts = _list_amounts(candidates, imagine_fraction)
    agents = {f"{sweep}={value:g}": replace(recipe, **changes) for (sweep, value), changes in amounts.items()}
    own, task_options = take_settings(config, settings)
    if own.shard is not None:
        raise ArgumentError(
            "scale: a curve needs all episodes, so --shard is not supported; use `wiw run --shard` for each number of "
            "candidates instead"
        )
    out = own.out or name_folder("scale")
    keeps_images = "keep_images" in settings or own.keep_images != RunConfig.keep_images
    kept = own.keep_images if keeps_images else 0
    run_config = replace(own, out=out, keep_images=kept, episodes=own.episodes or EPISODES)
    log = run_arms(env_or_task, agents, config=run_config, **task_options)
    return Scaling(log, _measure_points(log, {f"{sweep}={value:g}": (sweep, value) for sweep, value in amounts}))


def _list_amounts(
    candidates: Sequence[int] | None, fractions: Sequence[float] | None
) -> dict[tuple[str, float], dict[str, Any]]:
    """Return the options of the agent for each (sweep, value)."""
    if candidates is None and fractions is None:
        candidates = CANDIDATES
    for name, values in (("candidates", candidates), ("imagine_fraction", fractions)):
        if values is not None and (not values or len({f"{value:g}" for value in values}) < len(values)):
            raise ArgumentError(f"scale: expected different values of {name}, got {list(values)}")
    are_whole = all(count >= 1 and count == int(count) for count in candidates or [])
    if not are_whole or not all(0 <= share <= 1 for share in fractions or []):
        raise ArgumentError(
            "scale: expected whole numbers of candidates of at least 1, and an imagine_fraction from 0 to 1, got "
            f"{candidates} and {fractions}"
        )
    pool = max(candidates or [1])
    found: dict[tuple[str, float], dict[str, Any]] = {
        ("candidates", count): {"candidates": int(count), "pool": int(pool)} for count in candidates or []
    }
    return found | {("imagine_fraction", share): {"imagine_fraction": float(share)} for share in fractions or []}


def _measure_points(log: RunLog, amounts: Mapping[str, tuple[str, float]]) -> tuple[ScalePoint, ...]:
    """Return one point per arm that has a scored episode."""
    summary, found = log.numbers(), []
    for line in costs(log):
        success = summary[line.arm].estimates.get("success")
        if success is None:
            continue
        rows = line.calls.get("rows", 0.0)
        found.append(
            ScalePoint(
                line.arm,
                *amounts[line.arm],
                success,
                rows / line.episodes,
                line.calls.get("consultations", 0.0) / line.episodes,
                line.spent.get("calls", 0.0) / line.episodes,
                line.spent.get("cached_rows", 0.0) / rows if rows else 0.0,
                line.all_seconds / line.episodes,
            )
        )
    return tuple(found)
