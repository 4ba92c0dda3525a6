# SPDX-License-Identifier: Apache-2.0
"""What names a model's rollouts: any change of its code, its options or its networks, also where no file has them."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from wiw.errors import ArgumentError
from wiw.world_models.fingerprint import code_digest

MODEL = """
import functools
import numpy as np
import wiw
from numpy import clip

SCALE = 2

def helper(x):
    return x + 1

class Camera:
    width = 90

    def sees(self):
        return helper(self.width)

class Mine(wiw.WorldModel):
    accepts = wiw.accepts(control="trajectory", size=(8, 16), cacheable=True)
    gain = 1.5

    def __init__(self, shift=3):
        self.shift = shift

    def rollout(self, observations, controls, seeds):
        def inner(x):
            return [y + 10 for y in x]
        lowest = np.sin(Camera().sees())
        return clip(SCALE * inner(observations.image) - lowest, 0, 255)

    @property
    def half(self):
        return self.shift / 2

    @staticmethod
    def third(x, by=3):
        return x / by
"""
EDITS = {
    "constant": ("y + 10", "y + 11"),
    "operator": ("inner(observations.image) - lowest", "inner(observations.image) + lowest"),
    "attribute's name": ("observations.image", "observations.depth"),
    "called function": ("np.sin", "np.cos"),
    "global": ("SCALE = 2", "SCALE = 3"),
    "helper": ("x + 1", "x + 2"),
    "class that is read": ("width = 90", "width = 60"),
    "method of that class": ("helper(self.width)", "helper(helper(self.width))"),
    "class attribute": ("gain = 1.5", "gain = 1.6"),
    "declaration": ("size=(8, 16)", "size=(8, 18)"),
    "default": ("shift=3", "shift=4"),
    "property": ("self.shift / 2", "self.shift / 4"),
    "static method's default": ("by=3", "by=4"),
    "imported function": ("from numpy import clip", "from numpy import minimum as clip"),
    "decorator": ("    @staticmethod", "    @staticmethod\n    @functools.lru_cache(2)"),
}


def typed(code: str, home: str = "__main__") -> dict:
    """The names that code defines where no file has it."""
    names = {"__name__": home}
    exec(compile(code, "<cell>", "exec"), names)
    return names


def told(code: str, home: str = "__main__") -> str:
    return typed(code, home)["Mine"]().fingerprint()


@pytest.mark.parametrize("home", ["__main__", "nowhere", "json"])
@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_cell_is_another_model(edit, home):
    before, after = EDITS[edit]
    assert MODEL.count(before) == 1
    assert told(MODEL, home) != told(MODEL.replace(before, after), home)


def test_the_same_cell_is_the_same_model_however_often_it_ran_and_wherever_it_stands():
    first = typed(MODEL)["Mine"]()
    assert first.fingerprint() == told(MODEL) == told("\n\n" + MODEL) == told("x = 1" + MODEL + "y = 2")
    for _ in range(2000):
        first.third(1)  # lets the interpreter adapt its code
        assert first.half == 1.5
    assert first.fingerprint() == told(MODEL)


def test_what_is_only_called_the_same_does_not_count():
    assert told(MODEL) == told(MODEL + "image = width = object()")


def test_networks_count_by_their_code_and_attributes():
    pytest.importorskip("torch")
    code = """
import functools
import torch
import wiw

def act(x):
    return torch.relu(x)

def half(function):
    @functools.wraps(function)
    def halved(*given):
        return function(*given) / 2
    return halved

class Net(torch.nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.layer = torch.nn.Linear(2, 2)
        self.far = 9.0
        self.register_buffer("grid", torch.zeros(3), persistent=False)
        self.norm = torch.nn.Dropout(0.5)

    @half
    def forward(self, x):
        return act(self.layer(x))

net = Net().eval()

class Mine(wiw.WorldModel):
    accepts = wiw.accepts(control="trajectory", cacheable=True)

    def __init__(self):
        self.net = net

    @torch.no_grad()
    def rollout(self, observations, controls, seeds):
        return self.net(observations.image)

class Reads(Mine):
    def __init__(self):
        pass

    @torch.no_grad()
    def rollout(self, observations, controls, seeds):
        return net(observations.image)
"""
    edits = {
        "torch.relu": "torch.tanh",
        "act(self.layer(x))": "act(self.layer(x)) + 1",
        "self.far = 9.0": "self.far = 8.0",
        "torch.zeros(3)": "torch.ones(3)",
        "manual_seed(0)": "manual_seed(1)",
        "Net().eval()": "Net()",
        "/ 2": "/ 3",
        "    @half\n": "",
    }
    for name in ("Mine", "Reads"):
        prints = [typed(c)[name]().fingerprint() for c in (code, *(code.replace(*edit) for edit in edits.items()))]
        assert typed(code)[name]().fingerprint() == prints[0]
        assert len(set(prints)) == len(prints), name


def test_attributes_may_be_functions_enums_parts_and_models():
    code = """
import enum
from dataclasses import dataclass, field
from functools import partial
import wiw

class Mode(enum.Enum):
    SLOW = "slow"

@dataclass
class Lens:
    width: int = 90
    marks: list = field(default_factory=lambda: [7])

    def half(self):
        return self.width / 2

def scaled(x, by):
    return x * by

def times(k):
    return lambda x: x * k

class Mine(wiw.WorldModel):
    accepts = wiw.accepts(control="trajectory", cacheable=True)

    def __init__(self):
        self.mode, self.lens, self.scale = Mode.SLOW, Lens(), partial(scaled, by=2)
        self.shade, self.inner, self.own = times(5), wiw.world_model("warp"), self.half

    def rollout(self, observations, controls, seeds):
        return self.scale(observations.image)

    def half(self):
        return 0.5
"""
    edits = {"Mode.SLOW": "Mode('slow').value", "by=2": "by=3", "x * by": "x + by", "times(5)": "times(6)"}
    edits |= {"[7]": "[8]", "self.width / 2": "self.width / 3", '"warp"': '"copy"', "return 0.5": "return 0.25"}
    prints = [told(c) for c in (code, *(code.replace(*edit) for edit in edits.items()))]
    assert told(code) == prints[0] and len(set(prints)) == len(prints)


def test_what_cannot_be_told_is_named_with_a_way_out():
    code = MODEL.replace("SCALE = 2", "SCALE = np.random.default_rng()")
    with pytest.raises(ArgumentError, match=r"SCALE, which Mine\.rollout reads, a Generator.*def fingerprint.*leave"):
        told(code)


def test_a_module_that_was_edited_and_not_imported_again_is_another_model(tmp_path, monkeypatch):
    """Else frames of the old code would be found under the new one's name."""
    file = tmp_path / "edited_model.py"
    monkeypatch.syspath_prepend(str(tmp_path))
    file.write_text(MODEL)
    import edited_model

    before = edited_model.Mine().fingerprint()
    file.write_text(MODEL.replace("y + 10", "y + 11"))
    stale = edited_model.Mine().fingerprint()
    del sys.modules["edited_model"]
    import edited_model as fresh

    assert len({before, stale, fresh.Mine().fingerprint()}) == 3


@pytest.mark.parametrize(
    ("module", "name", "beside"),
    [
        ("wiw.world_models.nwm.model", "NWM", "motion.py"),
        ("wiw.world_models.warpnet.model", "WarpNet", "network.py"),
        ("wiw.world_models.video.actions.variants", "SVDAction", "injection.py"),
    ],
)
def test_all_files_of_a_built_in_model_count(module, name, beside, monkeypatch):
    model = getattr(importlib.import_module(module), name)
    before, read = code_digest(model), Path.read_bytes
    assert code_digest(model) == before
    monkeypatch.setattr(Path, "read_bytes", lambda path: read(path) + (b"# edited" if path.name == beside else b""))
    assert code_digest(model) != before
