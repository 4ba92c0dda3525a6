# SPDX-License-Identifier: Apache-2.0
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from locations import PYTHON_TESTS
from tyro.constructors import StructTypeInfo

from wiw.cli import main
from wiw.cli.doctor import examine
from wiw.cli.flag_help import read_flags
from wiw.cli.options import parse_options
from wiw.cli.parts import AgentFlags
from wiw.errors import ArgumentError
from wiw.runs.pictures import choose_pictured_episodes
from wiw.scenes.scans import formats
from wiw.studies.run_log import load_run
from wiw.tasks.imagenav import ImageNav

FAKES = PYTHON_TESTS / "fakes.py"
TASK = f"{FAKES}:line_task"


def run(*arguments):
    return main(["run", TASK, "--policy", "heuristic", *map(str, arguments)])


def test_help_teaches_by_examples(capsys):
    for command, example in (
        ([], "wiw demo"),
        (["run"], "--arms none,copy,warp,oracle"),
        (["resume"], "wiw resume runs/first"),
        (["report"], "--out first.html"),
        (["view"], "--keep-images all"),
        (["serve"], "--world-model remote:ws://127.0.0.1:8765"),
        (["check-model"], "wiw check-model my_model.py:MyModel"),
        (["verify"], "--episodes 10"),
        (["export"], "--rerun first.rrd"),
        ([], "75 stopped by SIGTERM or SIGUSR2"),
        (["scenes"], "apartments:val:4"),
        (["demo"], "oracle, a reference"),
        (["collect"], "--out demos --workers 4"),
        (["episodes"], "--out val.json.gz"),
    ):
        with pytest.raises(SystemExit) as stop:
            main([*command, "--help"])
        assert stop.value.code == 0
        printed = capsys.readouterr().out
        assert example in " ".join(printed.split())
        assert len({line.index("$ wiw") for line in printed.splitlines() if "$ wiw" in line}) == 1, "not aligned"


@pytest.mark.parametrize("command", [["run"], ["scale"], ["episodes"], ["scenes", "draw"]])
def test_help_names_every_kind_of_scans(command, capsys):
    with pytest.raises(SystemExit):
        main([*command, "--help"])
    printed = capsys.readouterr().out
    assert [kind for kind in formats.KINDS if f"{kind}:DIR" not in printed] == []


def test_no_command_shows_help_and_a_wrong_one_is_refused(capsys):
    with pytest.raises(SystemExit):
        main([])
    assert "wiw demo" in capsys.readouterr().out
    for arguments, message in (
        (["rnu"], "no command 'wiw rnu'; expected one of demo, list, run,"),
        (["rnu"], "Did you mean run?"),
        (["data", "stat"], "expected one of verify, stats, show, export, import. Did you mean stats?"),
    ):
        assert main(arguments) == 2
        assert message in capsys.readouterr().err


def test_version(capsys):
    assert main(["--version"]) == 0 and capsys.readouterr().out.startswith("wiw ")


def test_list_names_everything_with_a_line(capsys):
    assert main(["list"]) == 0
    shown = capsys.readouterr().out
    for name in (
        "copy",
        "oracle",
        "matcher",
        "imagenav",
        "spl",
        "wiw.world_models",
        "Predict that every future frame",
    ):
        assert name in shown


def test_run_prints_a_table_and_writes_a_report(tmp_path, capsys):
    assert run("--episodes", 4, "--out", tmp_path / "run", "--seed", 3) == 0
    shown = capsys.readouterr().out
    assert "SR %" in shown and "none" in shown and " s to prepare scenes and episodes" in shown
    assert str(tmp_path / "run" / "report.html") in shown
    log = load_run(tmp_path / "run")
    assert log.complete and log.store.config["seed"] == 3
    assert (tmp_path / "run" / "report.html").stat().st_size > 10_000


def test_report_and_resume_of_a_finished_run(tmp_path, capsys):
    run("--episodes", 2, "--out", tmp_path / "run", "--no-report")
    assert not (tmp_path / "run" / "report.html").exists()
    assert main(["report", str(tmp_path / "run"), "--out", str(tmp_path / "x.html")]) == 0
    assert (tmp_path / "x.html").exists()
    before = list(load_run(tmp_path / "run").episodes)
    assert main(["resume", str(tmp_path / "run"), "--no-report"]) == 0
    assert list(load_run(tmp_path / "run").episodes) == before


def test_errors_are_printed_and_can_be_retried(tmp_path, capsys):
    assert run("--scenes", "broken", "--episodes", 3, "--out", tmp_path / "run", "--no-report") == 1
    shown = capsys.readouterr()
    assert "1 infrastructure error, excluded from scores" in shown.err
    assert "INVALID RUN" in shown.out and "2/3" in shown.out
    assert main(["resume", str(tmp_path / "run"), "--retry-errors", "--no-report"]) == 1
    assert "no such scene" in capsys.readouterr().err
    assert main(["resume", str(tmp_path / "run"), "--retry-failed", "--no-report"]) == 1  # the old name
    assert "no such scene" in capsys.readouterr().err


@pytest.fixture
def short(tmp_path):
    """A preset of one decision."""
    (tmp_path / "short.yaml").write_text("base: paper\ndecisions: 1\n")
    return str(tmp_path / "short.yaml")


def test_episodes_are_written_and_run_from_the_file(tmp_path, two_rooms, short, capsys, monkeypatch):
    folder = tmp_path / "scans"
    folder.mkdir()
    for name in ("two_rooms.obj", "two_rooms.mtl"):
        shutil.copy(Path(two_rooms).with_name(name), folder)
    monkeypatch.chdir(tmp_path)
    options = ["--episodes", "3", "--per-scene", "3", "--seed", "4"]
    assert main(["episodes", "imagenav", "--scenes", "scans/two_rooms.obj", *options, "--out", "scans/e.json.gz"]) == 0
    assert "3 episodes in 1 scene, " in capsys.readouterr().out
    folder = folder.rename(tmp_path / "moved")
    command = ["run", "imagenav", "--policy", "heuristic", "--episodes", "2", "--no-report", "--preset", short]
    assert main([*command, "--episode-file", "moved/e.json.gz", "--out", "run"]) == 0
    log = load_run("run")
    task = ImageNav(scenes=folder / "two_rooms.obj", per_scene=3, seed=4)
    assert log.store.episodes() == task.episodes(2)
    assert [row["status"] for row in log.episodes] == ["done", "done"]
    (tmp_path / "e.json.gz").write_bytes((folder / "e.json.gz").read_bytes())
    assert main([*command, "--episode-file", "e.json.gz", "--out", "lost"]) == 2
    assert "two_rooms.obj: no such file" in capsys.readouterr().err
    assert main([*command, "--episode-file", "e.json.gz", "--scene-folder", "moved", "--out", "found"]) == 0
    assert load_run("found").store.episodes() == task.episodes(2)
    again = ["episodes", "imagenav", "--scenes", "moved/two_rooms.obj", *options]
    assert main([*again, "--out", "moved/e.json.gz/below-a-file.json"]) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert main([*again, "--out", "new/folder/e.json"]) == 0 and Path("new/folder/e.json").exists()


def test_per_scene_is_an_option(tmp_path, two_rooms, short):
    command = ["run", "imagenav", "--scenes", two_rooms, "--policy", "heuristic", "--preset", short, "--no-report"]
    assert main([*command, "--episodes", "1", "--per-scene", "2", "--out", str(tmp_path / "run")]) == 0
    assert load_run(tmp_path / "run").store.config["task"]["per_scene"] == 2


OPTIONED = """
import numpy as np
import wiw


class Tinted(wiw.WorldModel):
    accepts = wiw.accepts(control="image")

    def __init__(self, weights: str = "", strength: float = 0.5):
        assert isinstance(weights, str) and isinstance(strength, float)
        self.weights, self.strength = weights, strength

    def rollout(self, observations, controls, seeds):
        frames = np.repeat(observations.image[:, None], 1 + len(controls[0].actions), axis=1)
        frames[:, 1:] = frames[:, 1:] * self.strength
        return frames
"""


def test_a_world_model_takes_options(tmp_path, two_rooms, short, capsys):
    (tmp_path / "tinted.py").write_text(OPTIONED)
    task = ["run", "imagenav", "--scenes", two_rooms, "--preset", short, "--episodes", "1", "--no-report"]
    model = ["--world-model", f"{tmp_path}/tinted.py:Tinted"]
    options = ["--world-model-option", "weights=123", "--world-model-option", "strength=0.25"]
    arms = ["--arms", "none,placebo-shuffled", "--out", str(tmp_path / "run")]
    assert main([*task, *model, *options, *arms]) == 0
    agents = load_run(tmp_path / "run").store.info["agents"]
    taken = {arm: agent["model_options"] for arm, agent in agents.items()}
    given = {"weights": "123", "strength": 0.25}
    assert taken == {"none": {}, "placebo-shuffled": given, "Tinted": given}
    assert main(["resume", str(tmp_path / "run"), "--no-report"]) == 0
    for wrong, said in (
        ("weights", "KEY=VALUE"),
        ("speed=3", "unexpected keyword"),
        ("strength=[", "not valid YAML"),
        ("strength=2026-13-40", "not valid YAML"),
        (r'strength="\Ud80088888888"', "not valid YAML"),
    ):
        assert main([*task, *model, "--world-model-option", wrong, "--out", str(tmp_path / "again")]) == 2
        assert said in capsys.readouterr().err
        assert not (tmp_path / "again").exists()  # so that the same folder may be named once it is put right
    assert main([*task, "--world-model-option", "steps=3"]) == 2
    assert main([*task, "--policy-option", "steps=3", "--out", str(tmp_path / "run")]) == 2  # where a run is already
    assert load_run(tmp_path / "run").episodes


def test_files_in_options_are_named_from_the_root_on(tmp_path, monkeypatch):
    def factory(weights: "str | Path", prompts: "Path | None" = None, cache: "str | Path" = "auto", text: str = ""):
        """Annotated as text, as with `from __future__ import annotations`."""

    def other(weights="hub/name", checkpoint: str = "", folder: Path | None = None):
        """Annotated as they are, or not at all."""

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("w: 1", "auto"):
        (tmp_path / name).touch()
    there = str(tmp_path / "w: 1")
    options = parse_options(["weights=w: 1", "prompts=~/w: 1", "cache=auto", "text=auto"], factory, "--x")
    assert options == {"weights": there, "prompts": there, "cache": "auto", "text": "auto"}
    given = ["weights=w: 1", "checkpoint=auto", "folder=./auto"]
    auto = str(tmp_path / "auto")
    assert parse_options(given, other, "--x") == {"weights": there, "checkpoint": auto, "folder": auto}
    missing = ["weights=hub/none", "checkpoint=", "folder=null"]
    assert parse_options(missing, other, "--x") == {"weights": "hub/none", "checkpoint": "", "folder": None}


def test_a_task_takes_options(tmp_path, two_rooms, short, capsys):
    task = ["run", "imagenav", "--scenes", two_rooms, "--preset", short, "--episodes", "1", "--no-report"]
    options = ["--task-option", "radius=9", "--task-option", "spl=actions"]
    assert main([*task, *options, "--out", str(tmp_path / "run")]) == 0
    log = load_run(tmp_path / "run")
    said = log.store.config["task"]
    assert (said["radius"], said["spl"], log.episodes[0]["metrics"]["success"]) == (9.0, "actions", 1.0)
    assert main(["resume", str(tmp_path / "run"), "--no-report"]) == 0
    for wrong, message in (
        ("radius=wide", "radius: expected a number"),
        ("radios=9", "unknown option 'radios'"),
        ("seed=3", "--seed"),
        ("radius", "KEY=VALUE"),
    ):
        assert main([*task, "--task-option", wrong, "--out", str(tmp_path / wrong)]) == 2
        assert message in capsys.readouterr().err


def test_scaling_and_episodes_take_a_tasks_options_too(tmp_path, two_rooms, short, capsys):
    task = ["scale", "imagenav", "--scenes", two_rooms, "--preset", short, "--episodes", "1", "--candidates", "1"]
    options = ["--task-option", "radius=9", "--world-model", "copy", "--out", str(tmp_path / "run")]
    assert main([*task, *options]) == 0
    run_store = load_run(tmp_path / "run").store
    assert run_store.config["task"]["radius"] == 9.0 and not choose_pictured_episodes(run_store)
    pictured = [*options[:-1], str(tmp_path / "pictured"), "--keep-images", "2"]
    assert main([*task, *pictured]) == 0 and choose_pictured_episodes(load_run(tmp_path / "pictured").store)
    table = ["scale", "manipulation", "--tasks", "push_buttons", "--world-model", "copy", "--episodes", "1"]
    (tmp_path / "notes.txt").write_text("mine")
    assert main([*table, "--policy-option", "turned=1", "--out", str(tmp_path)]) == 2
    assert "unexpected keyword argument 'turned'" in capsys.readouterr().err
    assert {each.name for each in tmp_path.iterdir()} >= {"notes.txt"} and not (tmp_path / "run.sqlite").exists()
    made = ["episodes", "ar", "--scenes", two_rooms, "--out", str(tmp_path / "ar.json")]
    assert main([*made, "--task-option", "categories=bathtub, coffee table"]) == 2
    assert "has no object of the categories bathtub, coffee table" in capsys.readouterr().err


def test_errors_are_one_clean_line(tmp_path, capsys):
    assert run("--world-model", "wrap", "--out", tmp_path / "a") == 2
    message = capsys.readouterr().err
    assert message.startswith("wiw: ") and "Did you mean warp" in message and "Traceback" not in message
    assert main(["report", str(tmp_path / "nowhere")]) == 2
    assert "no run at" in capsys.readouterr().err
    run("--episodes", 1, "--out", tmp_path / "b", "--no-report")
    assert run("--episodes", 1, "--out", tmp_path / "b") == 2
    assert "wiw resume" in capsys.readouterr().err


def test_a_run_that_could_not_begin_leaves_nothing_behind(tmp_path, capsys, monkeypatch):
    """The server expects a different token: once it has the right one, the same command begins the run."""
    from wiw.serving.background import serve_in_background

    monkeypatch.delenv("WIW_TOKEN", raising=False)
    with serve_in_background("copy", token="right") as server:
        asked = ["--revision", "matcher", "--world-model", f"remote:{server.address}", "--episodes", 1]
        asked += ["--no-report", "--out", tmp_path / "run"]
        for token in (None, "wrong"):
            if token is not None:
                monkeypatch.setenv("WIW_TOKEN", token)
            assert run(*asked) == 2
            assert "expects a different token" in capsys.readouterr().err
            assert not (tmp_path / "run").exists()


def test_a_run_that_stops_after_it_recorded_something_stays(tmp_path):
    (tmp_path / "bad.py").write_text(
        "import wiw\n"
        "class Bad(wiw.policies.base.Policy):\n"
        "    def propose(self, situations, candidates, horizon):\n"
        "        return None if situations[0].key.decision else "
        "[[wiw.types.Proposal(__import__('numpy').ones(3, 'int8'))]] * len(situations)\n"
        "    def score(self, situations, proposals, rollouts):\n"
        "        return [[0.0]] * len(situations)\n"
    )
    assert main(["run", TASK, "--policy", f"{tmp_path / 'bad.py'}:Bad", "--out", str(tmp_path / "run")]) == 2
    assert (tmp_path / "run/run.sqlite").exists()


def test_errors_bring_no_escape_sequences_to_the_terminal(tmp_path, capsys):
    assert main(["report", f"{tmp_path}/\x1b[31mred\x1b]0;title\x07\x9b2J\x1b(B\rover\x08"]) == 2
    shown = capsys.readouterr().err
    assert f"no run at {tmp_path}/redover: expected" in shown
    assert not set(shown) & {chr(code) for code in (*range(10), *range(11, 32), *range(127, 160))}


GONE = """
import sys
sys.path.insert(0, {here!r})
from fakes import LineEnv, LineTask

class Env(LineEnv):
    def begin(self, episode):
        raise OSError("\\x1b[31mgone")

class Gone(LineTask):
    def environment(self, depth=False):
        return Env(self)

def task(scenes="", seed=0, preset="", backend="", **rules):
    return Gone(seed=seed)
"""


def test_causes_of_failed_episodes_bring_no_escape_sequences(tmp_path, capsys):
    (tmp_path / "gone.py").write_text(GONE.format(here=str(FAKES.parent)))
    command = ["run", f"{tmp_path / 'gone.py'}:task", "--policy", "heuristic", "--episodes", "2", "--no-report"]
    assert main([*command, "--out", str(tmp_path / "run")]) == 1
    shown = capsys.readouterr().err
    assert "OSError: gone" in shown and "\x1b" not in shown


def test_debug_shows_the_traceback(tmp_path):
    with pytest.raises(Exception, match="no run at"):
        main(["report", str(tmp_path), "--debug"])


def start(*arguments):
    paths = os.pathsep.join(sys.path)
    # Where tests run as a background job, SIGINT is ignored and would stay so in the child.
    wiw = ["env", "--default-signal=INT", sys.executable, "-m", "wiw.cli"]
    command = [*wiw, "run", TASK, "--policy", "heuristic", *map(str, arguments)]
    return subprocess.Popen(command, env={**os.environ, "PYTHONPATH": paths}, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
def test_a_stopped_run_says_how_to_go_on(tmp_path, sent, code):
    out = tmp_path / "run"
    process = start("--scenes", "slow", "--episodes", 30, "--live", 1, "--out", out, "--workers", 2)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (out.exists() and ended(out)):
        time.sleep(0.05)
    process.send_signal(sent)
    _, shown = process.communicate(timeout=20)
    assert process.returncode == code, shown
    assert f"wiw resume {out}" in shown and "Traceback" not in shown
    assert 0 < len(load_run(out).episodes) < 30
    assert main(["resume", str(out), "--no-report", "--workers", "1"]) == 0
    assert load_run(out).complete


def ended(out):
    try:
        return len(load_run(out).episodes) > 2
    except Exception:
        return False


def test_doctor_names_what_matters(capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    assert main(["doctor"]) == 0
    shown = capsys.readouterr().out
    for name in ("python", "processor", "threads", "instructions", "memory", "torch", "runs folder", "scene cache"):
        assert name in shown
    assert "torch" not in sys.modules


def test_doctor_warns_with_a_remedy(monkeypatch, tmp_path):
    monkeypatch.setattr(os, "access", lambda *_: False)
    findings = {finding.name: finding for finding in examine()}
    assert "not writable" in findings["runs folder"].remedy and findings["wiw"].remedy == ""


def test_doctor_says_where_scenes_are_kept_and_how_big_they_are(monkeypatch, tmp_path):
    monkeypatch.setenv("WIW_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("wiw.cli.doctor._count_free_gigabytes", lambda folder: 20.0)  # however full the disk is
    found = {finding.name: finding for finding in examine()}["scene cache"]
    assert str(tmp_path / "cache" / "scenes") in found.detail and "0 files, 0 MB" in found.detail and not found.remedy
    monkeypatch.setenv("WIW_CACHE_GB", "0.5")
    assert "at most 0.5 GB" in {finding.name: finding for finding in examine()}["scene cache"].detail
    (tmp_path / "cache" / "scenes").mkdir(parents=True)
    (tmp_path / "cache" / "scenes" / "a.wiwscene").write_bytes(bytes(3 << 20))
    assert "1 files, 3 MB" in {finding.name: finding for finding in examine()}["scene cache"].detail
    monkeypatch.setattr("wiw.cli.doctor._count_free_gigabytes", lambda folder: 0.5)
    assert "nearly full" in {finding.name: finding for finding in examine()}["scene cache"].remedy
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "set WIW_CACHE" in {finding.name: finding for finding in examine()}["scene cache"].remedy


def test_scenes_draws_a_sheet(tmp_path, capsys):
    pytest.importorskip("PIL")
    from PIL import Image

    mesh = tmp_path / "room.obj"
    mesh.write_text(ROOM)
    assert main(["scenes", str(mesh), "--out", str(tmp_path / "sheet.png"), "--views", "1"]) == 0
    assert "room.obj" in capsys.readouterr().out
    assert Image.open(tmp_path / "sheet.png").width > 500


ROOM = """v -2 0 -2
v 2 0 -2
v 2 0 2
v -2 0 2
v -2 2 -2
v 2 2 -2
f 1 4 3 2
f 1 2 6 5
"""


def test_each_task_names_the_policy_that_runs_it():
    from wiw.registry import POLICIES, TASKS
    from wiw.runs.recipes import TaskRecipe

    found = [TaskRecipe(name).find_policy() for name in ("imagenav", "ar", "manipulation")]
    assert found == ["matcher", "recogniser", "scripted"]
    named = [name for name in TASKS.names() if TASKS.find(name).default_policy]
    assert {TaskRecipe(name).find_policy() for name in named} <= set(POLICIES.names())
    assert TaskRecipe("imagenav", {"preset": "foresight"}).find_policy() == "navigator"
    assert TaskRecipe("ar", {"preset": "foresight"}).find_policy() == "recogniser"
    with pytest.raises(ArgumentError, match="has no default policy"):
        TaskRecipe(f"{PYTHON_TESTS / 'fakes.py'}:LineTask").find_policy()


def test_descriptions_of_flags_are_paragraphs(capsys):
    with suppress(SystemExit):
        main(["run", "--help"])
    words = " ".join(" ".join(line.strip("│ ") for line in capsys.readouterr().out.splitlines()).split())
    assert "repeated. isolate=false runs your own model in the run's process. (repeatable)" in words
    assert "Default: the policy's own choice. --revision-option" in words  # and no "(default: None)"
    flags = StructTypeInfo.make(AgentFlags, AgentFlags(), False)
    texts = {field.name: field.helptext() for field in read_flags(flags).fields}
    assert all(texts.values()) and not any("\n" in text for text in texts.values())


LEAVING = """
import sys
import threading

import wiw


class Quits(wiw.WorldModel):
    accepts = wiw.accepts(control="image", size=(48, 96))

    def rollout(self, observations, controls, seeds):
        sys.exit(0)


class Unmade(Quits):
    def __init__(self):
        sys.exit(0)


class Endless(Quits):
    def __init__(self):
        threading.Event().wait()
"""


def test_a_model_that_calls_exit_ends_no_command(tmp_path, two_rooms, short, capsys, monkeypatch):
    monkeypatch.setattr("wiw.loop.attempts.PAUSES", (0.0, 0.0))
    file = tmp_path / "leaving.py"
    file.write_text(LEAVING)
    command = ["run", "imagenav", "--scenes", two_rooms, "--preset", str(short), "--episodes", "1"]

    def ends(model, *more):
        out = tmp_path / model
        code = main([*command, "--world-model", f"{file}:{model}", "--out", str(out), "--no-report", *more])
        return code, capsys.readouterr().err

    code, said = ends("Quits")
    assert code == 1 and "1 infrastructure error, excluded from scores" in said and "SystemExit(0)" in said
    code, said = ends("Unmade")
    assert code == 2 and "cannot be built: SystemExit: 0 (leaving.py, line 17)" in said and "Traceback" not in said
    code, said = ends("Endless", "--deadline", "0.2")
    assert code == 2 and "did not return within 0.2 s" in said and "Traceback" not in said
    for model, kind in (("Quits", "raised"), ("Unmade", "raised"), ("Endless", "deadline")):
        assert main(["check-model", f"{file}:{model}", "--scenes", two_rooms, "--deadline", "5"]) == 1
        assert kind in capsys.readouterr().out
    file.write_text("import sys\nsys.exit(0)\n")
    code, said = ends("Quits", "--seed", "1")
    assert code == 2 and "cannot be loaded: SystemExit: 0 (leaving.py, line 2)" in said


def test_the_check_of_a_served_model_says_what_it_cannot_see(two_rooms, capsys):
    from wiw.serving.background import serve_in_background

    with serve_in_background("copy") as server:
        assert main(["check-model", f"remote:{server.address}", "--scenes", two_rooms]) == 0
    said = capsys.readouterr().out
    unseen = [line.split()[1] for line in said.splitlines() if "check-model` on the server's machine" in line]
    assert unseen == ["training", "inputs", "memory"]
    assert all(f"skipped  {name}" in said for name in unseen)
