# SPDX-License-Identifier: Apache-2.0
"""The core's threads in forked children, and while the interpreter ends."""

from __future__ import annotations

import os
import subprocess
import sys

ROTATE = """
import os, signal, sys, threading, time
import numpy as np
from wiw import panorama

images = np.zeros((4, 288, 512, 3), np.uint8)

def rotate_for_ever():
    while True:
        panorama.rotate(images, 33.3)

for _ in range(3):
    threading.Thread(target=rotate_for_ever, daemon=True).start()
time.sleep(0.2)
"""
FORK = """
for number in range(6):
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        assert panorama.rotate(images[:, :32, :64] + 1, 33.3).mean() == 1
        sys.exit(3)
    assert os.waitpid(child, 0)[1] == 3 << 8
print("forked", flush=True)
os._exit(0)
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "WIW_NUM_THREADS": "4"}
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=200, check=False
    )


def test_forked_children_compute_and_end_while_the_parent_computes() -> None:
    answer = run(ROTATE + FORK)
    assert answer.stdout == "forked\n", answer.stderr


def test_the_interpreter_ends_while_threads_are_in_the_core() -> None:
    for _ in range(4):
        answer = run(ROTATE)
        assert answer.returncode == 0 and not answer.stderr, answer
