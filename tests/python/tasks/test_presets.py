# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
from locations import ROOT

import wiw
from wiw.cli import main
from wiw.errors import ArgumentError, FileError, StoreError
from wiw.mapping_files import MOST_BRACKETS, parse_yaml, read_yaml_mapping
from wiw.runs.recipes import AgentRecipe
from wiw.studies.evaluate import evaluate, resume_run
from wiw.tasks import presets
from wiw.tasks.imagenav import ImageNav

PAPER = {
    "decisions": 20,
    "candidates": 3,
    "horizon": 5,
    "execute": 3,
    "radius": 0.5,
    "checked": "primitive",
    "distance": "euclidean",
    "spl": "metres",
    "motion": "refuse",
}
OFFICIAL = {**PAPER, "decisions": 21, "execute": -2, "checked": "decision", "distance": "geodesic", "spl": "actions"}


def write_preset(folder: Path, text: str) -> Path:
    path = folder / "own.yaml"
    path.write_text(text)
    return path


def test_shipped_presets_hold_the_published_rules() -> None:
    assert presets.list_presets("imagenav") == ["default", "paper", "foresight", "official"]
    assert asdict(ImageNav().rules) == asdict(ImageNav(preset="paper").rules) == PAPER
    assert asdict(ImageNav(preset="official").rules) == OFFICIAL
    assert ImageNav(preset="official").budget == 21 * 3
    assert ImageNav(preset="official", radius=1).rules.radius == 1.0


def test_what_a_reader_changes_is_not_what_the_next_one_reads(tmp_path: Path) -> None:
    own = write_preset(tmp_path, "generator: {near: 1}")
    read_yaml_mapping(own, "rules")["generator"]["near"] = 2
    assert read_yaml_mapping(own, "rules") == {"generator": {"near": 1}}
    write_preset(tmp_path, "generator: {near: 3}")
    assert read_yaml_mapping(own, "rules") == {"generator": {"near": 3}}


@pytest.mark.parametrize("line", ["{}", "rules: {}", "- {}"])
def test_brackets_are_nested_so_deep_and_no_deeper(line: str) -> None:
    """PyYAML alone takes 2.5 s to find that there is no end to 4,000 brackets."""
    assert parse_yaml(line.format("[" * MOST_BRACKETS + "]" * MOST_BRACKETS))
    with pytest.raises(ValueError, match="less deeply nested"):
        parse_yaml(line.format("[" * 10**6))


def test_they_lie_inside_the_package_and_are_shown_at_the_root() -> None:
    package = Path(wiw.__file__).parent
    assert package / "configs" == presets.FOLDER
    root = ROOT / "configs"
    assert {p.relative_to(root) for p in root.glob("*/*.yaml")} >= {
        Path("paper/imagenav.yaml"),
        Path("official/imagenav.yaml"),
    }


def test_a_file_of_ones_own_starts_from_a_shipped_preset(tmp_path: Path) -> None:
    own = write_preset(tmp_path, "base: official\nabout: longer\ndecisions: 40\nradius: 1\n")
    assert asdict(ImageNav(preset=own).rules) == {**OFFICIAL, "decisions": 40, "radius": 1.0}
    assert asdict(ImageNav(preset=str(write_preset(tmp_path, "motion: slide"))).rules) == {**PAPER, "motion": "slide"}


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("decisons: 4", ArgumentError, r"own.yaml: unknown rule 'decisons'; expected one of decisions, candidates"),
        ("decisions: many", ArgumentError, r"own.yaml: decisions: expected a whole number, got 'many'"),
        ("decisions: 2.5", ArgumentError, "decisions: expected a whole number"),
        ("decisions: true", ArgumentError, "decisions: expected a whole number"),
        ("motion: fly", ArgumentError, "motion: expected one of refuse, slide, got 'fly'"),
        ("radius: wide", ArgumentError, "radius: expected a number"),
        ("horizon: 0", ArgumentError, "must be positive"),
        ("generator: 3", ArgumentError, "own.yaml: generator: expected rules for generated episodes"),
        ("generator: {nearby: 3}", ArgumentError, "unknown rule 'nearby'"),
        ("policy: [navigator]", ArgumentError, "policy: expected the name of a policy"),
        ("base: mine", ArgumentError, "base 'mine' is not one of default, paper, foresight, official"),
        ("- 1\n- 2", FileError, "expected rules as `name: value` lines, got list"),
        ("a: [", FileError, "own.yaml"),
        (r'a: "\Ud80088888888888888"', FileError, "expected characters of Unicode"),
        ("a: 2026-13-40", FileError, "own.yaml.*month"),
        ("decisions: 10\nradius: 1\ndecisions: 11", FileError, r"own.yaml.*key 'decisions' twice .* lines 1 and 3"),
        ("policies: {matcher: {gate: 1, gate: 2}}", FileError, "own.yaml.*key 'gate' twice"),
        (
            "policies: {matchr: {gate: 1}}",
            ArgumentError,
            r"own.yaml: policies: no policy is named 'matchr'; expected path.py:Class or .*Did you mean matcher\?",
        ),
        (
            "models: {wrp: {size: [144, 256]}}",
            ArgumentError,
            "own.yaml: models: no world model is named 'wrp'; .*Did you mean warp",
        ),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path: Path, text: str, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        ImageNav(preset=write_preset(tmp_path, text))


def test_keys_of_other_mappings_may_be_overridden_but_none_may_be_given_twice() -> None:
    shared = "a: &a {x: 1, y: 2}\nb: {<<: *a, x: 3}\nc: {<<: [{x: 5}, *a], y: 4}\n"
    assert parse_yaml(shared) == {"a": {"x": 1, "y": 2}, "b": {"x": 3, "y": 2}, "c": {"x": 5, "y": 4}}
    assert parse_yaml("1: a\n'1': b") == {1: "a", "1": "b"}
    for text in ("x: {a: 1,\n a: 2}", "1: a\n0x1: b", "<<: {b: 1}\na: 1\na: 2"):
        with pytest.raises(ValueError, match=r"key '\w+' twice in one mapping, in lines \d and \d; leave one out"):
            parse_yaml(text)


def test_a_preset_has_options_of_a_class_in_a_file_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = write_preset(tmp_path, "models: {'mine.py:Mine': {n: 7}}\npolicies: {'isolated:mine.py:Plans': {m: 1}}")
    task = ImageNav(preset=own)
    for folder, name in ((tmp_path.parent, f"{tmp_path / 'mine.py'}:Mine"), (tmp_path, "mine.py:Mine")):
        monkeypatch.chdir(folder)
        assert AgentRecipe("matcher", name).resolve_model_options(task) == {"n": 7}
    recipe = AgentRecipe("isolated:mine.py:Plans")
    assert recipe.resolve_policy_options(recipe.policy, task) == {"m": 1}


def test_a_preset_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        ArgumentError, match=r"no preset 'offical'; choose from default, paper, foresight, official, or give the path"
    ):
        ImageNav(preset="offical")
    with pytest.raises(FileError, match=r"none\.yaml"):
        ImageNav(preset=tmp_path / "none.yaml")
    with pytest.raises(ArgumentError, match="imagenav: unknown option 'speed'"):
        ImageNav(speed=3)


def test_a_run_takes_a_preset_by_name_or_file_and_resume_refuses_a_changed_one(
    two_rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    own = write_preset(tmp_path, "base: official\ndecisions: 1\n")
    arguments = ["--scenes", two_rooms, "--policy", "heuristic", "--episodes", "1", "--no-report", "--keep-images", "0"]
    assert main(["run", "imagenav", "--preset", own.name, "--out", "run", *arguments]) == 0
    log = wiw.load_run("run")
    assert log.store.config["task"]["decisions"] == 1 and log.store.config["task"]["spl"] == "actions"
    write_preset(tmp_path, "base: official\ndecisions: 2\n")
    monkeypatch.chdir("/")
    with pytest.raises(StoreError, match="decisions: the run has 1, now 2"):
        resume_run(tmp_path / "run")


def test_evaluate_takes_a_task_by_name_with_its_preset(two_rooms: str, tmp_path: Path) -> None:
    log = evaluate(
        "imagenav",
        AgentRecipe("heuristic"),
        1,
        out=tmp_path,
        progress=False,
        scenes=two_rooms,
        preset="official",
        decisions=1,
    )
    assert log.store.config["task"]["checked"] == "decision"
    assert log.store.info["built"]["none"]["execute"] == -2
    with pytest.raises(ArgumentError, match="cannot take preset"):
        evaluate(ImageNav(scenes=two_rooms), AgentRecipe("heuristic"), 1, preset="official")


def test_list_names_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    shown = capsys.readouterr().out
    assert "Presets of imagenav" in shown and "the published code" in shown


def test_reading_a_preset_is_left_to_whoever_needs_one() -> None:
    code = "import sys, wiw, wiw.tasks.presets; sys.exit('yaml' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
