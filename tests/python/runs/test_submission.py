# SPDX-License-Identifier: Apache-2.0
"""Runs submitted as jobs, by submitit's local executor and by a SLURM that this machine plays."""

from __future__ import annotations

import json
import os
import shlex
import signal
import stat
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from locations import PYTHON_TESTS

import wiw
from wiw.cli import main
from wiw.cli.command_line import format_flags
from wiw.cli.parts import AgentFlags, TaskFlags
from wiw.cli.stop import LAST
from wiw.errors import ArgumentError, DependencyError, InfrastructureError, StoreError
from wiw.loop.config import AgentConfig
from wiw.runs.config import RunConfig
from wiw.runs.hidden_secrets import SECRETS, hide_secrets
from wiw.runs.submission import (
    LOGS,
    PATIENCE,
    SIGNAL_DELAY,
    STOP_SECONDS,
    ClusterConfig,
    JobCommand,
    SubmittedJob,
    cancel,
    find_states,
    read_jobs,
    submit_commands,
)
from wiw.studies.run_log import load_run

submitit = pytest.importorskip("submitit", reason="needs submitit: pip install 'wiw[slurm]'")

TASK = f"{PYTHON_TESTS / 'fakes.py'}:line_task"


@pytest.fixture(autouse=True)
def environment(tmp_path, monkeypatch):
    """Jobs import what the tests do, and have a disk of their own."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    monkeypatch.setenv("SLURM_TMPDIR", str(tmp_path / "disk"))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def submit(out, *arguments, episodes=6, scenes="", shards=2, cluster="local"):
    own = ["--policy", "heuristic", "--episodes", episodes, "--shards", shards, "--cluster", cluster, "--out", out]
    return main(["submit", TASK, *map(str, own), *(["--scenes", scenes] if scenes else []), *map(str, arguments)])


def wait_for(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "nothing happened"
        time.sleep(0.05)


def have_jobs_ended(out):
    return lambda: all(job.state not in ("RUNNING", "PENDING") for job in find_states(out))


def logs(out):
    return "\n".join(
        f"{path}:\n{path.read_text()}" for path in sorted((out / LOGS).glob("*.*")) if path.suffix != ".pkl"
    )


def test_flags_are_written_as_they_are_read(capsys):
    """Every flag of `wiw run` comes back from the text, as the command line reads it."""
    import tyro

    config = (tyro.conf.OmitArgPrefixes,)
    for settings in (
        RunConfig(episodes=7, seed=3, out=Path("a b/c"), keep_images="all", progress=False, fidelity=True, resume=True),
        RunConfig(shard="2/3", scratch=Path("/tmp"), deadline=12.5, cache="off", live=9, workers=2),
        AgentFlags(world_model="svd", world_model_option=("steps=3", "a=b c"), vlm="http://h/v1", prompts="p q"),
        AgentFlags(policy="vlm", vlm_prices=Path("p.yaml"), tracker="sam2", tracker_option=("weights=w",)),
        TaskFlags(scenes="apartments:val", task_option=("decisions=2",), motion="slide", backend="cpu"),
        AgentConfig(depth=2, width=3, execute=-1, candidates=4),
    ):
        assert tyro.cli(type(settings), args=format_flags(settings), config=config) == settings
        assert format_flags(type(settings)()) == []


def test_each_job_is_a_command_for_a_person(tmp_path, capsys):
    assert submit(tmp_path / "run", "--dry-run", "--arms", "none,heuristic+none", "--seed", "3") == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("wiw run")]
    assert len(lines) == 2 and not (tmp_path / "run" / "jobs.json").exists()
    for line in lines:
        assert main(shlex.split(line)[1:]) == 0
    wiw.merge([tmp_path / "run"], tmp_path / "run")
    log = load_run(tmp_path / "run")
    assert log.complete and log.arms == ["none", "heuristic"] and log.store.config["seed"] == 3


def test_jobs_run_are_shown_and_merged(tmp_path, capsys):
    out = tmp_path / "run"
    assert submit(out) == 0
    wait_for(have_jobs_ended(out))
    assert wiw.status(out).ended == 6, logs(out)
    assert main(["status", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "6/6" in shown and f"job {read_jobs(out)[0].id}  ENDED" in shown and "1/2" in shown
    assert main(["merge", str(out), "--out", str(out)]) == 0
    assert load_run(out).complete and wiw.verify(out).same
    assert submit(out) == 0
    shown = capsys.readouterr().out.partition("2 stores")[2]
    assert len(read_jobs(out)) == 2 and "wiw run" not in shown and "there is nothing to submit" in shown
    with pytest.raises(ArgumentError, match="was submitted with other flags"):
        raise_from_main(out, "--seed", 4)


def raise_from_main(out, *arguments):
    """Raise what the command line prints."""
    submit(out, "--debug", *arguments)


def find_children(process):
    return [int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def test_a_job_that_is_interrupted_is_requeued_and_goes_on(tmp_path):
    """SIGUSR2 goes to submitit's process, as from SLURM before the time limit; then to the command as well."""
    out = tmp_path / "run"
    assert submit(out, "--live", 1, scenes="slow", shards=1, episodes=8) == 0
    (job,) = read_jobs(out)
    for count, whole_job in ((2, False), (4, True)):
        wait_for(lambda count=count: (out / "shard-1-of-1/run.sqlite").exists() and count_decisions(tmp_path) >= count)
        (task,) = find_children(int(job.id))
        for process in [*(find_children(task) if whole_job else []), task]:
            os.kill(process, signal.SIGUSR2)
        wait_for(lambda task=task: find_children(int(job.id)) not in ([task], []))
    wait_for(have_jobs_ended(out))
    log = load_run(out / "shard-1-of-1")
    assert log.complete and len(log.episodes) == 8, logs(out)
    assert logs(out).count("Requeued job") == 2 and "Traceback" not in logs(out)
    assert log.store.info["session"]["ended"] > 0  # the last process went on with what was there


def count_decisions(tmp_path):
    """Return how many episodes have ended in the store that the job writes on its own disk."""
    found = list((tmp_path / "disk").rglob("run.sqlite"))
    try:
        return sum(len(load_run(path).episodes) for path in found)
    except StoreError:  # being made, or copied home just now
        return 0


def test_cancelled_jobs_end_and_keep_what_is_recorded(tmp_path, capsys):
    out = tmp_path / "run"
    assert submit(out, "--live", 1, scenes="slow", shards=1, episodes=40) == 0
    wait_for(lambda: count_decisions(tmp_path) >= 2)
    with pytest.raises(ArgumentError, match=r"is RUNNING \(1 active in all\); wait for them, or `wiw cancel"):
        submit_again = ["--live", 1, "--debug"]
        submit(out, *submit_again, scenes="slow", shards=1, episodes=40)
    assert main(["cancel", str(out)]) == 0 and "canceled 1 jobs" in capsys.readouterr().out
    wait_for(have_jobs_ended(out))
    found = wiw.status(out)
    assert 2 <= found.ended < 40 and found.stores[0].state == "stopped"
    assert cancel(out) == []  # nobody is there
    with pytest.raises(StoreError, match="no jobs of"):
        cancel(tmp_path)


def test_a_command_that_fails_is_an_error_of_its_job(tmp_path):
    with pytest.raises(InfrastructureError, match="exit code 2 of: wiw run nothing"):
        JobCommand(["run", "nothing"])()


def test_a_command_that_crashes_is_an_error_of_its_job_and_one_with_an_invalid_run_is_none(tmp_path):
    """Both exit with code 1."""
    (tmp_path / "bad.py").write_text(
        "import wiw\nclass Bad(wiw.Policy):\n    propose = None\n    def describe(self):\n        1 / 0\n"
    )
    options = ["--episodes", "4", "--no-progress", "--no-report"]
    crashing = [*options, "--policy", f"{tmp_path}/bad.py:Bad", "--out", str(tmp_path / "crashed")]
    with pytest.raises(InfrastructureError, match="exit code 1 of: wiw run"):
        JobCommand(["run", TASK, *crashing])()
    broken = [*options, "--scenes", "broken", "--policy", "heuristic", "--out", str(tmp_path / "invalid")]
    assert JobCommand(["run", TASK, *broken])() == 1


def test_without_slurm_or_submitit_it_is_said(tmp_path, monkeypatch):
    with pytest.raises(InfrastructureError, match=r"srun.*--cluster local"):
        submit_commands(tmp_path, [["--version"]], ClusterConfig())
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(DependencyError, match=r"wiw\[slurm\]"):
        submit_commands(tmp_path, [["--version"]], ClusterConfig())
    for name in ("minutes", "gpus", "cpus", "requeues", "parallel"):
        with pytest.raises(ArgumentError, match=f"submit: expected {name} of at least"):
            replace(ClusterConfig(), **{name: -1})
    (tmp_path / "jobs.json").write_text("[{}]")
    with pytest.raises(StoreError, match="damaged"):
        read_jobs(tmp_path)


def test_servers_are_jobs_that_all_shards_ask(tmp_path, two_rooms, capsys):
    out = tmp_path / "run"
    (tmp_path / "short.yaml").write_text("base: paper\ndecisions: 1\n")
    asked = ["imagenav", "--scenes", two_rooms, "--preset", tmp_path / "short.yaml", "--policy", "heuristic"]
    asked += ["--revision", "matcher", "--episodes", 2, "--candidates", 1, "--world-model", "warp", "--backend", "cpu"]
    asked += ["--arms", "none,warp"]
    jobs = ["--shards", 1, "--servers", 1, "--server-gpus", 0, "--cluster", "local", "--out", out]
    assert main(["submit", *map(str, [*asked, *jobs])]) == 0
    lines = [shlex.split(line)[1:] for line in capsys.readouterr().out.splitlines() if line.startswith("wiw ")]
    assert [line[0] for line in lines] == ["serve", "run"]
    file = out / "servers/1.json"
    wait_for(file.exists)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600 and json.loads(file.read_text())["token"]
    wait_for(lambda: [job.state for job in find_states(out)] == ["RUNNING", "ENDED"], 120)
    assert main(["run", *map(str, asked), "--out", str(tmp_path / "whole"), "--no-report"]) == 0
    assert wiw.merge([out], out).complete, logs(out)
    one, other = load_run(out), load_run(tmp_path / "whole")
    assert one.arms == other.arms == ["none", "warp"]
    assert one.store.config["arms"][1]["agent"]["model"] == f"remote:{file.parent}"
    assert [row["scores"] for row in one.decisions] == [row["scores"] for row in other.decisions]
    assert main(["submit", *map(str, [*asked, *jobs])]) == 0  # nothing is left, though a server is there
    assert len(cancel(out)) == 1
    wait_for(have_jobs_ended(out))
    assert not file.exists()
    with pytest.raises(ArgumentError, match="--servers serve --world-model"):
        submit(tmp_path / "other", "--servers", 1, "--debug")


def test_servers_of_the_language_model_are_jobs_that_all_shards_ask(tmp_path, two_rooms, capsys):
    """The answers are those of the model in the process of a run, though one of the two servers is killed."""
    pytest.importorskip("openai", reason="needs wiw[vlm]")
    out = tmp_path / "run"
    asked = ["imagenav", "--scenes", two_rooms, "--policy", "vlm", "--vlm", "mock", "--episodes", 2, "--backend", "cpu"]
    asked += ["--policy-option", "cache=off", "--salt", "", "--task-option", "decisions=1"]
    jobs = ["--shards", 2, "--vlm-servers", 2, "--vlm-server-gpus", 0, "--cluster", "local", "--out", out]
    assert main(["submit", *map(str, [*asked, *jobs])]) == 0
    lines = [shlex.split(line)[1:] for line in capsys.readouterr().out.splitlines() if line.startswith("wiw ")]
    assert [line[0] for line in lines] == ["serve-vlm", "serve-vlm", "run", "run"]
    assert [line[line.index("--vlm") + 1] for line in lines[2:]] == [f"remote:{out}/vlm-servers"] * 2
    assert not [part for line in lines[2:] for part in line if part.startswith("--vlm-server")]
    wait_for((out / "vlm-servers/1.json").exists)
    (task,) = find_children(int(read_jobs(out)[0].id))
    (server,) = find_children(task)
    os.kill(server, signal.SIGKILL)
    ended = ["ENDED", "RUNNING", "ENDED", "ENDED"]
    wait_for(lambda: [job.state for job in find_states(out)] == ended, 120)
    assert main(["run", *map(str, asked), "--out", str(tmp_path / "whole"), "--no-report"]) == 0
    assert wiw.merge([out], out).complete, logs(out)
    one, other = load_run(out), load_run(tmp_path / "whole")
    assert [row["status"] for row in one.episodes] == ["done", "done"]
    assert [row["actions"] for row in one.decisions] == [row["actions"] for row in other.decisions]
    assert len(cancel(out)) == 1
    wait_for(have_jobs_ended(out))
    assert not (out / "vlm-servers/2.json").exists()


def test_servers_of_two_kinds_ask_for_their_own_gpus(tmp_path, monkeypatch):
    """Each number of GPUs is an array of its own, and the shards, which need none, wait for all of them."""
    arrays = []

    def note(run, commands, config, name="wiw", after=()):
        arrays.append(([command[0] for command in commands], config.gpus, config.partition, [job.id for job in after]))
        return [SubmittedJob("slurm", f"{len(arrays)}_{place}", tuple(each)) for place, each in enumerate(commands)]

    monkeypatch.setattr("wiw.runs.submission.submit_commands", note)
    asked = ["--world-model", "warp", "--vlm", "mock", "--policy", "vlm", "--servers", 2, "--vlm-servers", 1]
    asked += ["--vlm-server-gpus", 2, "--server-partition", "gpu", "--partition", "cpu", "--shards", 2]
    assert main(["submit", "imagenav", *map(str, asked), "--out", str(tmp_path / "run")]) == 0
    assert arrays == [
        (["serve", "serve"], 1, "gpu", []),
        (["serve-vlm"], 2, "gpu", []),
        (["run", "run"], 0, "cpu", ["1_0", "1_1", "2_0"]),
    ]
    with pytest.raises(ArgumentError, match="vlm_servers: expected one language model"):
        submit(tmp_path / "other", "--vlm-servers", 1, "--debug")
    asked = ["submit", "imagenav", "--revision", "vlm", "--vlm-servers", "1", "--out", str(tmp_path / "b"), "--debug"]
    with pytest.raises(ArgumentError, match="name it there, not as an option"):
        main([*asked, "--revision-option", "vlm=mock"])
    with pytest.raises(ArgumentError, match="device and dtype are for a model in the worker process"):
        main([*asked, "--vlm", "mock", "--revision-option", "dtype=bfloat16", "--revision-option", "device=cpu"])


def test_shards_with_errors_are_submitted_again_when_asked(tmp_path, capsys):
    out = tmp_path / "run"
    assert submit(out, scenes="broken") == 0
    wait_for(have_jobs_ended(out))
    before = wiw.status(out)
    assert (before.ended, before.errors) == (6, 1), logs(out)
    assert submit(out, scenes="broken") == 0
    assert "nothing to submit\n1 episodes ended with an error: once" in capsys.readouterr().out
    assert main(["merge", str(out), "--out", str(out)]) == 0  # as it is printed, before and after the second round
    assert wiw.status(out) == before
    assert submit(out, "--retry-errors", scenes="broken") == 0
    lines = [shlex.split(line)[1:] for line in capsys.readouterr().out.splitlines() if line.startswith("wiw ")]
    assert [line[:3] for line in lines] == [["resume", str(out / "shard-1-of-2"), "--retry-errors"]]
    wait_for(have_jobs_ended(out))
    after = wiw.status(out)
    assert (after.ended, after.errors) == (6, 1) and after.stores[0].written > before.stores[0].written, logs(out)
    assert after.stores[1].written == before.stores[1].written
    assert main(["merge", str(out), "--out", str(out)]) == 0
    assert submit(out, scenes="broken") == 0  # as before: retries are no other flags


def test_every_arm_of_the_served_model_asks_the_servers(tmp_path, capsys):
    out = tmp_path / "run"
    arms = "none,mine=warp?size=[36,64],reseeded:warp?size=[36,64],placebo-shuffled,heuristic+warp?size=[36,64]"
    asked = ["imagenav", "--world-model", "warp", "--world-model-option", "size=[36,64]", "--arms", arms]
    jobs = ["--shards", "1", "--servers", "1", "--dry-run", "--out", str(out)]
    assert main(["submit", *asked, *jobs]) == 0
    lines = [shlex.split(line)[1:] for line in capsys.readouterr().out.splitlines() if line.startswith("wiw ")]
    served, run = f"remote:{out}/servers", lines[1]
    assert run[run.index("--arms") + 1].split(",") == [
        "none",
        f"mine={served}",
        f"reseeded:warp=reseeded:{served}",
        "placebo-shuffled",
        f"heuristic+warp=heuristic+{served}",
        f"warp={served}",
    ]
    assert run[run.index("--world-model") + 1] == served and "--world-model-option" not in run


ROLES = '{"proposal": {"model": "small", "key": "sk-1"}}'


@pytest.mark.parametrize(
    ("variable", "arguments"),
    [
        ("OPENAI_API_KEY", ["--policy", "vlm", "--policy-option", "key=sk-1"]),
        ("OPENAI_API_KEY", ["--revision", "vlm", "--revision-option", "key=sk-1"]),
        ("OPENAI_API_KEY", ["--policy", "vlm", "--vlm-model", "big", "--policy-option", f"roles={ROLES}"]),
        ("WIW_TOKEN", ["--world-model", "remote:ws://h:1", "--world-model-option", "token=sk-1"]),
        ("WIW_TOKEN", ["--world-model", "remote:ws://h:1", "--world-model-option", "token=sk-1", "--arms", "none"]),
        ("WIW_TOKEN", ["--arms", "none,far=remote:ws://h:1?token=sk-1"]),
    ],
)
def test_secrets_are_neither_printed_nor_written(tmp_path, capsys, variable, arguments):
    with pytest.raises(ArgumentError, match=f"is a secret, .* leave it out and set {variable}") as error:
        main(["submit", "imagenav", "--dry-run", "--out", str(tmp_path / "run"), *arguments, "--debug"])
    shown = capsys.readouterr()
    assert "sk-1" not in f"{error.value}{shown.out}{shown.err}" and not (tmp_path / "run").exists()


def test_what_submit_refuses_as_a_secret_stores_hide():
    assert hide_secrets([f"{name}=sk-1" for name in SECRETS]) == [f"{name}=***" for name in SECRETS]


def test_an_arm_may_be_named_like_a_secret(tmp_path, capsys):
    arms = ["--arms", "token=copy,key=none", "--policy", "heuristic", "--revision", "matcher"]
    assert main(["submit", "imagenav", "--dry-run", "--shards", "1", "--out", str(tmp_path), *arms]) == 0


@pytest.mark.parametrize("flag", [("--server-partition", "gpu"), ("--server-memory", "8")])
def test_resources_of_no_servers_are_refused(tmp_path, flag):
    with pytest.raises(ArgumentError, match=f"{flag[0]} is for the jobs of --servers and --vlm-servers"):
        submit(tmp_path / "run", *flag, "--debug")


def test_servers_ask_for_resources_of_their_own_and_all_run_at_once(tmp_path, monkeypatch):
    """Shards wait until all of them have begun; a server waits for them longer than it does without any of them."""
    submitted = []

    def submit_commands(folder, commands, config, name="wiw", after=()):
        submitted.append((list(commands), config, len(after)))
        return [SubmittedJob("slurm", f"7_{place}", tuple(own)) for place, own in enumerate(commands)]

    monkeypatch.setattr("wiw.runs.submission.submit_commands", submit_commands)
    asked = ["--shards", 8, "--parallel", 2, "--memory", 4, "--cpus", 3, "--constraint", "small", "--account", "lab"]
    asked += ["--partition", "cpu", "--servers", 4, "--server-partition", "gpu", "--server-memory", 64]
    made = ["--policy", "heuristic", "--world-model", "warp", "--episodes", 8, "--out", tmp_path / "run"]
    assert main(["submit", TASK, *map(str, [*made, *asked])]) == 0
    (servers, own, _), (shards, theirs, begun) = submitted
    assert (len(servers), own.parallel, own.partition, own.gpus, own.account) == (4, 4, "gpu", 1, "lab")
    assert (own.memory, own.cpus, own.constraint) == (64, None, None)
    assert (len(shards), theirs.parallel, theirs.memory, theirs.cpus, begun) == (8, 2, 4, 3, 4)
    for command in servers:
        idle, first = (float(command[command.index(flag) + 1]) for flag in ("--idle", "--await-first"))
        assert idle <= 3600 and first >= 86400


def test_a_model_in_a_file_is_served_whatever_folder_it_is_named_from(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    body = "accepts = wiw.accepts('trajectory', size=(8, 16))\n    rollout = None\n"
    (tmp_path / "mine.py").write_text(f"import wiw\n\nclass M(wiw.WorldModel):\n    {body}")
    asked = ["--policy", "heuristic", "--world-model", "mine.py:M", "--servers", "1", "--shards", "1", "--dry-run"]
    assert main(["submit", TASK, *asked, "--out", str(tmp_path / "run")]) == 0
    lines = [shlex.split(line)[1:] for line in capsys.readouterr().out.splitlines() if line.startswith("wiw serve ")]
    assert [line[1] for line in lines] == [f"{tmp_path}/mine.py:M"]


def test_servers_are_given_the_options_of_the_preset(tmp_path, capsys):
    pytest.importorskip("diffusers", reason="needs wiw[diffusers]")
    asked = ["imagenav", "--preset", "official", "--policy", "heuristic", "--revision", "matcher"]
    asked += ["--world-model", "svd", "--world-model-option", "motion=90", "--arms", "none,svd", "--servers", "2"]
    assert main(["submit", *asked, "--shards", "1", "--dry-run", "--out", str(tmp_path / "run")]) == 0
    lines = [shlex.split(line)[1:] for line in capsys.readouterr().out.splitlines() if line.startswith("wiw serve ")]
    assert [line[1] for line in lines] == ["svd", "svd"]
    assert {"steps=30", "frames=14", "motion=90"} <= set(lines[0])
    assert not [part for part in lines[0] if part.startswith("space=")], "none for plans of primitives"


SBATCH = """
import os, re, subprocess, sys
script = sys.argv[1]
text = open(script).read()
open(os.environ["FAKE_SLURM"] + "/script", "w").write(text)
first, last = map(int, re.search(r"--array=(\\d+)-(\\d+)", text).groups()) if "--array" in text else (0, 0)
for number in range(first, last + 1):
    own = f'run() {{ bash {script}; echo $? >> "$FAKE_SLURM/exit_{number}"; }}'
    held = f'while [ -e "$FAKE_SLURM/hold_{number}" ]; do sleep 0.05; done'
    loop = f'{own}; run; {held}; while rm "$FAKE_SLURM/requeue_{number}"; do run; done'
    job = {"SLURM_JOB_ID": str(700 + number), "SLURM_ARRAY_JOB_ID": "70", "SLURM_ARRAY_TASK_ID": str(number)}
    log = open(os.environ["FAKE_SLURM"] + f"/log_{number}", "w")
    subprocess.Popen(["bash", "-c", loop], env={**os.environ, **job}, stdout=log, stderr=log, start_new_session=True)
print("Submitted batch job 70")
"""
SRUN = """
import os, sys
command = sys.argv[1:]
while command[0].startswith("--"):
    command = command[1:] if command[0] == "--unbuffered" else command[2:]
open(os.environ["FAKE_SLURM"] + "/pid_" + os.environ["SLURM_ARRAY_TASK_ID"], "w").write(str(os.getpid()))
os.execvp(command[0], command)
"""
SCONTROL = """
import os, sys
assert sys.argv[1] == "requeue" and sys.argv[2].startswith("70_"), sys.argv
open(os.environ["FAKE_SLURM"] + "/requeue_" + sys.argv[2].partition("_")[2], "w")
open(os.environ["FAKE_SLURM"] + "/requeued", "a").write(sys.argv[2] + "\\n")
"""
SACCT = """
print("JobID|State|NodeList")
for number in range(2):
    print(f"70_{number}|COMPLETED|node1")
"""
SCANCEL = """
import os, sys
open(os.environ["FAKE_SLURM"] + "/cancelled", "a").write(" ".join(sys.argv[1:]))
"""


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """Commands of SLURM that run jobs on this machine, at once, and note what they are asked."""
    folder = tmp_path / "slurm"
    folder.mkdir()
    for name, code in (
        ("sbatch", SBATCH),
        ("srun", SRUN),
        ("scontrol", SCONTROL),
        ("sacct", SACCT),
        ("scancel", SCANCEL),
    ):
        program = folder / name
        program.write_text(f"#!{sys.executable}\n{code}")
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(folder))
    return folder


def test_an_array_of_slurm_jobs(tmp_path, slurm, capsys):
    out = tmp_path / "run"
    asked = ["--partition", "gpu", "--gpus", 1, "--minutes", 30, "--parallel", 1, "--account", "lab", "--memory", 8]
    assert submit(out, *asked, "--live", 1, cluster="slurm", scenes="slow", episodes=8) == 0
    script = (slurm / "script").read_text()
    for line in ("array=0-1%1", "partition=gpu", "gpus-per-node=1", "time=30", "signal=USR2@90", "requeue", "mem=8GB"):
        assert f"#SBATCH --{line}\n" in script
    assert [job.id for job in read_jobs(out)] == ["70_0", "70_1"]
    wait_for(lambda: count_decisions(tmp_path) >= 2)
    os.kill(int((slurm / "pid_0").read_text()), signal.SIGUSR2)
    wait_for(lambda: wiw.status(out).ended == 8)
    assert (slurm / "requeued").read_text() == "70_0\n", logs(out)
    assert wiw.merge([out], out).complete and wiw.verify(out).same
    assert main(["cancel", str(out)]) == 0 and not (slurm / "cancelled").exists()  # none is left
    assert "job 70_0" in json.dumps(main(["status", str(out)]) or capsys.readouterr().out)


def signal_step(slurm, numbers):
    """Send signals to all processes of the first job's step, as SLURM does, and wait until it has ended."""
    task = int((slurm / "pid_0").read_text())
    for number in numbers:
        for process in [*find_children(task), task]:
            with suppress(ProcessLookupError):
                os.kill(process, number)
    wait_for((slurm / "exit_0").exists)


@pytest.mark.parametrize(
    ("numbers", "requeued"),
    [((signal.SIGCONT, signal.SIGTERM), False), ((signal.SIGUSR2, signal.SIGCONT, signal.SIGTERM), True)],
    ids=["SIGTERM", "SIGUSR2 and SIGTERM"],
)
def test_a_job_that_slurm_preempts_by_sigterm_has_copied_its_store_and_goes_on(tmp_path, slurm, numbers, requeued):
    """SLURM itself requeues the job; at SIGTERM alone nobody else asks for that, as it may have been cancelled."""
    out, held = tmp_path / "run", slurm / "hold_0"
    held.touch()  # a job that was requeued is held for a while
    assert submit(out, "--live", 1, cluster="slurm", scenes="slow", episodes=8) == 0
    wait_for(lambda: (slurm / "pid_0").exists() and count_of_shard(tmp_path) >= 2)
    recorded = count_of_shard(tmp_path)
    signal_step(slurm, numbers)
    (shard,) = [store for store in wiw.status(out).stores if store.shard.number == 1]
    assert shard.state == "stopped" and recorded <= shard.ended < 4, logs(out)
    assert not list((tmp_path / "disk").glob("shard-1-of-2*/run.sqlite"))
    assert (slurm / "requeued").exists() == requeued
    shown = (slurm / "log_0").read_text()
    assert ("stopped by SIGTERM, with everything recorded kept: wiw run" in shown) != requeued, shown
    assert (slurm / "exit_0").read_text() != "0\n"
    (slurm / "requeue_0").touch()
    held.unlink()
    wait_for(lambda: wiw.status(out).ended == 8)
    wait_for(lambda: (slurm / "exit_0").read_text().endswith("\n0\n"))
    assert wiw.merge([out], out).complete and wiw.verify(out).same


def count_of_shard(tmp_path):
    """Return how many episodes of the first of two shards have ended in the store on its job's own disk."""
    found = list((tmp_path / "disk").glob("shard-1-of-2*/run.sqlite"))
    try:
        return sum(len(load_run(path).episodes) for path in found)
    except StoreError:  # being made
        return 0


def test_a_job_that_is_told_to_stop_before_its_command_has_begun_ends(monkeypatch):
    """Until then the signal is submitit's, which lets it pass."""

    def start(command, **options):
        os.kill(os.getpid(), signal.SIGTERM)
        return popen([sys.executable, "-c", "import time; time.sleep(20)"])

    popen = subprocess.Popen
    monkeypatch.setattr("wiw.runs.submission.subprocess.Popen", start)
    earlier = signal.signal(signal.SIGTERM, lambda number, frame: None)
    try:
        with pytest.raises(InfrastructureError, match="stopped by SIGTERM"):
            JobCommand(["run", "imagenav"])()
    finally:
        signal.signal(signal.SIGTERM, earlier)


def test_a_command_is_told_how_long_it_has_which_is_less_than_its_job(monkeypatch):
    told = []
    monkeypatch.setattr(
        "wiw.runs.submission.subprocess.Popen",
        lambda command, env: told.append(env["WIW_STOP_SECONDS"]) or SimpleNamespace(poll=lambda: 0),
    )
    monkeypatch.setattr("wiw.runs.submission.signal.signal", lambda number, handler: None)
    for own in (None, "20"):
        if own is not None:
            monkeypatch.setenv("WIW_STOP_SECONDS", own)
        assert JobCommand(["run"])() == 0
    assert told == [f"{STOP_SECONDS:g}", "20"] and STOP_SECONDS + LAST < PATIENCE < SIGNAL_DELAY


STATES = (
    "JobID|State|NodeList\n100_0|FAILED|n\n100_1|COMPLETED|n\n300_0|RUNNING|n\n300_1|COMPLETED|n\n400_0|PREEMPTED|n\n"
)
"""The answer of `sacct`, without what became of 200_0. 400_0 may be requeued."""


@pytest.mark.parametrize(
    ("answer", "canceled"),
    [
        ("", ["200_0", "300_0", "400_0"]),
        ("scancel: error: Kill job error on job id 200: Invalid job id specified", ["300_0", "400_0"]),
        ("scancel: error: Kill job error on job id 200: Job/step already completing or completed", ["300_0", "400_0"]),
    ],
)
def test_jobs_that_slurm_has_forgotten_keep_no_other_from_being_cancelled(tmp_path, slurm, answer, canceled):
    """SLURM refuses ids that it knows no more, and cancels the others given with them."""
    (slurm / "sacct").write_text(f"#!/bin/sh\ncat << EOF\n{STATES}EOF\n")
    refused = f"if '{answer}' and '200' in sys.argv:\n    sys.exit('{answer}')\n"
    (slurm / "scancel").write_text(
        f"#!{sys.executable}\nimport os, sys\n{refused}"
        "open(os.environ['FAKE_SLURM'] + '/cancelled', 'a').write(f'{sys.argv[1:]}')\n"
    )
    submitit.SlurmJob.watcher.clear()
    jobs = [
        {"cluster": "slurm", "id": name, "arguments": ["run"]}
        for name in ("100_0", "100_1", "200_0", "300_0", "300_1", "400_0")
    ]
    (tmp_path / "jobs.json").write_text(json.dumps(jobs))
    assert [job.id for job in cancel(tmp_path)] == canceled
    assert (slurm / "cancelled").read_text() == ("" if answer else "['200']") + "['300']['400']"
    submitit.SlurmJob.watcher.clear()


def test_a_cluster_that_cannot_be_told_to_cancel_is_said_once_the_others_are_told(tmp_path, slurm):
    (slurm / "sacct").write_text("#!/bin/sh\necho 'JobID|State|NodeList'\n")
    say = "[ $1 = 100 ] && echo no munge >&2; exit 1"
    (slurm / "scancel").write_text(f'#!/bin/sh\necho "$1" >> $FAKE_SLURM/told; {say}')
    submitit.SlurmJob.watcher.clear()
    jobs = [{"cluster": "slurm", "id": name, "arguments": ["run"]} for name in ("100_0", "200_0")]
    (tmp_path / "jobs.json").write_text(json.dumps(jobs))
    with pytest.raises(InfrastructureError, match=r"scancel 100 200: no munge; exit code 1; expected a machine"):
        cancel(tmp_path)
    assert (slurm / "told").read_text() == "100\n200\n"
    submitit.SlurmJob.watcher.clear()


def test_shards_of_which_slurm_says_nothing_are_not_submitted_twice(tmp_path, slurm):
    (slurm / "sacct").write_text("#!/bin/sh\necho 'JobID|State|NodeList'\n")  # as for a new job
    submitit.SlurmJob.watcher.clear()
    out = tmp_path / "run"
    assert submit(out, cluster="slurm", scenes="slow") == 0
    with pytest.raises(ArgumentError, match=r"job 70_0 of .* is UNKNOWN \(2 active in all\); .* remove .*jobs.json"):
        submit(out, "--debug", cluster="slurm", scenes="slow")
    wait_for(lambda: len(list(out.glob("*/run.sqlite"))) == 2 and wiw.status(out).ended == 6, 180)
    submitit.SlurmJob.watcher.clear()
