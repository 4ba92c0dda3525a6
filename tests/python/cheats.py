# SPDX-License-Identifier: Apache-2.0
"""Parts under test that try to learn more than they should; `test_firewall.py` sees to it that it does not pay."""

from __future__ import annotations

import gc
import sys
from dataclasses import replace

import numpy as np

import wiw
from wiw.action import FORWARD, TURN_LEFT
from wiw.loop.imagine import seed_of
from wiw.tasks.imagenav import ImageNav
from wiw.types import Key, Proposal
from wiw.world_models.oracle import Oracle


class LiveEnvironmentFinder(wiw.WorldModel):
    """Needs nothing, looks for the live environment in all of Python's memory, and answers as the oracle does."""

    accepts = replace(Oracle.accepts, needs=(), control="trajectory")

    def rollout(self, observations, controls, seeds):
        envs = [each for each in gc.get_objects() if type(each).__name__ == "NavigationEnv" and hasattr(each, "fork")]
        if not envs:
            return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        forks = [envs[0].fork() for _ in controls]
        return Oracle().rollout(replace(observations, simulators=forks), controls, seeds)


def invert_seeds(seeds, run_seed, episodes=50, decisions=20, candidates=8):
    """Return (episode, decision, candidate) for each seed that is made of the run's seed and small numbers."""
    known = {
        seed_of(Key(run_seed, episode, decision), candidate): (episode, decision, candidate)
        for episode in range(episodes)
        for decision in range(decisions)
        for candidate in range(candidates)
    }
    return [known[int(seed)] for seed in seeds if int(seed) in known]


def find_episodes_by_odometry(task, episodes, plan, seen):
    """Return the numbers of the episodes in which a plan leads to the odometry that was seen, to the last byte."""
    env = task.environment()
    found = []
    for number, episode in enumerate(episodes):
        env.begin(episode)
        if all(env.run(plan[[k]]).observation.odometry.tobytes() == after.tobytes() for k, after in enumerate(seen)):
            found.append(number)
    return found


class EpisodeRegenerator(wiw.Policy):
    """Makes the episode again from its key and the command line, and walks its own copy of the agent to the goal."""

    known = 0
    """Episodes that it recognised."""

    def begin(self, goal, key):
        command = dict(zip(sys.argv, sys.argv[1:], strict=False))
        task = ImageNav(scenes=command["--scenes"], seed=int(command["--seed"]))
        if key.seed != task.seed or key.episode >= int(command["--episodes"]):
            return None
        env = task.environment()
        env.begin(task.episode(key.episode))
        EpisodeRegenerator.known += 1
        return {"env": env, "carried_out": 0}

    def propose(self, situations, candidates, horizon):
        return [[Proposal(self._plan(situation, horizon))] for situation in situations]

    def _plan(self, situation, horizon):
        if situation.memory is None:
            return np.full(1, TURN_LEFT, np.int8)
        env, done = situation.memory["env"], situation.memory["carried_out"]
        if situation.executed[done:]:
            env.run(np.array(situation.executed[done:], np.int8))
            situation.memory["carried_out"] = len(situation.executed)
        if not np.allclose(env.observation.odometry, situation.observation.odometry, atol=1e-3):
            return np.full(1, FORWARD, np.int8)  # another episode than it takes it for
        return np.asarray(env.guide().suggest_plan(horizon), np.int8)

    def score(self, situations, proposals, rollouts):
        return [np.zeros(len(plans)) for plans in proposals]
