# SPDX-License-Identifier: Apache-2.0
"""Arms with names and options of their own, on the command line and in Python."""

import pytest

import wiw
from wiw.cli import main
from wiw.cli.parts import AgentFlags
from wiw.errors import ArgumentError, RegistryError
from wiw.loop.config import AgentConfig
from wiw.runs.arm_text import ArmText, parse_arm, split_arms
from wiw.runs.recipes import AgentRecipe, absolute, arm_recipes, make_arm_absolute
from wiw.studies.run_log import load_run

TASK = "imagenav"
MODEL = """
from pathlib import Path

import numpy as np
import wiw


class Shade(wiw.WorldModel):
    accepts = wiw.accepts(control="image")

    def __init__(self, weights: str = "", size: "Sequence[int]" = (), strength: float = 1.0):
        self.strength = float(Path(weights).read_text()) if weights else strength

    def rollout(self, observations, controls, seeds):
        frames = np.repeat(observations.image[:, None], 1 + len(controls[0].actions), axis=1)
        frames[:, 1:] = frames[:, 1:] * self.strength
        return frames

    def describe(self):
        return {**super().describe(), "strength": self.strength}
"""


@pytest.fixture
def shade(tmp_path, monkeypatch):
    """A file with a world model that reads a checkpoint, two checkpoints beside it."""
    (tmp_path / "shade.py").write_text(MODEL)
    (tmp_path / "big.txt").write_text("0.9")
    (tmp_path / "small.txt").write_text("0.5")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "shade.py"


def test_an_arm_has_a_name_a_model_and_options(shade):
    assert parse_arm("warp") == ArmText(None, "warp")
    assert parse_arm("small=warpnet?weights=a=b.npz&steps=3") == ArmText(
        "small", "warpnet", ("weights=a=b.npz", "steps=3")
    )
    assert parse_arm("warpnet?weights=small.npz") == ArmText(None, "warpnet", ("weights=small.npz",))
    assert parse_arm("far=remote:ws://host:80") == ArmText("far", "remote:ws://host:80")
    assert parse_arm("remote:ws://host:80/a=b") == ArmText(None, "remote:ws://host:80/a=b")
    folder = shade.parent / "x=1"
    folder.mkdir()
    (folder / "m.py").write_text(MODEL)
    assert parse_arm(f"{folder}/m.py:Shade") == ArmText(None, f"{folder}/m.py:Shade")
    assert make_arm_absolute("big=heuristic+shade.py:Shade?strength=1") == f"big=heuristic+{shade}:Shade?strength=1"
    assert split_arms("none, a=x?size=[4,8]&n=1,b=y?size=[2, 2],") == ["none", "a=x?size=[4,8]&n=1", "b=y?size=[2, 2]"]


def test_arms_share_the_options_of_their_agent_and_have_their_own(shade):
    agent = AgentRecipe("matcher", f"{shade}:Shade", model_options={"strength": 0.25})
    texts = [
        "copy",
        f"a={shade}:Shade?weights=big.txt&size=4,8",
        f"b={shade}:Shade",
        f"p=placebo-shuffled:{shade}:Shade",
    ]
    made = arm_recipes(agent, texts)
    assert {name: recipe.model_options for name, recipe in made.items()} == {
        "copy": {},
        "a": {"strength": 0.25, "weights": str(shade.parent / "big.txt"), "size": [4, 8]},
        "b": {"strength": 0.25},
        "p": {"strength": 0.25},
    }
    assert made["p"].placebo == "shuffled" and made["a"].model == made["b"].model == agent.model
    assert arm_recipes(agent, {"x": f"{shade}:Shade?strength=0.5"})["x"].model_options == {"strength": 0.5}
    assert arm_recipes(agent, {"oracle": "oracle", "none": None, "copy": "copy"}).keys() == {"oracle", "none", "copy"}


@pytest.mark.parametrize(
    ("arms", "message"),
    [
        (["a=copy", "a=warp"], r"different world models, got \['a', 'a'\]; .*name them: big="),
        (["warpnet?weights=a", "warpnet?weights=b"], r"got \['warpnet', 'warpnet'\]; .*big=warpnet\?weights="),
        (["=copy"], "expected a name without surrounding spaces, got '' in '=copy'"),
        (["a/b=copy"], "name 'a/b' in 'a/b=copy' contains '/'"),
        (["a="], "expected NAME=MODEL"),
        (["a=warpnet?"], "expected NAME=MODEL"),
        (["a=warpnet?weights=x&"], "expected NAME=MODEL"),
        (["a=warpnet?weights"], "expected KEY=VALUE, got 'weights'"),
        (["a=warpnet?weights=x&weights=y"], "'weights' is given twice"),
        (["a=none?steps=3"], "has options but no named world model"),
        (["oracle=warp"], "the name 'oracle' is reserved for the reference"),
        (["copy=placebo-shuffled:copy"], "choose another name"),
        ({"": "copy"}, "expected a name without surrounding spaces"),
        ({" a": "copy"}, "expected a name without surrounding spaces"),
        ({"a,b": "copy"}, "contains ','"),
        ({"a\nb": "copy"}, "contains"),
        ({"a": "b=copy"}, "is named both 'a' and 'b'"),
        ({"a": wiw.Agent("matcher", "copy")}, r"expected world models, got Agent; .*wiw\.compare"),
    ],
)
def test_wrong_arms_are_refused_with_a_hint(arms, message):
    with pytest.raises(ArgumentError, match=message):
        arm_recipes(AgentRecipe("matcher"), arms)


def test_two_checkpoints_of_one_model_are_two_arms_of_a_run(shade, two_rooms, tmp_path, capsys):
    task = ["run", "imagenav", "--scenes", two_rooms, "--backend", "cpu", "--task-option", "decisions=1"]
    arms = "none,big=shade.py:Shade?weights=big.txt,small=shade.py:Shade?weights=small.txt"
    command = [*task, "--policy", "heuristic", "--revision", "matcher", "--episodes", "2", "--arms", arms]
    assert main([*command, "--out", "run"]) == 0
    assert "none, big, small" in capsys.readouterr().err
    log = load_run("run")
    assert log.arms == ["none", "big", "small"] and log.complete
    files = {arm["name"]: arm["agent"].get("model_options") for arm in log.store.config["arms"]}
    assert files["big"] == {"weights": str(tmp_path / "big.txt")} and files["none"] is None
    built = log.store.info["built"]
    assert (built["big"]["model"]["strength"], built["small"]["model"]["strength"]) == (0.9, 0.5)
    assert "small" in (tmp_path / "run/report.html").read_text()
    log.close()
    assert main(["verify", "run", "--episodes", "1"]) == 0
    assert main(["compare", "run", "run", "--arm", "big", "--other", "small"]) == 0
    assert main(["blame", "run", "--arm", "small", "--episodes", "1"]) == 0
    assert {line["arm"] for line in wiw.load_run("run").blame()} >= {"small"}
    assert main([*command, "--out", "run", "--resume"]) == 0
    assert main(["resume", "run", "--no-report"]) == 0
    capsys.readouterr()
    assert main([*task, "--arms", "a=warp,a=copy", "--out", "wrong"]) == 2
    assert "name them:" in capsys.readouterr().err and not (tmp_path / "wrong").exists()
    with pytest.raises(RegistryError, match="unexpected keyword"):
        wiw.evaluate("imagenav", AgentRecipe("heuristic"), 1, scenes=two_rooms, arms=["a=copy?speed=3"], out="wrong")


def test_a_policy_that_is_misspelt_is_told_from_a_world_model():
    with pytest.raises(ArgumentError, match=r"no policy is named 'matchr'\. Did you mean matcher\?"):
        arm_recipes(AgentRecipe("heuristic"), ["none", "matchr+warp"])
    assert arm_recipes(AgentRecipe("heuristic"), ["a+b/mine.py:Mine"])["Mine"].policy == "heuristic"


def test_arms_in_one_text_are_those_of_the_command_line():
    text = "none,copy,small=warp?size=[144, 256]"
    assert arm_recipes(AgentRecipe("matcher"), text) == arm_recipes(AgentRecipe("matcher"), split_arms(text))
    assert list(arm_recipes(AgentRecipe("matcher"), text)) == ["none", "copy", "small"]


def test_announced_servers_are_named_from_the_root_on_so_that_any_folder_will_do(tmp_path, monkeypatch):
    """The arm is named by their folder, however it is written."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "servers").mkdir()
    folder = f"remote:{tmp_path}/servers"
    for given in ("remote:servers", "remote:./servers", folder):
        assert absolute(given) == folder and AgentRecipe("matcher", folder).arm == "servers"
        assert make_arm_absolute(f"a=heuristic+{given}?patience=9") == f"a=heuristic+{folder}?patience=9"
    assert absolute("placebo-shuffled:remote:servers") == f"placebo-shuffled:{folder}"
    assert (
        absolute("remote:later/") == f"remote:{tmp_path}/later"
    )  # a slash tells that it is a folder, and will be there
    for kept in ("remote:ws://a:1,ws://b:2", "remote:host"):
        assert absolute(kept) == kept
    flags = AgentFlags(policy="heuristic", world_model="remote:servers")
    assert flags.make_recipe(TASK, None, AgentConfig()).to_json()["model"] == folder


@pytest.mark.parametrize("kind", ["transformers", "replay", "remote"])
def test_places_of_language_models_are_named_from_the_root_on(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "place").mkdir()
    by_flag = AgentFlags(policy="vlm", vlm=f"{kind}:place")
    by_option = AgentFlags(policy="vlm", policy_option=(f"vlm={kind}:place",))
    for flags in (by_flag, by_option):
        recipe = flags.make_recipe(TASK, None, AgentConfig())
        assert recipe.policy_options["vlm"]["vlm"] == f"{kind}:{tmp_path}/place"
    roles = AgentFlags(policy="vlm", policy_option=(f'roles={{answer: {{vlm: "{kind}:place", model: big}}}}',))
    asked = roles.make_recipe(TASK, None, AgentConfig()).policy_options["vlm"]["roles"]
    assert asked == {"answer": {"vlm": f"{kind}:{tmp_path}/place", "model": "big"}}


@pytest.mark.parametrize("name", ["transformers:org/model", "transformers:", "http://localhost:8000/v1", "mock"])
def test_names_of_language_models_stay(name):
    recipe = AgentFlags(policy="vlm", vlm=name).make_recipe(TASK, None, AgentConfig())
    assert recipe.policy_options["vlm"]["vlm"] == name
