# SPDX-License-Identifier: Apache-2.0
"""Presets set what a number depends on, and a run that is not by the paper's protocol says so."""

from __future__ import annotations

import inspect
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from locations import PYTHON_TESTS, ROOT

import wiw
from recognition_file import a_file
from wiw.cli import main
from wiw.errors import ArgumentError, PromptError
from wiw.policies.matcher.policy import Matcher
from wiw.policies.vlm.policy import VLM
from wiw.policies.vlm.prompt_images import resize_view
from wiw.policies.vlm.prompt_import.importer import CARD, write_templates
from wiw.policies.vlm.prompts.templates import Prompts
from wiw.registry import POLICIES, WORLD_MODELS, find_options, task_class
from wiw.runs.compose import RunContext
from wiw.runs.departures import EPISODES, find_departures
from wiw.runs.ready_parts import require_preset
from wiw.runs.recipes import AgentRecipe, TaskInMemory, TaskRecipe, agent_recipe
from wiw.tasks import presets
from wiw.tasks.ar import AR
from wiw.tasks.imagenav import ImageNav
from wiw.tasks.manipulation import Manipulation
from wiw.types import Key
from wiw.vlm.messages import Call
from wiw.vlm.mock import MockClient
from wiw.world_models.clips import Alignment
from wiw.world_models.plan_text import make_template
from wiw.world_models.warp import Warp

SHIPPED = [(task, preset) for task in EPISODES for preset in presets.list_presets(task)]


def find_topics(task: Any, **agent: Any) -> dict[str, str]:
    recipe = AgentRecipe(**{"policy": "vlm", **agent})
    return {departure.topic: departure.found for departure in find_departures(task, {"arm": recipe})}


@pytest.fixture
def imported(tmp_path: Path) -> dict[str, dict[str, str]]:
    """Options of policy `vlm` with prompts that were imported, of which none is for ImageNav."""
    folder = tmp_path / "prompts"
    write_templates(folder, {"ar/planner": "Go on."})
    card = {"digest": Prompts(folder).digest, "imported": {"ar/planner": "main.tex:1"}}
    (folder / CARD).write_text(yaml.safe_dump(card))
    return {"vlm": {"prompts": str(folder)}}


# -- what presets set --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("task", "preset"), SHIPPED)
def test_every_setting_of_a_preset_is_an_option_of_its_part(task: str, preset: str) -> None:
    found = presets.load_preset(task, preset)
    assert found.rules.keys() <= set(presets.rule_names(type(task_class(task)(preset=preset).rules)))
    for registry, parts in ((POLICIES, found.policies), (WORLD_MODELS, found.models)):
        for name, options in parts.items():
            assert options.keys() <= inspect.signature(registry.find(name)).parameters.keys(), name
    for name, options in found.models.items():
        if "alignment" in options:
            assert Alignment.parse(options["alignment"], options["frames"]).frames == 14, name
            assert make_template(options["template"]) is not None


@pytest.mark.parametrize(("task", "preset"), [each for each in SHIPPED if each[1] != "paper-diffusion"])
def test_each_rule_that_differs_from_the_papers_has_a_reason(task: str, preset: str) -> None:
    found, paper = (presets.load_preset(task, name) for name in (preset, "paper"))
    changed = {name for name, value in found.rules.items() if paper.rules[name] != value}
    assert changed <= found.departures.get("rules", {}).keys()
    ours, theirs = (each.policies.get("vlm", {}) for each in (found, paper))
    assert {name for name in ours if theirs.get(name) != ours[name]} <= found.departures["vlm"].keys()


def test_the_published_settings_of_models_reach_them(world_model_options, tmp_path: Path) -> None:
    pytest.importorskip("diffusers")

    task = ImageNav("apartments:val", preset="official")
    options = world_model_options("wan2.2-5b")
    recipe = AgentRecipe("heuristic", "wan2.2-5b", "matcher", model_options={"weights": options["weights"], "steps": 1})
    model = recipe.build(RunContext(task)).model.unwrapped
    assert (model.size, model.frames, model.guidance, model.steps) == ((704, 704), 33, 5.0, 1), (
        "options given come last"
    )
    assert model.accepts.frames == 14 and model.accepts.template.separator == ", "
    assert recipe.resolve_model_options(ImageNav("apartments:val")) == recipe.model_options


def test_the_policy_has_the_presets_settings() -> None:
    vlm = {"vlm": {"vlm": "mock", "tracker": "growing", "cache": "off"}}
    recipe, found = AgentRecipe("vlm", policy_options=vlm), {}
    for preset in ("default", "paper", "official"):
        policy = recipe._make_policy("vlm", "discrete", AR("apartments:val", preset=preset))
        found[preset] = (policy.view_size, policy.temperature, policy.revision_temperature, policy.tries)
    assert found == {"default": (None, 1.0, 0.0, 3), "paper": (384, 1.0, 0.0, 3), "official": (512, 1.0, 1.0, 5)}
    with pytest.raises(ArgumentError, match="expected view_size of at least 1, for tasks ar, imagenav, got 384"):
        wiw.policy("vlm", vlm="mock", task="aeqa", view_size=384)


@pytest.mark.parametrize("side", [384, 512, None])
def test_views_are_shown_in_the_asked_size(side: int | None) -> None:
    view = np.zeros((480, 480, 3), np.uint8)
    view[:240] = 200
    shown = resize_view(view, side)
    assert shown.shape == (side or 480, side or 480, 3)
    assert shown[: len(shown) // 2 - 3].min() == 200 and shown[len(shown) // 2 + 3 :].max() == 0


def answer_plans(call: Call) -> str:
    """Return plans that differ by their seed, so that each is a plan of its own."""
    turns = ["turn_left"] * (1 + call.seed % 3)
    return json.dumps({"reason": "", "actions": [*turns, "forward", "forward"][:5]})


class Listening(wiw.WorldModel):
    """Notes what it is asked."""

    accepts = wiw.accepts(control="text", view="perspective", frames=14)

    def __init__(self) -> None:
        self.asked: list[tuple[tuple[int, ...], str]] = []

    def rollout(self, observations: Any, controls: Any, seeds: Any) -> Any:
        rows = zip(observations.image, controls, strict=True)
        self.asked += [(image.shape, control.text) for image, control in rows]
        return np.repeat(observations.image[:, None], 14, 1)


@pytest.mark.parametrize(
    ("preset", "side", "revised_at"), [("default", 480, 0.0), ("paper", 384, 0.0), ("official", 512, 1.0)]
)
def test_what_is_asked_in_an_image_goal_episode(preset: str, side: int, revised_at: float, two_rooms: str) -> None:
    """Three plans from front view, panorama and goal; then a plan from the goal and a strip of 384 pixels a plan."""
    client, model = MockClient(answer_plans), Listening()
    task = ImageNav(two_rooms, preset=preset)
    recipe = AgentRecipe("vlm", model, policy_options={"vlm": {"vlm": client}})
    env = task.environment(depth=True)
    observation = env.begin(task.episode(0))
    agent = recipe.build(RunContext(task))
    agent.decide(observation, env.goal, key=Key(0, 0, 0))
    *plans, revision = client.calls
    assert len(plans) == 3 and {call.temperature for call in plans} == {1.0}
    for call in plans:
        assert list_shapes(call) == [(side, side, 3), (576, 1024, 3), (side, side, 3)]
    goal, *strips = list_shapes(revision)
    assert goal == (side, side, 3) and 1 <= len(strips) <= 3
    assert all(height > 384 and (width + 4) % 388 == 0 for height, width, _ in strips), "frames of 384, 4 apart"
    assert revision.temperature == revised_at
    assert model.asked and all(shape == (480, 480, 3) and text for shape, text in model.asked)


@pytest.mark.parametrize(("preset", "side"), [("default", 480), ("paper", 384), ("official", 512)])
def test_what_is_asked_in_a_recognition_episode(preset: str, side: int, two_rooms: str, tmp_path: Path) -> None:
    """Two plans from boxed front view and panorama, a primitive with their strips, a question with all categories."""
    client, model = MockClient(lambda call: {"A": 0.6, "B": 0.4} if call.labels else answer_plans(call)), Listening()
    task = AR(episode_file=a_file(tmp_path, two_rooms), preset=preset)
    env = task.environment(depth=True)
    observation = env.begin(task.episode(0))
    recipe = AgentRecipe("vlm", model, policy_options={"vlm": {"vlm": client, "tracker": "flow"}})
    recipe.build(RunContext(task)).decide(observation, env.goal, key=Key(0, 0, 0))
    *plans, move, category = client.calls
    assert len(plans) == 2 and {call.temperature for call in plans} == {1.0}
    assert len(move.labels) == 3 and len(category.labels) == len(env.goal.choices)
    for call in client.calls:
        assert list_shapes(call)[:2] == [(side, side, 3), (576, 1024, 3)]
    assert [len(list_shapes(call)) for call in plans] == [2, 2] and len(list_shapes(move)) == 4
    for height, width, _ in [*list_shapes(move)[2:], *list_shapes(category)[2:]]:
        assert height > 384 and (width + 4) % 388 == 0, "frames of 384, 4 apart"
    assert model.asked and all(shape == (480, 480, 3) and text for shape, text in model.asked)


def list_shapes(call: Call) -> list[tuple[int, ...]]:
    return [part.shape for message in call.messages for part in message.content if not isinstance(part, str)]


# -- departures of a run -----------------------------------------------------------------------------------------------


def test_a_run_by_the_paper_departs_by_its_episodes_and_what_cannot_be_copied_alone(imported) -> None:
    found = find_topics(AR("apartments:val", preset="paper"), model="svd", policy_options=imported)
    assert found == {"episodes": "generated in apartments:val (paper: 551 of Matterport3D)", "temperatures": ""}
    told = find_topics(AR("apartments:val", preset="paper"), model="wan2.1", policy_options=imported)
    assert told.keys() - found.keys() == {"wording of plans", "clip alignment"}


def test_every_difference_of_a_run_is_found(imported) -> None:
    vlm = {"vlm": {**imported["vlm"], "tries": 9, "view_size": 384}}
    task = AR("apartments:val", decisions=4)
    found = find_topics(task, model="svd", candidates=7, reviser="matcher", policy_options=vlm)
    assert found["decisions"] == "4 (paper: 10)" and found["candidates"] == "7 (paper: 2)"
    assert found["tries"] == "9 (paper: open)" and found["tracker"] == "frames (paper: sam2)"
    assert found["revision"] == "matcher (paper: vlm)" and "view_size" not in found
    assert find_topics(task, policy="matcher")["policy"] == "matcher (paper: vlm, heuristic)"
    assert find_topics(task, policy_options={"vlm": {"prompts": "minimal"}})["prompts"] == "minimal (paper: its own)"


def test_the_key_of_a_server_is_no_departure_and_is_told_nobody(imported) -> None:
    own = {"vlm": {**imported["vlm"], "key": "SECRET"}}
    task = AR("apartments:val")
    assert find_topics(task, policy_options=own) == find_topics(task, policy_options=imported)
    roles = {"revise": {"model": "m", "vlm": "http://b/v1", "key": "SECRET"}}
    found = find_topics(task, policy_options={"vlm": {**own["vlm"], "roles": roles}})
    assert "http://b/v1" in found["roles"] and "SECRET" not in str(found)


def test_prompts_are_the_papers_only_as_they_were_imported_for_the_task(imported) -> None:
    folder = Path(imported["vlm"]["prompts"])
    assert "prompts" not in find_topics(AR("apartments:val"), policy_options=imported)
    other = find_topics(ImageNav("apartments:val"), policy_options=imported)["prompts"]
    assert other == f"{folder}, of whose source none is for imagenav (paper: its own)"
    write_templates(folder, {"ar/planner": "Go on, and look behind doors."})
    changed = find_topics(AR("apartments:val"), policy_options=imported)["prompts"]
    assert changed == f"{folder}, changed since they were imported (paper: its own)"


def test_a_presets_reasons_are_for_its_own_values() -> None:
    agents = {"arm": AgentRecipe("vlm", policy_options={"vlm": {"tries": 7}})}
    found = {each.topic: each for each in find_departures(AR("apartments:val", preset="official", decisions=4), agents)}
    assert (found["decisions"].reason, found["tries"].reason) == ("", "")
    assert found["prediction"].reason and found["revision_temperature"].reason


def test_prompts_that_are_not_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(PromptError, match="expected one of the sets default, minimal, or a folder with templates"):
        find_topics(AR("apartments:val"), policy_options={"vlm": {"prompts": str(tmp_path / "minimall")}})


def test_settings_of_models_that_a_preset_names_count() -> None:
    task, own = ImageNav("apartments:val", preset="official"), {"steps": 5, "size": (704, 704), "guidance": 5.0}
    found = find_topics(task, model="wan2.2-5b", model_options=own, imagine_fraction=0.5)
    assert found["wan2.2-5b steps"] == "5 (preset: 50)"
    assert not {"wan2.2-5b size", "wan2.2-5b guidance"} & found.keys(), "as the preset has them"
    assert found["decisions with a world model"] == "a share of 0.5 (paper: all)"


def test_nobody_knows_whether_a_served_model_has_the_presets_options() -> None:
    served, said = "remote:ws://localhost:1", "options of a served world model"
    assert said in find_topics(ImageNav("apartments:val", preset="official"), model=served)
    assert said not in find_topics(ImageNav("apartments:val"), model=served), "there are none"


def test_fewer_episodes_than_the_papers_are_a_departure(tmp_path: Path, two_rooms: str) -> None:
    file = tmp_path / "val.json.gz"
    assert main(["episodes", "imagenav", "--scenes", two_rooms, "--episodes", "2", "--out", str(file)]) == 0
    tasks, agents = (ImageNav(episode_file=file), Manipulation()), {"arm": AgentRecipe("vlm")}
    found = [{str(each) for each in find_departures(tasks[0], agents, count)} for count in (1, 144)]
    assert "episodes 1 of val.json.gz (paper: 144 of HM3D)" in found[0]
    assert not any(each.startswith("episodes") for each in found[1])
    assert "episodes 8 (paper: 200 of RLBench)" in {each.short for each in find_departures(tasks[1], agents, 8)}
    assert "episodes" not in find_topics(tasks[1])


def test_the_published_code_departs_by_its_rules_with_reasons() -> None:
    task = ImageNav("apartments:val", preset="official")
    found = find_departures(task, {"arm": AgentRecipe("heuristic", "ltx", "vlm")})
    rules = {each.topic: each for each in found if each.topic in presets.load_preset("imagenav", "paper").rules}
    assert rules.keys() == {"decisions", "execute", "checked", "distance", "spl"}
    assert all(each.reason for each in rules.values()), rules
    topics = {each.topic for each in found}
    assert {"negative prompts", "seeds", "view_size"} <= topics and not {"clip alignment", "temperatures"} & topics


def test_the_papers_diffusion_policy_has_its_own_numbers() -> None:
    assert TaskRecipe("manipulation", {"preset": "paper-diffusion"}).find_policy() == "diffuser"
    found = find_topics(Manipulation(preset="paper-diffusion"), policy="diffuser", reviser="vlm")
    assert not {"actions", "horizon", "policy"} & found.keys()
    assert find_topics(Manipulation(), policy="diffuser")["horizon"] == "5 (paper: 50)"


def test_tables_are_never_taken_for_rlbenchs() -> None:
    for preset in presets.list_presets("manipulation"):
        assert "tables of this project, not RLBench's" in find_topics(Manipulation(preset=preset))


def test_a_task_of_ones_own_has_no_protocol_to_depart_from() -> None:
    from fakes import LineTask

    assert find_departures(LineTask(), {"arm": AgentRecipe("heuristic")}) == ()
    assert TaskInMemory(LineTask()).build().departures == {}


# -- parts that were made before a run ---------------------------------------------------------------------------------


class OwnAgent(wiw.Agent):
    """Decides otherwise."""


@pytest.fixture
def own_preset(tmp_path: Path) -> Path:
    path = tmp_path / "mine.yaml"
    path.write_text(
        "base: default\npolicies: {matcher: {gate: 0.1, imagined: 9.0}}\nmodels: {warp: {size: [72, 128]}}\n"
    )
    return path


def require(task: Any, agent: Any) -> None:
    agent_recipe(agent).require(task, 2)


def test_objects_without_the_presets_options_are_refused(own_preset: Path, two_rooms: str, tmp_path: Path) -> None:
    task, out = ImageNav(two_rooms, preset=own_preset), tmp_path / "run"
    policy, model = wiw.policy("matcher"), wiw.world_model("warp")
    with pytest.raises(
        ArgumentError,
        match=r"preset .*mine\.yaml sets gate, imagined of policy matcher, which this object was built without: write "
        r'wiw\.Agent\("matcher", \.\.\.\).* or build it as wiw\.policy\("matcher", \.\.\., gate=0\.1, imagined=9\.0\)',
    ):
        wiw.evaluate(task, wiw.Agent(policy, model), 1, out=out, progress=False)
    refused = r'mine\.yaml sets size of world model warp, .* wiw\.world_model\("warp", \.\.\., size=\[72, 128\]\)'
    for agent in (wiw.Agent("matcher", model), wiw.Agent("matcher", Warp), wiw.Agent("matcher", Warp(size=None))):
        with pytest.raises(ArgumentError, match=refused):
            require(task, agent)
    with pytest.raises(ArgumentError, match="sets gate, imagined of policy matcher"):
        require(task, wiw.Agent("heuristic", "copy", reviser=policy))
    with pytest.raises(ArgumentError, match="sets gate, imagined of policy matcher"):
        require(task, OwnAgent("matcher", "copy"))
    with pytest.raises(ArgumentError, match=refused):
        wiw.evaluate(task, wiw.Agent("matcher"), 1, arms={"mine": model}, out=out, progress=False)
    assert not out.exists()


def test_names_and_objects_with_the_presets_options_or_their_own_values_run(own_preset: Path) -> None:
    task, paper = (ImageNav("apartments:val", preset=preset) for preset in (own_preset, "paper"))
    require(task, wiw.Agent("matcher", "warp"))
    require(task, wiw.Agent(wiw.policy("matcher", gate=0.1, imagined=2), wiw.world_model("warp", size=(72, 128))))
    require(task, wiw.Agent(Matcher(gate=0.1, imagined=9.0), Warp(size=(72, 128))))
    require(task, wiw.Agent(wiw.policy("heuristic"), wiw.world_model("copy")))
    require(task, OwnAgent(wiw.policy("matcher", gate=0.1, imagined=9.0), "copy"))
    require(paper, wiw.Agent(wiw.policy("matcher"), wiw.world_model("warp")))


@pytest.mark.parametrize("task", EPISODES)
def test_the_default_preset_refuses_no_object(task: str, tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("base: default\ncandidates: 2\n")
    for preset in ("default", own):
        for policy in (wiw.policy("matcher"), wiw.policy("vlm", vlm="mock")):
            require_preset(task_class(task)(preset=preset), (policy,), wiw.world_model("warp"))


def test_a_language_model_built_without_the_papers_images_is_refused() -> None:
    paper, said = ImageNav("apartments:val", preset="paper"), "preset paper sets view_size of policy vlm"
    for policy in (wiw.policy("vlm", vlm="mock"), VLM("mock"), wiw.policy("vlm", vlm="mock", task="imagenav")):
        require(ImageNav("apartments:val"), wiw.Agent(policy))
        with pytest.raises(ArgumentError, match=said):
            require(paper, wiw.Agent(policy))
    require(paper, wiw.Agent(wiw.policy("vlm", vlm="mock", view_size=384)))
    require(paper, wiw.Agent(VLM("mock", view_size=384)))


@pytest.mark.parametrize("make", [VLM, lambda vlm, **options: wiw.policy("vlm", vlm=vlm, **options)])
def test_an_object_departs_as_the_same_agent_by_name_does(make: Any) -> None:
    for preset, view in (("default", {}), ("paper", {"view_size": 384})):
        task, own = ImageNav("apartments:val", preset=preset), {"vlm": "mock", "tries": 5, "prompts": "minimal", **view}
        named = find_topics(task, model="warp", policy_options={"vlm": own})
        assert find_topics(task, policy=make(**own), model=wiw.world_model("warp")) == named
        assert {"prompts", "temperatures", "tries"} <= named.keys() and "policy" not in named


def test_options_of_objects_are_compared_with_the_papers_and_the_presets() -> None:
    task = AR("apartments:val")
    told = find_topics(
        task, policy="matcher", reviser=wiw.policy("vlm", vlm="http://localhost:1/v1", key="SECRET", tracker="flow")
    )
    assert told["tracker"] == "flow (paper: sam2)" and told["policy"] == "matcher (paper: vlm, heuristic)"
    assert "SECRET" not in str(told)
    assert find_topics(task, policy=VLM("mock"))["tracker"] == "unknown (paper: sam2)"
    pair = AgentRecipe(wiw.policy("vlm", vlm="mock", tries=8), "warp", wiw.policy("vlm", vlm="mock", view_size=99))
    found = {each.short for each in find_departures(task, {"arm": pair})}
    assert {"tries 8 (paper: open)", "view_size 99 (paper: 384)"} <= found


def test_a_model_that_is_an_object_departs_by_its_options(own_preset: Path) -> None:
    task = ImageNav("apartments:val", preset=own_preset)
    found = find_topics(task, policy="matcher", model=wiw.world_model("warp", size=(144, 256)))
    assert found["warp size"] == "(144, 256) (preset: [72, 128])"
    assert "warp size" not in find_topics(task, policy="matcher", model=Warp(size=(72, 128)))


def test_what_a_part_was_made_with_is_kept_as_long_as_the_part() -> None:
    policy = wiw.policy("matcher", gate=0.1)
    assert find_options(policy) == ("matcher", {"gate": 0.1}) and find_options(Matcher()) is None
    place = id(policy)
    del policy
    assert place not in wiw.registry._MADE


# -- where it is said --------------------------------------------------------------------------------------------------


def test_manifest_tables_and_report_begin_with_it(two_rooms: str, tmp_path: Path, capsys) -> None:
    arguments = ["run", "imagenav", "--scenes", two_rooms, "--policy", "heuristic", "--episodes", "1"]
    assert main([*arguments, "--task-option", "decisions=1", "--out", str(tmp_path / "run")]) == 0
    log = wiw.load_run(tmp_path / "run")
    topics = [departure["topic"] for departure in log.store.info["departures"]]
    assert topics[:2] == ["decisions", "episodes"]
    said = "not the paper's protocol: decisions 1 (paper: 20); episodes generated in"
    assert str(log.summary()).startswith(said)
    page = re.sub(r"&#39;", "'", (tmp_path / "run/report.html").read_text())
    assert page.index(said) < page.index("With ") if "With " in page else said in page


def test_a_run_from_before_is_read_without(two_rooms: str) -> None:
    from wiw.runs.departures import read_departures

    assert read_departures({}) == ()


def test_a_dry_run_says_it_and_runs_nothing(two_rooms: str, tmp_path: Path, capsys) -> None:
    arguments = ["run", "ar", "--scenes", two_rooms, "--policy", "vlm", "--vlm", "mock", "--preset", "official"]
    assert main([*arguments, "--world-model", "ltx", "--dry-run", "--out", str(tmp_path / "run")]) == 0
    shown = capsys.readouterr().out
    assert "sets rules: decisions 11, prediction surest" in shown and "alignment frames_per_action=32/13" in shown
    assert "decisions 11 (paper: 10): its loop recognises 11 times and moves between" in shown
    assert not (tmp_path / "run").exists()


def test_the_list_says_what_each_preset_sets_and_why(capsys) -> None:
    assert main(["list", "presets"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "sets vlm: view_size 384, tracker sam2" in shown
    assert "departs from the paper: prediction surest (paper: last), for rules: of all answers the most" in shown


def test_reasons_of_a_file_of_ones_own_are_checked(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("base: paper\nradius: 1.0\ndepartures:\n  rules: {radius: our floor is large}\n")
    found = find_departures(ImageNav("apartments:val", preset=own), {"arm": AgentRecipe("vlm")})
    assert "radius 1.0 (paper: 0.5): our floor is large" in [str(each) for each in found]
    own.write_text("departures:\n  everyone: {radius: why}\n")
    with pytest.raises(ArgumentError, match=r"own\.yaml: departures: expected reasons, grouped by whom they concern"):
        ImageNav("apartments:val", preset=own)
    own.write_text("models: [ltx]\n")
    with pytest.raises(ArgumentError, match="models: expected options by name"):
        ImageNav("apartments:val", preset=own)


def test_each_line_of_the_page_on_differences_names_what_shows_it() -> None:
    files = {file.name for file in PYTHON_TESTS.rglob("test_*.py")}
    lines = (ROOT / "docs/differences.md").read_text().splitlines()
    rows = [line for line in lines if line.startswith("| ") and not line.startswith(("| |", "|---"))]
    assert len(rows) > 20
    for row in rows:
        proof = row.rstrip(" |").rpartition("|")[2]
        tests = re.findall(r"test_\w+\.py", proof)
        assert tests or "`wiw " in proof, row
        assert files.issuperset(tests), row
