# SPDX-License-Identifier: Apache-2.0
"""`wiw list`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Literal

from rich.markup import escape
from tyro.conf import Positional

What = Literal[
    "all",
    "world-models",
    "policies",
    "trackers",
    "tasks",
    "presets",
    "tiers",
    "studies",
    "metrics",
    "errors",
    "vlm-models",
    "prompts",
]


def list_names(what: Positional[What] = "all", /) -> int:
    """List everything that has a name: world models, policies, tasks, presets, studies, metrics, VLMs and prompts.

    $ wiw list
    $ wiw list world-models
    $ wiw list presets

    Built-in names come first, then those of installed packages. A package adds its own with entry points in the group
    shown next to each heading.

    Args:
        what: Kind of names to list. world-models also shows each model's inputs and weights, and what is missing on
            this machine; presets shows what each preset sets and where it departs from the paper.
    """
    from rich.console import Console

    from wiw.cli.world_models import world_models

    console = Console()
    console.print(world_models(console.width) if what == "world-models" else _make_table(what))
    return 0


def _make_table(what: str) -> Any:
    from rich.table import Table

    from wiw.registry import METRICS, POLICIES, TASKS, TRACKERS, WORLD_MODELS

    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column()
    registries = {
        "world-models": WORLD_MODELS,
        "policies": POLICIES,
        "trackers": TRACKERS,
        "tasks": TASKS,
        "metrics": METRICS,
    }
    sections: dict[str, Callable[[Any], None]] = {
        name: lambda table, name=name, registry=registry: _add_registry(table, name, registry)  # type: ignore[misc]
        for name, registry in registries.items()
    }
    sections |= {
        "errors": _add_errors,
        "presets": _add_presets,
        "tiers": _add_tiers,
        "studies": _add_studies,
        "vlm-models": _add_vlm_models,
        "prompts": _add_prompts,
    }
    if what == "presets":
        _add_presets(table, detailed=True)
        return table
    for name in sections if what == "all" else [what]:
        sections[name](table)
    return table


def _add_registry(table: Any, title: str, registry: Any) -> None:
    table.add_row(f"[bold]{title.replace('-', ' ').capitalize()}[/]", f"[dim]{registry.group}[/]")
    for name in registry.names():
        table.add_row(f"  {name}", _first_line(registry, name))
    table.add_row()


def _add_settings(table: Any, task: str, preset: str) -> None:
    from wiw.cli.presets import list_reasons, list_settings

    for line in list_settings(task, preset):
        table.add_row("", f"sets {escape(line)}")
    for line in list_reasons(task, preset):
        table.add_row("", f"[dim]departs from the paper: {escape(line)}[/]")


def _add_presets(table: Any, detailed: bool = False) -> None:
    from wiw.registry import TASKS
    from wiw.tasks import presets

    for task in TASKS.built_in:
        table.add_row(f"[bold]Presets of {task}[/]", "[dim]--preset NAME, or a YAML file of your own[/]")
        for name in presets.list_presets(task):
            table.add_row(f"  {name}", escape(presets.describe_preset(task, name)))
            if detailed:
                _add_settings(table, task, name)
    table.add_row()


def _add_errors(table: Any) -> None:
    from wiw.experiments.errors.kinds import ERRORS

    table.add_row("[bold]Errors of futures[/]", "[dim]--arms error-KIND@DOSE[:MODEL]; by default of the oracle[/]")
    for name, kind in ERRORS.items():
        table.add_row(f"  {name}", f"{escape(kind.about)} [dim]Dose: {escape(kind.unit)}.[/]")
    table.add_row()


def _add_tiers(table: Any) -> None:
    from wiw.datasets.imagenav import TIERS

    table.add_row("[bold]Tiers of imagenav[/]", "[dim]--tier NAME, or --tier all for all of them in turn[/]")
    for name, tier in TIERS.items():
        table.add_row(f"  {name}", tier.about)
    table.add_row()


def _add_studies(table: Any) -> None:
    from wiw.cli.study import STUDIES
    from wiw.studies.study_file import list_studies

    table.add_row("[bold]Studies[/]", "[dim]wiw study NAME, or a YAML file of your own[/]")
    own = {name: line for _, name, line in STUDIES}
    for name, line in {**own, **list_studies()}.items():
        table.add_row(f"  {name}", escape(line))
    table.add_row()


def _add_vlm_models(table: Any) -> None:
    from wiw.policies.vlm import presets as vlms

    table.add_row("[bold]Models for policy vlm[/]", "[dim]--vlm-model NAME; docs/vlm.md explains how to serve them[/]")
    for name in vlms.list_names():
        table.add_row(f"  {name}", escape(vlms.describe(name)))
    table.add_row()


def _add_prompts(table: Any) -> None:
    from wiw.policies.vlm.prompts.templates import SETS, Prompts

    table.add_row(
        "[bold]Prompts of policy vlm[/]", "[dim]--prompts NAME, or a folder written by `wiw prompts import`[/]"
    )
    for name, (_, line) in SETS.items():
        table.add_row(f"  {name}", f"{escape(line)} [dim](digest {Prompts(name).digest})[/]")


def _first_line(registry: Any, name: str) -> str:
    """Return the first line of an entry's description, or why it cannot be loaded."""
    try:
        thing = registry.find(name)
        text = str(getattr(thing, "about", "") or inspect.getdoc(thing) or "")
    except Exception as error:  # a broken plugin must not hide the others
        return f"[red]{escape(str(error))}[/]"
    return escape(text.strip().partition("\n")[0])
