# SPDX-License-Identifier: Apache-2.0
"""A world model that fails in every way it can, one call at a time."""

from __future__ import annotations

import gc
import pickle
import re
import threading
import time

import numpy as np
import pytest

import wiw
from wiw.action import FORWARD
from wiw.errors import ArgumentError, ConstructionError, RolloutError
from wiw.loop import attempts
from wiw.loop.attempts import TRIES, Attempted, make_model
from wiw.runs.compose import Limits, RunContext
from wiw.runs.recipes import AgentRecipe
from wiw.tasks.imagenav import ImageNav
from wiw.types import Conditioning, Control
from wiw.world_models.base import Requirements

SEEDS = np.zeros(2, np.uint64)
OBSERVATIONS = Conditioning(np.full((2, 8, 16, 3), 7, np.uint8))
CONTROLS = [Control(np.array([FORWARD], np.int8), np.zeros((1, 3)), np.eye(4)[None], length=1)] * 2
GOOD = np.full((2, 2, 8, 16, 3), 5, np.uint8)
NAN = GOOD.astype(np.float32)
NAN[0, 0, 0, 0, 0] = np.nan


class Scripted(wiw.WorldModel):
    """Answers with one thing after another, the last one for ever; raises what is an exception."""

    accepts = wiw.accepts(control="image", size=(8, 16))

    def __init__(self, *answers) -> None:
        self.answers, self.calls, self.threads = list(answers), 0, set()

    def rollout(self, observations, controls, seeds):
        self.calls += 1
        self.threads.add(threading.get_ident())
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        answer = answer() if callable(answer) else answer
        if isinstance(answer, BaseException):
            raise answer
        return answer


class SpeechlessError(Exception):
    def __str__(self):
        raise KeyError("words")


def ask(model, deadline=5.0):
    return Attempted(model, deadline).rollout(OBSERVATIONS, CONTROLS, SEEDS)


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attempts, "PAUSES", (0.0, 0.0))


@pytest.mark.parametrize("failures", [0, 1, 2])
def test_a_call_that_fails_is_made_again(failures: int) -> None:
    model = Scripted(*[ConnectionError("gone")] * failures, GOOD)
    asked = Attempted(model, 5.0)
    np.testing.assert_array_equal(asked.rollout(OBSERVATIONS, CONTROLS, SEEDS), GOOD)
    spent = asked.spent
    assert (model.calls, spent.get("retries", 0), spent["rows"]) == (failures + 1, failures, 2 * (failures + 1))


@pytest.mark.parametrize(
    ("answer", "kind", "calls"),
    [
        (OSError("gone"), "raised", TRIES),
        (ArgumentError("no such plan"), "raised", TRIES),
        (GOOD[:, :1], "frames", 2),
        (GOOD[:1], "shape", 2),
        (GOOD[..., :2], "shape", 2),
        (GOOD.astype(np.float32), "dtype", 2),
        (NAN, "nan", 2),
        (GOOD.tolist(), "type", 2),
        (None, "type", 2),
    ],
    ids=lambda value: str(value) if isinstance(value, str | int) else "",
)
def test_what_fails_every_time_is_named_by_its_kind(answer, kind: str, calls: int) -> None:
    model = Scripted(answer)
    with pytest.raises(RolloutError, match="Scripted") as caught:
        ask(model)
    assert (caught.value.kind, model.calls) == (kind, calls)
    assert pickle.loads(pickle.dumps(caught.value)).kind == kind


def test_an_error_without_words_is_an_error_of_the_model() -> None:
    with pytest.raises(RolloutError, match=r"SpeechlessError: its text cannot be had \(KeyError\)") as caught:
        ask(Scripted(SpeechlessError()))
    assert caught.value.kind == "raised"


def test_different_breaches_have_all_their_tries() -> None:
    model = Scripted(GOOD[:1], GOOD[:, :1], GOOD)
    np.testing.assert_array_equal(ask(model), GOOD)


def test_a_call_that_hangs_is_abandoned_and_the_next_try_may_answer() -> None:
    release = threading.Event()
    model = Scripted(lambda: (release.wait(20), GOOD[:1])[1], GOOD)
    begin = time.perf_counter()
    np.testing.assert_array_equal(ask(model, 0.2), GOOD)
    assert time.perf_counter() - begin < 5 and len(model.threads) == 2
    release.set()


def test_a_model_that_always_hangs_fails_by_its_deadline() -> None:
    release = threading.Event()
    begin = time.perf_counter()
    with pytest.raises(RolloutError, match=r"within 0\.1 s") as caught:
        ask(Scripted(lambda: release.wait(20)), 0.1)
    release.set()
    assert caught.value.kind == "deadline" and 0.3 <= time.perf_counter() - begin < 5


def test_a_slow_model_is_never_entered_twice_at_a_time() -> None:
    inside, most = [0], [0]

    def slow():
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        time.sleep(0.3)
        inside[0] -= 1
        return GOOD

    with pytest.raises(RolloutError, match="deadline"):
        ask(Scripted(slow), 0.2)
    assert most[0] == 1


def test_one_thread_serves_all_calls_and_ends_with_its_owner() -> None:
    model = Scripted(GOOD)
    asked = Attempted(model, 5.0)
    before = threading.active_count()
    for _ in range(5):
        asked.rollout(OBSERVATIONS, CONTROLS, SEEDS)
    assert len(model.threads) == 1 and threading.get_ident() not in model.threads
    assert pickle.loads(pickle.dumps(Attempted(Scripted(None), 3.0))).deadline == 3.0
    del asked
    gc.collect()
    deadline = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() <= before


def test_without_a_deadline_a_call_stays_in_its_thread() -> None:
    model = Scripted(GOOD)
    ask(model, float("inf"))
    assert model.threads == {threading.get_ident()}
    with pytest.raises(ArgumentError, match="deadline"):
        Attempted(model, 0)


def test_torch_finds_the_state_of_the_thread_that_asks() -> None:
    torch = pytest.importorskip("torch")
    seen = []
    model = Scripted(lambda: (seen.append((torch.is_grad_enabled(), torch.is_inference_mode_enabled())), GOOD)[1])
    with torch.no_grad():
        ask(model)
    with torch.inference_mode():
        ask(model)
    ask(model)
    assert seen == [(False, False), (False, True), (True, False)]


class Leaving(BaseException):
    """What a library may use to leave all handlers of `Exception` behind."""


@pytest.mark.parametrize("deadline", [5.0, float("inf")])
@pytest.mark.parametrize("stop", [SystemExit(0), GeneratorExit(), Leaving("enough")], ids=repr)
def test_a_model_ends_no_process(stop, deadline) -> None:
    model = Scripted(stop)
    with pytest.raises(RolloutError, match=re.escape(repr(stop))) as caught:
        ask(model, deadline)
    assert caught.value.kind == "raised" and model.calls == TRIES


def test_ctrl_c_is_no_error_of_the_model() -> None:
    model = Scripted(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        ask(model, float("inf"))
    assert model.calls == 1


class Slow(Scripted):
    """Its constructor waits for what never comes."""

    def __init__(self) -> None:
        threading.Event().wait()


class Fetching(Scripted):
    """Like one that fetches weights, longer than the deadline of a call."""

    requires = Requirements(weights="somebody/network")

    def __init__(self) -> None:
        super().__init__(GOOD)
        time.sleep(0.2)


class Wrong(Scripted):
    def __init__(self, error) -> None:
        raise error


def test_a_constructor_is_held_to_the_deadline_and_its_errors_have_a_type(two_rooms) -> None:
    with pytest.raises(ConstructionError, match=r"'Slow' cannot be built.*within 0\.1 s") as caught:
        make_model(Slow, 0.1)
    assert caught.value.kind == "deadline"
    with pytest.raises(ConstructionError, match=r"within 0\.1 s"):
        AgentRecipe("matcher", Slow).build(RunContext(ImageNav(scenes=two_rooms)), Limits(deadline=0.1))
    assert isinstance(make_model(Fetching, 0.05), Fetching)
    for error in (OSError("no weights"), SystemExit(3)):
        with pytest.raises(ConstructionError, match=r"cannot be built: (OSError: no weights|SystemExit: 3)") as caught:
            make_model(Wrong, 5, error=error)
        assert caught.value.kind == "raised" and caught.value.__cause__ is error
    with pytest.raises(ArgumentError, match="mine"):
        make_model(Wrong, 5, error=ArgumentError("mine"))
    with pytest.raises(KeyboardInterrupt):
        wiw.world_model(Wrong, error=KeyboardInterrupt())


class Threaded(Scripted):
    """Starts a thread in its constructor and in each call, as samplers and loaders do."""

    def __init__(self) -> None:
        super().__init__(GOOD)
        self.ended, self.started = threading.Event(), []
        self.start()

    def start(self) -> None:
        self.started.append(threading.Thread(target=self.ended.wait))
        self.started[-1].start()

    def rollout(self, observations, controls, seeds):
        self.start()
        return super().rollout(observations, controls, seeds)


def test_threads_of_a_model_do_not_keep_the_process_alive() -> None:
    model = make_model(Threaded, 5.0)
    ask(model)
    assert len(model.started) == 2 and all(thread.daemon for thread in model.started)
    model.ended.set()
