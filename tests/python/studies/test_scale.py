# SPDX-License-Identifier: Apache-2.0
"""Inference-time scaling: nested amounts of imagination on the same episodes."""

from __future__ import annotations

import errno
import json

import numpy as np
import pytest
from fakes import LineAgent

import wiw
from wiw.cli.app import main
from wiw.errors import ArgumentError, FileError
from wiw.experiments.gating import Gated, is_consulted
from wiw.loop.memory import Query
from wiw.runs.config import RunConfig
from wiw.runs.pictures import choose_pictured_episodes
from wiw.runs.recipes import AgentRecipe
from wiw.types import Goal, Key, Observation, Proposal


def test_shares_of_decisions_are_nested_and_as_large_as_said() -> None:
    keys = [Key(5, e, d) for e in range(100) for d in range(20)]
    before: set[Key] = set()
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        chosen = {key for key in keys if is_consulted(key, share)}
        assert before <= chosen and abs(len(chosen) / len(keys) - share) < 0.04
        before = chosen
    assert len(before) == len(keys)


class Many(wiw.Policy):
    """Proposes one plan after another; remembers how many it was asked for."""

    asked = 0

    def propose(self, situations, candidates, horizon):
        self.asked = candidates
        return [[Proposal([1] * (i + 1), prior=-float(i)) for i in range(candidates)] for _ in situations]

    def score(self, situations, proposals, rollouts):
        return [np.arange(len(plans), dtype=float) for plans in proposals]


def query(episode=0, decision=0):
    panorama = np.full((576, 1024, 3), 9, np.uint8)
    return Query(Observation(panorama, panorama[:480, :480], np.zeros(3)), Goal("x"), Key(0, episode, decision))


def test_fewer_candidates_are_the_first_of_the_pool() -> None:
    for count in (1, 2, 4):
        agent = wiw.Agent(Many(), "copy", candidates=count, pool=4)
        (decision,) = agent.decide_batch([query()])
        assert agent.policy.asked == 4
        assert [len(p.actions) for p in decision.proposals] == [1, 2, 3, 4][:count]
        assert agent.replace().config.pool == 4 and agent.describe()["pool"] == 4
    with pytest.raises(ArgumentError, match="pool"):
        wiw.Agent(Many(), "copy", candidates=4, pool=3)
    with pytest.raises(ArgumentError, match="imagine_fraction"):
        Gated(wiw.world_model("copy"), 1.5)


def test_decisions_without_imagination_follow_the_proposer() -> None:
    agent = wiw.Agent(Many(), Gated(wiw.world_model("copy"), 0.5))
    queries = [query(episode) for episode in range(12)]
    decisions = agent.decide_batch(queries)
    for asked, decision in zip(queries, decisions, strict=True):
        imagines = is_consulted(asked.key, 0.5)
        assert (decision.rollouts is not None) == imagines
        assert decision.chosen == (2 if imagines else 0)
        assert decision.calls.get("consultations", 0) == imagines
    assert 0 < sum(d.rollouts is not None for d in decisions) < 12


def test_a_share_of_all_decisions_is_the_model_itself() -> None:
    def describe(fraction):
        return wiw.Agent(Many(), Gated(wiw.world_model("copy"), fraction)).describe()

    plain = wiw.Agent(Many(), "copy").describe()
    assert describe(1.0) == plain and describe(0.25) == {**plain, "imagine_fraction": 0.25}


def test_a_sweep_in_python(two_rooms, tmp_path) -> None:
    agent = AgentRecipe("heuristic", "copy", reviser="matcher")
    options = {"scenes": two_rooms, "decisions": 3}
    found = wiw.scale(
        "imagenav", agent, [1, 3], [0.0, 0.5, 1.0], episodes=3, out=tmp_path / "run", progress=False,
        cache=tmp_path / "cache", **options,
    )  # fmt: skip
    by = {(point.sweep, point.value): point for point in found.points}
    assert list(by) == [
        ("candidates", 1), ("candidates", 3), ("imagine_fraction", 0), ("imagine_fraction", 0.5),
        ("imagine_fraction", 1),
    ]  # fmt: skip
    assert by["imagine_fraction", 0].rollouts == 0 == by["imagine_fraction", 0].consultations
    assert by["candidates", 1].rollouts <= by["candidates", 3].rollouts
    full, most = by["imagine_fraction", 1], by["candidates", 3]
    assert (full.rollouts, full.success) == (most.rollouts, most.success)  # three candidates are the task's own number
    assert full.cached == 1.0 and full.calls == 0.0 and most.cached > 0
    assert 0 < by["imagine_fraction", 0.5].consultations < full.consultations
    numbers, plot = found.save()
    assert len(json.loads(numbers.read_text())["points"]) == 5 and "<svg" in plot.read_text()


def test_an_agent_of_another_method_is_refused() -> None:
    with pytest.raises(ArgumentError, match=r"expected a wiw.Agent or an AgentRecipe.*, got a LineAgent"):
        wiw.scale("imagenav", LineAgent(0.0))


@pytest.mark.parametrize(
    "amounts",
    [
        {"candidates": [2, 2.5]},
        {"imagine_fraction": [0.1234567, 0.1234568]},
        {"candidates": [0]},
        {"candidates": [2, 2]},
    ],
)
def test_amounts_that_would_be_alike_are_refused(amounts) -> None:
    with pytest.raises(ArgumentError, match="scale: expected"):
        wiw.scale("ImageNav-v0", AgentRecipe("heuristic", "oracle"), **amounts)


def test_images_are_kept_where_they_are_asked_for_and_results_appear_whole(two_rooms, tmp_path, monkeypatch) -> None:
    agent, options = AgentRecipe("heuristic", "copy", reviser="matcher"), {"scenes": two_rooms, "decisions": 1}
    pictures = {}
    cases = {"default": {}, "asked": {"keep_images": 2}, "config": {"config": RunConfig(keep_images=1)}}
    for name, asked in cases.items():
        found = wiw.scale("imagenav", agent, [1], episodes=2, out=tmp_path / name, progress=False, **asked, **options)
        pictures[name] = len(choose_pictured_episodes(found.log.store))
    assert pictures == {"default": 0, "asked": 2, "config": 1}
    found.save()
    monkeypatch.setattr("wiw.studies.scale.Scaling.svg", lambda self: "<svg>")
    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(FileError, match=r"scale.json: cannot be written \(No space left"):
        found.save()
    assert json.loads((tmp_path / "config" / "scale.json").read_text())["points"]


def full(file):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_the_command(two_rooms, tmp_path, capsys) -> None:
    options = ["--scenes", two_rooms, "--episodes", "1", "--policy", "heuristic", "--world-model", "copy"]
    out = ["--out", str(tmp_path / "run")]
    assert main(["scale", "imagenav", "--candidates", "1,2", *options, *out]) == 0
    shown = capsys.readouterr().out
    assert "candidates=1" in shown and "candidates=2" in shown and "scale.svg" in shown
    assert main(["scale", "imagenav", "--candidates", "1,x", *options]) == 2
    assert "expected numbers" in capsys.readouterr().err
    for wrong, said in ((["--candidates", "1,1"], "different values"), (["--imagine-fraction", "2"], "from 0 to 1")):
        assert main(["scale", "imagenav", *wrong, *options]) == 2
        assert said in capsys.readouterr().err
    with pytest.raises(ArgumentError, match="with a world model"):
        wiw.scale("imagenav", wiw.Agent("heuristic"))


def test_the_command_line_takes_the_flags_of_runs(two_rooms, tmp_path, capsys) -> None:
    flags = [
        "--scenes",
        two_rooms,
        "--per-scene",
        "2",
        "--motion",
        "slide",
        "--backend",
        "cpu",
        "--policy",
        "heuristic",
    ]
    search = [
        "--policy",
        "heuristic",
        "--revision",
        "matcher",
        "--horizon",
        "4",
        "--execute",
        "1",
        "--candidates",
        "1,2",
    ]
    options = ["--task-option", "decisions=1", "--episodes", "1", "--no-progress", "--out", str(tmp_path / "run")]
    assert main(["scale", "imagenav", "--world-model", "copy", *flags, *search, *options]) == 0
    config = wiw.load_run(tmp_path / "run").store.config
    task, arms = config["task"], config["arms"]
    assert (task["per_scene"], task["motion"]) == (2, "slide")
    assert [(arm["agent"]["candidates"], arm["agent"]["execute"]) for arm in arms] == [(1, 1), (2, 1)]
    assert main(["scale", "imagenav", "--width", "2"]) == 2 and "--depth 2" in capsys.readouterr().err
    assert main(["scale", "imagenav", "--prompts", str(tmp_path)]) == 2
    assert "are for policy vlm" in capsys.readouterr().err
