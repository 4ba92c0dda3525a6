# SPDX-License-Identifier: Apache-2.0
"""Marks by a language model behind any OpenAI-compatible server."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from wiw.errors import ArgumentError, DependencyError, JudgeError
from wiw.judging.judge import HIGHEST_MARK, LOWEST_MARK, Judge, Judgement, Reference
from wiw.judging.prompts.judge_prompt import JudgePrompt
from wiw.vlm import Reply, Request, connect, user
from wiw.vlm.cache import open_reply_cache
from wiw.vlm.structured import iterate_json_objects, strip_thoughts

if TYPE_CHECKING:
    from pydantic import BaseModel

TEMPERATURE, SEED, MAX_TOKENS = 0.2, 1234, 32
"""Sampling of OpenEQA's judge."""
PARSER_VERSION = 2
"""Raised when a reply may be read as another mark than before."""
LONGEST_ANSWER = 1000
"""Characters of an answer that the model is shown."""
_REPORTED_CHARACTERS = 120
_PLAIN_MARK = re.compile(
    r"(?:(?:your|my|the|final|overall)\s+)*(?:(?:mark|score|rating|answer)\s*(?:is|[:=])?\s*)?"
    r"([+-]?\d{1,9}(?:\.\d{1,9})?)\s*(?:/\s*5|out of 5)?\s*\.?",
    re.IGNORECASE,
)

_EMPHASIS = re.compile(r"(?<!\w)[*_`]+|[*_`]+(?!\w)")
"""Markdown around words, as in "**Mark:** 4"."""


class LanguageModelJudge(Judge):
    """Asks a language model for the mark of each answer; every mark comes with the model's raw reply.

    Args:
        llm: an address such as "http://localhost:8000/v1", or a client; see `wiw.vlm.connect`.
        model: its name there; None means the only one that the server offers.
        prompts: folder with a template `judge.j2` that replaces the shipped one; see `JudgePrompt`.
        temperature: of the sampling.
        seed: of the sampling; it is sent as it is.
        max_tokens: maximum number of tokens of a reply.
        cache: where replies are kept, so that none is paid for twice: "auto" (`~/.cache/wiw/replies`), a folder, "off".
        client: further options of the client, such as `dialect` and `concurrency`.

    Raises:
        ArgumentError: an option out of range, or one that the client does not take.
        DependencyError: `wiw[vlm]` is not installed.
        PromptError: see `JudgePrompt`.
    """

    name = "llm"

    def __init__(
        self,
        llm: Any,
        model: str | None = None,
        *,
        prompts: str | Path | None = None,
        temperature: float = TEMPERATURE,
        seed: int = SEED,
        max_tokens: int = MAX_TOKENS,
        cache: str | Path = "auto",
        **client: Any,
    ) -> None:
        if temperature < 0 or seed < 0 or max_tokens < 1:
            raise ArgumentError(
                "judge llm: expected temperature >= 0, seed >= 0 and max_tokens >= 1, got "
                f"{temperature}, {seed}, {max_tokens}"
            )
        self.prompt = JudgePrompt(prompts)
        self.temperature, self.seed, self.max_tokens = temperature, seed, max_tokens
        self._schema = make_schema()
        options = {"cache": open_reply_cache(cache)} if isinstance(llm, str) else {}
        named = {} if model is None else {"model": model}
        self.client = connect(llm, **{**options, **named, **client})

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_schema"}  # a class made at run time

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _schema=make_schema())

    @property
    def concurrency(self) -> int:
        """How many requests its client sends at a time."""
        return self.client.concurrency

    def describe(self) -> dict[str, Any]:
        """Return the model, the digest of the prompt and the sampling.

        Raises:
            VlmError: the model's name was not given, and its server cannot be asked for it.
        """
        return {
            "judge": self.name,
            "version": PARSER_VERSION,
            "model": self.client.model,
            "manner": self.client.manner,
            "prompt": self.prompt.digest,
            "temperature": self.temperature,
            "seed": self.seed,
            "max_tokens": self.max_tokens,
        }

    def _judge_answers(self, references: Sequence[Reference], answers: Sequence[str]) -> list[Judgement | JudgeError]:
        requests = [self._build_request(*row) for row in zip(references, answers, strict=True)]
        replies = self.client.ask(requests) if requests else []
        return [self._read_judgement(*row) for row in zip(references, replies, strict=True)]

    def _build_request(self, reference: Reference, answer: str) -> Request:
        shown = answer[:LONGEST_ANSWER]
        text = self.prompt.render(reference.question, reference.answer, reference.extra_answers, shown)
        # One try: another would be sampled at another temperature and seed than those on record.
        return Request(
            (user(text),),
            schema=self._schema,
            temperature=self.temperature,
            seed=self.seed,
            exact_seed=True,
            max_tokens=self.max_tokens,
            tries=1,
        )

    def _read_judgement(self, reference: Reference, reply: Reply) -> Judgement | JudgeError:
        try:
            mark = read_mark(reply)
        except JudgeError as error:
            return JudgeError(f"question '{reference.question}': {self.client.model}: {error}", error.kind)
        return Judgement(
            mark,
            self.name,
            model=self.client.model,
            prompt_digest=self.prompt.digest,
            reply=reply.text,
            seed=self.seed,
            temperature=self.temperature,
        )


@cache
def make_schema() -> type[BaseModel]:
    """Return the schema {"mark": 1 | 2 | 3 | 4 | 5}.

    Raises:
        DependencyError: pydantic is not installed.
    """
    try:
        from pydantic import BeforeValidator, ConfigDict, create_model
    except ImportError:
        raise DependencyError("a language model as judge needs: pip install 'wiw[vlm]'") from None
    mark: Any = Annotated[Literal[1, 2, 3, 4, 5], BeforeValidator(_refuse_booleans)]
    return create_model("Mark", __config__=ConfigDict(extra="forbid"), mark=(mark, ...))


def _refuse_booleans(value: Any) -> Any:
    """Return a value that is not a boolean; true equals 1 and would pass for it."""
    if isinstance(value, bool):
        raise ValueError("expected a number")
    return value


def read_mark(reply: Reply) -> int:
    """Return the mark of a reply: that of the schema, or the number where it is all that the model says.

    Raises:
        JudgeError: it says no mark, one out of range, or more than a mark.
    """
    problem = reply.problem
    if problem is None and reply.value is not None:
        return int(reply.value.mark)
    if problem is not None and problem.kind in ("empty", "refusal", "huge"):
        raise JudgeError(f"expected a mark from 1 to 5, got {problem}", problem.kind)
    cut = bool(reply.completions) and reply.completions[-1].completion.finish == "length"
    return parse_mark(reply.text, cut)


def parse_mark(text: str, cut: bool = False) -> int:
    """Return the mark that a text consists of: '{"mark": 3}', "3", "3/5" or "Your mark: 3".

    Args:
        text: a model's reply.
        cut: whether the model was not done when the text ended.

    Raises:
        JudgeError: it is empty, says more than a mark, or a mark that is not from 1 to 5.
    """
    if not text.strip():
        raise JudgeError("expected a mark from 1 to 5, got an empty reply", "empty")
    value = _find_number(strip_thoughts(text).strip())
    shown = text.strip()[:_REPORTED_CHARACTERS]
    if value is None:
        hint = "; it was cut off, so raise max_tokens if the model thinks aloud" if cut else ""
        raise JudgeError(
            f"expected a mark from 1 to 5 and nothing else, got {shown!r}{hint}", "truncated" if cut else "malformed"
        )
    if value != int(value) or not LOWEST_MARK <= value <= HIGHEST_MARK:
        raise JudgeError(f"expected a mark from 1 to 5, got {shown!r}", "range")
    return int(value)


def _find_number(text: str) -> float | None:
    """Return the number that a text consists of, as a JSON object or in plain words."""
    plain = _PLAIN_MARK.fullmatch(_EMPHASIS.sub("", text).strip())
    if plain is not None:
        return float(plain[1])
    found, whole = [("", False), *iterate_json_objects(text)][-1]
    if not whole:
        return None
    try:
        values = json.loads(found)
    except (ValueError, RecursionError):
        return None
    mark = values.get("mark") if isinstance(values, dict) else None
    if isinstance(mark, str) and re.fullmatch(r"[+-]?\d{1,9}", mark.strip()):
        return float(mark)
    return float(mark) if isinstance(mark, int | float) and not isinstance(mark, bool) and abs(mark) < 1e9 else None
