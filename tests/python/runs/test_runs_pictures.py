# SPDX-License-Identifier: Apache-2.0
"""Which episodes keep pictures: spread evenly, and one in which a model succeeds where the floor fails."""

from __future__ import annotations

import sqlite3
from dataclasses import replace

import pytest
from fakes import LineAgent, LineTask

from wiw.report.episodes import read_stories
from wiw.report.story import Album
from wiw.runs.pictures import choose_episodes, choose_pictured_episodes, pool_episodes, spread_evenly
from wiw.runs.store import RunStore
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import run_arms
from wiw.types import Episode

EPISODES = LineTask().episodes(40)


def outcomes(**arms):
    """Every arm fails in every episode but those named."""
    return [
        {"arm": arm, "episode": i, "status": "done", "metrics": {"success": float(i in wins)}}
        for arm, wins in arms.items()
        for i in range(40)
    ]


def test_without_a_gain_they_are_spread_evenly():
    assert spread_evenly(EPISODES, 3) == [0, 20, 39] and spread_evenly(EPISODES, 0) == []
    alike = outcomes(copy={5, 7}, warp={5}, oracle={7})
    assert choose_episodes(EPISODES, range(40), alike, 3) == [0, 20, 39]
    assert choose_episodes(EPISODES, range(40), outcomes(warp={5}), 2) == [0, 39]  # no floor to compare with


def test_an_episode_that_a_model_wins_comes_first_in_place_of_the_nearest():
    found = outcomes(copy={3}, warp={3, 14}, mine={14, 17}, oracle={14, 30})
    assert choose_episodes(EPISODES, range(40), found, 3) == [14, 0, 39]
    assert choose_episodes(EPISODES, range(40), found, 1) == [14]
    assert choose_episodes(EPISODES, [0, 17, 39], found, 2) == [17, 0] or choose_episodes(
        EPISODES, [0, 17, 39], found, 2
    ) == [17, 39]


def test_a_model_counts_for_more_than_the_ceiling_and_a_placebo_for_nothing():
    found = outcomes(**{"none": {2}, "warp": {25}, "oracle": {8, 9}, "placebo-shuffled:mine": {33}})
    controls = {"placebo-shuffled:mine"}
    assert choose_episodes(EPISODES, range(40), found, 2, controls)[0] == 25
    found = outcomes(**{"copy": set(), "oracle": {8}, "placebo-shuffled:mine": {33}})
    assert choose_episodes(EPISODES, range(40), found, 2, controls)[0] == 8


def test_every_kind_keeps_an_episode():
    mixed = [replace(e, info={"task": "ab"[i % 2]}) for i, e in enumerate(EPISODES)]
    assert {mixed[i].kind for i in spread_evenly(mixed, 1)} == {"a", "b"}
    chosen = choose_episodes(mixed, range(40), outcomes(copy=set(), warp={9}), 1)
    assert chosen[0] == 9 and {mixed[i].kind for i in chosen} == {"a", "b"}


def test_a_pool_holds_the_even_choice():
    assert len(pool_episodes(EPISODES, 2)) == 12 and {0, 39} <= set(pool_episodes(EPISODES, 2))
    assert pool_episodes(EPISODES, 0) == [] and pool_episodes(EPISODES, 40) == list(range(40))


class Counted(dict):
    """A row that counts how often rows are read."""

    reads = 0

    def __getitem__(self, name):
        Counted.reads += 1
        return super().__getitem__(name)


def test_each_episode_and_each_outcome_is_looked_at_a_few_times_however_many_there_are(monkeypatch):
    count, group, looks = 300, Episode.group.fget, []
    monkeypatch.setattr(Counted, "reads", 0)
    episodes = LineTask().episodes(count)
    monkeypatch.setattr(Episode, "group", property(lambda own: looks.append(own) or group(own)))
    assert len(pool_episodes(episodes, count)) == count and len(looks) <= 6 * count
    rows = [
        Counted(arm=arm, episode=i, status="done", metrics={"success": 0.0}) for arm in AGENTS for i in range(count)
    ]
    assert choose_episodes(episodes, range(count), rows, count) == list(range(count))
    assert Counted.reads <= 6 * len(rows)


AGENTS = {"none": LineAgent(0.35), "copy": LineAgent(0.3), "warp": LineAgent(0.75)}


def pictures_of(folder):
    with sqlite3.connect(store_path(folder)) as store:
        return {episode for (episode,) in store.execute("SELECT DISTINCT episode FROM image")}


def test_a_run_ends_with_pictures_of_the_chosen_episodes_alone(tmp_path):
    log = run_arms(LineTask(), AGENTS, 20, out=tmp_path / "run", progress=False)
    kept = log.store.info["pictures"]
    success = {(row["arm"], row["episode"]): row["metrics"]["success"] for row in log.episodes}
    assert (success["warp", kept[0]], success["copy", kept[0]]) == (1.0, 0.0)
    assert "keep_images" not in log.store.info and len(kept) == 2 and pictures_of(tmp_path / "run") == set(kept)
    stories, _ = read_stories(log.store, log.arms, Album())
    assert [story.index for story in stories] == kept
    everything = run_arms(LineTask(), AGENTS, 20, out=tmp_path / "all", progress=False, keep_images="all")
    assert pictures_of(tmp_path / "all") == set(range(20))
    assert store_path(tmp_path / "run").stat().st_size < store_path(tmp_path / "all").stat().st_size / 4
    everything.close()


def test_a_stopped_run_chooses_at_its_end(tmp_path, monkeypatch):
    write, left = RunStore.write, [200]

    def stop(store, row):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        write(store, row)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(RunStore, "write", stop)
        run_arms(LineTask(), AGENTS, 20, out=tmp_path / "run", progress=False)
    with RunStore.read(tmp_path / "run") as store:
        assert len(store.info["pictures"]) == 12 and len(choose_pictured_episodes(store)) == 2
    log = run_arms(LineTask(), AGENTS, 20, out=tmp_path / "run", progress=False, resume=True)
    whole = run_arms(LineTask(), AGENTS, 20, out=tmp_path / "whole", progress=False)
    assert log.store.info["pictures"] == whole.store.info["pictures"]
    assert pictures_of(tmp_path / "run") == set(log.store.info["pictures"])
