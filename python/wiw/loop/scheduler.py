# SPDX-License-Identifier: Apache-2.0
"""The closed loop's outside: keeps many episodes live so that every model call carries a whole batch."""

from __future__ import annotations

import time
import traceback
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from wiw.errors import ArgumentError, ContractError, RolloutError, VlmError
from wiw.loop.agent import Agent, Query
from wiw.types import Decision, DecisionRecord, Episode, EpisodeResult, Key

NO_STRANGERS: Mapping[int, Episode] = {}


class Sink(Protocol):
    """Receives what happens, in any order over episodes and in order within one."""

    def decision(self, record: DecisionRecord) -> None:
        """One decision was taken and carried out."""

    def episode(self, result: EpisodeResult) -> None:
        """One episode has ended, or its infrastructure has failed."""

    def again(self, episodes: Sequence[int]) -> None:
        """These episodes begin anew; what was reported of them does not count."""

    def lost(self, spent: Mapping[str, float]) -> None:
        """A decision has failed; what was asked for it, and its "seconds"."""


@dataclass
class Trial:
    """One live episode."""

    index: int
    episode: Episode
    env: Any
    key: Key
    observation: Any
    begin: float
    stranger: Query | None = None
    decisions: int = 0
    done: bool = field(default=False)

    def query(self, agent: Agent) -> Query:
        """What the agent is asked; a fork of the simulator goes along only where the world model declares its need, and
        a guide only where stages are told the truth.
        """
        simulator = self.env.fork() if "simulator" in agent.needs else None
        guide = self.env.guide() if "guide" in agent.needs else None
        semantic = self.env.semantic() if "semantic" in agent.needs else None
        key = self.key.at(self.decisions)
        return Query(self.observation, self.env.goal, key, simulator, self.stranger, guide, semantic)

    def carry_out(self, decision: Decision) -> DecisionRecord:
        """Executes the decision's first segment and observes."""
        before = self.env.truth()
        plan = decision.actions[: decision.execute]
        begin = time.perf_counter()
        outcome = self.env.run(plan) if decision.answer is None else self.env.run(plan, decision.answer)
        seconds = {**decision.seconds, "environment": time.perf_counter() - begin}
        decision = replace(decision, seconds=seconds)
        self.observation, self.done = outcome.observation, outcome.terminated or outcome.truncated
        facts = outcome.executed, before, self.env.truth(), outcome.path, getattr(outcome, "refused", ())
        end = self.observation if self.done else None
        record = DecisionRecord(self.index, self.decisions, decision, *facts, end)
        self.decisions += 1
        return record


def run_episodes(
    task: Any,
    agent: Agent,
    episodes: Sequence[tuple[int, Episode]],
    *,
    seed: int,
    live: int = 4,
    sink: Sink,
    strangers: Mapping[int, Episode] = NO_STRANGERS,
) -> None:
    """Runs (index, episode) pairs to their ends, at most `live` at a time.

    `strangers` names for each index another episode, whose first moment goes along with every query; for placebos.

    An exception in an episode is infrastructure: the episode is reported as failed and the rest go on. One in a batch
    may be due to any of its episodes, so each of them is run again by itself, after the others: what fails does not
    depend on what else was live. A policy's broken contract or a wrong argument would hit every episode alike, so it is
    raised; so is what the sink raises.
    """
    waiting, trials, suspects = deque(episodes), list[Trial](), deque[tuple[int, Episode]]()
    envs = [task.environment(depth="depth" in agent.needs) for _ in range(min(live, len(episodes)))]
    try:
        while waiting or trials or suspects:
            while waiting and envs:
                _start(agent, waiting.popleft(), envs, trials, seed, sink, strangers)
            if not trials and not waiting and suspects:
                _start(agent, suspects.popleft(), envs, trials, seed, sink, strangers)
            suspects += _advance(agent, trials, sink)
            for trial in [trial for trial in trials if trial.done]:
                trials.remove(trial)
                envs.append(trial.env)
                agent.forget(trial.key)
    finally:
        for env in [*envs, *(trial.env for trial in trials)]:
            env.close()


def _start(
    agent: Agent,
    item: tuple[int, Episode],
    envs: list[Any],
    trials: list[Trial],
    seed: int,
    sink: Sink,
    strangers: Mapping[int, Episode],
) -> None:
    index, episode = item
    begin = time.perf_counter()
    env = envs.pop()
    try:
        stranger = _first_moment(agent, env, strangers[index], Key(seed, index)) if strangers else None
        observation = env.begin(episode)
    except Exception as error:  # whatever went wrong, the run goes on and the record says so
        envs.append(env)
        sink.episode(_failed(index, episode, begin, "environment", error))
        return
    trials.append(Trial(index, episode, env, Key(seed, index), observation, begin, stranger))


def _first_moment(agent: Agent, env: Any, episode: Episode, key: Key) -> Query:
    observation = env.begin(episode)
    simulator = env.fork() if "simulator" in agent.needs else None
    semantic = env.semantic() if "semantic" in agent.needs else None
    return Query(observation, env.goal, key, simulator, semantic=semantic)


def _advance(agent: Agent, trials: list[Trial], sink: Sink) -> list[tuple[int, Episode]]:
    """One decision for every live episode; returns those that have to be run again, one at a time."""
    if not trials:
        return []
    before, begin = agent.meter(), time.perf_counter()
    try:
        decisions = agent.decide_batch([trial.query(agent) for trial in trials])
    except (ArgumentError, ContractError):
        raise
    except Exception as error:
        kind = _kind(error)
        sink.lost({**(agent.meter() - before), "seconds": time.perf_counter() - begin})
        for trial in trials:
            trial.done = True
        if len(trials) > 1:
            sink.again([trial.index for trial in trials])
            return [(trial.index, trial.episode) for trial in trials]
        sink.episode(_failed(trials[0].index, trials[0].episode, trials[0].begin, kind, error))
        return []
    for trial, decision in zip(trials, decisions, strict=True):
        try:
            record = trial.carry_out(decision)
            result = _finished(trial) if trial.done else None
        except Exception as error:
            trial.done = True
            sink.lost({**decision.spent, "seconds": sum(decision.seconds.values())})
            sink.episode(_failed(trial.index, trial.episode, trial.begin, "environment", error))
            continue
        sink.decision(record)
        if result is not None:
            sink.episode(result)
    return []


def _kind(error: Exception) -> str:
    if isinstance(error, RolloutError):
        return f"world_model/{error.kind}"
    return f"vlm/{error.kind}" if isinstance(error, VlmError) else "agent"


def _finished(trial: Trial) -> EpisodeResult:
    metrics = {**trial.env.result(), "decisions": float(trial.decisions)}
    seconds = time.perf_counter() - trial.begin
    return EpisodeResult(trial.index, trial.episode.episode_id, trial.episode.scene, "done", metrics, seconds)


def _failed(index: int, episode: Episode, begin: float, kind: str, error: Exception) -> EpisodeResult:
    text = "".join(traceback.format_exception(error))
    seconds = time.perf_counter() - begin
    return EpisodeResult(index, episode.episode_id, episode.scene, "error", {}, seconds, text, kind)
