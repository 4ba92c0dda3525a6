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
    answer = json.loads(
        subprocess.run([sys.executable, "-c", PROBE], capture_output=True, check=True, text=True).stdout
    )
    assert not {"torch", "torchvision", "cv2", "matplotlib", "scipy", "gymnasium"} & set(answer["modules"])
    assert answer["seconds"] < 0.3


def test_every_public_name_is_there() -> None:
    for name in wiw.__all__:
        assert getattr(wiw, name) is not None
        assert name in dir(wiw)


@pytest.mark.slow
def test_editors_know_the_types_of_what_names_make(tmp_path: Path) -> None:
    api = pytest.importorskip("mypy.api")
    names = {
        'wiw.make("ImageNav-v0")': "wiw.GymnasiumEnv",
        'wiw.policy("matcher")': "wiw.policies.base.Policy",
        'wiw.world_model("warp")': "wiw.world_models.base.WorldModel",
        'wiw.world_model("none")': "None",
    }
    file = tmp_path / "typed.py"
    file.write_text("import wiw\n" + "".join(f"reveal_type({call})\n" for call in names))
    said, errors, code = api.run([str(file), "--follow-imports=silent", f"--cache-dir={tmp_path / 'cache'}"])
    assert code == 0, said + errors
    assert re.findall(r'Revealed type is "([^"]*)"', said) == list(names.values())
