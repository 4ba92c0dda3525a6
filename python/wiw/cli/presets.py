# SPDX-License-Identifier: Apache-2.0
"""Describe the settings of a preset, and where it departs from the paper, as lines of text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from wiw.tasks.presets import DEFAULT, Preset, load_preset


def list_settings(task: str, preset: str | Path) -> list[str]:
    """Return where a preset differs from the default: one line each for its policy, its rules and its generated
    episodes, and one for the options of each policy and model.
    """
    ours, base = load_preset(task, preset), load_preset(task, DEFAULT)
    named = [f"policy: {ours.policy}"] if ours.policy != base.policy else []
    general = [
        f"{title}: {changes}"
        for title, own, others in (
            ("rules", ours.rules, base.rules),
            ("generated episodes", ours.generator, base.generator),
        )
        if (changes := _list_changes(own, others))
    ]
    parts = [
        f"{name}: {changes}"
        for kind in ("policies", "models")
        for name, options in getattr(ours, kind).items()
        if (changes := _list_changes(options, getattr(base, kind).get(name, {})))
    ]
    return [*named, *general, *parts]


def list_reasons(task: str, preset: str | Path) -> Iterator[str]:
    """Yield one line per departure of a preset from the paper, with whom it concerns and the reason."""
    ours, paper = load_preset(task, preset), load_preset(task, "paper")
    for who, reasons in ours.departures.items():
        for topic, reason in reasons.items():
            yield f"{topic}{_show_values(ours, paper, who, topic)}, for {who}: {reason}"


def _show_values(ours: Preset, paper: Preset, who: str, topic: str) -> str:
    """Return the values of the setting that a departure is about, if it is about one."""
    values = [each.rules if who == "rules" else each.policies.get(who, {}) for each in (ours, paper)]
    if topic not in values[0]:
        return ""
    return f" {values[0][topic]} (paper: {values[1].get(topic, 'open')})"


def _list_changes(options: Mapping[str, Any], base: Mapping[str, Any]) -> str:
    changed = {name: value for name, value in options.items() if name not in base or base[name] != value}
    return ", ".join(f"{name} {_show(value)}" for name, value in changed.items())


def _show(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"'{value.get('prompt', '...')}'"
    return "(none)" if value == "" else str(value)
