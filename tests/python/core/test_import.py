# SPDX-License-Identifier: Apache-2.0
"""`import wiw` is light."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import wiw

PROBE = """
import json, sys, time
begin = time.process_time()
import pytest

import wiw
seconds = time.process_time() - begin
print(json.dumps({"seconds": seconds, "modules": sorted(m for m in sys.modules if "." not in m)}))
"""


def test_import_takes_no_heavy_module() -> None:
    answers = [json.loads(run_python("-c", PROBE)) for _ in range(3)]
    assert not {"torch", "torchvision", "cv2", "matplotlib", "scipy", "gymnasium"} & set(answers[0]["modules"])
    assert min(answer["seconds"] for answer in answers) < 0.3  # other work on the machine makes single ones longer


def run_python(*arguments: str) -> str:
    done = subprocess.run([sys.executable, *arguments], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_public_name_is_there() -> None:
    for name in wiw.__all__:
        assert getattr(wiw, name) is not None
        assert name in dir(wiw)


@pytest.mark.slow
def test_editors_know_the_types_of_what_names_make(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    names = {
        'wiw.make("ImageNav-v0")': "wiw.GymnasiumEnv",
        'wiw.policy("matcher")': "wiw.policies.base.Policy",
        'wiw.world_model("warp")': "wiw.world_models.base.WorldModel",
        'wiw.world_model("none")': "None",
    }
    file = tmp_path / "typed.py"
    file.write_text("import wiw\n" + "".join(f"reveal_type({call})\n" for call in names))
    # In a process of its own: the millions of objects that mypy leaves would slow down every garbage collection after.
    said = run_python("-m", "mypy", str(file), "--follow-imports=silent", f"--cache-dir={tmp_path / 'cache'}")
    assert re.findall(r'Revealed type is "([^"]*)"', said) == list(names.values())
