# SPDX-License-Identifier: Apache-2.0
"""World models of one's own in processes of their own: what they do there harms neither the run nor its numbers."""

from __future__ import annotations

import gc
import locale
import os
import pickle
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from copy import deepcopy
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from bad_models import FAILING, FATAL, HARMLESS, SIZE, WAYS, imagine
from locations import PYTHON_TESTS
from readers import READERS

import wiw
from wiw.action import FORWARD
from wiw.errors import (
    ArgumentError,
    ConstructionError,
    ContractError,
    InfrastructureError,
    RegistryError,
    RolloutError,
)
from wiw.isolation import models, source
from wiw.isolation.failures import EndedError, ExitError, LateError, RaisedError
from wiw.isolation.models import IsolatedModel, roll_out
from wiw.isolation.process import _build_error
from wiw.loop import attempts
from wiw.loop.attempts import Attempted, make_model
from wiw.policies.base import Situation
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.studies.evaluate import evaluate
from wiw.types import Conditioning, Control, Decision, Goal, Key, Observation
from wiw.world_models.base import answer_deadline

BAD = f"{PYTHON_TESTS / 'bad_models.py'}:Bad"
PEEPING = BAD.replace(":Bad", ":Peeping")
CONTROLS = [Control(np.full(2, FORWARD, np.int8), np.zeros((2, 3)), np.stack([np.eye(4)] * 2), length=2)] * 2
FAILURES = (EndedError, ExitError, LateError, RaisedError, ContractError)


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attempts, "PAUSES", (0.0, 0.0))


@pytest.fixture(scope="module")
def model():
    made = make_model(BAD, 60.0, memory_gb=0.3)
    yield made
    made.close()


def observe(way=None):
    """Return observations that make the model misbehave in some way."""
    image = np.full((2, *SIZE, 3), 90, np.uint8)
    image[0, 0, 0, 0] = 0 if way is None else 1 + WAYS.index(way)
    return Conditioning(image)


def ask(model, way=None, deadline=20.0):
    seeds = np.arange(2, dtype=np.uint64)
    return Attempted(model, deadline).once(observe(way), CONTROLS, seeds)


def describe_surroundings():
    """Return what of this process a careless model changes."""
    return {
        "random": (random.getstate(), np.random.get_state()[1].tolist()),  # noqa: NPY002 - what models change
        "folder": os.getcwd(),  # noqa: PTH109 - as the system has it
        "environment": dict(os.environ),
        "path": list(sys.path),
        "arguments": list(sys.argv),
        "locale": locale.setlocale(locale.LC_ALL),
        "signals": [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)],
        "numpy": np.geterr(),
        "streams": (sys.stdin.closed, sys.stdout.closed),
    }


def count_descriptors():
    return len(list(Path("/proc/self/fd").iterdir()))


DEAR = ("change_torch",)
"""Ways that are tried nightly."""


@pytest.mark.parametrize(
    "way",
    [pytest.param(way, marks=pytest.mark.nightly if way.__name__ in DEAR else ()) for way in WAYS],
    ids=lambda way: way.__name__,
)
def test_what_a_model_does_stays_in_its_process(model, way, capfd) -> None:
    before, threads = describe_surroundings(), threading.enumerate()
    hangs = way.__name__.startswith(("hang", "stop"))
    try:
        frames = ask(model, way, 0.3 if hangs else 30.0)
    except FAILURES as error:
        assert way in (*FATAL, *FAILING), error
        assert isinstance(error, LateError) == hangs
        assert isinstance(error, EndedError | LateError) == (way in FATAL)
    else:
        assert way in HARMLESS
        time.sleep(0.1 if way.__name__ == "change_answer_later" else 0)
        np.testing.assert_array_equal(frames, imagine(observe(way), CONTROLS))
    assert describe_surroundings() == before
    assert not [each for each in threading.enumerate() if each not in threads]
    good = Attempted(model, 30.0).rollout(observe(), CONTROLS, np.zeros(2, np.uint64))
    np.testing.assert_array_equal(good, imagine(observe(), CONTROLS))
    assert "noise" not in capfd.readouterr().out


def test_a_call_is_made_three_times_and_then_an_error_of_the_infrastructure(model) -> None:
    asked = Attempted(model, 30.0)
    with pytest.raises(RolloutError, match=r"Bad gave no usable answer in 3 attempts.*exit code 0") as caught:
        asked.rollout(observe(WAYS[[way.__name__ for way in WAYS].index("exit_at_once")]), CONTROLS, np.zeros(2, "u8"))
    assert caught.value.kind == "ended" and asked.spent["calls"] == 3


def test_nothing_is_left_of_a_killed_process_and_its_children() -> None:
    before = count_descriptors()
    model = make_model(BAD, 60.0)
    ask(model, next(way for way in WAYS if way.__name__ == "start_process"))
    group = model._process._process.pid
    model.close()
    deadline = time.monotonic() + 5
    while _has_group(group) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not _has_group(group)
    del model
    gc.collect()
    assert count_descriptors() <= before


def test_children_of_a_process_that_ends_by_itself_end_with_it(tmp_path) -> None:
    head = (
        "import os, subprocess, wiw\n"
        "class Ending(wiw.WorldModel):\n"
        "    accepts = wiw.accepts(control='image', view='perspective', size=(64, 128), frames=3)\n"
        "    def rollout(self, observations, controls, seeds):\n"
        "        child = subprocess.Popen(['sleep', '60'])\n"
    )
    for name, end, said in (("crash", "os._exit(3)", "exit code 3"), ("kill", "os.kill(os.getpid(), 9)", "SIGKILL")):
        (tmp_path / f"{name}.py").write_text(f"{head}        {end}\n")
        model = make_model(f"{tmp_path}/{name}.py:Ending", 60.0)
        group = model._process._process.pid
        with pytest.raises(EndedError, match=f"its process ended with {said}"):
            model.rollout(observe(), CONTROLS, np.zeros(2, np.uint64))
        deadline = time.monotonic() + 5
        while _has_group(group) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert not _has_group(group)


def test_a_process_that_ends_between_look_and_call_is_not_taken_for_one_with_a_model(model) -> None:
    process = model._find_process()
    os.kill(process._process.pid, signal.SIGKILL)
    os.waitid(os.P_PID, process._process.pid, os.WEXITED | os.WNOWAIT)
    with pytest.raises(EndedError, match="SIGKILL"):
        process.call(roll_out, observe(), CONTROLS, np.zeros(2, np.uint64), 20.0, answer=2 * 3 * SIZE[0] * SIZE[1] * 3)
    np.testing.assert_array_equal(ask(model), imagine(observe(), CONTROLS))


def _has_group(group):
    with suppress(ProcessLookupError):
        os.killpg(group, 0)
        return any(state.split()[2] != "Z" for state in _list_states(group))
    return False


def _list_states(group):
    for file in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            text = file.read_text()
            rest = text.rpartition(")")[2].split()
            if int(rest[2]) == group:
                yield f"x x {rest[0]}"


def test_its_process_is_fresh_and_knows_no_command(two_rooms) -> None:
    env = wiw.make("ImageNav-v0", scenes=two_rooms)
    env.reset()
    found = wiw.world_model(PEEPING).describe()
    assert found["argv"] == ["wiw"] and found["simulators"] == 0 and found["modules"] == []
    assert "pytest" not in found["main"]
    here = wiw.world_model(PEEPING, isolate=False)
    assert type(here).__name__ == "Peeping" and not isinstance(here, IsolatedModel)
    assert here.describe()["simulators"] > 0
    env.close()


def test_answers_are_each_ones_own_and_inputs_may_be_kept(tmp_path) -> None:
    file = tmp_path / "keeping.py"
    file.write_text(
        "import numpy as np, wiw\n"
        "class Keeping(wiw.WorldModel):\n"
        "    accepts = wiw.accepts(control='image', view='perspective', size=(64, 128), frames=3)\n"
        "    kept = []\n"
        "    def rollout(self, observations, controls, seeds):\n"
        "        self.kept.append(observations.image)\n"
        "        return np.repeat(self.kept[0][:, None], 3, 1)\n"
    )
    model = wiw.world_model(f"{file}:Keeping")
    shades = [np.full((2, 64, 128, 3), shade, np.uint8) for shade in (10, 20, 30)]
    answers = [model.rollout(Conditioning(image), CONTROLS, np.zeros(2, np.uint64)) for image in shades]
    assert [int(answer.min()) for answer in answers] == [10, 10, 10] == [int(answer.max()) for answer in answers]
    assert not any(np.may_share_memory(one, other) for one in answers for other in answers if one is not other)


def test_what_hangs_when_it_starts_anew_or_says_what_it_is_fails_by_a_deadline(tmp_path, monkeypatch) -> None:
    file, marker = tmp_path / "hanging.py", tmp_path / "marker"
    file.write_text(
        "import os, time, wiw\n"
        f"if os.path.exists({str(marker)!r}):\n"
        "    time.sleep(99)\n"
        "class Hanging(wiw.WorldModel):\n"
        "    accepts = wiw.accepts(control='image', view='perspective', size=(64, 128), frames=3)\n"
        "    def rollout(self, observations, controls, seeds):\n"
        f"        open({str(marker)!r}, 'w').close()\n"
        "        os._exit(3)\n"
        "    def describe(self):\n"
        "        time.sleep(99)\n"
    )
    monkeypatch.setattr(source, "STARTING", 0.5)
    monkeypatch.setattr(models, "IDENTIFYING", 0.5)
    made = make_model(f"{file}:Hanging", 20.0)
    made._patience = 0.5
    with pytest.raises(ConstructionError, match=r"cannot say what it is: no answer within 0\.5 s") as caught:
        made.describe()
    assert caught.value.kind == "deadline"
    made = make_model(f"{file}:Hanging", 20.0)
    made._patience = 0.5
    with pytest.raises(RolloutError, match=r"cannot be loaded: no answer within 0\.5 s"):
        Attempted(made, 20.0).rollout(observe(), CONTROLS, np.zeros(2, np.uint64))


def test_a_model_made_without_a_deadline_starts_anew_within_that_of_the_call(tmp_path) -> None:
    file, marker = tmp_path / "hanging.py", tmp_path / "marker"
    file.write_text(
        "import os, time, wiw\n"
        "class Hanging(wiw.WorldModel):\n"
        "    accepts = wiw.accepts(control='image', view='perspective', size=(64, 128), frames=3)\n"
        "    def __init__(self):\n"
        f"        if os.path.exists({str(marker)!r}):\n"
        "            time.sleep(99)\n"
        "    def rollout(self, observations, controls, seeds):\n"
        f"        open({str(marker)!r}, 'w').close()\n"
        "        os._exit(3)\n"
    )
    made = wiw.world_model(f"{file}:Hanging")
    for said in ("exit", r"did not return within [12]"):
        with pytest.raises((ConstructionError, EndedError, ExitError), match=said), answer_deadline(2.0):
            made.rollout(observe(), CONTROLS, np.zeros(2, np.uint64))


def test_construction_and_import_fail_by_kind(tmp_path) -> None:
    def write(text):
        file = tmp_path / "made.py"
        file.write_text(f"import os, sys, time, wiw\n{text}")
        return f"{file}:Made"

    head = "class Made(wiw.WorldModel):\n    accepts = wiw.accepts(control='image', frames=3)\n    rollout = None\n"
    with pytest.raises(RegistryError, match="cannot be loaded: its process ended with exit code 4"):
        make_model(write("os._exit(4)"))
    with pytest.raises(RegistryError, match=r"cannot be loaded: ValueError: here \(made\.py, line 2\)"):
        make_model(write("raise ValueError('here')"))
    with pytest.raises(ConstructionError, match="cannot be built: its process ended with SIGKILL") as caught:
        make_model(write(head + "    def __init__(self):\n        os.kill(os.getpid(), 9)\n"))
    assert caught.value.kind == "ended"
    with pytest.raises(ConstructionError, match=r"did not return within 0\.3 s") as caught:
        make_model(write(head + "    def __init__(self):\n        time.sleep(99)\n"), 0.3)
    assert caught.value.kind == "deadline"
    name = write(head + "    def __init__(self, steps: int = 3):\n        self.steps = steps\n")
    with pytest.raises(RegistryError, match=r"unexpected keyword argument 'stps'; it takes \(steps: 'int' = 3"):
        make_model(name, stps=4)
    made = make_model(name, steps=4)
    assert made.describe() == {"name": "Made", "steps": 4}
    assert pickle.loads(pickle.dumps(made)).describe() == made.describe()
    with pytest.raises(ArgumentError, match="only the oracle is given"):
        make_model(write(head.replace("frames=3", "needs=('simulator',)")))


POLICY = """
import os
from collections import Counter

import numpy as np

import wiw
from wiw.action import FORWARD, TURN_LEFT
from wiw.types import Proposal


class Own(wiw.Policy):
    def __init__(self, fatal: int = -1) -> None:
        self.fatal, self.looks = fatal, 0

    def begin(self, goal, key):
        return Counter()

    def observe(self, situations):
        self.looks += len(situations)
        for each in situations:
            each.memory["looks"] += 1

    def propose(self, situations, candidates, horizon):
        if any(each.key.episode == self.fatal for each in situations):
            os._exit(3)
        return [[self._plan(each, number) for number in range(candidates)] for each in situations]

    def _plan(self, situation, number):
        draws = np.random.default_rng([situation.key.episode, situation.key.decision, number]).random(3)
        actions = np.where(draws < 0.8, FORWARD, TURN_LEFT)
        return Proposal(actions, float(draws[0]), f"look {situation.memory['looks']}, {len(situation.executed)} done")

    def score(self, situations, proposals, rollouts):
        return [np.array([plan.prior for plan in plans]) for plans in proposals]

    def describe(self):
        return {"policy": "Own"}

    @property
    def spent(self):
        return {"looks": self.looks}
"""


def test_a_policy_decides_in_its_process_as_in_ours_and_cannot_take_the_run_with_it(tmp_path) -> None:
    (tmp_path / "own.py").write_text(POLICY)
    name, task = f"{tmp_path / 'own.py'}:Own", TaskRecipe(f"{PYTHON_TESTS / 'fakes.py'}:line_task")

    def run(policy, **options):
        recipe = AgentRecipe(policy, policy_options={policy: options})
        return evaluate(task, recipe, 4, out=tmp_path / f"run{len(list(tmp_path.iterdir()))}", progress=False, live=2)

    def read(log):
        said = ("actions", "proposals", "scores", "chosen", "note")
        return [{name: row[name] for name in said if name in row} for row in log.store.decisions()]

    here, there = run(name), run(f"isolated:{name}")
    assert read(here) == read(there) and len(read(here)) > 8
    assert [row["metrics"] for row in here.episodes] == [row["metrics"] for row in there.episodes]
    assert there.store.config["arms"][0]["agent"]["policy"] == f"isolated:{name}"  # so says the manifest
    assert wiw.verify(there.path, 4).same
    log = run(f"isolated:{name}", fatal=2)
    assert [(row["episode"], row["status"]) for row in log.episodes if row["status"] != "done"] == [(2, "error")]
    assert "its process ended with exit code 3" in log.episodes[2]["error"]
    with pytest.raises(RegistryError, match="expected a policy of your own"):
        wiw.policy("isolated:matcher")


def test_a_revision_is_held_to_its_contract_in_its_process_too(tmp_path) -> None:
    task = TaskRecipe(f"{PYTHON_TESTS / 'fakes.py'}:line_task")
    for number, (revision, said) in enumerate(
        {
            "proposals[0]": "expected .actions, number of the proposal, or None., got Proposal",
            "(proposals[0].actions, 0.9)": "expected the number of one of .* got 0.9",
        }.items()
    ):
        file = tmp_path / f"vague{number}.py"
        file.write_text(f"{POLICY}\n    def revise(self, situation, proposals, scores):\n        return {revision}\n")
        for isolated in ("", "isolated:"):
            with pytest.raises(ContractError, match=rf"Own\.revise: {said}"):
                evaluate(
                    task, AgentRecipe(f"{isolated}{file}:Own"), 1, out=tmp_path / f"{isolated}{number}", progress=False
                )


def test_a_policy_s_new_process_takes_no_memory_for_one_of_the_old_one_s(tmp_path) -> None:
    (tmp_path / "own.py").write_text(POLICY)
    policy, key, goal = wiw.policy(f"isolated:{tmp_path / 'own.py'}:Own"), Key(0, 0), Goal("imagenav")

    def look(memory) -> str:
        blank = np.zeros((8, 16, 3), np.uint8)
        situation = Situation(Observation(blank, blank, np.zeros(3)), goal, key, memory)
        policy.observe([situation])
        return policy.propose([situation], 1, 3)[0][0].note

    first, second = policy.begin(goal, key), policy.begin(goal, key)
    assert [look(first), look(first), look(second)] == ["look 1, 0 done", "look 2, 0 done", "look 1, 0 done"]
    policy.close()
    new = policy.begin(goal, key)
    with pytest.raises(RaisedError, match="process has ended, and its memory"):
        look(second)
    del first, second
    gc.collect()
    assert [look(new), look(new)] == ["look 1, 0 done", "look 2, 0 done"]
    assert policy.spent == {"looks": 5}
    policy.close()


def test_a_copy_of_a_policy_s_memory_is_another_one_in_its_process_too(tmp_path) -> None:
    """What is done with copies, such as scoring true futures for their fidelity, must change no decision."""
    (tmp_path / "own.py").write_text(POLICY)
    blank, key, goal = np.zeros((8, 16, 3), np.uint8), Key(0, 0), Goal("imagenav")
    notes = []
    for name in ("", "isolated:"):
        policy = wiw.policy(f"{name}{tmp_path / 'own.py'}:Own")

        def look(memory, policy=policy) -> str:
            situation = Situation(Observation(blank, blank, np.zeros(3)), goal, key, memory)
            policy.observe([situation])
            return policy.propose([situation], 1, 3)[0][0].note

        memory = policy.begin(goal, key)
        look(memory)
        copy = deepcopy(memory)
        notes.append([look(copy), look(copy), look(memory), look(deepcopy(copy))])
    assert notes[0] == notes[1] == [f"look {count}, 0 done" for count in (2, 3, 2, 4)]
    policy.close()
    policy.begin(goal, key)
    with pytest.raises(RaisedError, match="process has ended, and its memory"):
        deepcopy(memory)
    policy.close()


def test_a_policy_in_its_process_is_not_told_where_north_is(tmp_path) -> None:
    drawing = """
    def draw(self, situation, decision, north):
        return {"north": np.full((2, 2, 3), 255 if north else 7, np.uint8)}
"""
    (tmp_path / "own.py").write_text(POLICY + drawing)
    blank, key, goal = np.zeros((8, 16, 3), np.uint8), Key(0, 0), Goal("imagenav")
    for name, shown in (("", 255), ("isolated:", 7)):
        policy = wiw.policy(f"{name}{tmp_path / 'own.py'}:Own")
        situation = Situation(Observation(blank, blank, np.zeros(3)), goal, key, policy.begin(goal, key))
        decision = Decision(np.zeros(1, np.int8), 1, ())
        assert policy.draw(situation, decision, 0.75)["north"].max() == shown
    policy.close()


FATAL_MODEL = """
import os

import numpy as np

import wiw
from wiw.loop.imagine import seed_of
from wiw.types import Key


class Fatal(wiw.WorldModel):
    accepts = wiw.accepts(control="image", view="perspective", size=(8, 16))

    def __init__(self, fatal: int = -1) -> None:
        self.fatal = fatal

    def rollout(self, observations, controls, seeds):
        own = [seed_of(Key(0, self.fatal, d), c) for d in range(9) for c in range(3)] if self.fatal >= 0 else []
        if set(own) & set(map(int, seeds)):
            os._exit(3)
        return np.repeat(observations.image[:, None], 1 + len(controls[0].actions), 1)
"""


def test_an_episode_that_ends_its_model_s_process_three_times_is_an_error_and_the_run_goes_on(tmp_path) -> None:
    (tmp_path / "own.py").write_text(POLICY)
    (tmp_path / "fatal.py").write_text(FATAL_MODEL)
    task = TaskRecipe(f"{PYTHON_TESTS / 'fakes.py'}:line_task")

    def run(name, **options):
        recipe = AgentRecipe(f"{tmp_path / 'own.py'}:Own", f"{tmp_path / 'fatal.py'}:Fatal", model_options=options)
        log = evaluate(task, recipe, 3, out=tmp_path / name, progress=False, live=2)
        return log, {row["episode"]: row["metrics"] for row in log.episodes if row["status"] == "done"}

    here, quiet = run("here", isolate=False)
    there, disturbed = run("there", fatal=1)
    (error,) = [row for row in there.episodes if row["status"] == "error"]
    assert (error["episode"], error["kind"]) == (1, "world_model/ended")
    assert "in 3 attempts; the last error: its process ended with exit code 3" in error["error"]
    assert disturbed == {episode: quiet[episode] for episode in (0, 2)} and there.complete
    assert here.store.config["arms"][0]["agent"]["model_options"] == {"isolate": False}


THEIRS = """
import os, numpy as np, wiw

class Theirs(wiw.WorldModel):
    accepts = wiw.accepts(control="trajectory", view="perspective", size=(8, 16))
    version = "1"

    def rollout(self, observations, controls, seeds):
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        frames[:, 1:] = os.getpid() & 255, os.getpid() >> 8 & 255, os.getpid() >> 16
        return frames
"""
"""A model that shows in which process it runs."""


def test_the_model_of_an_installed_package_has_a_process_of_its_own(tmp_path, monkeypatch):
    """Installed packages name models by entry points; these are as foreign as files."""
    (tmp_path / "theirs.py").write_text(THEIRS)
    (tmp_path / "theirs-1.0.dist-info").mkdir()
    (tmp_path / "theirs-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (tmp_path / "theirs-1.0.dist-info" / "entry_points.txt").write_text("[wiw.world_models]\ntheirs = theirs:Theirs\n")
    monkeypatch.syspath_prepend(tmp_path)
    image = np.zeros((2, 8, 16, 3), np.uint8)
    model = wiw.world_model("theirs")
    assert isinstance(model, IsolatedModel) and "theirs" not in sys.modules
    frames = model.rollout(Conditioning(image), CONTROLS, np.arange(2, dtype=np.uint64))
    model.close()
    own = [os.getpid() & 255, os.getpid() >> 8 & 255, os.getpid() >> 16]
    assert not frames[:, 0].any() and (frames[:, 1:] == frames[0, 1, 0, 0]).all()
    assert frames[0, 1, 0, 0].tolist() != own
    here = wiw.world_model("theirs", isolate=False).rollout(
        Conditioning(image), CONTROLS, np.arange(2, dtype=np.uint64)
    )
    assert (here[:, 1:] == own).all()


def test_a_small_dev_shm_is_enough(tmp_path):
    """Shared memory is anonymous files; containers often have 64 MB in /dev/shm, here it is 64 kB."""
    (tmp_path / "theirs.py").write_text(THEIRS.replace("(8, 16)", "(480, 960)"))
    (tmp_path / "ask.py").write_text(
        "import os, numpy as np, wiw\nfrom wiw.types import Conditioning, Control\n"
        "if __name__ == '__main__':\n"
        "    plan = np.full(14, wiw.action.FORWARD, np.int8)\n"
        "    control = Control(plan, np.zeros((14, 3)), np.stack([np.eye(4)] * 14), length=14)\n"
        "    model = wiw.world_model('theirs.py:Theirs')\n"
        "    image = np.zeros((1, 480, 960, 3), np.uint8)\n"
        "    frames = model.rollout(Conditioning(image), [control], np.zeros(1, np.uint64))\n"
        "    model.close()\n"
        "    print(frames.nbytes, os.statvfs('/dev/shm').f_blocks * os.statvfs('/dev/shm').f_frsize)\n"
    )
    small = "mount -t tmpfs -o size=64k tmpfs /dev/shm"
    if shutil.which("unshare") is None or subprocess.run(["unshare", "-m", "sh", "-c", small], check=False).returncode:
        pytest.skip("making a small /dev/shm needs root and the right to mount")
    command = ["unshare", "-m", "sh", "-c", f"{small} && exec {sys.executable} ask.py"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    said = subprocess.check_output(command, cwd=tmp_path, env=environment, text=True, timeout=120)
    assert said.split() == [str(15 * 480 * 960 * 3), str(64 << 10)]


@pytest.mark.parametrize("name", ["find_raising_line", "is_stop_request", "KeyboardInterrupt", "__doc__"])
def test_a_child_names_no_other_things_than_errors(name: str) -> None:
    """What a child reports is data: only names of wiw's exceptions are followed."""
    assert type(_build_error({"type": name, "text": "no"})) is RaisedError


@pytest.mark.parametrize("place", ["value", "error"])
def test_a_reply_nested_too_deep_is_none(place: str, tmp_path: Path) -> None:
    """Describing its value would otherwise end the run with a `RecursionError`."""
    nested: Any = "no"
    for _ in range(900):
        nested = [nested]
    reply = {"value": nested} if place == "value" else {"error": {"type": nested}}
    with pytest.raises(OSError, match="32 levels"):
        READERS["reply"].read(msgpack.packb(reply), tmp_path)


SHADED = (
    "import numpy as np, wiw\n"
    "from {helper} import SHADE\n"
    "class Own(wiw.WorldModel):\n"
    "    accepts = wiw.accepts(control='image', view='perspective', size=(64, 128), frames=3)\n"
    "    def rollout(self, observations, controls, seeds):\n"
    "        return np.full((len(controls), 3, 64, 128, 3), SHADE, np.uint8)\n"
)


def save_own(folder: Path, helper: str, shade: int) -> str:
    (folder / f"{helper}.py").write_text(f"SHADE = {shade}\n")
    (folder / "own.py").write_text(SHADED.format(helper=helper))
    return f"{folder / 'own.py'}:Own"


def find_shade(made: wiw.WorldModel) -> int:
    image = np.zeros((2, 64, 128, 3), np.uint8)
    return int(made.rollout(Conditioning(image), CONTROLS, np.zeros(2, np.uint64)).max())


def test_a_forked_process_makes_models_and_leaves_those_of_its_parent_alone(tmp_path) -> None:
    """Programs that make models fork workers of their own, such as of a data loader."""
    name = save_own(tmp_path, "forked_helper", 7)
    made = wiw.world_model(name)
    assert find_shade(made) == 7
    queue = get_context("fork").SimpleQueue()

    def work() -> None:
        queue.put((find_shade(wiw.world_model(name)), find_shade(made)))

    child = get_context("fork").Process(target=work)
    child.start()
    child.join(60)
    if hung := child.is_alive():
        child.kill()
    assert not hung and not queue.empty() and queue.get() == (7, 7)
    assert find_shade(made) == 7


def test_an_edited_module_next_to_a_model_is_seen(tmp_path) -> None:
    name = save_own(tmp_path, "edited_helper", 7)
    assert models.find_isolated_model(name).__name__ == "Own"  # its process waits, and nothing has been made in it
    save_own(tmp_path, "edited_helper", 8)
    assert find_shade(wiw.world_model(name)) == 8
    found = models.find_isolated_model(name)
    save_own(tmp_path, "edited_helper", 9)
    found.source.end_idle()
    with pytest.raises(InfrastructureError, match="has changed since it was loaded"):
        found.source.take_process(None)
