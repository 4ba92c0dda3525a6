# SPDX-License-Identifier: Apache-2.0
"""Whatever a model says, an answer is what it said or a problem with a name: no crash, no default in its place."""

from __future__ import annotations

import json
import math
import re
import string
from collections.abc import Iterator
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

pytest.importorskip("pydantic")
pytest.importorskip("json_repair")

from wiw.policies.vlm.plans import parse_plans, plan_schema
from wiw.vlm import Request, user
from wiw.vlm.messages import Completion, Kind
from wiw.vlm.mock import MockClient

ACTIONS = ["forward", "turn_left", "turn_right", "forward"]
GOOD = json.dumps({"reason": 'a "door", {ahead}', "actions": ACTIONS})
NAMES = ("forward", "turn_left", "turn_right")
KINDS = set(get_args(Kind))


def replies_without_a_plan() -> Iterator[str]:
    """Families of answers out of which no plan may be read."""
    yield from (
        "",
        " ",
        "\n\n",
        "\0",
        "null",
        "true",
        "0",
        "[]",
        "{}",
        '""',
        "```json\n```",
        "<think>",
        "\ufeff",
        "\ud83d",
    )
    yield from (GOOD[:cut] for cut in range(len(GOOD)))  # cut off anywhere
    yield from (f"```json\n{GOOD[:cut]}" for cut in range(1, len(GOOD), 2))
    yield from (
        GOOD.replace(name, wrong) for name in NAMES for wrong in ("fly", "", "FORWARD!", "forward turn_left", "A")
    )
    for actions in (
        [],
        ["forward"] * 6,
        "forward",
        None,
        1,
        [1],
        [None],
        [["forward"]],
        {"0": "forward"},
        [True],
        ["stop"],
    ):
        yield json.dumps({"reason": "r", "actions": actions})
    for reason in (None, 1, [], {}):
        yield json.dumps({"reason": reason, "actions": ACTIONS})
    yield from (
        json.dumps(value)
        for value in (
            {"reason": "r"},
            {"ACTIONS": ACTIONS, "reason": "r", "Actions": ["forward"]},
            {"actions": ACTIONS, "reason": "r", "Reason": "s"},
            {"actions": ACTIONS, "reason": "r", "Actions": ["forward"]},
            {"actions": ["forward left"], "reason": "r"},
        )
    )
    yield json.dumps({"answer": {"reason": "r", "actions": ACTIONS}})
    yield from ("[" * depth + "]" * depth for depth in (10, 1000, 50_000))
    yield from ('{"a":' * depth + "1" + "}" * depth for depth in (10, 500, 5000, 13_000))
    yield from ("{" * depth for depth in (1, 7, 60_000))
    yield from ("x" * length for length in (1, 1000, 65_536, 65_537, 1_000_000))
    yield GOOD[:-1] + " " * 70_000 + "}"
    for refusal in (
        "I'm sorry, but I can't help.",
        "I cannot assist with that.",
        "As an AI, I have no body.",
        "Sorry, no.",
    ):
        yield from (refusal, refusal.upper(), f"  {refusal}", refusal.replace("'", "\u2019"))
    words = (
        "Go forward.",
        "forward, forward",
        "['forward']",
        "(forward)",
        "reason: door; actions: forward",
        "- forward\n- forward",
    )
    yield from (prefix + word for word in words for prefix in ("", "Answer: ", "```\n", "<answer>", "Plan 1. "))
    yield from string.ascii_letters
    for bad in ("NaN", "Infinity", "-", "undefined", "None", "0x10", "1e", "'", "\\"):
        yield GOOD.replace('["forward"', f"[{bad}")
        yield f'{{"reason": {bad}, "actions": {bad}}}'


CORPUS = list(dict.fromkeys(replies_without_a_plan()))


def plan_of(text: str, finish: str = "stop", count: int = 1) -> Any:
    client = MockClient(lambda call: Completion(text, finish))
    (reply,) = client.ask([Request((user("Plan!"),), schema=plan_schema(5, count), tries=1)])
    return reply


def held(text: str, finish: str = "stop") -> None:
    """A plan is made of words that the text holds, in their order; everything else is a problem with a name."""
    reply = plan_of(text, finish)
    if reply.problem is not None:
        assert reply.value is None and reply.problem.kind in KINDS and reply.problem.detail
        assert len(reply.problem.raw) <= 500 and text.startswith(reply.problem.raw)
        json.dumps([reply.problem.raw, reply.text])
        return
    ((actions, reason),) = parse_plans(reply.value)
    assert 1 <= len(actions) <= 5 and isinstance(reason, str)
    found = {name: re.search(name, text, re.IGNORECASE) for name in ("actions", "reason")}
    begin, other = (-1 if each is None else each.start() for each in found.values())
    rest = text[begin:] if begin > other else text
    rest = re.sub(r"[\s_-]+", "_", rest.casefold())
    for name in reply.value.actions:
        rest = rest[rest.index(name) + len(name) :]


def test_the_corpus_is_large() -> None:
    assert len(CORPUS) >= 300


def test_no_plan_is_made_out_of_an_answer_that_holds_none() -> None:
    for text in CORPUS:
        reply = plan_of(text)
        assert reply.problem is not None and reply.problem.kind in KINDS, f"a plan out of {text[:200]!r}"
        held(text)


@pytest.mark.parametrize(
    "said",
    [
        {"actions": ACTIONS},
        {"reason": "r", "actions": ACTIONS, "confidence": 1},
        {"reason": "r", "actions": ["Forward", "Turn Left", "TURN-RIGHT", " forward "]},
        {"thoughts": ["a", "wall"], "actions": ["forward", "turn  left", "Turn_Right", "FORWARD"]},
        {"Reason": "r", "Actions": ACTIONS},
    ],
)
def test_harmless_variations_are_read_and_recorded(said: dict[str, Any]) -> None:
    for text in (json.dumps(said), f"Here it is: {json.dumps(said)}"):
        reply = plan_of(text)
        assert reply.problem is None and reply.adapted and not reply.repaired
        assert reply.value.actions == ACTIONS and reply.value.reason == said.get("reason", said.get("Reason", ""))
    listed = plan_of(json.dumps({"plans": [said], "number": 1}), count=2)
    assert [plan.actions for plan in listed.value.plans] == [ACTIONS]
    assert plan_of(GOOD).problem is None and not plan_of(GOOD).adapted


def test_every_kind_of_problem_is_found() -> None:
    kinds = {plan_of(text).problem.kind for text in CORPUS} | {plan_of(GOOD, "content_filter").problem.kind}
    assert kinds == KINDS - {"no_option"}


def test_no_choice_is_made_out_of_an_answer_that_holds_none() -> None:
    """Texts that begin with the letter of an option are votes; nothing else is."""
    for text in CORPUS:
        client = MockClient(lambda call, text=text: Completion(text))
        (reply,) = client.ask([Request((user("Which?"),), choices=("one", "two", "three"))])
        voted = text.strip(" ()[]*\"'\n").upper() in ("A", "B", "C")
        assert (reply.problem is None) == voted == (reply.probabilities is not None), text[:100]


@settings(max_examples=100, suppress_health_check=[HealthCheck.too_slow])
@given(st.text(max_size=300), st.sampled_from(["stop", "length", "content_filter", "tool_calls", ""]))
def test_any_text(text: str, finish: str) -> None:
    held(text, finish)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=8) | st.sampled_from([*NAMES, "reason", "actions"]),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["reason", "actions", "plans", "x"]), inner, max_size=4)
    ),
    max_leaves=12,
)


@settings(max_examples=100, suppress_health_check=[HealthCheck.too_slow])
@given(JSON)
def test_any_json(value: Any) -> None:
    held(json.dumps(value))


@settings(max_examples=100, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(st.integers(0, len(GOOD)), st.integers(0, 3), st.text(max_size=3)), min_size=1, max_size=4))
def test_any_slip_of_the_pen(slips: list[tuple[int, int, str]]) -> None:
    text = GOOD
    for place, removed, inserted in slips:
        text = text[:place] + inserted + text[place + removed :]
    held(text)


@settings(max_examples=100)
@example([("A", math.inf), ("B", -1.0)])
@example([("A", 1000.0), ("B", -1.0)])
@given(st.lists(st.tuples(st.text(max_size=3), st.floats(allow_nan=True, allow_infinity=True)), max_size=20))
def test_any_list_of_tokens(listed: list[tuple[str, float]]) -> None:
    client = MockClient(lambda call: Completion("?", "length", tuple(listed) or None))
    (reply,) = client.ask([Request((user("Which?"),), choices=("one", "two", "three"))])
    if reply.problem is None:
        assert abs(reply.probabilities.sum() - 1) < 1e-9 and np.isfinite(reply.probabilities).all()
        assert any(token.strip(" \t\r\n\u2581\u0120\u010a().:*\"'`[]") in set("ABC") for token, _ in listed)
        assert 0 <= reply.mass <= 1
    else:
        assert reply.problem.kind == "no_option" and reply.probabilities is None
