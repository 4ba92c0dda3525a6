# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
import threading
from collections import Counter
from typing import ClassVar

import numpy as np
import pytest

import wiw
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, GripperTextTemplate, GripperVocabulary, TextTemplate
from wiw.errors import ArgumentError, ContractError
from wiw.experiments.fidelity import FidelityObserver
from wiw.loop.attempts import TRIES, Attempted
from wiw.loop.config import AgentConfig
from wiw.loop.imagine import seed_of
from wiw.loop.memory import Query
from wiw.loop.scheduler import run_episodes
from wiw.policies.base import FrameSpec
from wiw.runs.rows import decision_row
from wiw.tasks.imagenav import ImageNav
from wiw.types import Answer, DecisionRecord, Goal, Key, Observation, Proposal, Truth


class Recorder:
    def __init__(self) -> None:
        self.decisions, self.results, self.wasted = {}, {}, Counter()

    def decision(self, record) -> None:
        self.decisions[record.episode, record.index] = record

    def episode(self, result) -> None:
        self.results[result.episode] = result

    def record_restart(self, episodes) -> None:
        self.decisions = {key: record for key, record in self.decisions.items() if key[0] not in episodes}

    def record_lost(self, spent) -> None:
        self.wasted.update(spent)


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pauses between tries."""
    monkeypatch.setattr("wiw.loop.attempts.PAUSES", (0.0, 0.0))


SIZE = (144, 256)
"""Height and width in which models here answer: a quarter of the panorama's."""


class Stamp(wiw.WorldModel):
    """Writes seed and plan into its frames, so that a reader sees what it was asked."""

    accepts = wiw.accepts(control="trajectory", view="panorama", size=SIZE, causal=True)

    def rollout(self, observations, controls, seeds):
        frames = np.zeros((len(controls), len(controls[0].actions) + 1, *SIZE, 3), np.uint8)
        frames[:, 0] = observations.image
        for row, (control, seed) in enumerate(zip(controls, seeds, strict=True)):
            for k in range(len(control.actions)):
                frames[row, k + 1] = 2 + int(seed) % 200 if k == control.length - 1 else 0
        return frames


class Greedy(wiw.Policy):
    """Proposes fixed plans and prefers bright futures."""

    plans = ([FORWARD, FORWARD, TURN_LEFT], [TURN_LEFT, FORWARD], [TURN_RIGHT, TURN_RIGHT], [FORWARD])

    def propose(self, situations, candidates, horizon):
        return [[Proposal(plan[:horizon]) for plan in self.plans[:candidates]] for _ in situations]

    def score(self, situations, proposals, rollouts):
        return [np.array([float(r.frames[-1].mean()) for r in rows]) for rows in rollouts]


def run(task, agent, count=3, live=2, seed=0):
    recorder = Recorder()
    run_episodes(task, agent, list(enumerate(task.episodes(count))), seed=seed, live=live, sink=recorder)
    return recorder


@pytest.fixture
def task(two_rooms: str) -> ImageNav:
    return ImageNav(scenes=two_rooms, decisions=3)


@pytest.mark.parametrize(
    "make",
    [
        lambda: wiw.Agent("matcher"),
        lambda: wiw.Agent("matcher", "copy"),
        lambda: wiw.Agent("matcher", "oracle"),
        lambda: wiw.Agent("matcher", "oracle", candidates=2, horizon=3, depth=2, width=1),
        lambda: wiw.Agent("climber"),
        lambda: wiw.Agent("geometric"),
        lambda: wiw.Agent("heuristic", "oracle", candidates=4),
        lambda: wiw.Agent(Greedy(), Stamp(), candidates=4),
    ],
    ids=[
        "matcher",
        "matcher+copy",
        "matcher+oracle",
        "two levels",
        "climber",
        "geometric",
        "heuristic+oracle",
        "greedy+stamp",
    ],
)
def test_results_do_not_depend_on_how_many_episodes_are_live(task: ImageNav, make) -> None:
    alone, together = run(task, make(), live=1), run(task, make(), live=3)
    assert alone.decisions.keys() == together.decisions.keys()
    for name, record in alone.decisions.items():
        other = together.decisions[name]
        np.testing.assert_array_equal(record.decision.actions, other.decision.actions)
        np.testing.assert_array_equal(record.decision.scores, other.decision.scores)
        np.testing.assert_array_equal(record.path, other.path)
    assert all(result.status == "done" for result in alone.results.values())


def test_the_oracle_imagines_what_then_happens(task: ImageNav) -> None:
    """The chosen plan's imagined panoramas equal what the environment shows when the plan is carried out."""

    class Whole(Greedy):
        frames = FrameSpec("panorama", (576, 1024))

    env = task.environment()
    observation = env.begin(task.episode(0))
    agent = wiw.Agent(Whole(), "oracle", candidates=4)
    decision = agent.decide(observation, env.goal, wiw.types.Key(0, 0), simulator=env.fork())
    for proposal, rollout in zip(decision.proposals, decision.rollouts, strict=True):
        env.begin(task.episode(0))
        for k, action in enumerate(proposal.actions):
            real = env.run([action]).observation.panorama
            # A rolled panorama and one rendered after the turn differ by rounding on edges.
            assert (np.abs(rollout.frames[k].astype(int) - real) > 2).mean() < 5e-3, (proposal, k)


def test_the_oracle_needs_a_fork_for_each_decision(task: ImageNav) -> None:
    env, agent = task.environment(depth=True), wiw.Agent("matcher", "oracle")
    observation, key = env.begin(task.episode(0)), wiw.types.Key(0, 0)
    agent.decide(observation, env.goal, key, simulator=env.fork())
    moved = env.run([FORWARD, FORWARD]).observation
    with pytest.raises(ArgumentError, match=r"pass the environment's fork"):
        agent.decide(moved, env.goal, key.at(1))


class Chunked(Stamp):
    """Answers two primitives a call, each frame brighter than the one before."""

    accepts = wiw.accepts(control="trajectory", view="panorama", size=SIZE, frames=3)

    def rollout(self, observations, controls, seeds):
        steps = np.arange(1, 4, dtype=np.uint8)[None, :, None, None, None]
        return np.minimum(observations.image[:, None] // 2 + steps, 255).astype(np.uint8)


@pytest.mark.parametrize(
    "model", ["oracle", "warp", "copy", Stamp(), Chunked()], ids=["oracle", "warp", "copy", "stamp", "chunked"]
)
def test_a_policy_that_reads_only_ends_is_shown_the_same_ends(task: ImageNav, model) -> None:
    class Whole(Greedy):
        frames = FrameSpec("panorama", (72, 128))

    class Ends(Greedy):
        frames = FrameSpec("panorama", (72, 128), ends=True)

    whole, ends = (
        run(task, wiw.Agent(policy(), model, candidates=4, observers=[FidelityObserver()]), count=1)
        for policy in (Whole, Ends)
    )
    assert whole.decisions.keys() == ends.decisions.keys()
    for name, record in whole.decisions.items():
        one, other = record.decision, ends.decisions[name].decision
        np.testing.assert_array_equal(one.scores, other.scores)
        np.testing.assert_array_equal(one.fidelity.scores, other.fidelity.scores)
        for every, last in zip(one.rollouts, other.rollouts, strict=True):
            assert last.frames.shape == (1, 72, 128, 3) and last.real.shape == (1,)
            np.testing.assert_array_equal(every.frames[-1], last.frames[0])
            assert every.real[-1] == last.real[0]


def test_a_decision_keeps_its_evidence(task: ImageNav) -> None:
    recorder = run(task, wiw.Agent(Greedy(), Stamp(), candidates=4), count=1)
    record = recorder.decisions[0, 0]
    decision = record.decision
    assert len(decision.proposals) == len(decision.rollouts) == len(decision.scores) == 4
    assert decision.chosen == int(np.argmax(decision.scores))
    assert set(decision.seconds) == {"propose", "platform", "world_model", "revise", "environment"}
    assert decision.calls["rows"] >= 1
    np.testing.assert_array_equal(record.executed, decision.actions[: len(record.executed)])
    assert [len(r.frames) for r in decision.rollouts] == [3, 2, 2, 1]
    assert decision.rollouts[2].real.all() and not decision.rollouts[3].real.any()
    assert "4 proposals, 4 rollouts" in repr(decision) and len(repr(decision)) < 300


def test_without_a_model_the_policy_takes_its_own_best(task: ImageNav) -> None:
    decision = run(task, wiw.Agent(Greedy()), count=1).decisions[0, 0].decision
    assert decision.rollouts is None and decision.chosen == 0


def test_an_observation_without_the_depth_that_is_needed_is_named(task: ImageNav) -> None:
    env = task.environment()
    observation, info = env.reset()
    for agent in (wiw.Agent("matcher"), wiw.Agent("heuristic", "warp", reviser="matcher")):
        with pytest.raises(ArgumentError, match="create the environment with depth=True"):
            agent.decide(observation, env.goal, key=info["key"])


def test_a_failing_model_is_infrastructure_and_the_rest_goes_on(task: ImageNav) -> None:
    class Flaky(Stamp):
        calls = 0

        def rollout(self, observations, controls, seeds):
            Flaky.calls += 1
            if Flaky.calls <= TRIES:
                raise ConnectionError("server is gone")
            return super().rollout(observations, controls, seeds)

    recorder = run(task, wiw.Agent(Greedy(), Attempted(Flaky())), count=3, live=1)
    states = {i: r.status for i, r in recorder.results.items()}
    assert states == {0: "error", 1: "done", 2: "done"}
    assert "server is gone" in recorder.results[0].error and not recorder.results[0].metrics
    assert recorder.results[0].kind == "world_model/raised"


def test_a_model_that_hangs_fails_its_episode_and_the_rest_goes_on(task: ImageNav) -> None:
    release = threading.Event()

    class Stuck(Stamp):
        """Never answers the first decision of episode 1."""

        def rollout(self, observations, controls, seeds):
            if {seed_of(Key(0, 1, 0), c) for c in range(4)} & set(seeds.tolist()):
                release.wait(60)
            return super().rollout(observations, controls, seeds)

    recorder = run(task, wiw.Agent(Greedy(), Attempted(Stuck(), deadline=0.6)), count=3, live=3)
    release.set()
    assert {i: r.status for i, r in recorder.results.items()} == {0: "done", 1: "error", 2: "done"}
    assert recorder.results[1].kind == "world_model/deadline" and "within 0.6 s" in recorder.results[1].error


@pytest.mark.parametrize("live", [1, 2, 4])
def test_what_fails_does_not_depend_on_what_else_is_live(task: ImageNav, live: int) -> None:
    class Picky(Stamp):
        """Cannot stand the third decision of episode 1."""

        def rollout(self, observations, controls, seeds):
            bad = {seed_of(Key(0, 1, 2), c) for c in range(4)}
            if bad & set(seeds.tolist()):
                raise RuntimeError("not this one")
            return super().rollout(observations, controls, seeds)

    recorder = run(task, wiw.Agent(Greedy(), Attempted(Picky())), count=4, live=live)
    assert {i: r.status for i, r in recorder.results.items()} == {0: "done", 1: "error", 2: "done", 3: "done"}
    assert "not this one" in recorder.results[1].error
    clean = run(task, wiw.Agent(Greedy(), Stamp()), count=4, live=1)
    for (episode, index), record in recorder.decisions.items():
        np.testing.assert_array_equal(record.executed, clean.decisions[episode, index].executed)
    for episode in (0, 2, 3):
        assert recorder.results[episode].metrics == clean.results[episode].metrics
    assert max(index for episode, index in recorder.decisions if episode == 1) == 1


class Careless(Greedy):
    """Answers with whatever it was made with."""

    def __init__(self, proposals=None, scores=None, plan=None, chosen=None) -> None:
        self.proposed, self.scored, self.plan, self.chosen = proposals, scores, plan, chosen

    def propose(self, situations, candidates, horizon):
        good = super().propose(situations, candidates, horizon)
        return good if self.proposed is None else self.proposed

    def score(self, situations, proposals, rollouts):
        good = super().score(situations, proposals, rollouts)
        return good if self.scored is None else self.scored

    def revise(self, situation, proposals, scores):
        return super().revise(situation, proposals, scores) if self.plan is None else (self.plan, self.chosen)


def test_policies_declare_what_they_need_in_known_words() -> None:
    for declared, said in (
        ({"needs": "depth"}, r"Odd\.needs: expected .*needs = \('depth',\), got 'depth'"),
        ({"needs": ("dpeth",)}, r"Odd\.needs: .*got \('dpeth',\)"),
        ({"frames": ("front", (96, 96))}, r"Odd\.frames: expected .*FrameSpec"),
    ):
        odd = type("Odd", (Greedy,), declared)()
        for parts in ({"policy": odd}, {"policy": Greedy(), "reviser": odd}):
            with pytest.raises(ContractError, match=said):
                wiw.Agent(**parts, model=Stamp())


@pytest.mark.parametrize(
    ("careless", "said"),
    [
        (Careless([]), "each of 1 episodes"),
        (Careless([[]]), "1 to 3 plans"),
        (Careless([[Proposal([FORWARD])] * 4]), "1 to 3 plans for an episode, got 4"),
        (Careless([[Proposal([FORWARD] * 6)]]), "1 to 5 primitives"),
        (Careless([[Proposal([])]]), "1 to 5 primitives"),
        (Careless([[Proposal([7])]]), r"got \[7\]"),
        (Careless([[[FORWARD]]]), "wiw.types.Proposal"),
        (Careless([Proposal([FORWARD])]), "a list for each episode, .*got a list of Proposal"),
        (Careless(scores=[1.0]), "expected 3 finite numbers"),
        (Careless(scores=[["much", None, []]]), "a list of numbers for each episode"),
        (Careless(scores=[np.array([1.0])]), "3 finite numbers"),
        (Careless(scores=[np.array([1.0, np.nan, 0.0])]), "finite"),
        (Careless(scores=[]), "each of 1 episodes"),
        (Careless(plan=[]), "1 to 5 primitives"),
        (Careless(plan=[FORWARD] * 9), "1 to 5 primitives"),
        (Careless(plan=[FORWARD], chosen=3), "number of one of 3 proposals, .*got 3"),
        (Careless(plan=[FORWARD], chosen=-1), "number of one of 3 proposals, .*got -1"),
        (Careless(plan=[FORWARD], chosen=1.0), r"number of one of 3 proposals, .*got 1\.0"),
        (Careless(plan=[FORWARD], chosen=True), "number of one of 3 proposals, .*got True"),
    ],
)
def test_policies_are_held_to_their_contract(task: ImageNav, careless: Careless, said: str) -> None:
    with pytest.raises(ContractError, match=said):
        run(task, wiw.Agent(careless, Stamp()), count=1)


@pytest.mark.parametrize("revision", [Proposal([FORWARD]), np.array([FORWARD, FORWARD]), ([FORWARD],), None])
def test_a_reviser_returns_a_plan_and_its_number(task: ImageNav, revision: object) -> None:
    class Vague(Greedy):
        def revise(self, situation, proposals, scores):
            return revision

    with pytest.raises(ContractError, match=r"Vague\.revise: expected \(actions, number of the proposal, or"):
        run(task, wiw.Agent(Vague(), Stamp()), count=1)


def test_models_are_refused_that_ask_for_what_nobody_gives() -> None:
    def model(**declared):
        return type("Odd", (Stamp,), {"accepts": wiw.accepts(**{"control": "trajectory", **declared})})()

    for declared, said in [
        ({"needs": ("depth", "semantic")}, "needs semantic"),
        ({"needs": ("simulator",)}, "only the oracle"),
        ({"space": "pose7"}, "discrete primitives"),
        ({"needs": ("depth",), "frames": 4}, "have up to 5"),
    ]:
        with pytest.raises(ArgumentError, match=said):
            wiw.Agent(Greedy(), model(**declared))
    wiw.Agent(Greedy(), model(needs=("depth",), frames=4), horizon=3)
    with pytest.raises(ArgumentError, match="size"):
        wiw.accepts(control="image", size=(480,))
    assert wiw.accepts("image", needs="depth").needs == ("depth",)
    for declared, said in [
        ({"control": "image", "size": 128}, r"size \(height, width\) in pixels, got 128"),
        ({"control": "image", "frames": "14"}, "frames includes the observation: .*got '14'"),
        ({"control": "image", "best_batch": 2.5}, "best_batch of at least 1, got 2.5"),
        ({"control": "text", "template": "prompt.txt"}, "TextTemplate"),
        ({"control": "text", "template": GripperTextTemplate()}, "TextTemplate"),
        ({"control": "text", "space": "pose7", "template": TextTemplate()}, "GripperTextTemplate"),
        ({"control": "action", "vocabulary": {"jump": 1}}, "unknown action 'jump'"),
        ({"control": "action", "vocabulary": {7: 1}}, "unknown action 7"),
        ({"control": "action", "vocabulary": {1: [1, 0], 2: [1]}}, "one width"),
        ({"control": "action", "vocabulary": {"forward": "w"}}, "a number or a vector for forward, got 'w'"),
        ({"control": "action", "vocabulary": {"forward": [[1.0]]}}, "a number or a vector for forward"),
        ({"control": "action", "vocabulary": GripperVocabulary()}, "map from primitives"),
        ({"control": "action", "space": "pose7", "null_first": True}, "null_first is for primitives"),
        ({"control": "action", "space": "pose7", "vocabulary": {1: 1}}, "GripperVocabulary"),
        ({"control": "action", "space": "pose7", "vocabulary": GripperVocabulary("roll")}, "roll"),  # type: ignore[arg-type]
    ]:
        with pytest.raises(ArgumentError, match=said):
            wiw.accepts(**declared)


def test_a_model_gets_its_own_words_and_numbers(task: ImageNav) -> None:
    class Talker(Stamp):
        accepts = wiw.accepts(control="text", size=SIZE, template=TextTemplate(prompt="Walk: {actions}!"))

        def rollout(self, observations, controls, seeds):
            assert all(control.text.startswith("Walk: ") and control.ids is None for control in controls)
            return super().rollout(observations, controls, seeds)

    class Numbers(Stamp):
        accepts = wiw.accepts(control="action", size=SIZE, null_first=True)

        def rollout(self, observations, controls, seeds):
            assert all(control.ids.tolist() == [0, *control.actions.tolist()] for control in controls)
            return super().rollout(observations, controls, seeds)

    class Named(Stamp):
        names = ("forward", "turn_left", "turn_right", "stop")
        accepts = wiw.accepts(
            control="action", size=SIZE, vocabulary={"null": 9, **{name: 1 + i for i, name in enumerate(names)}}
        )

        def rollout(self, observations, controls, seeds):
            assert all(control.ids.tolist() == [int(own) or 9 for own in control.actions] for control in controls)
            return super().rollout(observations, controls, seeds)

    for model in (Talker(), Numbers(), Named()):
        assert run(task, wiw.Agent(Greedy(), model), count=1).results[0].status == "done"


def test_costs_are_each_episodes_own(task: ImageNav) -> None:
    def costs(live):
        recorder = run(task, wiw.Agent(Greedy(), Stamp()), count=3, live=live)
        return {name: record.decision.calls for name, record in recorder.decisions.items()}

    assert costs(1) == costs(3) and costs(1)[0, 0]["rows"] == 2  # two begin with turns


def test_a_task_settles_what_an_agent_leaves_open() -> None:
    agent = wiw.Agent(Greedy(), Stamp(), candidates=2)
    resolved = agent.spec.config.resolve({"candidates": 4, "horizon": 7, "execute": -2})
    assert (resolved.candidates, resolved.horizon, resolved.execute) == (2, 7, -2)
    assert agent.replace(config=resolved).config == resolved.complete()
    own = AgentConfig(horizon=9).resolve({"candidates": 4, "horizon": 5, "execute": 3}).complete()
    assert (own.candidates, own.horizon, own.execute) == (4, 9, 3), "another horizon, the same budget"
    short = AgentConfig(horizon=2).resolve({"candidates": 4, "horizon": 5, "execute": 3})
    routes = {"candidates": 3, "horizon": 21, "execute": 50}  # of a task in which a policy walks whole routes
    assert AgentConfig(execute=40).resolve(routes).complete().execute == 40
    with pytest.raises(ArgumentError, match="expected execute of at most 5, a plan's length, got 9"):
        AgentConfig(execute=9).resolve({"candidates": 4, "horizon": 5, "execute": 3})
    assert short.execute == 2
    bare = agent.replace(model=None)
    assert bare.model is None and bare.config.candidates == 2 and agent.model is not None


def test_a_model_that_breaks_its_contract_fails_the_episode_with_what_was_expected(task: ImageNav) -> None:
    class Wrong(Stamp):
        def rollout(self, observations, controls, seeds):
            return super().rollout(observations, controls, seeds)[:, 1:]

    result = run(task, wiw.Agent(Greedy(), Attempted(Wrong())), count=1).results[0]
    assert (result.status, result.kind) == ("error", "world_model/frames")
    assert re.search(r"expected uint8 .* got uint8", result.error)


@pytest.mark.parametrize(
    ("spoil", "kind"),
    [
        (lambda frames: frames[:, 1:], "frames"),
        (lambda frames: frames[..., :2], "shape"),
        (lambda frames: frames / 255, "dtype"),
        (lambda frames: None, "type"),
    ],
    ids=["frames", "shape", "dtype", "type"],
)
def test_a_bare_model_is_held_to_its_contract_in_its_first_answer(task: ImageNav, spoil, kind: str) -> None:
    """Without a wrapper that asks again, a broken contract is the caller's to know, not an error of one episode."""

    class Spoiling(Stamp):
        calls = 0

        def rollout(self, observations, controls, seeds):
            Spoiling.calls += 1
            return spoil(super().rollout(observations, controls, seeds))

    env = task.environment()
    observation = env.begin(task.episode(0))
    agent = wiw.Agent(Greedy(), Spoiling())
    with pytest.raises(ContractError, match=r"Spoiling\.rollout: ") as caught:
        agent.decide(observation, env.goal, Key(0, 0))
    assert caught.value.kind == kind and Spoiling.calls == 1
    with pytest.raises(ContractError, match=r"Spoiling\.rollout: "):
        run(task, agent, count=2)
    assert Spoiling.calls == 2


def test_a_model_of_fixed_length_is_padded_and_chunked(task: ImageNav) -> None:
    class Short(wiw.WorldModel):
        accepts = wiw.accepts(
            control="action", view="perspective", size=(64, 64), frames=3, vocabulary={0: 9, 1: 7, 2: 5, 3: 6, 4: 0}
        )
        lengths: ClassVar[set] = set()

        def rollout(self, observations, controls, seeds):
            for control in controls:
                assert len(control.actions) == 2 and observations.image.shape[1:] == (64, 64, 3)
                Short.lengths.add((control.length, tuple(control.ids)))
            return np.repeat(observations.image[:, None], 3, 1)

    class Long(Greedy):
        plans = ([FORWARD, FORWARD, TURN_LEFT, FORWARD, FORWARD], [FORWARD])

    record = run(task, wiw.Agent(Long(), Short(), candidates=2), count=1).decisions[0, 0]
    assert [len(r.frames) for r in record.decision.rollouts] == [5, 1]
    assert {(2, (7, 7)), (2, (5, 7)), (1, (7, 7))} <= Short.lengths


def test_a_perspective_model_works_with_the_matcher(task: ImageNav) -> None:
    class Still(wiw.WorldModel):
        accepts = wiw.accepts(control="text", view="perspective", frames=9)

        def rollout(self, observations, controls, seeds):
            assert all(
                "forward" in c.text.lower() or "left" in c.text.lower() or "right" in c.text.lower() for c in controls
            )
            return np.repeat(observations.image[:, None], 9, 1)

    recorder = run(task, wiw.Agent("matcher", Still()), count=1)
    assert recorder.results[0].status == "done", recorder.results[0].error
    assert recorder.decisions[0, 0].decision.rollouts[0].view == "front"


def test_asking_for_the_impossible_says_so(task: ImageNav) -> None:
    with pytest.raises(ArgumentError, match="candidates"):
        wiw.Agent("matcher", candidates=0)
    env = task.environment()
    observation = env.begin(task.episode(0))
    with pytest.raises(ArgumentError, match="depth=True"):
        wiw.Agent(Greedy(), "warp").decide(observation, env.goal, wiw.types.Key(0, 0))
    with pytest.raises(ArgumentError, match="simulator"):
        wiw.Agent(Greedy(), "oracle").decide(observation, env.goal, wiw.types.Key(0, 0))

    class Proposing(wiw.Policy):
        propose = Greedy.propose

    with pytest.raises(ArgumentError, match=r"only proposes; let it implement `score`, or .* --revision \(reviser=\)"):
        wiw.Agent(Proposing(), "copy")


class Quiz(Greedy):
    """Believes what it was made with, if its goal has choices."""

    def __init__(self, *probabilities: float) -> None:
        self.probabilities = np.array(probabilities)

    def answer(self, situations, proposals, rollouts):
        return [Answer(s.goal.choices, self.probabilities) if s.goal.choices else None for s in situations]


def test_answers_reach_the_decision_and_the_environment() -> None:
    goal = Goal("quiz", choices=("chair", "lamp"))
    query = Query(Observation(np.zeros((576, 1024, 3), np.uint8), np.zeros((480, 480, 3), np.uint8), np.zeros(3)),
                  goal, Key(0, 0))  # fmt: skip
    decision = wiw.Agent(Quiz(0.3, 0.7)).decide_batch([query])[0]
    assert decision.answer.label == "lamp" and decision.answer.confidence == 0.7
    assert decision_row("a", record_of(decision), False).values["answer"].startswith('{"label":"lamp"')
    for wrong in (Quiz(0.3, 0.3), Quiz(1.0), Quiz(-0.5, 1.5), Quiz(np.nan, 1.0), Greedy()):
        with pytest.raises(ContractError, match=r"\.answer: expected|Greedy gives no answer"):
            wiw.Agent(wrong).decide_batch([query])


def record_of(decision) -> DecisionRecord:
    here = Truth(np.zeros(3), 0.0, 1.0, 1.0)
    return DecisionRecord(0, 0, decision, decision.actions[:1], here, here, np.zeros((2, 3)))


def test_a_model_may_not_answer_in_the_memory_of_an_earlier_answer(task: ImageNav) -> None:
    class Reusing(Stamp):
        accepts = wiw.accepts(control="trajectory", view="panorama", size=SIZE, best_batch=1, frames=6)
        _memory = np.zeros((1, 6, *SIZE, 3), np.uint8)

        def rollout(self, observations, controls, seeds):
            self._memory[:] = super().rollout(observations, controls, seeds)
            return self._memory

    with pytest.raises(ContractError, match="return a new array from every call"):
        run(task, wiw.Agent(Greedy(), Reusing()), count=1)


class Remembering(Greedy):
    """Remembers every moment that it has observed."""

    def __init__(self) -> None:
        self.begun: list[int] = []
        self.lengths: dict[tuple[int, int], int] = {}

    def begin(self, goal, key):
        self.begun.append(key.episode)
        return []

    def observe(self, situations):
        for situation in situations:
            situation.memory.append(situation.observation)
            self.lengths[situation.key.episode, situation.key.decision] = len(situation.memory)

    def score(self, situations, proposals, rollouts):
        assert all(len(situation.memory) == situation.key.decision + 1 for situation in situations)
        return super().score(situations, proposals, rollouts)


def test_memory_holds_every_moment_from_the_first_on(task: ImageNav) -> None:
    policy = Remembering()
    recorder = run(task, wiw.Agent(policy, "copy", candidates=2), count=2)
    assert sorted(policy.begun) == [0, 1]
    assert len(recorder.decisions) > 4
    assert policy.lengths == {key: key[1] + 1 for key in recorder.decisions}


def test_a_first_decision_carries_out_before_the_second(task: ImageNav) -> None:
    env, seen = task.environment(), []

    class Watching(Greedy):
        def observe(self, situations):
            seen.extend(situation.executed for situation in situations)

    agent = wiw.Agent(Watching(), candidates=1, horizon=2, execute=2)
    env.begin(task.episode(0))
    for index in range(3):
        env.run(agent.decide(env.observation, env.goal, Key(0, 0, index)).actions)
    assert seen == [(), (FORWARD, FORWARD), (FORWARD,) * 4]
