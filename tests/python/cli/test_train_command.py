# SPDX-License-Identifier: Apache-2.0
"""`wiw train`: its help, and the numbers that it refuses before anything is prepared."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import pytest

from wiw.cli.app import main
from wiw.errors import ArgumentError
from wiw.training.trainer import run_training, warmup_cosine_schedule

NETWORKS = ("recogniser", "navigator", "warpnet", "pocket", "perception", "armnet", "diffuser")


def test_both_helps_name_all_networks(capsys: pytest.CaptureFixture[str]) -> None:
    for command in (["--help"], ["train", "--help"]):
        with pytest.raises(SystemExit) as end:
            main(command)
        assert end.value.code == 0
        text = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert "recogniser, navigator, warpnet, pocket, perception, armnet, diffuser or a video model" in text


OPTIONS = {
    "recogniser": ("minutes", "epochs", "places", "workers", "seed"),
    "navigator": ("minutes", "epochs", "places", "workers", "seed"),
    "warpnet": ("minutes", "epochs", "places", "workers", "seed"),
    "pocket": ("epochs", "seed"),
    "perception": ("minutes", "epochs", "places", "workers", "seed"),
    "armnet": ("minutes", "epochs", "plays", "workers", "seed"),
    "diffuser": ("minutes", "epochs", "seed"),
    "ltx-action": ("epochs", "seed"),
}
"""Numbers that each command takes."""
BAD_NUMBERS = {
    "minutes": {
        "-3": "--minutes: expected a number above 0, got -3.0",
        "0": "--minutes: expected a number above 0, got 0.0",
        "nan": "--minutes: expected a number above 0, got nan",
        "inf": "--minutes: expected a number above 0, got inf",
    },
    "epochs": {"0": "--epochs: expected 1 or more, got 0"},
    "places": {"-1": "--places: expected 1 or more, got -1"},
    "plays": {"0": "--plays: expected 1 or more, got 0"},
    "workers": {"0": "--workers: expected 1 or more, got 0"},
    "seed": {"-1": "--seed: expected 0 to 2**63 - 1, got -1"},
}


@pytest.mark.parametrize(("what", "option"), [(what, option) for what in OPTIONS for option in OPTIONS[what]])
def test_numbers_out_of_range_are_refused(
    what: str, option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for value, expected in BAD_NUMBERS[option].items():
        assert main(["train", what, f"--{option}", value, "--out", str(tmp_path / "x")]) == 2
        assert expected in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("what", "option", "value"),
    [
        ("warpnet", "--categories", "chair"),
        ("warpnet", "--plays", "3"),
        ("warpnet", "--gpus", "2"),
        ("armnet", "--places", "3"),
        ("armnet", "--scenes", "apartments:train:1"),
        ("armnet", "--device", "cuda"),
        ("diffuser", "--workers", "3"),
        ("diffuser", "--cache", "c"),
        ("ltx-action", "--minutes", "3"),
        ("ltx-action", "--scenes", "house.glb"),
    ],
)
def test_options_of_other_networks_are_refused(
    what: str, option: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["train", what, option, value, "--out", str(tmp_path / "x")])
    assert end.value.code == 2
    shown = capsys.readouterr().err
    assert f"Unrecognized options: {option}, {value}" in shown and f"wiw train {what} --help" in shown
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("what", [name for name in NETWORKS if name != "pocket"])
def test_the_help_says_how_many_epochs_the_recipe_has(what: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("torch", reason="needs wiw[torch]")
    with pytest.raises(SystemExit):
        main(["train", what, "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    (said,) = re.findall(r"how often each sample is used, on average\. Default: (\d+)\.", text)
    assert int(said) == importlib.import_module(f"wiw.training.{what}").Recipe().epochs


@pytest.mark.parametrize("what", NETWORKS)
def test_torchruns_processes_are_refused_where_each_would_train_alike(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """They would overwrite each other's weights and state."""
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert main(["train", what, "--out", str(tmp_path / "x")]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert f"{what}: expected a single process, got 2 from torchrun; run the command without torchrun" in said
    assert not list(tmp_path.iterdir())


class _Counter:
    def __init__(self) -> None:
        self.steps = 0

    def train_step(self, learning_rate: float) -> float:
        self.steps += 1
        return learning_rate


@pytest.mark.parametrize("minutes", [-3.0, 0.0, float("nan"), float("inf")])
def test_training_in_python_refuses_such_minutes_too(minutes: float) -> None:
    counter = _Counter()
    with pytest.raises(ArgumentError, match="minutes: expected a finite number above 0"):
        run_training(lambda: counter, None, 1, minutes, warmup_cosine_schedule(0.1), lambda *_: None)
    assert counter.steps == 0


def test_clips_are_encoded_ahead_by_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")
    pytest.importorskip("pyarrow", reason="no pyarrow: pip install 'wiw[export]'")
    from wiw.ray_cluster import Engine
    from wiw.training.post_training import encode_clips as module

    given: list[Any] = []
    monkeypatch.setattr(module, "encode_clips", lambda *args, **named: (given.append((args, named)), 7)[1])
    (tmp_path / "data").mkdir()
    asked = ["train", "nwm-action", "--data", str(tmp_path / "data"), "--device", "cpu", "--option", "frames=6"]
    cache = ["--cache", str(tmp_path / "cache"), "--encode-only"]
    assert main([*asked, *cache, "--engine", "ray", "--workers", "3"]) == 0
    ((args, named),) = given
    assert args == ("nwm-action", tmp_path / "data", tmp_path / "cache")
    assert (named["workers"], named["place"], named["recipe"].frames) == (3, Engine(engine="ray"), 6)
    assert main([*asked, "--encode-only"]) == 2  # into which folder?
    assert main([*asked, "--workers", "3"]) == 2  # for --encode-only
    for of_training in (["--dry-run"], ["--gpus", "2"], ["--out", "x"], ["--validation", "v"], ["--decisions", "d"]):
        assert main([*asked, *cache, *of_training]) == 2
        assert f"{of_training[0]}" in capsys.readouterr().err.splitlines()[-1]
    assert len(given) == 1
