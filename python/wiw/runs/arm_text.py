# SPDX-License-Identifier: Apache-2.0
"""Arms as text: `[NAME=][POLICY+]MODEL[?KEY=VALUE&KEY=VALUE]`, such as `small=warpnet?weights=small.npz`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from wiw.errors import ArgumentError

FORBIDDEN = re.compile(r"[,=?&/\\\x00-\x1f\x7f]")
"""Characters that no name of an arm may have: those that separate arms and their parts, or folders."""
EXAMPLE = "big=warpnet?weights=big.npz,small=warpnet?weights=small.npz"


@dataclass(frozen=True)
class ArmText:
    """The parts of an arm's text."""

    name: str | None
    """None if the arm is named by its policy and model."""
    model: str
    """With what stands before it: a policy and "+", or the kind of a placebo."""
    options: tuple[str, ...] = ()
    """KEY=VALUE, for the world model."""

    def __str__(self) -> str:
        name = "" if self.name is None else f"{self.name}="
        return f"{name}{self.model}{'?' if self.options else ''}{'&'.join(self.options)}"


def parse_arm(text: str) -> ArmText:
    """Return the parts of an arm's text.

    Raises:
        ArgumentError: no name before "=", or one with forbidden characters; no model behind it; no options behind "?".
    """
    target, question, options = text.strip().partition("?")
    name, equals, model = target.partition("=")
    if not equals or _is_place(target):
        name, model = "", target
    else:
        check_arm_name(name.strip(), text)
    pairs = tuple(pair.strip() for pair in options.split("&"))
    if not model.strip() or (question and not all(pairs)):
        raise ArgumentError(f"arms: expected NAME=MODEL?KEY=VALUE&KEY=VALUE, as in {EXAMPLE}, got '{text}'")
    return ArmText(name.strip() or None, model.strip(), pairs if question else ())


def check_arm_name(name: str, text: str | None = None) -> None:
    """Check the name that a user gives an arm.

    Raises:
        ArgumentError: an empty name, spaces around it, or a character that it may not have.
    """
    place = f" in '{text}'" if text is not None else ""
    if not name or name != name.strip():
        raise ArgumentError(f"arms: expected a name without surrounding spaces, got '{name}'{place}; as in {EXAMPLE}")
    if found := FORBIDDEN.search(name):
        raise ArgumentError(
            f"arms: the name '{name}'{place} contains {found.group()!r}; use letters, digits, '-', '_' and '.', as in "
            f"{EXAMPLE}"
        )


def split_arms(text: str) -> list[str]:
    """Return the arms of a list with commas between them; those in brackets belong to a value: size=[480, 480], and one
    before ws:// to a list of servers.

    Raises:
        ArgumentError: there are none.
    """
    arms = [arm.strip() for arm in re.split(r",(?!\s*wss?://)(?![^\[]*\])", text) if arm.strip()]
    if not arms:
        raise ArgumentError(f"arms: expected at least one, as in none,copy,warp or {EXAMPLE}, got '{text}'")
    return arms


def _is_place(model: str) -> bool:
    """Return whether "=" belongs to an address, or to the path of a file that exists."""
    path, _, _ = model.rpartition(":")
    return "://" in model.partition("=")[0] or (path.endswith(".py") and Path(path).expanduser().is_file())
