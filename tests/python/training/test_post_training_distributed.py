# SPDX-License-Identifier: Apache-2.0
"""Post-training in two processes on the CPU (gloo), with whole and sharded weights (FSDP2), against one process."""

from __future__ import annotations

import os
import pickle
import shlex
import signal
import subprocess
import sys
import threading
import time
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from locations import PYTHON_TESTS, TESTS

import wiw
from wiw import action
from wiw.cli.app import main
from wiw.errors import ArgumentError, DependencyError
from wiw.training import launcher
from wiw.training.launcher import ProcessLayout, TrainingJob, list_options
from wiw.types import Conditioning, Control

pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")
pytest.importorskip("peft", reason="no peft: pip install 'wiw[diffusers]'")
pytest.importorskip("pyarrow", reason="no pyarrow: pip install 'wiw[export]'")

import torch
from post_training_parts import make_trainer, save_dataset, save_stock, tiny_recipe
from safetensors.torch import load_file

from wiw.training.post_training import distributed
from wiw.training.post_training.clip_trainer import require_equal_shares
from wiw.training.post_training.train import post_train
from wiw.training.post_training.trainer import PostTrainer

pytestmark = pytest.mark.usefixtures("one_torch_thread")

CASES = (("ltx-action", False), ("ltx-action", True), ("wan2.1-action", True))
"""One trained whole, with and without shards, and one by LoRA on frozen weights of another precision."""
CHANGES: dict[str, Any] = {"rows": 1, "epochs": 3, "ema": 0.9}
PRECISIONS = {"ltx-action": ("float32", 1e-4), "wan2.1-action": ("bfloat16", 3e-2)}
"""Of products, and how far gradients may be apart for it, relative to their norm."""
EPOCHS, STOPPED, KILLED = 4, 1, 2

PROCESS = """
import os, signal, sys
sys.path[:0] = {path!r}
import torch
torch.set_num_threads(1)
from test_post_training_distributed import run_process
run_process({folder!r})
"""


def run_process(folder: str) -> None:
    """All that one of two processes does: trainings whose results the first one keeps; in the last, one is killed."""
    place = Path(folder)
    with distributed.join_processes():
        for name, shard in CASES:
            found = train_and_resume(name, place, shard)
            if distributed.is_main():
                torch.save(found, place / f"{name}-{shard}.pt")
        said = str(find_error(lambda: train_with_damage(place)))
        (place / f"error-{torch.distributed.get_rank()}").write_text(said)
        options = post_options(place)
        post_train("ltx-action", place / "data", place / "sharded", recipe=validated_recipe(shard=True), **options)

        stock = PostTrainer.train_step

        def send_signal(step: int, number: signal.Signals, self: PostTrainer, rate: float) -> float:
            loss = stock(self, rate)
            if self.step_count == step and not distributed.is_main():
                os.kill(os.getpid(), number)
            return loss

        recipe = tiny_recipe("ltx-action", rows=1, epochs=EPOCHS, shard=True)
        for out, step, number in (("stopped", STOPPED, signal.SIGINT), ("killed", KILLED, signal.SIGKILL)):
            PostTrainer.train_step = lambda self, rate, own=(step, number): send_signal(*own, self, rate)  # type: ignore[method-assign]
            error = find_error(
                lambda out=out: post_train(
                    "ltx-action", place / "data", place / out, recipe=recipe, part="all", **options
                )
            )
            (place / f"{out}-{torch.distributed.get_rank()}").write_text(type(error).__name__)


def post_options(place: Path) -> dict[str, Any]:
    return {"weights": place / "stock" / "ltx", "device": "cpu", "seconds": 0}


def validated_recipe(**changes: Any) -> Any:
    return tiny_recipe("ltx-action", rows=1, epochs=2, validate_every=2, validate_clips=2, held_out=0.4, **changes)


@cache
def train_and_resume(name: str, place: Path, shard: bool = False) -> dict[str, Any]:
    """Losses and states of three steps, and those of a third one that begins with the state after the second."""

    def start() -> PostTrainer:
        weights = place / "stock" / name.removesuffix("-action")
        return make_trainer(name, place / "data", weights, **CHANGES, precision=PRECISIONS[name][0], shard=shard)

    whole = start()
    losses, states = [], []
    for _ in range(3):
        losses.append(whole.train_step(1e-3))
        states.append(deepcopy(whole.state_dict()))
    resumed = start()
    resumed.load_state_dict(distributed.call_on_main(lambda: states[1]))
    again = resumed.train_step(1e-3)
    return {"losses": losses, "again": again, "first": states[0], "end": states[2], "other": resumed.state_dict()}


def train_with_damage(place: Path) -> None:
    """A training whose second clip of a step, which the second process has, has no finite loss."""
    trainer = make_trainer("ltx-action", place / "data", place / "stock" / "ltx", **CHANGES)
    damaged, stock = int(trainer.order.select(0)[1]), trainer.compute_losses
    trainer.compute_losses = lambda rows, random: stock(rows, random) * (torch.nan if rows[0] == damaged else 1)  # type: ignore[method-assign]
    trainer.train_step(1e-3)


def find_error(work: Any) -> BaseException:
    try:
        work()
    except BaseException as error:
        return error
    raise AssertionError("expected an error")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which two processes have trained, until one of them was killed."""
    folder = tmp_path_factory.mktemp("two")
    save_dataset(folder / "data", scenes=[f"scene-{number}" for number in range(8)])
    for name in PRECISIONS:
        save_stock(folder / "stock", name)
    path = [str(folder) for folder in (Path(__file__).parent, PYTHON_TESTS, TESTS)]
    script = folder / "process.py"
    script.write_text(PROCESS.format(path=path, folder=str(folder)))
    options = list_options(ProcessLayout(gpus=2), "localhost", "test")
    command = [sys.executable, "-m", "torch.distributed.run", *options, str(script)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    ended = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False, env=environment)
    assert ended.returncode == 1 and "exitcode  : -9" in ended.stderr, ended.stderr
    return folder


@pytest.mark.parametrize(("name", "shard"), CASES)
@pytest.mark.nightly
def test_two_processes_train_as_one_does(name: str, shard: bool, place: Path) -> None:
    one, two = train_and_resume(name, place), torch.load(place / f"{name}-{shard}.pt", weights_only=True)
    limit = PRECISIONS[name][1]
    np.testing.assert_allclose(two["losses"], one["losses"], rtol=limit)
    assert one["end"]["weights"].keys() == two["end"]["weights"].keys() and two["end"]["count"] == 3
    wanted, found = (
        torch.cat([moments["exp_avg"].flatten() for _, moments in sorted(each["first"]["optimizer"]["state"].items())])
        for each in (one, two)
    )  # a tenth of the first gradient
    assert float((found - wanted).norm()) < limit * float(wanted.norm())
    for part in ("weights", "averages"):
        assert all(value.shape == one["end"][part][key].shape for key, value in two["end"][part].items())


@pytest.mark.parametrize(("name", "shard"), CASES)
@pytest.mark.nightly
def test_two_processes_resume_exactly(name: str, shard: bool, place: Path) -> None:
    found = torch.load(place / f"{name}-{shard}.pt", weights_only=True)
    assert found["again"] == found["losses"][2]
    for part in ("weights", "averages"):
        assert all(torch.equal(value, found["other"][part][key]) for key, value in found["end"][part].items())


@pytest.mark.nightly
def test_a_loss_that_is_not_finite_in_one_process_stops_both_and_names_the_clip(place: Path) -> None:
    trainer = make_trainer("ltx-action", place / "data", place / "stock" / "ltx", **CHANGES)
    clip = trainer.clips.describe(int(trainer.order.select(0)[1]))
    for number in range(2):
        said = (place / f"error-{number}").read_text()
        assert said.startswith(f"step 1: the loss is not finite on a batch of {clip}. The state before")


@pytest.mark.nightly
def test_a_checkpoint_of_sharded_weights_is_that_of_one_process_and_runs(place: Path) -> None:
    recipe, options = validated_recipe(), post_options(place)
    card = post_train("ltx-action", place / "data", place / "whole", recipe=recipe, **options)
    assert card["validation"]["psnr"] > 0
    for file in ("action_encoder.safetensors", "transformer/diffusion_pytorch_model.safetensors"):
        wanted, found = load_file(place / "whole" / file), load_file(place / "sharded" / file)
        assert wanted.keys() == found.keys()
        for key, value in wanted.items():
            torch.testing.assert_close(found[key], value, rtol=0, atol=1e-4)  # two steps at a rate of 1e-5
    config = "transformer/config.json"
    assert (place / "whole" / config).read_text() == (place / "sharded" / config).read_text()
    shape = {"size": recipe.size, "frames": recipe.frames}
    model = wiw.world_model("ltx-action", checkpoint=str(place / "sharded"), device="cpu", steps=2, **shape)
    plan = action.pad([action.TURN_LEFT], recipe.frames - 1)
    views = action.to_trajectory(plan), action.to_viewpoints(plan)
    control = Control(plan, *views, ids=action.with_null(plan), length=1)
    image = np.full((1, *recipe.size, 3), 90, np.uint8)
    assert model.rollout(Conditioning(image), [control], np.zeros(1, np.uint64)).shape[1] == recipe.frames


@pytest.mark.nightly
def test_a_killed_sharded_training_goes_on_in_one_process(place: Path) -> None:
    recipe, options = tiny_recipe("ltx-action", rows=1, epochs=EPOCHS), post_options(place)
    steps: list[int] = []
    for out in ("reference", "killed"):
        steps.clear()
        post_train(
            "ltx-action",
            place / "data",
            place / out,
            recipe=recipe,
            part="all",
            on_step=lambda step, *_: steps.append(step),
            **options,
        )
    assert steps == list(range(KILLED, EPOCHS + 1))  # the step in which one was killed is done again
    file = "transformer/diffusion_pytorch_model.safetensors"
    wanted, found = load_file(place / "reference" / file), load_file(place / "killed" / file)
    assert all(float((value - found[key]).abs().max()) < 2e-5 * EPOCHS for key, value in wanted.items())


@pytest.mark.nightly
def test_a_signal_to_one_process_stops_both_after_the_same_step(place: Path) -> None:
    state = torch.load(place / "stopped.checkpoint", weights_only=True)
    assert state["step"] == len((place / "stopped.log" / "metrics.jsonl").read_text().splitlines()) == STOPPED
    assert all(value.numel() for value in state["state"]["weights"].values())
    assert [(place / f"stopped-{number}").read_text() for number in range(2)] == ["KeyboardInterrupt"] * 2


# -- the launcher ------------------------------------------------------------------------------------------------------


def test_processes_run_the_command_and_their_exit_code_is_handed_on(capfd: pytest.CaptureFixture[str]) -> None:
    assert launcher.run_processes(["view", "nowhere"], ProcessLayout(gpus=2)) == 2
    assert "no run at nowhere: expected" in capfd.readouterr().err


def test_a_stop_is_handed_on_to_all_processes_first() -> None:
    """The handler that was there before is called, once they have ended."""
    ended: list[set[str]] = []
    children = Path(f"/proc/self/task/{threading.get_native_id()}/children")
    others = set(children.read_text().split())  # of earlier tests

    def list_own() -> set[str]:
        return set(children.read_text().split()) - others

    def stop() -> None:
        while len(list_own()) < 2:
            time.sleep(0.1)
        time.sleep(2)  # torchrun knows a process once its start has returned
        os.kill(os.getpid(), signal.SIGTERM)

    before = signal.signal(signal.SIGTERM, lambda *_: ended.append(list_own()))
    try:
        threading.Thread(target=stop, daemon=True).start()
        assert launcher.run_processes(["serve", "copy", "--port", "0"], ProcessLayout(gpus=2)) == 0
    finally:
        signal.signal(signal.SIGTERM, before)
    assert ended == [set()]


def test_a_dry_run_prints_torchruns_command(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["train", "ltx-action", "--data", "data", "--option", "size=[64, 128]", "--seed", "3", "--out", "runs/a"]
    assert main([*command, "--gpus", "4", "--dry-run"]) == 0
    printed = shlex.split(capsys.readouterr().out)
    assert printed[:6] == ["torchrun", "--standalone", "--nproc-per-node", "4", "-m", "wiw.cli"]
    assert main([*printed[6:], "--dry-run"]) == 0  # the command that each process runs is one
    assert shlex.split(capsys.readouterr().out)[6:] == printed[6:]
    assert main([*command, "--gpus", "8", "--nodes", "2", "--dry-run"]) == 0
    printed = shlex.split(capsys.readouterr().out)
    assert printed[1:9] == [
        "--nnodes",
        "2",
        "--nproc-per-node",
        "8",
        "--rdzv-backend",
        "c10d",
        "--rdzv-endpoint",
        "HOST:29500",
    ]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["ltx-action", "--data", "data", "--gpus", "3"],
            "16 passes of 1, which cannot be split evenly among 3 processes",
        ),
        (["ltx-action", "--gpus", "2"], "ltx-action trains on a dataset"),
        (["ltx-action", "--data", "data", "--gpus", "0"], "expected --gpus of at least 1, got 0"),
        (
            [
                "ltx-action",
                "--data",
                "data",
                "--gpus",
                "2",
                "--option",
                "shard=true",
                "--option",
                "optimizer=adamw8bit",
            ],
            "8 bits",
        ),
    ],
)
def test_what_cannot_be_shared_is_refused(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", *arguments]) == 2
    assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("option", ["--gpus=2", "--dry-run", "--partition=gpu"])
def test_processes_of_torchrun_start_no_others(
    option: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert main(["train", "ltx-action", "--data", "data", option]) == 2
    assert "expected a single process, got 2 from torchrun; leave these options out" in " ".join(
        capsys.readouterr().err.split()
    )


def test_options_of_a_job_are_refused_where_there_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "ltx-action", "--data", "data", "--hours", "3", "--account", "lab"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "--hours, --account: only for SLURM jobs; name a --partition" in said


def test_passes_are_shared_out_evenly_or_not_at_all() -> None:
    require_equal_shares(16, 4, 2)
    with pytest.raises(
        ArgumentError, match="16 clips has 4 passes of 4, which cannot be split evenly among 8 processes"
    ):
        require_equal_shares(16, 4, 8)


def test_each_process_has_its_own_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed.require_own_gpu("cuda:1")  # in one process any will do
    monkeypatch.setattr(distributed, "count_processes", lambda: 3)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    for own in ("0", "1"):
        monkeypatch.setenv("LOCAL_RANK", own)
        distributed.require_own_gpu("cuda")
    with pytest.raises(ArgumentError, match="expected cuda, as each process takes its own GPU, got cuda:1"):
        distributed.require_own_gpu("cuda:1")
    monkeypatch.setenv("LOCAL_RANK", "2")
    distributed.require_own_gpu("cpu")
    with pytest.raises(ArgumentError, match="got 2 GPUs here; lower --gpus"):
        distributed.require_own_gpu("cuda")


def test_a_job_asks_slurm_for_its_machines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What submitit hands to an sbatch that only keeps it."""
    pytest.importorskip("submitit", reason="no submitit: pip install 'wiw[slurm]'")
    for name, work in (("srun", "exit 1"), ("sbatch", f"cp $1 {tmp_path}/submitted; echo Submitted batch job 12")):
        (tmp_path / name).write_text(f"#!/bin/sh\n{work}\n")
        (tmp_path / name).chmod(0o700)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    layout = ProcessLayout(nodes=2, gpus=8, partition="gpu", hours=12, account="lab", memory=900)
    assert launcher.submit_job(["train", "ltx-action"], layout, tmp_path / "jobs") == "12"
    lines = (tmp_path / "submitted").read_text().splitlines()
    wanted = (
        "nodes=2",
        "gpus-per-node=8",
        "ntasks-per-node=1",
        "mem=900GB",
        "time=720",
        "partition=gpu",
        "account=lab",
    )
    assert all(f"#SBATCH --{line}" in lines for line in (*wanted, "requeue", "signal=USR2@600")), lines


def test_a_machine_without_slurm_or_submitit_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(DependencyError, match=r"wiw\[slurm\]"):
        launcher.submit_job(["train", "ltx-action"], ProcessLayout(nodes=2), tmp_path)


def test_a_job_starts_torchrun_and_is_stopped_and_requeued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On one of two machines, with a command in place of torchrun's that waits for the signal."""
    submitit = pytest.importorskip("submitit", reason="no submitit: pip install 'wiw[slurm]'")

    class Environment:
        hostnames, job_id = ("first", "second"), "7"

    told = tmp_path / "told"
    script = tmp_path / "python"
    script.write_text(f'#!/bin/sh\nkill -USR2 $$\necho "$@" > {told}\nexec sleep 60\n')
    script.chmod(0o700)
    monkeypatch.setattr(submitit, "JobEnvironment", Environment)
    monkeypatch.setattr(launcher.sys, "executable", str(script))
    job = pickle.loads(pickle.dumps(TrainingJob(["train", "ltx-action"], ProcessLayout(nodes=2, gpus=8))))
    requeued: list[Any] = []

    def stop(number: int, frame: Any) -> None:
        requeued.append(job.checkpoint())
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    try:
        signal.setitimer(signal.ITIMER_REAL, 1.0)
        with pytest.raises(TimeoutError):
            job()
    finally:
        signal.signal(signal.SIGALRM, before)
    assert told.read_text().split()[:2] == ["-m", "torch.distributed.run"]
    assert "--rdzv-endpoint first:29500 --rdzv-id wiw-7 -m wiw.cli train ltx-action" in told.read_text()
    assert job._process.poll() == -signal.SIGTERM
    assert requeued[0].function.arguments == ["train", "ltx-action"] and requeued[0].function.layout == job.layout
    assert replace(job.layout, nodes=1).count == 8
