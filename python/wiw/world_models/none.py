# SPDX-License-Identifier: Apache-2.0
"""No world model: the same loop with imagination left out."""


def none() -> None:
    """`wiw.world_model("none")` is None, which `wiw.Agent` takes as "act without imagining"."""
    return
