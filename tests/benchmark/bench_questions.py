# SPDX-License-Identifier: Apache-2.0
"""CPU time to make the questions of an apartment, with twins and checks by rendering, beside that of the apartment."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from tempfile import TemporaryDirectory
from typing import Any

from wiw import scenes
from wiw.tasks.aeqa import AEQA

APARTMENTS, PER_APARTMENT = 8, 4
TARGET = 5.0  # seconds of CPU an apartment


def main() -> None:
    with TemporaryDirectory() as folder:
        os.environ["WIW_CACHE"] = folder
        baking = measure_cpu(lambda: [scenes.apartment(seed, "val") for seed in range(APARTMENTS)])
        task = AEQA(scenes=f"apartments:val:{APARTMENTS}")
        asking = measure_cpu(lambda: task.episodes(PER_APARTMENT * APARTMENTS))
    print(f"questions of {APARTMENTS} apartments ({os.cpu_count()} cores, load {os.getloadavg()[0]:.1f})")
    print(f"  questions {asking / APARTMENTS:.2f} s of CPU an apartment (target {TARGET:g})")
    print(f"  apartment {baking / APARTMENTS:.2f} s of CPU, once: it is cached")


def measure_cpu(make: Callable[[], Any]) -> float:
    """Seconds of all threads of this process."""
    began = time.process_time()
    make()
    return time.process_time() - began


if __name__ == "__main__":
    main()
