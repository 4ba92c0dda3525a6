# SPDX-License-Identifier: Apache-2.0
"""Objects that a local model generates: it writes their strings, and decides between the types of a union."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pydantic = pytest.importorskip("pydantic")
pytest.importorskip("json_repair")

from wiw.vlm import Request, connect, user  # noqa: E402
from wiw.vlm.instances import generate_instance  # noqa: E402
from wiw.vlm.json_strings import read_string  # noqa: E402
from wiw.vlm.mock import MockClient  # noqa: E402

IMAGE = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
PROMPT = (user("Note!", IMAGE),)


class Note(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid")
    reason: str
    answer: str | None = pydantic.Field(max_length=20)


class Short(pydantic.BaseModel):
    word: str = pydantic.Field(min_length=3, max_length=5)


@pytest.fixture
def client(tiny: Path) -> Any:
    return connect(f"transformers:{tiny}", device="cpu")


def write(client: Any, schema: Any = Note, max_tokens: int = 60, **options: Any) -> Any:
    return client.ask([Request(PROMPT, schema=schema, max_tokens=max_tokens, tries=1, **options)])[0]


def score_next_tokens(client: Any, begun: str) -> Any:
    import torch

    with torch.inference_mode():
        return client._network(**client._prepare_inputs(PROMPT, begun)).logits[0, -1]


@contextmanager
def preferring(client: Any, piece: str) -> Iterator[None]:
    """Make the model write a token wherever it can."""
    import torch

    token = client._tokenizer.get_vocab()[piece]
    push = torch.zeros(client._network.lm_head.out_features)
    push[token] = 1000.0
    hook = client._network.lm_head.register_forward_hook(lambda _module, _given, scores: scores + push)
    yield
    hook.remove()


def test_strings_are_the_likeliest_tokens_one_after_the_other(client: Any) -> None:
    import torch

    inputs = dict(client._prepare_inputs(PROMPT, '{"reason": "'))
    begin = inputs["input_ids"].shape[1]
    for _ in range(12):
        with torch.inference_mode():
            scores = client._network(**inputs).logits[:, -1:].clone()
            scores[..., client._tokenizer.convert_tokens_to_ids(["<image>", "<pad>", "<s>", "<unk>"])] = -torch.inf
            token = scores.argmax(-1)
        inputs["input_ids"] = torch.cat([inputs["input_ids"], token], 1)
        inputs["attention_mask"] = torch.ones_like(inputs["input_ids"])
    reply = write(client)
    assert reply.problem is None
    assert reply.value.reason.startswith(read_string(client._decode(inputs["input_ids"][0, begin:]))[0])


def test_strings_are_sampled_by_temperature_and_seed_whatever_else_is_asked(client: Any) -> None:
    client._network.generation_config.top_k = 1  # the model's own preference, which is not the request's
    requests = [Request(PROMPT, schema=Note, temperature=1.0, seed=s, max_tokens=40) for s in range(4)]
    together = [reply.text for reply in client.ask(requests)]
    assert len({json.loads(text)["reason"] for text in together}) == 4
    assert [client.ask([request])[0].text for request in reversed(requests)] == together[::-1]


def test_null_or_a_string_is_decided_by_how_each_begins(client: Any) -> None:
    words = client._tokenizer.get_vocab()
    reply = write(client, max_tokens=16)
    scores = score_next_tokens(client, f'{{"reason": {json.dumps(reply.value.reason)}, "answer": ')
    assert (reply.value.answer is None) == bool(scores[words["n"]] > scores[words['"']])
    for piece, answer in (('"', ""), ("n", None)):
        with preferring(client, piece):
            assert write(client, max_tokens=16).value.answer == answer


def test_lengths_are_kept_even_by_a_model_that_writes_nothing_or_goes_on(client: Any) -> None:
    with preferring(client, '"'):
        assert write(client, max_tokens=30).value.reason == ""
        for limit in (60, 1):
            assert 3 <= len(write(client, Short, max_tokens=limit).value.word) <= 5
    with preferring(client, "a"):
        said = write(client, Short)
        assert said.value.word == "aaaaa" and said.completions[0].completion.finish == "stop"
        cut = write(client, Note)
        assert cut.value.reason.strip("a") == "" and cut.completions[0].completion.finish == "length"
    with preferring(client, "</s>"):
        ended = write(client, Note)
        assert ended.value.reason == "" and ended.completions[0].completion.finish == "stop"


@pytest.mark.parametrize(("piece", "reason"), [("\\", "\\"), ("\n", "\n")])
def test_whatever_the_model_writes_is_escaped(client: Any, piece: str, reason: str) -> None:
    with preferring(client, piece):
        reply = write(client)
    assert not reply.repaired and set(reply.value.reason) == {reason}
    assert json.loads(reply.text)["reason"] == reply.value.reason


@pytest.mark.parametrize(
    ("written", "text", "closed"),
    [
        ('a door", "more', "a door", True),
        (r'say \"hi\" twice", ', 'say "hi" twice', True),
        (r'C:\windows\\", ', "C:\\windows\\", True),
        (r"é = \u00e9, \ud83d\ude00, \ud83d.", "é = é, 😀, ?.", False),
        ("half\ufffd", "half", False),
        ("begun\\", "begun", False),
        (r"begun \u00", r"begun \u00", False),
        ('two\nlines"', "two\nlines", True),
        ('"', "", True),
        ("", "", False),
    ],
)
def test_strings_are_read_as_far_as_they_are_written(written: str, text: str, closed: bool) -> None:
    assert read_string(written) == (text, closed)


@given(st.text())
def test_every_string_is_read_as_it_was_escaped(text: str) -> None:
    for as_ascii in (False, True):
        assert read_string(json.dumps(text, ensure_ascii=as_ascii)[1:] + ", more") == (text, True)
    read_string(text)[0].encode()


def test_types_are_told_apart_by_how_they_begin() -> None:
    class Mixed(pydantic.BaseModel):
        number: Literal[3, 12, 14] | None
        size: Annotated[int, pydantic.Field(ge=8, le=11)] | Note | None
        words: list[Note]
        flag: bool | Literal["yes", "no"]

    asked = []

    def choose(before: str, options: Any) -> int:
        if len(options) > 1:
            asked.append([list(option) for option in options])
        return len(options) - 1

    text = generate_instance(Mixed.model_json_schema(), choose, lambda before, least, most: before[-12:])
    assert asked[:2] == [[["1", "3"], ["null"]], [["1", "8", "9"], ['{"reason"'], ["null"]]]
    assert asked[2] == [["]"], ['{"reason"']] and asked[3] == [['"'], ["null"]]
    assert [["false", "true"], ['"']] in asked and all("type" not in str(options) for options in asked)
    assert json.loads(text)["words"][1] == {"reason": ' {"reason": ', "answer": None}


def test_the_mock_writes_strings_of_the_right_length() -> None:
    class Both(pydantic.BaseModel):
        long: str = pydantic.Field(min_length=40)
        short: str = pydantic.Field(max_length=3)

    value = write(MockClient(), Both).value
    assert len(value.long) == 40 and len(value.short) == 3
