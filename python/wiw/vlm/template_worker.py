# SPDX-License-Identifier: Apache-2.0
"""Templates in Jinja's sandbox, and a separate process that fills a user's within bounds (`python FILE`).

The sandbox keeps a template from the rest of the program, but not from taking all time or memory, and a single
expression can do that inside compiled code. So the process has the kernel's limits. It reads pickled jobs from its
parent and answers each with a line of JSON. Nothing of wiw is imported here: it starts in a tenth of a second.
"""

from __future__ import annotations

import json
import pickle
import resource
import signal
import sys
from collections.abc import Mapping
from functools import cache
from typing import Any

from jinja2 import StrictUndefined, TemplateSyntaxError, meta, nodes
from jinja2.sandbox import SandboxedEnvironment

SECONDS = 2.0
"""Seconds of processor time for one prompt."""
MEMORY = 256 << 20
"""Bytes of address space."""
CHARACTERS = 1 << 20
"""Maximum number of characters of one prompt."""
ENVIRONMENT = SandboxedEnvironment(undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def unknown_slot(source: str, slots: Mapping[str, Any]) -> str | None:
    """Return the first variable of a template that is not a slot, if there is one.

    Raises:
        TemplateSyntaxError: the source is not a template.
    """
    kinds = [kind for _, kind, _ in ENVIRONMENT.lex(source)]
    for name in ("raw", "comment"):  # Jinja takes one that is open at the end for an empty one
        if kinds.count(f"{name}_begin") != kinds.count(f"{name}_end"):
            raise TemplateSyntaxError(f"a {name} block does not end", source.count("\n") + 1)
    tree = ENVIRONMENT.parse(source)
    own = {name.name for name in tree.find_all(nodes.Name) if name.ctx == "store"}  # also those set in one branch only
    unknown = sorted(meta.find_undeclared_variables(tree) - set(slots) - own)
    return unknown[0] if unknown else None


@cache
def compile_template(source: str) -> Any:
    """Return the template of a source."""
    return ENVIRONMENT.from_string(source)


def fill_template(source: str, slots: Mapping[str, Any]) -> str:
    """Return a template with its slots filled.

    Raises:
        ValueError: it is too long.
    """
    parts, size = [], 0
    for part in compile_template(source).generate(**slots):
        parts.append(part)
        size += len(part)
        if size > CHARACTERS:
            raise ValueError(f"expected a prompt of at most {CHARACTERS} characters, but this one has more")
    return "".join(parts)


def answer(job: Mapping[str, Any]) -> dict[str, str]:
    """Return the result of a job, under "text", "unknown" or "error"."""
    try:
        unknown = unknown_slot(job["source"], job["slots"]) if job["check"] else None
        return {"text": fill_template(job["source"], job["slots"])} if unknown is None else {"unknown": unknown}
    except MemoryError:
        return {"error": f"MemoryError: expected a prompt that takes at most {MEMORY >> 20} MiB to fill"}
    except Exception as error:  # an expression can raise anything
        return {"error": f"{type(error).__name__}: {error}"[:2000]}


def serve() -> None:
    """Answer jobs until the parent closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    while True:
        try:
            job = pickle.load(sys.stdin.buffer)  # noqa: S301 - from the parent
        except EOFError:
            return
        signal.setitimer(signal.ITIMER_PROF, job["seconds"])  # its signal ends the process
        reply = json.dumps(answer(job))
        signal.setitimer(signal.ITIMER_PROF, 0)
        print(reply, flush=True)  # noqa: T201 - to the parent


if __name__ == "__main__":
    serve()
