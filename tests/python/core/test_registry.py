# SPDX-License-Identifier: Apache-2.0
"""How things are found by `path.py:Class` and `package.module:Class`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

import wiw
from wiw.errors import ArgumentError, ConstructionError, ContractError, Error, RegistryError, find_raising_line
from wiw.registry import METRICS, POLICIES, TASKS, WORLD_MODELS, Registry

MODEL = """
import numpy as np
import wiw


class Mine(wiw.WorldModel):
    accepts = wiw.accepts(control="image", causal=True)

    def rollout(self, observations, controls, seeds):
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
"""
POLICY = """
import wiw


class Mine(wiw.Policy):
    steps = {steps}
"""


@pytest.fixture(autouse=True)
def own_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])


def test_a_file_that_was_mended_is_imported_again(tmp_path: Path) -> None:
    file = tmp_path / "policy.py"
    file.write_text("import numpy\nraise OSError('no weights')\n")
    for _ in range(2):
        with pytest.raises(RegistryError, match=r"OSError: no weights \(policy\.py, line 2\)") as caught:
            POLICIES.find(f"{file}:Mine")
        assert isinstance(caught.value.__cause__, OSError)
    file.write_text(POLICY.format(steps=1))
    assert POLICIES.find(f"{file}:Mine").steps == 1


def test_a_models_file_that_was_mended_is_imported_again(tmp_path: Path) -> None:
    file = tmp_path / "model.py"
    file.write_text("import numpy\nraise OSError('no weights')\n")
    with pytest.raises(RegistryError, match=r"OSError: no weights \(model\.py, line 2\)"):
        WORLD_MODELS.find(f"{file}:Mine")
    file.write_text(MODEL)
    assert WORLD_MODELS.make(f"{file}:Mine").accepts.causal


@pytest.mark.parametrize("broken", ["class Mine(:\n", "import nothing_of_this_name\n", "1 / 0\n", "x = 1\n"])
def test_whatever_an_import_raises_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str) -> None:
    file = tmp_path / "broken_file.py"
    file.write_text(broken)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in (f"{file}:Mine", "broken_file:Mine"):
        with pytest.raises(RegistryError, match=r"policy .* cannot be loaded") as caught:
            POLICIES.find(name)
        assert caught.value.__cause__ is not None
    with pytest.raises(RegistryError, match=r"world model .* cannot be loaded"):
        WORLD_MODELS.find(f"{file}:Mine")


def test_an_edited_file_gives_the_new_class_and_an_untouched_one_the_same(tmp_path: Path) -> None:
    file = tmp_path / "policy.py"
    file.write_text(POLICY.format(steps=1))
    first = POLICIES.find(f"{file}:Mine")
    assert POLICIES.find(f"{file}:Mine") is first
    for steps in (2, 3, 4):
        file.write_text(POLICY.format(steps=steps))
        assert POLICIES.find(f"{file}:Mine").steps == steps
    assert first.steps == 1


def test_a_file_finds_the_modules_beside_it(tmp_path: Path) -> None:
    (tmp_path / "helper_beside_the_file.py").write_text("STEPS = 7\n")
    (tmp_path / "policy.py").write_text(POLICY.format(steps="__import__('helper_beside_the_file').STEPS"))
    assert POLICIES.find(f"{tmp_path / 'policy.py'}:Mine").steps == 7


def test_a_files_module_has_the_same_name_in_every_process(tmp_path: Path) -> None:
    (tmp_path / "model.py").write_text(MODEL)
    code = f"import wiw.registry as r; print(r.WORLD_MODELS.find({str(tmp_path / 'model.py')!r} + ':Mine').__module__)"
    names = set()
    for seed in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": os.pathsep.join(sys.path)}
        names.add(subprocess.check_output([sys.executable, "-c", code], env=environment, text=True).strip())
    assert len(names) == 1


def test_plugins_are_loaded_by_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    points = {
        "rules": EntryPoint("rules", "wiw.policies.heuristic:Heuristic", "wiw.policies"),
        "gone": EntryPoint("gone", "no_such_package:Policy", "wiw.policies"),
    }
    monkeypatch.setattr(Registry, "_list_plugins", lambda self: points)
    assert POLICIES.make("rules") is not None and "rules" in POLICIES.names()
    with pytest.raises(RegistryError, match="'gone' cannot be loaded: ModuleNotFoundError"):
        POLICIES.find("gone")


def test_a_class_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thing.py").write_text("class Thing:\n    pass\n\n\ndef maker():\n    return Thing()\n")
    for registry, base in ((WORLD_MODELS, "WorldModel"), (POLICIES, "Policy")):
        for name in ("Thing", "maker"):
            with pytest.raises(RegistryError, match=f"is not a {registry.kind}: expected a class derived .*{base}"):
                registry.make(f"{tmp_path / 'thing.py'}:{name}")
        with pytest.raises(RegistryError, match=f"is not a {registry.kind}"):
            registry.make(object())
    with pytest.raises(RegistryError, match="is not a world model"):
        wiw.Agent("heuristic", f"{tmp_path / 'thing.py'}:Thing")
    assert WORLD_MODELS.make("none") is None


def test_task_ids_and_paths_keep_their_case(tmp_path: Path, two_rooms: str) -> None:
    (tmp_path / "task.py").write_text("from wiw.tasks.imagenav import ImageNav\n\n\nclass Mine(ImageNav):\n    pass\n")
    for name in ("ImageNav-v0", "imagenav", "ImageNav", f"{tmp_path / 'task.py'}:Mine"):
        assert wiw.make(name, scenes=two_rooms).task.scenes == two_rooms
    assert type(TASKS.make(f"{tmp_path / 'task.py'}:Mine")).__name__ == "Mine"


def test_a_file_without_a_class_asks_for_one() -> None:
    with pytest.raises(RegistryError, match=r"named 'mine\.py'\. To use a file, .*: mine\.py:CLASS"):
        wiw.world_model("mine.py")


def test_an_error_is_placed_at_the_line_of_its_user(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(MODEL + "\n    def __init__(self):\n        np.zeros(3).reshape(2)\n")
    with pytest.raises(ConstructionError, match=r"ValueError: .* \(mine\.py, line 13\)"):
        WORLD_MODELS.make_here(f"{file}:Mine")
    with pytest.raises(ValueError) as raised:
        json.loads("no")
    assert find_raising_line(raised.value).filename == __file__
    with pytest.raises(Error) as raised:
        wiw.world_model("copy", size="small")
    assert find_raising_line(raised.value).filename == __file__


def test_what_was_registered_here_may_be_registered_again_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    metrics = replace(METRICS, registered={})
    for label in ("Near", "Nearer"):  # as by a notebook's cell that runs again
        metrics.register("near", wiw.Metric("near", label, "rate", True))
    assert metrics.find("near").label == "Nearer"
    with pytest.raises(RegistryError, match="already exists"):
        metrics.register("success", wiw.Metric("success", "SR", "rate", True))
    with pytest.raises(ArgumentError, match="metric 'near': expected kind 'rate' or 'length', got 'percent'"):
        wiw.Metric("near", "Near", "percent", True)


def test_a_function_without_its_declaration_is_asked_for_it() -> None:
    with pytest.raises(RegistryError, match=r"needs its declaration: .*accepts=wiw\.accepts"):
        wiw.world_model(lambda observations, controls, seeds: None)


def test_environments_are_made_as_gymnasium_makes_them(two_rooms: str) -> None:
    assert wiw.make("ImageNav-v0", scenes=two_rooms, render_mode="rgb_array").render_mode == "rgb_array"
    with pytest.raises(ArgumentError, match="expected 'rgb_array'"):
        wiw.make("ImageNav-v0", scenes=two_rooms, render_mode="human")
    assert wiw.make_vec("ImageNav-v0", 1, scenes=two_rooms, render_mode="rgb_array").render_mode == "rgb_array"
    with pytest.raises(ArgumentError, match="expected 'rgb_array'"):
        wiw.make_vec("ImageNav-v0", 1, scenes=two_rooms, render_mode="human")
    with pytest.raises(ArgumentError, match=r"expected the name of a task.*got <class"):
        wiw.make(wiw.Task)


BASE = """
import numpy as np
import wiw


class Base(wiw.WorldModel):
    accepts: wiw.Accepts

    def rollout(self, observations, controls, seeds):
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)


class Mine(Base):
    accepts = wiw.accepts(control="image")
"""


@pytest.mark.parametrize("make", [wiw.world_model, WORLD_MODELS.make_here])
def test_a_base_of_world_models_leaves_the_declaration_to_others(tmp_path: Path, make: Any) -> None:
    file = tmp_path / "mine.py"
    file.write_text(BASE)
    assert make(f"{file}:Mine").accepts.control == "image"
    with pytest.raises(ContractError, match=r"Base: expected the class attribute `accepts = wiw\.accepts\(\.\.\.\)`"):
        make(f"{file}:Base")


OPTIONS = (
    BASE
    + """

class Sized(Mine):
    def __init__(self, size=8):
        self.size = size
"""
)


@pytest.mark.parametrize("make", [wiw.world_model, WORLD_MODELS.make_here])
def test_a_model_without_a_constructor_takes_no_options(tmp_path: Path, make: Any) -> None:
    file = tmp_path / "sized.py"
    file.write_text(OPTIONS)
    make(f"{file}:Sized", size=4)
    with pytest.raises(RegistryError, match="unexpected keyword argument 'size'; it takes"):
        make(f"{file}:Mine", size=4)
    own = WORLD_MODELS.find_here(f"{file}:Mine")
    for make_wrongly in (lambda: own(4), lambda: own(size=4)):
        with pytest.raises(TypeError, match=r"Mine\(\) takes no arguments"):
            make_wrongly()
