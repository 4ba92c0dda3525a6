# SPDX-License-Identifier: Apache-2.0
"""Beam search deeper than one level, against a twin that follows every plan one primitive at a time.

The world is a number from 0 to 250 that primitives change and that every pixel shows; leading turns, and stopping
before any step, show the real panorama, in which turning changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

import wiw
from wiw._core import core
from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT, to_trajectory
from wiw.errors import ArgumentError
from wiw.loop.imagine import seed_of
from wiw.loop.memory import Query
from wiw.loop.search import move
from wiw.types import Goal, Key, Observation, Proposal

CANDIDATES, HORIZON = 3, 4


def step(state: int, action: int) -> int:
    return (state * 5 + int(action) * 37 + 11) % 251


def render_last_frame(state: int, plan) -> int:
    """The slow twin of a rollout's last frame."""
    leading = 0
    while leading < len(plan) and (plan[leading] == plan[0] != FORWARD or plan[leading] == STOP):
        leading += 1
    for action in plan[leading:]:
        state = step(state, action)
    return state


def model_of(causal: bool = False, frames: int = 0, needs: tuple[str, ...] = (), size=(36, 64)):
    class Numbers(wiw.WorldModel):
        accepts = wiw.accepts(control="action", size=size, causal=causal, frames=frames, needs=needs, best_batch=4)

        def __init__(self) -> None:
            self.seeds: set[int] = set()

        def rollout(self, observations, controls, seeds):
            self.seeds |= set(map(int, seeds))
            answer = np.zeros((len(controls), len(controls[0].actions) + 1, *size, 3), np.uint8)
            for row, control in enumerate(controls):
                state = int(observations.image[row, 0, 0, 0])
                assert (observations.image[row] == state).all()
                answer[row, 0] = state
                for k, action in enumerate(control.actions):
                    state = step(state, action)
                    if k >= control.shared:
                        answer[row, k + 1] = state
            return answer

    return Numbers()


@dataclass
class Memory:
    observed: list[int] = field(default_factory=list)


class Wanderer(wiw.Policy):
    """Its plans follow from the key, from what it sees and from where it believes to be; it notes what it observes."""

    frames = wiw.policies.base.FrameSpec("panorama", (18, 32))

    def begin(self, goal, key):
        return Memory()

    def observe(self, situations):
        for s in situations:
            s.memory.observed.append(int(s.observation.panorama[0, 0, 0]))

    def propose(self, situations, candidates, horizon):
        return [self.plans(s.observation, s.key, len(s.memory.observed), candidates, horizon) for s in situations]

    @staticmethod
    def plans(observation, key, observed, candidates, horizon):
        assert observation.depth is None and observation.front.shape == (48, 48, 3)
        assert (observation.front == observation.panorama[0, 0, 0]).all()
        mark = [int(observation.panorama[0, 0, 0]), observed, *(int(1e3 * (x + 10)) for x in observation.odometry)]
        made = []
        for candidate in range(candidates):
            draws = core.uniform(core.fold_key([key.seed, key.episode, key.decision, candidate, *mark]), horizon + 1)
            length = 1 + int(draws[-1] * horizon)
            plan = [(FORWARD, TURN_LEFT, TURN_RIGHT, STOP)[int(4 * d)] for d in draws[:length]]
            made.append(Proposal(plan[: plan.index(STOP) + 1] if STOP in plan else plan, prior=float(draws[0])))
        return made

    def score(self, situations, proposals, rollouts):
        return [
            np.array([float(r.frames[-1, 0, 0, 0]) + 1e-3 * p.prior for r, p in zip(futures, plans, strict=True)])
            for futures, plans in zip(rollouts, proposals, strict=True)
        ]


def query(episode: int, state: int) -> Query:
    picture = np.full((72, 128, 3), state, np.uint8)
    odometry = np.array([0.3 * episode, -0.2, 3.0])
    return Query(Observation(picture, np.full((48, 48, 3), state, np.uint8), odometry), Goal("t"), Key(5, episode, 2))


def brute_force(asked: Query, width: int, depth: int):
    """Candidates of the last level with their scores: every plan followed from the start, kept by plain sorting."""
    state, here, key = int(asked.observation.panorama[0, 0, 0]), asked.observation, asked.key
    level = [(p.actions.tolist(), p.prior) for p in Wanderer.plans(here, key, 1, CANDIDATES, HORIZON)]
    for number in range(1, depth + 1):
        scores = [render_last_frame(state, plan) + 1e-3 * prior for plan, prior in level]
        if number == depth:
            return level, scores
        longer = []
        for c in sorted(range(len(level)), key=lambda i: -scores[i])[:width]:
            plan, prior = level[c]
            if STOP in plan:
                longer.append((plan, prior))
                continue
            shown = render_last_frame(state, plan)
            there = Observation(
                np.full((72, 128, 3), shown, np.uint8),
                np.full((48, 48, 3), shown, np.uint8),
                move(here.odometry, plan),
            )
            named = Key(core.fold_key([key.seed, number, c]), key.episode, key.decision)
            for p in Wanderer.plans(there, named, 2, CANDIDATES, HORIZON):
                longer.append((plan + p.actions.tolist(), prior + p.prior))
        level = longer
    raise AssertionError


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("frames", [0, 4])
@pytest.mark.parametrize(("depth", "width"), [(1, None), (2, None), (2, 1), (3, 2), (3, 100)])
def test_it_finds_what_brute_force_finds(causal: bool, frames: int, depth: int, width: int | None) -> None:
    queries = [query(episode, state) for episode, state in enumerate((3, 90, 77, 200))]
    agent = wiw.Agent(
        Wanderer(), model_of(causal, frames), candidates=CANDIDATES, horizon=HORIZON, depth=depth, width=width
    )
    for asked, decision in zip(queries, agent.decide_batch(queries), strict=True):
        level, scores = brute_force(asked, width or CANDIDATES, depth)
        assert [p.actions.tolist() for p in decision.proposals] == [plan for plan, _ in level]
        np.testing.assert_allclose([p.prior for p in decision.proposals], [prior for _, prior in level])
        np.testing.assert_allclose(decision.scores, scores)
        assert decision.chosen == int(np.argmax(scores))
        assert decision.actions.tolist() == level[decision.chosen][0]
        assert [len(r.frames) for r in decision.rollouts] == [len(plan) for plan, _ in level]
        assert decision.execute == min(HORIZON - 2, len(decision.actions))


def test_a_wide_beam_is_exhaustive_search() -> None:
    """With nothing thrown away, the best of all pairs of plans is found."""

    class Fixed(Wanderer):
        def propose(self, situations, candidates, horizon):
            return [[Proposal(p) for p in ([FORWARD], [FORWARD, TURN_LEFT], [TURN_RIGHT, FORWARD])] for _ in situations]

    agent = wiw.Agent(Fixed(), model_of(), candidates=3, horizon=4, depth=2, width=3)
    decision = agent.decide_batch([query(0, 42)])[0]
    plans = [p.actions.tolist() for p in Fixed().propose([0], 3, 4)[0]]
    every = {(*a, *b): render_last_frame(42, [*a, *b]) for a in plans for b in plans}
    assert {tuple(p.actions.tolist()) for p in decision.proposals} == set(every)
    assert every[tuple(decision.actions.tolist())] == max(every.values())


def test_a_future_is_not_drawn_from_the_stream_of_its_plan() -> None:
    for key, number in ((Key(0, 17, 3), 2), (Key(1, 0, 0), 0)):
        assert seed_of(key, number) != core.fold_key([key.seed, key.episode, key.decision, number])


def test_imagining_deeper_leaves_the_real_memory_alone_and_keeps_seeds() -> None:
    model = model_of()
    agent = wiw.Agent(Wanderer(), model, candidates=CANDIDATES, horizon=HORIZON, depth=3)
    decision = agent.decide_batch([query(0, 90)])[0]
    memory = agent.parts.memories.recall([query(0, 90)], agent.parts.imaginer)[0][0].memory
    assert memory.observed == [90]
    assert model.seeds <= {seed_of(Key(5, 0, 2), c) for c in range(CANDIDATES)}
    assert len(decision.proposals) > CANDIDATES and decision.calls["rows"] > len(decision.proposals)


def test_results_do_not_depend_on_what_else_is_live() -> None:
    queries = [query(episode, 31 * episode) for episode in range(4)]
    make = lambda: wiw.Agent(Wanderer(), model_of(True), candidates=CANDIDATES, horizon=HORIZON, depth=2)  # noqa: E731
    together = make().decide_batch(queries)
    for asked, decision in zip(queries, together, strict=True):
        alone = make().decide_batch([asked])[0]
        np.testing.assert_array_equal(alone.actions, decision.actions)
        np.testing.assert_array_equal(alone.scores, decision.scores)


def test_models_that_need_depth_or_the_simulator_look_ahead_from_the_real_place(two_rooms: str) -> None:
    """Whole plans are imagined from the real observation; the oracle's are then what truly happens."""
    env = wiw.make("ImageNav-v0", scenes=two_rooms)
    observation, info = env.reset(options={"episode": 1})
    for name in ("warp", "oracle"):
        agent = wiw.Agent("heuristic", name, "matcher", horizon=3, depth=2, width=2)
        decision = agent.decide(observation, env.goal, info["key"], env.fork())
        assert len(decision.proposals) == 6 and all(len(p.actions) == 6 for p in decision.proposals)
    plan, rollout = decision.proposals[0], decision.rollouts[0]
    segment = env.run(plan.actions)
    real = wiw.panorama.resize(segment.observation.panorama, rollout.frames.shape[1:3])
    assert np.abs(rollout.frames[-1].astype(int) - real).mean() < 1


@pytest.mark.parametrize("azimuth", [0.0, 2.9, -1.3])
def test_moving_follows_the_trajectory_from_where_one_stands(azimuth: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        first, second = (rng.integers(1, 4, 6).astype(np.int8) for _ in range(2))
        np.testing.assert_allclose(
            np.cos(move(to_trajectory(first)[-1], second) - to_trajectory([*first, *second])[-1])[2], 1
        )
        np.testing.assert_allclose(
            move(to_trajectory(first)[-1], second)[:2], to_trajectory([*first, *second])[-1, :2], atol=1e-12
        )
        assert abs(move(np.array([0, 0, azimuth]), first)[2]) <= np.pi


def test_what_cannot_be_searched_deeper_says_so() -> None:
    class Front(wiw.WorldModel):
        accepts = wiw.accepts(control="text", view="perspective")

        def rollout(self, observations, controls, seeds):
            raise AssertionError

    with pytest.raises(ArgumentError, match="Front only imagines the front view"):
        wiw.Agent(Wanderer(), Front(), depth=2)
    with pytest.raises(ArgumentError, match=r"Seeing needs them; implement its `extend`"):
        wiw.Agent(type("Seeing", (Wanderer,), {"needs": ("depth",)})(), "copy", depth=2)
    extending = type("Extending", (Wanderer,), {"needs": ("depth",), "extend": Wanderer.propose})
    assert wiw.Agent(extending(), "copy", depth=2).config.depth == 2
    for name in ("depth", "width"):
        with pytest.raises(ArgumentError, match=f"expected {name} of at least 1, got 0"):
            wiw.Agent(Wanderer(), "copy", **{name: 0})
        with pytest.raises(ArgumentError, match=f"expected {name} as a whole number, got '3'"):
            wiw.Agent(Wanderer(), "copy", **{name: "3"})
    assert wiw.Agent(Wanderer(), depth=2).decide_batch([query(0, 9)])[0].rollouts is None  # nothing is imagined
    with pytest.raises(ArgumentError, match="needs depth"):
        wiw.Agent(Wanderer(), model_of(frames=3, needs=("depth",)), candidates=3, horizon=4, depth=2)
