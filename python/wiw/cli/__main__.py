# SPDX-License-Identifier: Apache-2.0
"""`python -m wiw.cli` is `wiw`."""

from wiw.cli import run_process

if __name__ == "__main__":
    run_process()
