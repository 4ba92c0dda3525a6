# SPDX-License-Identifier: Apache-2.0
"""`wiw list`."""

from __future__ import annotations

import inspect
from typing import Any, Literal

from rich.markup import escape
from tyro.conf import Positional


def list_names(what: Positional[Literal["all", "world-models"]] = "all", /) -> int:
    """Lists world models, policies, tasks, metrics and presets: built-in ones, and those of installed packages.

    $ wiw list
    $ wiw list world-models

    A package adds its own by entry points in the groups named beside the headings.

    Args:
        what: world-models tells more of each: what it takes and gives, and what it lacks on this machine.
    """
    from rich.console import Console

    from wiw.cli.world_models import world_models

    console = Console()
    console.print(world_models(console.width) if what == "world-models" else _everything())
    return 0


def _everything() -> Any:
    from rich.table import Table

    from wiw.policies.vlm import presets as vlms
    from wiw.registry import METRICS, POLICIES, TASKS, WORLD_MODELS
    from wiw.tasks import presets

    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column()
    sections = {"World models": WORLD_MODELS, "Policies": POLICIES, "Tasks": TASKS, "Metrics": METRICS}
    for title, registry in sections.items():
        table.add_row(f"[bold]{title}[/]", f"[dim]{registry.group}[/]")
        for name in registry.names():
            table.add_row(f"  {name}", _first_line(registry, name))
        table.add_row()
    for task in TASKS.built_in:
        table.add_row(f"[bold]Presets of {task}[/]", "[dim]--preset NAME, or a YAML file of your own[/]")
        for name in presets.list_presets(task):
            table.add_row(f"  {name}", escape(presets.describe_preset(task, name)))
    table.add_row()
    table.add_row("[bold]Models for policy vlm[/]", "[dim]--vlm-model NAME; docs/vlm.md says how to serve them[/]")
    for name in vlms.list_names():
        table.add_row(f"  {name}", escape(vlms.describe(name)))
    return table


def _first_line(registry: Any, name: str) -> str:
    """What a thing is, in its own words; or why it cannot be loaded."""
    try:
        thing = registry.find(name)
        text = str(getattr(thing, "about", "") or inspect.getdoc(thing) or "")
    except Exception as error:  # a broken plugin must not hide the others
        return f"[red]{escape(str(error))}[/]"
    return escape(text.strip().partition("\n")[0])
