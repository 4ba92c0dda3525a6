# SPDX-License-Identifier: Apache-2.0
"""`wiw blame`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from wiw.cli.options import Options, tracker_options
from wiw.cli.parts import MaybeName
from wiw.cli.stop import stoppable
from wiw.errors import ArgumentError


def blame(
    run: Positional[Annotated[Path, arg(metavar="RUN")]],
    /,
    *,
    arm: Annotated[str | None, arg(metavar="A,B,...")] = None,
    episodes: Annotated[int | None, arg(metavar="N")] = None,
    workers: Annotated[int | None, arg(metavar="N")] = None,
    retry_errors: bool = False,
    revision_option: Options = (),
    tracker: MaybeName = None,
    tracker_option: Options = (),
) -> int:
    """Find the stage that causes the failures of a run: imagination, scoring or proposals; perception or exploration.

    $ wiw blame runs/first
    $ wiw blame runs/first --arm warp
    $ wiw blame runs/first --arm none,warp --episodes 20 --workers 2

    Reruns every failure with ground truth in one stage at a time, with the same random numbers: with the oracle as the
    world model, with ground-truth scores, with a ground-truth plan among the proposals, and with all three. The first
    rerun that succeeds tells you which stage to work on:

      imagination  ground-truth futures are enough: a better world model helps
      scoring      ground-truth scores are enough: a good plan was proposed, but the agent did not choose it
      proposals    a ground-truth plan is enough: the agent recognises a good plan but proposed none
      joint        only all three together are enough
      beyond       not even all three: look at the budget, the actions, or the answer

    Question answering (aeqa) with policy explorer has other stages. Its failures, marks below 5, are rerun with the
    oracle as the world model, with true labels and colours for real views, with a tour of the whole home before the
    first decision, and with the last two together:

      imagination  ground-truth futures are enough: a better world model helps
      perception   true labels and colours are enough: the agent went to the right places
      exploration  a tour is enough: the agent recognises what it sees, but had not seen enough
      joint        only perception and exploration together are enough
      answering    not even both: look at the map, or how the answer is read from it

    Ctrl-C and SIGTERM lose nothing: the same command continues, also with more episodes. Reruns are stored in
    RUN/blame, which `wiw view RUN/blame` opens like any run; `wiw report RUN` and `wiw view RUN` show the verdicts.

    Args:
        run: The run's folder.
        arm: One arm or several. Default: all.
        episodes: Maximum number of failures per arm, sampled at random. Default: all.
        workers: Number of processes. Default: as many as the run was started with. Results do not depend on it.
        retry_errors: Whether to repeat reruns that ended with an infrastructure error.
        revision_option: Override an option of the run's revision policy, such as vlm=URL for another server; may be
            repeated. Options that would change results are refused, and so is any override if nothing is left to rerun.
        tracker: Override the run's tracker by name, under the same conditions.
        tracker_option: Override an option of the tracker, such as weights=FOLDER if they have moved; may be repeated.
    """
    from wiw.studies.blame import blame as rerun_failures

    arms = None if arm is None else [name.strip() for name in arm.split(",") if name.strip()]
    changes: dict[str, Any] = {
        "reviser_options": _parse_revision_options(run, revision_option),
        "tracker": tracker,
        "tracker_options": tracker_options(tracker, tracker_option),
    }
    found = stoppable(
        lambda: rerun_failures(run, arms, episodes, workers, retry_errors=retry_errors, **changes), run, "blame"
    )
    found.summary()
    print(f"\nepisodes  {found.save()}")
    errors = sum(len(line.rerun_errors) for line in found.arms)
    if errors:
        print(f"Once the cause of the errors is fixed:  wiw blame {run} --retry-errors", file=sys.stderr)
    return 1 if errors else 0


def _parse_revision_options(run: Path, pairs: tuple[str, ...]) -> dict[str, Any]:
    """Return options for the revision policy of a run.

    Raises:
        ArgumentError: its arms have different ones.
    """
    from wiw.registry import POLICIES
    from wiw.runs.execute import read_recipes
    from wiw.runs.part_options import parse_options
    from wiw.runs.store import RunStore

    if not pairs:
        return {}
    with RunStore.read(run) as store:
        _, agents = read_recipes(store)
    revisers = {str(recipe.reviser or recipe.policy) for recipe in agents.values()}
    if len(revisers) > 1:
        raise ArgumentError(f"--revision-option: the arms have different revision policies: {', '.join(revisers)}")
    return parse_options(pairs, POLICIES.find(revisers.pop()), "--revision-option")
