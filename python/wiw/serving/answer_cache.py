# SPDX-License-Identifier: Apache-2.0
"""A cache of recent answers, for clients that ask again because an answer was lost."""

from __future__ import annotations

from collections import OrderedDict


class AnswerCache:
    """Encoded answers by the id of their row; the least recently used are evicted first.

    Args:
        most_bytes: that they may take together.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most, self._size = most_bytes, 0
        self._answers: OrderedDict[bytes, bytes] = OrderedDict()

    def get(self, row: bytes) -> bytes | None:
        """Return the answer, if it is cached."""
        if row in self._answers:
            self._answers.move_to_end(row)
        return self._answers.get(row)

    def put(self, row: bytes, answer: bytes) -> None:
        """Store an answer."""
        self._size += len(answer) - len(self._answers.pop(row, b""))
        self._answers[row] = answer
        while self._size > self._most:
            _, oldest = self._answers.popitem(last=False)
            self._size -= len(oldest)
