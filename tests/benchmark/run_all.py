# SPDX-License-Identifier: Apache-2.0
"""Runs every bench_*.py beside this file, each in a process of its own; names on the command line choose some.

python tests/benchmark/run_all.py               # all
python tests/benchmark/run_all.py panorama nav  # two
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent


def main() -> None:
    names = sys.argv[1:] or sorted(file.stem.removeprefix("bench_") for file in HERE.glob("bench_*.py"))
    print(f"load before: {os.getloadavg()[0]:.2f} on {os.cpu_count()} cores; ratios within one run are what counts")
    failed = []
    for name in names:
        print(f"\n=== {name} ===", flush=True)
        if subprocess.run([sys.executable, HERE / f"bench_{name}.py"], check=False).returncode != 0:
            failed.append(name)
    if failed:
        sys.exit(f"benchmarks that did not run: {', '.join(failed)}")


if __name__ == "__main__":
    main()
