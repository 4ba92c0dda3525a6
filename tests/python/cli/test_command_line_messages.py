# SPDX-License-Identifier: Apache-2.0
"""What a newcomer's command says: what will run, what there is, and what is wrong."""

from __future__ import annotations

import os
import pickle
import re
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from locations import PYTHON_TESTS, ROOT

from wiw import errors
from wiw.cli import app, main
from wiw.cli.app import EXIT_ERROR, EXIT_INTERRUPTED
from wiw.cli.bars import Bars
from wiw.cli.demo import PARTS
from wiw.cli.stop import EXIT_RESUME, Terminated
from wiw.errors import VlmError
from wiw.registry import TASKS
from wiw.vlm.openai import OpenAIClient

FAKES = PYTHON_TESTS / "fakes.py"


def test_a_run_announces_itself_before_it_does_anything(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("wiw.studies.evaluate.evaluate", refuse)
    options = ["--scenes", "apartments:val:4", "--episodes", "8", "--arms", "copy,oracle", "--workers", "2"]
    assert main(["run", "imagenav", *options, "--out", str(tmp_path / "r")]) == 130
    assert capsys.readouterr().err.splitlines()[:4] == [
        "task    imagenav: 8 episodes in 2 of 4 scenes (apartments:val:4, 5 per scene), seed 0",
        "arms    copy, oracle (policy matcher)",
        "workers 2",
        f"run     {tmp_path / 'r'}",
    ]
    assert main(["run", "imagenav", "--tier", "all", "--preset", "foresight", *options, "--episodes", "31"]) == 130
    assert "31 episodes in 3 of 4 scenes (apartments:val:4, 15 per scene)" in capsys.readouterr().err, "5 of each tier"


@pytest.mark.parametrize(
    ("what", "names", "others"),
    [
        ("tasks", ["imagenav", "ar", "manipulation"], ["warp"]),
        ("policies", ["matcher", "vlm"], ["warp", "imagenav"]),
        ("trackers", ["reprojection", "sam2"], ["matcher"]),
        ("metrics", ["spl", "mean_trajectory"], ["matcher"]),
        ("presets", ["official", "paper-diffusion"], ["matcher"]),
    ],
)
def test_list_takes_a_kind(what: str, names: list[str], others: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", what]) == 0
    first_words = set(re.findall(r"^  (\S+)", capsys.readouterr().out, re.MULTILINE))
    assert set(names) <= first_words and not set(others) & first_words


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policy-option", "a=b"], "policy matcher: unknown option 'a'; expected one of histogram,"),
        (["--policy-option", "turn=left"], "policy matcher: turn: expected a number, got 'left'"),
        (["--width", "2"], "give --depth 2 or more"),
        (["--fidelity-share", "0.5"], "give --fidelity"),
        (["--served", "warp"], "give their number with --servers"),
        (["--cache", "off", "--cache-gb", "3"], "leave one of them out"),
        (["--look-every", "5"], "give --until"),
        (["--policy", "recogniser"], "use it with task ar"),
        (["--scenes", "apartment:val:1"], "wiw: apartment:val:1: no such file"),
        (["--scenes", "apartment:val:1"], "Did you mean apartments:val:1?"),
        (["--policy", "matcher", "--revision", "recogniser"], "use it with task ar"),
        (["--world-model", f"{FAKES}:Nothing"], "fakes.py defines no 'Nothing'; it has LineEnv,"),
    ],
)
def test_a_mistake_is_explained_in_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--scenes", "apartments:val:1", "--episodes", "1", "--out", str(tmp_path / "r"), "--no-report"]
    assert main(["run", "imagenav", *options, *arguments]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("wiw: ") and message in last


def test_a_missing_episode_file_is_named_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "none.json"
    assert main(["run", "imagenav", "--episode-file", str(file), "--out", str(tmp_path / "r")]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"wiw: {file}: No such file or directory"


def test_facts_of_scenes_are_whole_in_80_columns(
    two_rooms: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(
        "wiw.cli.scenes._list_facts", lambda _: ["a" * 40, "10.5 x 12.2 x 2.6", "1,108,123", *["1234"] * 5]
    )
    assert main(["scenes", two_rooms, "--views", "1", "--out", str(tmp_path / "sheet.png")]) == 0
    shown = capsys.readouterr().out
    assert "…" not in shown and max(map(len, shown.splitlines()[:4])) <= 80
    for text in ("triangles", "walk m2", "islands", "1,108,123", "10.5 x 12.2 x 2.6"):
        assert text in shown


def test_the_demo_ends_with_its_pages_and_the_ready_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    log = SimpleNamespace(report=lambda remark: reports.append(remark) or "report.html")
    reports: list[str] = []
    monkeypatch.setattr("wiw.studies.evaluate.evaluate", lambda *_, **__: log)
    monkeypatch.setattr("wiw.cli.run.finish", lambda log, report, remark: print(log.report(remark)) or 0)
    assert main(["demo", "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    ready = "docs/report-imagenav.html"
    assert (
        ready in " ".join(shown.split()) and all(ready in remark for remark in reports) and len(reports) == len(PARTS)
    )
    assert {part.task for part in PARTS} == set(TASKS.names())
    assert all(f"{tmp_path}/{part.task}/report.html" in shown for part in PARTS)
    text = [line for line in shown.splitlines() if not line.startswith("        ")]
    assert max(map(len, text)) < 80
    assert ROOT.joinpath(ready).stat().st_size <= 10**6


def test_errors_name_the_module_that_users_import() -> None:
    for name in ("ArgumentError", "FileError", "Error", "NavigationError", "BackendError"):
        error = getattr(errors, name)
        assert error.__module__ == "wiw.errors"
        assert pickle.loads(pickle.dumps(error("why"))).args == ("why",)


def test_what_is_no_number_is_refused_plainly(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        (["run", "--episodes", "two"], "--episodes: expected a whole number, got 'two'"),
        (["run", "--episodes", "2.5"], "--episodes: expected a whole number, got '2.5'"),
        (["run", "--deadline", "soon"], "--deadline: expected a number, got 'soon'"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2
        shown = " ".join(capsys.readouterr().err.replace("│", " ").split())
        assert message in shown and "no type matching" not in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["episodes", "--episodes", "0"], "expected --episodes of at least 1, got 0"),
        (["submit", "--shards", "0", "--dry-run"], "expected --shards of at least 1, got 0"),
        (["scenes", "apartments:val:5:2"], "'apartments:val:5:2': holds no scene; expected first < end"),
        (["scenes", "apartments:val:1", "--views", "-1"], "expected --views of at least 0, got -1"),
        (["data", "stats", "nowhere", "--clip", "0"], "expected --clip of at least 1 frame, got 0"),
        (["compare", "a", "b", "--other", "warp"], "name one of the first with --arm"),
        (["power", "5", "--pilot", "a"], "or neither; got --pilot"),
        (["power", "--base", "99"], "+5 points mean that 7 % are won, but the base fails only in 1 %"),
        (["study", "eror"], "data-scaling, errors, front-vs-panorama, models, vlm,"),
        (["collect", "decisions", "--out", str(FAKES)], "fakes.py already exists"),
        (["bench", "gpu", "--networks", "warp"], "no network 'warp'"),
        (["bench", "gpu", "--seconds", "-1"], "expected seconds of at least 0, got -1"),
        (["run", "imagenav", "--episode-file", str(FAKES)], "fakes.py: expected an episode file, which is JSON"),
    ],
)
def test_a_mistake_is_explained_before_any_work(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_wrong_flag_brings_hints_of_its_own_command_only(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["run", "--epsodes", "3"], ["run", "--episodes", "x"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        shown = capsys.readouterr().err
        assert stop.value.code == 2 and "wiw run --help" in shown and "wiw verify" not in shown


def test_half_a_size_is_refused_plainly(capsys: pytest.CaptureFixture[str]) -> None:
    for size, message in ((["32"], "Expected 2 values"), (["32", "x"], "expected two whole numbers, got '32 x'")):
        with pytest.raises(SystemExit) as stop:
            main(["collect", "navigation", "--size", *size])
        assert stop.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize("command", ["demo", "power", "compare", "report", "serve", "view"])
def test_help_shows_no_default_of_none(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    assert "default: None" not in " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_a_sheet_that_cannot_be_written_is_an_error(two_rooms: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", two_rooms, "--views", "1", "--out", "/proc/sheet.png"]) == 2
    assert "/proc/sheet.png: cannot be written" in capsys.readouterr().err


def test_without_a_server_the_mock_is_suggested() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    client = OpenAIClient(f"http://127.0.0.1:{port}/v1", attempts=1)
    with pytest.raises(VlmError, match=r"no server answers there.*--vlm mock"):
        _ = client.model


def test_bars_show_text_as_it_is_and_follow_a_total_that_grows(capsys: pytest.CaptureFixture[str]) -> None:
    with Bars() as bars:
        for done in range(1, 5):
            bars.show("measuring", done, done + 1, f"[red]{done}[/x]")
        bars.show("files", 0, 0, "none")
        measuring = bars._bars.tasks[0]
        assert (measuring.completed, measuring.total) == (4, 5)
    lines = capsys.readouterr().err.splitlines()
    assert "measuring: [red]1[/x]" in lines and lines[-1].startswith("measuring")


def run_with_broken_pipe(arguments: list[str], stream: str) -> int:
    """Return the exit code of a command whose output nobody reads any more."""
    unread, written = os.pipe()
    os.close(unread)
    streams: dict[str, int] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, stream: written}
    command = [sys.executable, "-m", "wiw.cli", *arguments]
    try:
        return subprocess.run(command, check=False, timeout=120, **streams).returncode
    finally:
        os.close(written)


def test_a_reader_that_has_gone_changes_no_exit_code() -> None:
    assert run_with_broken_pipe(["list", "tasks"], "stdout") == 0
    assert run_with_broken_pipe(["run", "imagenav", "--arms", "nothing"], "stderr") == EXIT_ERROR


@pytest.mark.parametrize(
    ("stop", "code"), [(Terminated, EXIT_RESUME), (KeyboardInterrupt, EXIT_INTERRUPTED), (None, 0)]
)
def test_a_stop_that_cannot_be_told_is_one(stop: Any, code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(arguments: Any) -> None:
        try:
            if stop is not None:
                raise stop
        finally:
            raise BrokenPipeError  # as of printing how to resume

    monkeypatch.setattr(app, "_dispatch", fail)
    assert main(["run"]) == code
