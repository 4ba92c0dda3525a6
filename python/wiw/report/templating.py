# SPDX-License-Identifier: Apache-2.0
"""Fill the pages' templates: everything is escaped, and a missing name is an error."""

from __future__ import annotations

import math
from datetime import datetime, timezone
from functools import cache
from importlib.resources import files

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from wiw.analysis.statistics import Estimate
from wiw.analysis.summary import column_title, show_p

PACKAGE = "wiw.report"


@cache
def environment() -> Environment:
    """Return the templates of all pages."""
    made = Environment(
        loader=PackageLoader(PACKAGE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {
        "column": column_title,
        "p": show_p,
        "signed": format_signed,
        "how": _name_method,
        "number": _number,
    }
    made.filters |= {"asset": _read_asset, "minute": _format_minute, "counted": _count_noun}
    made.tests |= {"known": _is_known}
    return made


def format_signed(value: float) -> str:
    """Return, e.g., "+21.3" or "\u22124.0", with a true minus sign."""
    return f"{value:+.1f}".replace("-", "\u2212")


def _number(value: float) -> str:
    """Return two digits, with a true minus sign."""
    return f"{value:.2f}".replace("-", "\u2212")


def _format_minute(time: str) -> str:
    """Return e.g. "2026-11-22 18:06 UTC" of a time in ISO format."""
    return datetime.fromisoformat(time).astimezone(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")


def _count_noun(nouns: str, count: float) -> str:
    """Return e.g. "1 consultation" or "3 real frames" of a count named "consultations" or "real_frames"."""
    noun = nouns.replace("_", " ")
    return f"{count:g} {noun.removesuffix('s') if count == 1 else noun}"


def _name_method(estimate: Estimate) -> str:
    """Return the method of an interval, with the bootstrap as a second opinion."""
    if estimate.bootstrap is None:
        return estimate.method
    low, high = estimate.bootstrap
    return f"{estimate.method}; bootstrap over scenes: {low:.1f} to {high:.1f}"


def _is_known(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _read_asset(name: str) -> Markup:
    """Return a style sheet or script of the templates, as it is."""
    return Markup((files(PACKAGE) / "templates" / name).read_text(encoding="utf-8"))
