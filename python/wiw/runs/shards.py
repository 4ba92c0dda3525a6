# SPDX-License-Identifier: Apache-2.0
"""Shards: equal parts of a run's episodes, each run by a command of its own with a store of its own."""

from __future__ import annotations

import re
from dataclasses import dataclass

from wiw.errors import ArgumentError

PATTERN = re.compile(r"(\d+)/(\d+)")


@dataclass(frozen=True)
class Shard:
    """Part `number` of `count`, counted from 1; prints as "3/8"."""

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Return the shard that a text such as "3/8" names.

        Raises:
            ArgumentError: no such text, or a number that is not from 1 to the count.
        """
        found = PATTERN.fullmatch(text)
        shard = cls(int(found.group(1)), int(found.group(2))) if found else None
        if shard is None or not 1 <= shard.number <= shard.count:
            raise ArgumentError(f"expected a shard I/N with I from 1 to N, as in 3/8, got '{text}'")
        return shard

    def select(self, episodes: int) -> range:
        """Return the indices of this shard's episodes among all: consecutive ones, which share scenes.

        Raises:
            ArgumentError: there are more shards than episodes.
        """
        if episodes < self.count:
            raise ArgumentError(
                f"shard {self}: with {episodes} episodes some shards would be empty; expected at most {episodes} shards"
            )
        first, last = ((self.number - 1) * episodes // self.count, self.number * episodes // self.count)
        return range(first, last)

    @property
    def folder(self) -> str:
        """Name of the shard's folder in that of the whole run."""
        width = len(str(self.count))
        return f"shard-{self.number:0{width}}-of-{self.count}"

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"
