# SPDX-License-Identifier: Apache-2.0
"""Errors of known doses, added to imagined futures to learn which kinds of error cost success.

`error-blur@16` is an arm whose world model is the oracle with frames blurred by 16 pixels, `error-blur@16:warp` one of
another world model. `wiw list errors` has all kinds with the units of their doses; `wiw study errors` runs them all.
"""

from __future__ import annotations

from collections.abc import Mapping

from wiw.errors import ArgumentError
from wiw.experiments.errors.base import Degradation
from wiw.experiments.errors.content import Invented, Missing, Moved, OpenSpace
from wiw.experiments.errors.control import Direction, Drift, Ignored, Lag, Scale
from wiw.experiments.errors.looks import Blur, Flicker, Noise, Resolution, Tint
from wiw.suggestions import did_you_mean

_KINDS: tuple[type[Degradation], ...] = (
    Blur, Noise, Tint, Resolution, Flicker, Scale, Direction, Lag, Drift, Ignored, Missing, Moved, Invented, OpenSpace,
)  # fmt: skip
ERRORS: Mapping[str, type[Degradation]] = {kind.kind: kind for kind in _KINDS}
"""Kinds of errors, by name."""


def make_error(text: str) -> Degradation:
    """Return the error that KIND@DOSE names.

    Raises:
        ArgumentError: an unknown kind, no number as dose, or one out of range.
    """
    kind, at, dose = text.partition("@")
    if kind not in ERRORS:
        known = ", ".join(ERRORS)
        raise ArgumentError(f"no error is called '{kind}'.{did_you_mean(kind, list(ERRORS))} Known: {known}")
    try:
        amount = float(dose)
    except ValueError:
        example = f"{kind}@{next(iter(ERRORS[kind].doses.values()))[0]:g}"
        raise ArgumentError(
            f"error '{text}': expected KIND@DOSE with a number ({ERRORS[kind].unit}), such as {example}, got "
            f"'{dose if at else 'no dose'}'"
        ) from None
    return ERRORS[kind](amount)
