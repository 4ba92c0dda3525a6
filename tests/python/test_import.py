# SPDX-License-Identifier: Apache-2.0
"""`import wiw` is light."""

from __future__ import annotations

import json
import subprocess
import sys

import wiw

PROBE = """
import json, sys, time
begin = time.process_time()
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
