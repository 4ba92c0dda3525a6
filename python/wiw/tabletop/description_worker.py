# SPDX-License-Identifier: Apache-2.0
"""The child process that reads a robot for `wiw.tabletop.description.read_description`."""

from __future__ import annotations

from wiw.scenes.child import answer_job
from wiw.tabletop.description import write_description

if __name__ == "__main__":
    answer_job(write_description)
