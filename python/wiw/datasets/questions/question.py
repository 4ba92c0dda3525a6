# SPDX-License-Identifier: Apache-2.0
"""A question about a home, with everything that its episode knows and its agent does not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

from wiw.datasets.fields import integer, number, text
from wiw.errors import ArgumentError

CATEGORIES = (
    "object recognition",
    "attribute recognition",
    "object state recognition",
    "object localization",
    "spatial understanding",
    "functional reasoning",
    "world knowledge",
)
"""OpenEQA's seven, in its words."""

ANSWER_TYPES = ("yes_no", "count", "color", "material", "category", "place", "state", "text")
"""Kinds of answers, which rules compare each in its own way; "text" is free."""

Viewpoint = tuple[float, float, float, float]


@dataclass(frozen=True)
class Question:
    """A question and its hidden row. An agent gets `text` and nothing else."""

    text: str
    answer: str
    category: str
    answer_type: str = "text"
    extra_answers: tuple[str, ...] = ()
    """Other answers that are as right."""
    template: str = ""
    """Name of the template in `grammar.TEMPLATES`; empty if a person wrote the question."""
    slots: Mapping[str, str] = field(default_factory=dict)
    """Words that fill the template."""
    target: tuple[int, ...] = ()
    """Ids of the instances that answer it: an answer is grounded if they were in view."""
    viewpoints: tuple[Viewpoint, ...] = ()
    """Places with headings (x, y, z, yaw) from which it can be answered, the nearest to the start first."""
    twin: str = ""
    """Id of the episode that asks the same, from the same start, where something else is true; empty without one."""

    def __post_init__(self) -> None:
        texts = (self.text, self.answer, *self.extra_answers)
        if not all(any(character.isalnum() for character in text) for text in texts):
            raise ArgumentError(
                f"expected a question and an answer with words in them, got {self.text!r}: "
                f"{', '.join(repr(text) for text in texts[1:])}"
            )
        if self.category not in CATEGORIES:
            raise ArgumentError(f"category: expected one of {', '.join(CATEGORIES)}, got {self.category!r}")
        if self.answer_type not in ANSWER_TYPES:
            raise ArgumentError(f"answer_type: expected one of {', '.join(ANSWER_TYPES)}, got {self.answer_type!r}")
        object.__setattr__(self, "slots", MappingProxyType(dict(self.slots)))

    def __reduce__(self) -> tuple[Any, ...]:
        return Question.from_info, (self.to_info(),)

    def to_info(self) -> dict[str, Any]:
        """Return the question as JSON, for `Episode.info["question"]`."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        values["slots"] = dict(self.slots)
        values["extra_answers"], values["target"] = list(self.extra_answers), list(self.target)
        values["viewpoints"] = [list(viewpoint) for viewpoint in self.viewpoints]
        return values

    @classmethod
    def from_info(cls, info: Any) -> Question:
        """Return the question of `Episode.info["question"]`.

        Raises:
            ArgumentError: a field is missing, of another type, or out of its range; names it.
        """
        if not isinstance(info, Mapping):
            raise ArgumentError(f"question: expected an object with text, answer and category, got {info!r:.80}")
        unknown = set(info) - {item.name for item in fields(cls)}
        missing = {"text", "answer", "category"} - set(info)
        if unknown or missing:
            raise ArgumentError(
                f"question: {'lacks ' + ', '.join(sorted(missing)) if missing else 'has the unknown field'} "
                f"{', '.join(sorted(unknown))}".strip()
            )
        try:
            return cls(
                **{name: text(info[name], name) for name in _TEXTS if name in info},
                extra_answers=_texts(info.get("extra_answers", ()), "extra_answers"),
                slots={text(k, "slots"): text(v, "slots") for k, v in dict(info.get("slots", {})).items()},
                target=tuple(integer(each, "target") for each in info.get("target", ())),
                viewpoints=tuple(_viewpoint(each) for each in info.get("viewpoints", ())),
            )
        except (TypeError, ValueError) as error:
            raise ArgumentError(f"question: {error}") from error


_TEXTS = ("text", "answer", "category", "answer_type", "template", "twin")


def _texts(values: Any, name: str) -> tuple[str, ...]:
    if not isinstance(values, list | tuple):
        raise ValueError(f"{name}: expected a list of texts, got {values!r:.80}")
    return tuple(text(each, name) for each in values)


def _viewpoint(value: Any) -> Viewpoint:
    if not isinstance(value, list | tuple) or len(value) != 4:
        raise ValueError(f"viewpoints: expected [x, y, z, yaw], got {value!r:.80}")
    x, y, z, yaw = (number(each, "viewpoints") for each in value)
    return x, y, z, yaw
