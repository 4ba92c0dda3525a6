# SPDX-License-Identifier: Apache-2.0
"""The outer loop: keeps many episodes live, so that every model call carries a whole batch."""

from __future__ import annotations

import time
import traceback
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from wiw.errors import ArgumentError, ContractError, JudgeError, RolloutError, VlmError, is_stop_request
from wiw.loop.agent import Agent
from wiw.loop.keys import make_key
from wiw.loop.memory import Query
from wiw.loop.privileged import LiveEnvironments
from wiw.types import Decision, DecisionRecord, Episode, EpisodeResult, Key


class Sink(Protocol):
    """Receives what happens, in any order over episodes and in order within one."""

    def decision(self, record: DecisionRecord) -> None:
        """Record a decision that was taken and carried out."""

    def episode(self, result: EpisodeResult) -> None:
        """Record that an episode has ended, or its infrastructure has failed."""

    def record_restart(self, episodes: Sequence[int]) -> None:
        """Discard what was reported of these episodes: they start again."""

    def record_lost(self, spent: Mapping[str, float]) -> None:
        """Record that a decision has failed; what was asked for it, and its "seconds"."""


@dataclass
class LiveEpisode:
    """One episode in progress."""

    index: int
    episode: Episode
    env: Any
    key: Key
    observation: Any
    begin: float
    north: float | None = None
    """See `Query`."""
    decisions: int = 0
    executed: list[Any] = field(default_factory=list)
    """Actions carried out so far."""
    done: bool = field(default=False)

    def query(self) -> Query:
        """Return the episode's query to the agent."""
        key = self.key.at(self.decisions)
        return Query(self.observation, self.env.goal, key, self.north, tuple(self.executed))

    def carry_out(self, decision: Decision) -> DecisionRecord:
        """Execute the decision's first segment and observe."""
        before = self.env.truth()
        plan = decision.actions[: decision.execute]
        begin = time.perf_counter()
        outcome = self.env.run(plan) if decision.answer is None else self.env.run(plan, decision.answer)
        seconds = {**decision.seconds, "environment": time.perf_counter() - begin}
        decision = replace(decision, seconds=seconds)
        self.observation, self.done = outcome.observation, outcome.terminated or outcome.truncated
        self.executed += outcome.executed.tolist()
        facts = outcome.executed, before, self.env.truth(), outcome.path, outcome.refused
        end = self.observation if self.done else None
        record = DecisionRecord(self.index, self.decisions, decision, *facts, end)
        self.decisions += 1
        return record


def _open_environment(task: Any, needs: Collection[str]) -> Any:
    """Return an environment whose observations have what an agent needs.

    Raises:
        ArgumentError: the agent needs the view of a wrist camera, and the task has no cameras.
        ContractError: the task returns none.
    """
    cameras: dict[str, Any] = {"cameras": ("wrist",)} if "wrist" in needs else {}
    if cameras and "cameras" not in task.sensor_options:
        raise ArgumentError(f"this agent needs the view of a wrist camera, which task '{task.name}' does not have")
    env = task.environment(depth="depth" in needs, **cameras)
    if env is None:
        raise ContractError(f"{type(task).__name__}.environment: expected a wiw.Env, got None")
    return env


def run_episodes(
    task: Any,
    agent: Agent,
    episodes: Sequence[tuple[int, Episode]],
    *,
    seed: int,
    salt: str = "",
    live: int = 4,
    sink: Sink,
    pictured: Collection[int] = (),
) -> None:
    """Run (index, episode) pairs to their ends, at most `live` at a time.

    Keys are made of seed and salt (`wiw.loop.keys`). Policies draw what they believe in the episodes whose index is in
    `pictured`.

    An exception in an episode is infrastructure: the episode is recorded as an error and the rest continue. One in a
    batch may be due to any of its episodes, so each of them is run again on its own, after the others: what breaks does
    not depend on what else was live. A policy's broken contract or a wrong argument would hit every episode alike, so
    it is raised; so is what the sink raises.
    """
    waiting, running, suspects = deque(episodes), list[LiveEpisode](), deque[tuple[int, Episode]]()
    envs = [_open_environment(task, agent.needs) for _ in range(min(live, len(episodes)))]
    environments, keys = LiveEnvironments(), {index: make_key(seed, index, salt) for index, _ in episodes}
    agent.grant(environments)
    try:
        while waiting or running or suspects:
            while waiting and envs:
                running += _start(waiting.popleft(), envs, keys, sink, pictured)
            if not running and not waiting and suspects:
                running += _start(suspects.popleft(), envs, keys, sink, pictured)
            for each in running:
                environments.add(each.key, each.env)
            suspects += _advance(agent, running, sink)
            for each in [each for each in running if each.done]:
                running.remove(each)
                envs.append(each.env)
                environments.remove(each.key)
                agent.forget(each.key)
    finally:
        for env in [*envs, *(each.env for each in running)]:
            env.close()


def _start(
    item: tuple[int, Episode],
    envs: list[Any],
    keys: Mapping[int, Key],
    sink: Sink,
    pictured: Collection[int],
) -> list[LiveEpisode]:
    """Begin an episode in one of the free environments; return it, unless it could not begin."""
    index, episode = item
    begin = time.perf_counter()
    env = envs.pop()
    try:
        observation = env.begin(episode)
        north = -float(env.truth().yaw) if index in pictured else None
    except BaseException as error:  # whatever went wrong, the run goes on and the record says so
        if is_stop_request(error):
            raise
        envs.append(env)
        sink.episode(_build_error_result(index, episode, begin, "environment", error))
        return []
    return [LiveEpisode(index, episode, env, keys[index], observation, begin, north)]


def _advance(agent: Agent, running: list[LiveEpisode], sink: Sink) -> list[tuple[int, Episode]]:
    """Decide once for every live episode; return those that have to be run again, one at a time."""
    if not running:
        return []
    before, begin = agent.count_spent(), time.perf_counter()
    try:
        decisions = agent.decide_batch([each.query() for each in running])
    except (ArgumentError, ContractError):
        raise
    except BaseException as error:
        if is_stop_request(error):
            raise
        kind = _classify_error(error)
        sink.record_lost({**(agent.count_spent() - before), "seconds": time.perf_counter() - begin})
        for each in running:
            each.done = True
        if len(running) > 1:
            sink.record_restart([each.index for each in running])
            return [(each.index, each.episode) for each in running]
        sink.episode(_build_error_result(running[0].index, running[0].episode, running[0].begin, kind, error))
        return []
    for each, decision in zip(running, _hand_over(decisions), strict=True):
        try:
            record = each.carry_out(decision)
            result = _build_result(each) if each.done else None
        except BaseException as error:
            if is_stop_request(error):
                raise
            each.done = True
            sink.record_lost({**decision.spent, "seconds": sum(decision.seconds.values())})
            kind = f"judge/{error.kind}" if isinstance(error, JudgeError | VlmError) else "environment"
            sink.episode(_build_error_result(each.index, each.episode, each.begin, kind, error))
            continue
        sink.decision(record)
        if result is not None:
            sink.episode(result)
    return []


def _hand_over(decisions: list[Decision]) -> Iterator[Decision]:
    """Yield decisions and keep none: what one was made of goes before the next is carried out."""
    decisions.reverse()
    while decisions:
        yield decisions.pop()


def _classify_error(error: BaseException) -> str:
    if isinstance(error, RolloutError):
        return f"world_model/{error.kind}"
    return f"vlm/{error.kind}" if isinstance(error, VlmError) else "agent"


def _build_result(live: LiveEpisode) -> EpisodeResult:
    """Return the end of an episode; where its judge gave no mark, an error with the details, to be judged again."""
    try:
        metrics = {**live.env.result(), "decisions": float(live.decisions)}
    except (JudgeError, VlmError) as error:
        found = _build_error_result(live.index, live.episode, live.begin, f"judge/{error.kind}", error)
        return replace(found, details=dict(live.env.details()))
    details, seconds = dict(live.env.details()), time.perf_counter() - live.begin
    episode = live.episode
    return EpisodeResult(live.index, episode.episode_id, episode.scene, "done", metrics, seconds, details=details)


def _build_error_result(index: int, episode: Episode, begin: float, kind: str, error: BaseException) -> EpisodeResult:
    text = "".join(traceback.format_exception(error))
    seconds = time.perf_counter() - begin
    return EpisodeResult(index, episode.episode_id, episode.scene, "error", {}, seconds, text, kind)
