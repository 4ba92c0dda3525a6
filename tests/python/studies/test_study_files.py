# SPDX-License-Identifier: Apache-2.0
"""`wiw study`: YAML files that list runs, what is compared and what is plotted."""

from __future__ import annotations

import json
import re
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from fakes import LineAgent, LineTask

import wiw
from wiw.cli.app import main
from wiw.errors import ArgumentError, FileError, ScorerError, StoreError, WeightsError
from wiw.report import study_page
from wiw.runs.config import RunConfig
from wiw.studies.evaluate import run_arms
from wiw.studies.study import StudyPart, _adjust, _compare
from wiw.studies.study_file import list_studies, load_study, parse_variables

OWN = """
title: Is <it> worth it?
about: one line
text: Bear & mind.
variables: {scenes: SCENES, model: warp, episodes: 2, options: {size: [64, 128]}, extra: null}
small: {episodes: 1}
settings: {seed: 3, keep_images: 0}
runs:
  here:
    task: imagenav
    task_options: {scenes: "{scenes}", decisions: 1, goal_instances: 1}
    settings: {episodes: "{episodes}"}
    agent: {policy: heuristic, candidates: 2, model: "{model}", reviser: matcher}
    arms:
      none: {model: none, reviser: null}
      front: {model_options: {view: perspective, size: [48, 48]}}
      around: {model_options: {view: panorama, size: [48, 96]}, with: {model_options: "{options}"}}
      left-out: {when: "{extra}", model: "{extra}"}
    compare: [[around, front], [left-out, front]]
    plots: [success, rollouts]
"""


@pytest.fixture
def own(two_rooms: str, tmp_path: Path) -> Path:
    path = tmp_path / "own.yaml"
    path.write_text(OWN.replace("SCENES", two_rooms))
    return path


def test_a_study_runs_resumes_and_draws_its_page(own: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out"
    command = ["study", str(own), "--out", str(out), "--set", "episodes=2"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "Comparisons, paired by episode" in said and str(out / "study.html") in said
    written = {path.name for path in out.iterdir()}
    assert written >= {"study.html", "study.json", "study.yaml", "here", "here-success-by-arm.svg"}
    page = (out / "study.html").read_text()
    assert "Is &lt;it&gt; worth it?" in page and "Bear &amp; mind." in page and page.count("<svg") == 2
    assert "around - front" in page and "left-out - front" not in page
    assert not re.search(r"(src|href)=.https?:", page)
    numbers = json.loads((out / "study.json").read_text())["runs"][0]
    assert [line["arm"] for line in numbers["arms"]] == ["none", "front", "around"]
    assert {line["n"] for line in numbers["arms"]} == {2} and numbers["arms"][0]["rollouts"] == 0
    assert numbers["arms"][1]["rollouts"] == numbers["arms"][2]["rollouts"] > 0  # equal numbers of futures
    assert {(each["arm"], each["base"]) for each in numbers["differences"]} == {("around", "front")}
    log = wiw.load_run(out / "here")
    ended = [(row["arm"], row["episode"], row["seconds"]) for row in log.episodes]
    assert wiw.study(own, out=out, progress=False).save()  # nothing is run again
    assert [(row["arm"], row["episode"], row["seconds"]) for row in wiw.load_run(out / "here").episodes] == ended
    plan = (out / "study.yaml").read_text()
    with pytest.raises(StoreError, match="episodes"):
        wiw.study(own, out=out, variables={"episodes": 1}, progress=False)
    assert (out / "study.yaml").read_text() == plan, "it says what was run"


def test_a_study_that_was_begun_may_gain_arms_and_nothing_else(own: Path, tmp_path: Path) -> None:
    own.write_text(own.read_text().replace("seed: 3", "seed: 3, salt: pepper").replace("[left-out, front]", ""))
    content = yaml.safe_load(own.read_text())
    arms = content["runs"]["here"]["arms"]

    def run(out: str, *names: str, **changes: Any) -> dict[tuple[str, int], Any]:
        content["runs"]["here"]["arms"] = {name: {**arms[name], **changes} for name in names}
        content["runs"]["here"]["compare"] = []
        own.write_text(yaml.safe_dump(content, sort_keys=False))
        wiw.study(own, out=tmp_path / out, variables={"episodes": 1}, progress=False)
        log = wiw.load_run(tmp_path / out / "here")
        return {(row["arm"], row["episode"]): (row["metrics"], row["seconds"]) for row in log.episodes}

    few = run("grown", "none", "around")
    grown, whole = run("grown", "none", "front", "around"), run("whole", "none", "front", "around")
    assert few.items() <= grown.items(), "what has been run stays"
    assert list(grown) == list(whole) and {arm for arm, _ in grown} == {"none", "front", "around"}
    assert [metrics for metrics, _ in grown.values()] == [metrics for metrics, _ in whole.values()]
    log = wiw.load_run(tmp_path / "grown" / "here")
    assert log.arms == ["none", "front", "around"]
    assert [each["arms"] for each in log.store.info["arms_added"]] == [["front"]]
    for names, changes in ((("none", "front"), {}), (("none", "front", "around"), {"candidates": 3})):
        with pytest.raises(StoreError, match=r"run with a different configuration \(arms"):
            run("grown", *names, **changes)


def test_variables_are_filled_in_and_arms_are_merged(own: Path) -> None:
    (run,) = load_study(own).runs
    assert list(run.agents) == ["none", "front", "around"] and run.agents["none"].model is None
    assert run.agents["around"].model_options == {"view": "panorama", "size": [64, 128]}
    assert run.agents["front"].model == "warp" and run.compare == (("around", "front"),)
    assert run.settings == RunConfig(seed=3, keep_images=0, episodes=2) and run.task.options["seed"] == 3
    assert load_study(own, small=True).runs[0].settings.episodes == 1
    assert load_study(own, {"episodes": 7}, small=True).runs[0].settings.episodes == 7
    with_more = load_study(own, {"extra": "copy", "model": "oracle"}).runs[0]
    assert with_more.agents["left-out"].model == "copy" and with_more.agents["front"].model == "oracle"
    assert len(with_more.compare) == 2
    assert parse_variables(["a=1", "b=[1, 2]", "c=x", "d="]) == {"a": 1, "b": [1, 2], "c": "x", "d": None}


def test_a_run_may_be_named_by_a_number(own: Path) -> None:
    own.write_text(own.read_text().replace("  here:", "  2024:"))
    assert [run.name for run in load_study(own).runs] == ["2024"]


def test_a_pair_of_arms_named_by_text_says_which_is_unknown(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    run = {"task": "imagenav", "agent": {"policy": "matcher"}, "arms": "none,copy"}
    file.write_text(yaml.safe_dump({"runs": {"here": {**run, "compare": [["copy", "none"]]}}}))
    assert load_study(file).runs[0].compare == (("copy", "none"),)
    file.write_text(yaml.safe_dump({"runs": {"here": {**run, "compare": [["copy", "nome"]]}}}))
    with pytest.raises(ArgumentError, match=r"compare: unknown name 'nome'; expected one of none, copy.*mean none"):
        load_study(file)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("title:", "titel:", "unknown name 'titel'.*Did you mean title"),
        ("small: {episodes", "small: {1: 2, episodes", "small: unknown name '1'"),
        ("variables: {", "variables: {off: 3, ", "variables: expected a name, got one that YAML reads as False"),
        (", model: warp,", ", 1: warp,", "unknown name 'model'; expected one of scenes, 1, episodes"),
        (
            '"{model}", reviser',
            '"{modle}", reviser',
            "runs: here: agent: model: unknown name 'modle'.*Did you mean model",
        ),
        (
            "small: {episodes",
            "small: {episode",
            "small: unknown name 'episode'; expected one of scenes, model, episodes",
        ),
        ("policy: heuristic, ", "", "arms: none: expected a policy, here or in `agent`, got none"),
        ("candidates: 2", "candidate: 2", "arms: none: unknown name 'candidate'.*Did you mean candidates"),
        ("[around, front], ", "[round, front], ", "compare: unknown name 'round'.*Did you mean around"),
        ("[[around, front], [left-out, front]]", "[around, front]", "compare: expected pairs of arms"),
        ("[success, rollouts]", "[succes]", "plots: unknown name 'succes'.*Did you mean success"),
        ("[success, rollouts]", "true", "plots: expected a list of names, got True"),
        (
            "[success, rollouts]",
            "[quality]\n    quality: {scorers: laion}",
            r"here: quality: scorers: expected \[text, \.\.\.\], got 'laion'",
        ),
        (
            "[success, rollouts]",
            "[quality]\n    quality: {frames: many}",
            "quality: frames: expected a whole number, got 'many'",
        ),
        ("[success, rollouts]", "[quality]", "here: the plot 'quality' scores pictures, of which keep_images: 0"),
        ("[success, rollouts]", "[quality]\n    quality: {frame: 8}", "quality: unknown name 'frame'.*mean frames"),
        (
            "[success, rollouts]",
            "[success]\n    quality: {frames: 8}",
            "here: quality: nothing is scored without its plot; add `quality` to plots",
        ),
        (
            "      front:",
            "      no:",
            "arms: False: expected a name, got one that YAML reads as False; put it in quotes",
        ),
        ("  here:", "  null:", "runs: expected a name, got one that YAML reads as None"),
        ("keep_images: 0", "keep_image: 0", "settings: unknown name 'keep_image'.*Did you mean keep_images"),
        ("seed: 3", "out: there", "settings: unknown name 'out'"),
        ("seed: 3", "seed: three", "settings: seed: expected a whole number or null, got 'three'"),
        ("keep_images: 0", "keep_images: some", "settings: keep_images: expected a whole number or all, got 'some'"),
        ("seed: 3", "cache: off", "settings: cache: expected text or a path.*, got False"),
        ("candidates: 2", "candidates: two", "arms: none: candidates: expected a whole number or null, got 'two'"),
        ("candidates: 2", "ground_truth: scoring", "ground_truth: expected a list.*, got 'scoring'"),
        ("{model: none, reviser: null}", "{model: copy}", "the name 'none' is reserved for the reference"),
        ("      front:", "      fr/ont:", "arms"),
        ("runs:\n  here:", "runs: {}\nsmal:\n  here:", "unknown name 'smal'"),
    ],
)
def test_what_a_study_cannot_say_is_refused_with_its_place(own: Path, old: str, new: str, said: str) -> None:
    text = own.read_text()
    assert old in text
    own.write_text(text.replace(old, new, 1))
    with pytest.raises(ArgumentError, match=said):
        load_study(own)


def test_scorers_and_weights_are_looked_for_before_anything_runs(own: Path, tmp_path: Path) -> None:
    text = own.read_text().replace("keep_images: 0", "keep_images: 1")
    for options, error, said in (
        ("scorers: [no-such-command]", ScorerError, "no-such-command"),
        (f"lpips: {tmp_path}", WeightsError, "lpips"),
    ):
        own.write_text(text.replace("[success, rollouts]", f"[quality]\n    quality: {{{options}}}", 1))
        with pytest.raises(error, match=said):
            wiw.study(own, out=tmp_path / "out", progress=False)
    assert not (tmp_path / "out").exists()


def test_studies_are_listed_taught_and_looked_up(capsys: Any, tmp_path: Path) -> None:
    assert {"front-vs-panorama", "models", "vlm"} <= set(list_studies())
    assert main(["list", "studies"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in ("data-scaling", "front-vs-panorama", "models", "vlm"))
    with pytest.raises(SystemExit):
        main(["study"])
    taught = capsys.readouterr().out
    example = taught[taught.index("  title:") : taught.index("An arm accepts")]
    (tmp_path / "example.yaml").write_text(example)
    assert [*load_study(tmp_path / "example.yaml").runs[0].agents] == [
        "none",
        "short",
        "long",
    ]  # the help can be copied
    assert main(["study", "modles"]) == 2 and "Did you mean models?" in capsys.readouterr().err
    assert main(["study", "vlm", "--set", "servr=x"]) == 2 and "Did you mean server?" in capsys.readouterr().err
    assert main(["study", "vlm", "--set", "server"]) == 2 and "expected NAME=VALUE" in capsys.readouterr().err
    with pytest.raises(FileError, match=r"nowhere.yaml does not exist; expected a study"):
        load_study(tmp_path / "nowhere.yaml")
    for name, call in (("errors", r"wiw\.study_errors"), ("data-scaling", r"wiw\.data_scaling")):
        with pytest.raises(ArgumentError, match=f"'{name}' is a function of its own: call {call}"):
            wiw.study(name)


def test_shipped_studies_are_what_they_say() -> None:
    (front,) = load_study("front-vs-panorama").runs
    one, other = (front.agents[name].model_options for name in ("front", "panorama"))
    pixels = [options["size"][0] * options["size"][1] for options in (one, other)]
    assert abs(pixels[0] / pixels[1] - 1) < 0.01 and (one["view"], other["view"]) == ("perspective", "panorama")
    assert front.agents["front"].numbers == front.agents["panorama"].numbers and front.compare == (
        ("panorama", "front"),
    )
    (models,) = load_study("models", {"arms": "none,copy,big=warp?size=[64,128]"}).runs
    assert list(models.agents) == ["none", "copy", "big"] and models.settings.keep_images == "all"
    (vlm,) = load_study("vlm").runs
    assert "other-revises" not in vlm.agents and "imported" not in vlm.agents and "base" in vlm.agents
    (vlm,) = load_study("vlm", {"model": "a", "other": "b", "other_server": "http://b", "imported": "prompts"}).runs
    assert vlm.agents["other-revises"].policy_options["vlm"] == {
        "vlm": "http://localhost:8000/v1", "model": "a", "roles": {"revise": {"vlm": "http://b", "model": "b"}}
    }  # fmt: skip
    assert vlm.agents["imported"].policy_options["vlm"]["prompts"] == "prompts"


@pytest.mark.nightly
def test_the_studies_of_models_and_of_views_run_in_small(tmp_path: Path, two_rooms: str) -> None:
    tiny = {"scenes": two_rooms, "episodes": 2, "per_scene": 2, "tier": "any"}
    arms = {"arms": "none,copy,warp?size=[64,128],oracle?size=[64,128]", "frames": 6}
    found = wiw.study("models", out=tmp_path / "m", small=True, variables={**tiny, **arms}, progress=False)
    assert found.save() and "controllability" in (tmp_path / "m/study.html").read_text()
    sizes = {"front_size": [48, 48], "panorama_size": [34, 68]}
    found = wiw.study("front-vs-panorama", out=tmp_path / "f", small=True, variables={**tiny, **sizes}, progress=False)
    assert [line.name for line in found.parts[0].numbers.arms] == ["none", "front", "panorama"]


@pytest.mark.nightly
def test_the_study_of_language_models_asks_each_server_for_its_part(tmp_path: Path) -> None:
    pytest.importorskip("openai")
    from wiw.serving.vlm_server import VlmServer
    from wiw.vlm.mock import MockClient

    own = tmp_path / "prompts/ar/answerer.j2"
    own.parent.mkdir(parents=True)
    own.write_text("Which of these is it?")
    with VlmServer(MockClient(model="a")) as first, VlmServer(MockClient(model="b")) as second:
        names = {"server": first.url, "other_server": second.url, "model": "a", "other": "b", "task": "ar"}
        more = {"world_model": "copy", "imported": str(own.parents[1])}
        found = wiw.study("vlm", out=tmp_path / "out", small=True, variables={**names, **more}, progress=False)
    (part,) = found.parts
    assert len(part.numbers.arms) == 10 and not found.invalid
    assert any(own.read_text() in str(call.messages) for call in first.client.calls)
    asked: dict[str, set[str]] = {}
    for row in part.log.decisions:
        for exchange in row["exchanges"]:
            asked.setdefault(row["arm"], set()).add(f"{exchange['purpose'].partition('/')[0]} {exchange['model']}")
    assert "answer b" in asked["other-answers"] and "answer a" in asked["other-revises"]
    assert "move b" in asked["other-revises"] and "propose b" in asked["other-proposes"]
    assert not any(each.endswith(" b") for each in asked["base"])


def test_a_line_that_is_no_arms_has_no_rollouts() -> None:
    """Tables of question answering have a line for the best guess from the text alone."""
    log: Any = SimpleNamespace(table=lambda: [{"arm": "none"}, {"arm": "blind"}])
    part = StudyPart(SimpleNamespace(name="here"), log, SimpleNamespace(), (), {"none": 2.0})  # type: ignore[arg-type]
    assert part.as_dict()["arms"] == [{"arm": "none", "rollouts": 2.0}, {"arm": "blind"}]


def test_the_small_version_has_a_folder_of_its_own(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["study", str(own), "--small"]) == 0
    assert [each.name for each in (tmp_path / "runs").iterdir()] == ["study-own-small"]


def test_a_control_is_one_whatever_its_name(own: Path, tmp_path: Path) -> None:
    text = own.read_text().replace("left-out: {when", "control: {model: copy, placebo: swapped}\n      left-out: {when")
    own.write_text(text)
    found = wiw.study(own, out=tmp_path / "out", progress=False)
    roles = {line.name: line.role for line in found.parts[0].numbers.arms}
    assert roles["control"] == "control: same compute, futures of another episode"
    assert roles["front"] == roles["around"] == "world model" and roles["none"].startswith("policy without")


def test_pairs_of_all_runs_are_adjusted_together(tmp_path: Path) -> None:
    arms = {"none": LineAgent(0.1), "warp": LineAgent(0.9)}
    run: Any = SimpleNamespace(compare=(("warp", "none"),))
    with closing(run_arms(LineTask(), arms, 16, out=tmp_path, progress=False)) as log:
        part = StudyPart(run, log, log.numbers(), _compare(run, log), {})
    (first,) = [each for each in part.differences if each.metric == "success"]
    for count in (1, 3):
        for own in _adjust([part] * count):
            (found,) = [each for each in own.differences if each.metric == "success"]
            assert found.p_adjusted == pytest.approx(min(1.0, count * first.p_value))


def test_pairs_of_a_run_that_was_looked_at_have_the_p_of_bets(tmp_path: Path) -> None:
    arms = {"none": LineAgent(0.1), "warp": LineAgent(0.9)}
    run: Any = SimpleNamespace(compare=(("warp", "none"),))
    with closing(run_arms(LineTask(), arms, 16, out=tmp_path, progress=False, until="width<1", look_every=8)) as log:
        found = {each.metric: each.p_value for each in _compare(run, log)}
        assert found == {each.metric: each.p_value for each in log.numbers().differences}
    assert found["actions"] == 1


def test_figures_of_runs_of_like_names_are_all_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study_page, "list_figures", lambda part: [("Success", "", part.run.name)])
    monkeypatch.setattr(study_page, "render_study", lambda *_: "page")
    parts = [SimpleNamespace(run=SimpleNamespace(name=name)) for name in ("near@1", "near:1", "Near@1")]
    study_page.write_study(None, parts, "{}", tmp_path)
    drawn = sorted(each.read_text() for each in tmp_path.glob("*.svg"))
    assert drawn == ["Near@1", "near:1", "near@1"]


def test_an_arm_that_a_study_has_twice_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("runs:\n  here:\n    arms:\n      long: {horizon: 10}\n      long: {horizon: 5}\n")
    with pytest.raises(FileError, match=r"own.yaml.*key 'long' twice in one mapping, in lines 4 and 5"):
        load_study(file)
