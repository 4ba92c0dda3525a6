# SPDX-License-Identifier: Apache-2.0
"""The language-model judge's prompt: one Jinja template with the slots of `SLOTS`; a user's own may replace it.

The shipped template is filled here, a user's in a process with limits on time, memory and length
(`wiw.vlm.template_filler`).
"""

from __future__ import annotations

from hashlib import blake2b
from pathlib import Path
from typing import Any

from wiw.errors import PromptError
from wiw.vlm import template_worker
from wiw.vlm.template_filler import TemplateFiller

FOLDER = Path(__file__).parent
NAME = "judge.j2"
SLOTS: dict[str, Any] = {
    "question": "Where is the kettle?",
    "answer": "on the stove",
    "extra_answers": ["in the kitchen"],
    "prediction": "on the kitchen counter",
}
"""Every slot, with a value to test templates with: the question, its right answer, others that are right as well, and
the answer to mark."""


class JudgePrompt:
    """The template of the prompt.

    Args:
        folder: with a template `judge.j2`; None means the shipped one.

    Raises:
        PromptError: no such file, one that cannot be read, or one with an unknown slot.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        self.folder = None if folder is None else Path(folder).expanduser()
        self._path = (self.folder or FOLDER) / NAME
        try:
            self._source = self._path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise PromptError(f"{self._path}: expected a template for the judge: {error}") from error
        self._filling = TemplateFiller()
        self.digest = blake2b(self._source.encode(), digest_size=8).hexdigest()
        """Digest of the template, as hexadecimal digits."""
        if self.folder is not None:  # tried on, so that what is wrong is known before the first question
            self._filling.fill(self._path, self._source, SLOTS, check=True)

    def __reduce__(self) -> Any:
        return JudgePrompt, (self.folder,)

    def render(self, question: str, answer: str, extra_answers: tuple[str, ...], prediction: str) -> str:
        """Return the prompt for one answer.

        Raises:
            PromptError: a user's template cannot be filled within the limits on time, memory and length.
        """
        slots = {"question": question, "answer": answer, "extra_answers": list(extra_answers), "prediction": prediction}
        if self.folder is None:
            return template_worker.fill_template(self._source, slots).strip()
        return self._filling.fill(self._path, self._source, slots).strip()
