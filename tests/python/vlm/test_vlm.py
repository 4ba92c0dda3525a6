# SPDX-License-Identifier: Apache-2.0
"""Clients of vision-language models: choices, JSON, caches, records and a real model with random weights."""

from __future__ import annotations

import json
import math
import pickle
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pydantic = pytest.importorskip("pydantic")
pytest.importorskip("json_repair")

from wiw.errors import ArgumentError, FileError, VlmError, WeightsError  # noqa: E402
from wiw.vlm import Request, choices, connect, structured, user  # noqa: E402
from wiw.vlm.cache import ReplyCache, open_reply_cache  # noqa: E402
from wiw.vlm.images import from_data_uri, to_data_uri  # noqa: E402
from wiw.vlm.instances import generate_instance  # noqa: E402
from wiw.vlm.messages import Completion, Problem  # noqa: E402
from wiw.vlm.mock import MockClient  # noqa: E402
from wiw.vlm.prices import Prices  # noqa: E402

IMAGE = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)


class Plan(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid")
    reason: str
    actions: list[Literal["forward", "turn_left"]] = pydantic.Field(min_length=1, max_length=4)


def ask(client: Any, *content: Any, **options: Any) -> Any:
    return client.ask([Request((user(*content),), **options)])[0]


def slow_choice(listed: dict[str, float], labels: str) -> list[float]:
    """The recipe, one step after the other, in probabilities."""
    own = dict.fromkeys(labels, 0.0)
    for token, value in listed.items():
        if token.strip(" (.)") in own:
            own[token.strip(" (.)")] += math.exp(value)
    least = min(math.exp(min(listed.values())), max(1 - sum(math.exp(value) for value in listed.values()), 1e-300))
    weights = [own[label] or least for label in labels]
    return [weight / sum(weights) for weight in weights]


@given(
    st.dictionaries(
        st.sampled_from(["A", " A", "(A", "B", " B", "B)", "C", " D", "the", "I", "\n"]), st.floats(-20, 0), min_size=1
    )
)
def test_choices_equal_their_slow_twin(listed: dict[str, float]) -> None:
    found = choices.read_logprobs(list(listed.items()), "ABCD")
    named = [token for token in listed if token.strip(" (.)") in set("ABCD")]
    if sum(math.exp(listed[token]) for token in named) < choices.LEAST_MASS:
        assert found is None
        return
    assert found is not None
    np.testing.assert_allclose(found[0], slow_choice(listed, "ABCD"), rtol=1e-9, atol=1e-12)
    given = {label: sum(math.exp(p) for token, p in listed.items() if token.strip(" (.)") == label) for label in "ABCD"}
    np.testing.assert_allclose(found[1], np.array([*given.values()]) / max(1.0, sum(given.values())))


def test_tokens_that_a_server_forbids_count_nothing() -> None:
    found = choices.read_logprobs([("A", -0.1), ("B", -9999.0), ("x", -math.inf), ("y", math.nan)], "ABC")
    assert found is not None
    np.testing.assert_allclose(found[0], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(found[1], [math.exp(-0.1), 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "vote"),
    [
        ("B", 1), ("b", 1), (" (B) chair", 1), ("B. chair", 1), ("**B**", 1), ("The answer is C.", 2), ("Answer: A", 0),
        ("**Answer:** B", 1), ("**Answer**: **C**", 2), ("**Answer:** A chair", None),
        ("A chair", None), ("I'm sorry", None), ("Bad", None), ("", None), ("D", None), ("It is B", None),
        ("?" * 5000, None),
    ],
)  # fmt: skip
def test_votes_are_letters_that_stand_alone(text: str, vote: int | None) -> None:
    found = choices.count_votes([text], tuple("ABC"))
    assert found is None if vote is None else found is not None and found[0].argmax() == vote and found[1].sum() == 1


def test_thoughts_are_no_part_of_votes_and_texts() -> None:
    thought = MockClient(lambda call: Completion("<think>A chair? No, so B.\n</think>\n\nB"))
    reply = ask(thought, "Which?", choices=("x", "y"))
    assert reply.by == "votes" and reply.probabilities.tolist() == [0, 1] and len(thought.calls) == 6
    assert ask(thought, "Which?").text.strip() == "B"
    endless = MockClient(lambda call: Completion("<think>A, or B?"))
    assert ask(endless, "Which?", choices=("x", "y")).problem.kind == "no_option"
    assert ask(endless, "Which?").problem.kind == "empty"


def test_a_server_without_logprobs_is_asked_for_votes_and_the_reply_says_so() -> None:
    texts = iter(["?", "A", "(B)", "b", "no idea", "B."])
    client = MockClient(lambda call: Completion(next(texts)))
    reply = ask(client, "Which?", choices=("x", "y"))
    assert (reply.by, reply.mass) == ("votes", 0.8) and reply.problem is None and reply.raw.tolist() == [0.2, 0.6]
    assert reply.probabilities.tolist() == [0.25, 0.75]
    assert len({call.seed for call in client.calls}) == 6 and {call.temperature for call in client.calls[1:]} == {1.0}


@pytest.mark.parametrize("finish", ["content_filter", "refusal"])
def test_a_withheld_answer_is_no_choice_whatever_tokens_it_lists(finish: str) -> None:
    likely = (("A", -0.01), ("B", -5.0))
    reply = ask(MockClient(lambda call: Completion("A", finish, likely)), "Which?", choices=("left", "right"))
    assert reply.problem is not None and reply.problem.kind == "refusal" and reply.probabilities is None


def test_mass_below_one_half_is_doubtful() -> None:
    reply = ask(MockClient(lambda call: {"A": 0.2, " B": 0.1, "The": 0.7}), "Which?", choices=("x", "y"))
    assert reply.doubtful and reply.mass == pytest.approx(0.3)
    np.testing.assert_allclose(reply.raw, [0.2, 0.1])
    np.testing.assert_allclose(reply.probabilities, [2 / 3, 1 / 3])


@pytest.mark.parametrize(("count", "most"), [(5, 20), (27, 20), (27, 3), (60, 7), (3, 2)])
def test_rounds_find_the_distribution_of_a_model_that_is_consistent(count: int, most: int) -> None:
    """A model whose odds between two options never change has the same distribution in one round as in several."""
    truth = np.random.default_rng(count).dirichlet(np.ones(count))

    def script(call: Any) -> dict[str, float]:
        lines = call.messages[-1].content[-1].splitlines()
        shown = {line[0]: truth[int(line.split(" o")[1])] for line in lines if " o" in line and line[1] == "."}
        assert len(shown) <= most
        return {label: p / sum(shown.values()) for label, p in shown.items()}

    reply = ask(MockClient(script, top_logprobs=most), "Which?", choices=tuple(f"o{i}" for i in range(count)))
    np.testing.assert_allclose(reply.probabilities, truth, rtol=1e-6)


def test_one_question_with_all_choices_goes_on_after_z() -> None:
    """27 letters, of which a server that lists 5 tokens names some: unlisted ones keep at most what is left over."""
    options = tuple(f"o{i}" for i in range(27))
    client = MockClient(lambda call: {"Γ": 0.6, "B": 0.2, "the": 0.1, "C": 0.05, "D": 0.02, "E": 0.03}, top_logprobs=5)
    reply = ask(client, "Which?", choices=options, rounds=False)
    (call,) = client.calls
    assert len(call.labels) == 27 and call.labels[-2:] == ("Z", "Γ") and "Γ. o26" in call.messages[-1].content[-1]
    assert reply.raw[[26, 1, 2, 4]].tolist() == pytest.approx([0.6, 0.2, 0.05, 0.03]) and reply.raw[3] == 0
    assert reply.mass == pytest.approx(0.88) and reply.probabilities.sum() == pytest.approx(1)
    assert reply.probabilities[3] < reply.probabilities[4] + 1e-9 < reply.probabilities[26]
    votes = MockClient(lambda call: Completion("Γ."))
    assert ask(votes, "Which?", choices=options, rounds=False).probabilities.argmax() == 26
    many = tuple(f"o{i}" for i in range(60))
    in_rounds = MockClient()
    assert ask(in_rounds, "Which?", choices=many, rounds=False).probabilities.shape == (60,)
    assert max(len(call.labels) for call in in_rounds.calls) <= 36


def test_requests_that_make_no_sense_are_refused() -> None:
    for wrong in ({"choices": ("a",)}, {"choices": ("a", "a")}, {"choices": ("a", "b"), "schema": Plan}, {"tries": 0}):
        with pytest.raises(ArgumentError):
            Request((user("?"),), **wrong)
    for spec in ("ftp://x", "transformers:", "replay", "mock:3"):
        with pytest.raises(ArgumentError, match="expected http"):
            connect(spec)
    with pytest.raises(ArgumentError, match="no option colour; there are script"):
        connect("mock", colour="red")
    with pytest.raises(ArgumentError, match="top_logprobs from 2 to 26"):
        connect("mock", top_logprobs=40)


@pytest.mark.parametrize(
    ("text", "actions", "repaired"),
    [
        ('{"reason": "a", "actions": ["forward"]}', ["forward"], False),
        ('Sure!\n```json\n{"reason": "a } b", "actions": ["forward"]}\n```', ["forward"], False),
        ("{'reason': 'a', 'actions': ['forward', 'turn_left',]}", ["forward", "turn_left"], True),
        ('{reason: "a", actions: ["forward"]} and so on', ["forward"], True),
    ],
)
def test_json_is_found_and_slips_are_mended(text: str, actions: list[str], repaired: bool) -> None:
    reply = ask(MockClient(lambda call: text), "Plan!", schema=Plan)
    assert reply.value.actions == actions and reply.repaired is repaired and reply.problem is None


def test_an_unusable_answer_is_asked_for_again_then_it_is_the_outcome() -> None:
    texts = iter(["nonsense", '{"reason": "a", "actions": ["forward"]}'])
    client = MockClient(lambda call: next(texts))
    reply = ask(client, "Plan!", schema=Plan, tries=2)
    assert reply.value.actions == ["forward"] and [each.used for each in reply.completions] == [False, True]
    first, second = client.calls
    assert first.temperature == 0 and second.temperature > 0 and first.seed != second.seed
    reply = ask(MockClient(lambda call: "nonsense"), "Plan!", schema=Plan, tries=2)
    assert reply.value is None and reply.problem.kind == "malformed" and reply.problem.raw == "nonsense"
    assert len(reply.completions) == 2


def test_a_question_is_named_by_all_that_its_answer_depends_on() -> None:
    client = MockClient()
    base: dict[str, Any] = {"choices": ("a", "b")}
    names = set()
    other = IMAGE.copy()
    other[3, 4, 1] ^= 1
    for content, options in (
        ((IMAGE, "?"), base),
        ((other, "?"), base),
        ((IMAGE, "!"), base),
        (("?", IMAGE), base),
        ((IMAGE, "?"), {**base, "seed": 1}),
        ((IMAGE, "?"), {"choices": ("a", "c")}),
        ((IMAGE, "?"), {"schema": Plan}),
        ((IMAGE, "?"), {"temperature": 0.5}),
        ((IMAGE.reshape(60, 40, 3), "?"), base),
    ):
        names.add(ask(client, *content, **options).completions[0].call)
    names.add(ask(MockClient(model="other"), IMAGE, "?", **base).completions[0].call)
    assert len(names) == 10
    assert ask(MockClient(), IMAGE.copy(), "?", **base).completions[0].call in names


def test_calls_that_cannot_be_counted_or_priced_are_told() -> None:
    known = MockClient(prices=Prices({"mock": (1.0, 2.0)}))
    ask(known, "?")
    assert not {"vlm_uncounted", "vlm_unpriced"} & set(known.spent) and known.spent["vlm_usd"] > 0
    other = MockClient(prices=Prices({"another": (1.0, 2.0)}))
    ask(other, "?")
    assert other.spent["vlm_unpriced"] == 1 and "vlm_usd" not in other.spent
    silent = MockClient(lambda call: Completion("fine"))
    ask(silent, "?")
    assert silent.spent["vlm_uncounted"] == 1 and "vlm_unpriced" not in silent.spent


def test_the_cache_answers_what_was_of_use(tmp_path: Path) -> None:
    texts = iter(["nonsense", '{"reason": "a", "actions": ["forward"]}', "nonsense", "more"])
    first = MockClient(lambda call: next(texts), cache=ReplyCache(tmp_path), prices=Prices({"mock": (1.0, 2.0)}))
    reply = ask(first, IMAGE, schema=Plan)
    assert first.spent["vlm_calls"] == 2 and first.spent["vlm_cached"] == 0
    read, written = first.spent["vlm_input_tokens"], first.spent["vlm_output_tokens"]
    assert first.spent["vlm_usd"] == pytest.approx((read + 2 * written) / 1e6)
    again = MockClient(lambda call: "nonsense", cache=ReplyCache(tmp_path))
    second = ask(again, IMAGE, schema=Plan)  # the unusable answer comes again, and then the one that was kept
    assert second.value == reply.value and again.spent["vlm_calls"] == 1 and again.spent["vlm_cached"] == 1
    assert "vlm_usd" not in again.spent
    assert pickle.loads(pickle.dumps(ReplyCache(tmp_path))).folder == tmp_path
    assert open_reply_cache("off") is None


def test_the_cache_keeps_to_its_budget_and_survives_damage(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cache = ReplyCache(tmp_path, 200_000 / 2**30)
    for k in range(200):
        cache.put({f"k{k}": Completion("x" * 1000)})
    kept = [k for k in range(200) if cache.get(f"k{k}")]
    assert kept == list(range(200 - len(kept), 200)) and 100 <= len(kept) <= 160
    with sqlite3.connect(tmp_path / "replies.sqlite") as connection:
        (pages,) = connection.execute("PRAGMA page_count").fetchone()
        assert pages * 4096 <= 200_000 + 2 * 4096
        connection.execute("UPDATE reply SET data = '{' WHERE name = 'k199'")
    assert cache.get("k199") is None and "damaged" in caplog.text
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/replies.sqlite").write_bytes(b"no database" * 100)
    broken = ReplyCache(tmp_path / "broken")
    assert broken.get("a") is None and "no longer cached" in caplog.text
    broken.put({"a": Completion("x")})
    with pytest.raises(ArgumentError, match="above 0"):
        ReplyCache(tmp_path, 0)


def test_answers_are_added_up_only_where_some_must_go(tmp_path: Path) -> None:
    """Reading all of them for each new one would take longer and longer."""
    cache = ReplyCache(tmp_path, 400_000 / 2**30)
    asked: list[str] = []
    cache._open().set_trace_callback(asked.append)
    counts = []
    for _ in range(3):
        for k in range(200):
            cache.put({f"{len(counts)} {k}": Completion("x" * 1000)})
        counts.append(sum("total(" in each for each in asked))
    assert counts[0] == 0 and 0 < counts[2] < 40


def test_a_locked_cache_is_used_again_when_it_is_free(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("wiw.vlm.cache.LONGEST_WAIT", 0.1)
    cache = ReplyCache(tmp_path)
    cache.put({"old": Completion("x")})
    with closing(sqlite3.connect(tmp_path / "replies.sqlite")) as other:
        other.execute("BEGIN IMMEDIATE")
        assert cache.get("old") == Completion("x")
        assert not caplog.text
        cache.put({"new": Completion("y")})
    assert "another process wrote" in caplog.text and "disk space" not in caplog.text
    assert cache.get("new") is None
    cache.put({"new": Completion("y")})
    assert cache.get("new") == Completion("y")


def test_a_mock_records_calls_in_a_test_and_not_in_a_run() -> None:
    scripted, random = MockClient(lambda call: "x"), connect("mock")
    for client, count in ((scripted, 1), (MockClient(), 1), (MockClient(record=False), 0), (random, 0)):
        ask(client, IMAGE)
        assert len(client.calls) == count


def test_the_cache_serves_several_threads(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cache = ReplyCache(tmp_path)
    cache.put({"first": Completion("x")})

    def work(k: int) -> bool:
        cache.put({f"k{k}": Completion("x")})
        return cache.get("first") is not None and cache.get(f"k{k}") is not None

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(work, range(40)))
    assert not caplog.text


def test_prices_come_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "prices.yaml"
    path.write_text("big: [2.5, 10]\n")
    prices = Prices.load(path)
    assert (
        prices.compute_cost("big", 1_000_000, 100_000) == pytest.approx(3.5)
        and prices.compute_cost("small", 1, 1) is None
    )
    for wrong in ("big: 3", "- big", "big: [1, x]", "big: [1, -2]", "big: [.nan, 1]", f"big: [1, {10**400}]", "{", ""):
        path.write_text(wrong)
        with pytest.raises(FileError, match="dollars per million tokens"):
            Prices.load(path)


def test_images_travel_as_data_uris() -> None:
    assert (from_data_uri(to_data_uri(IMAGE)) == IMAGE).all()
    smooth = np.linspace(0, 255, 40 * 60 * 3).reshape(40, 60, 3).astype(np.uint8)
    jpeg = from_data_uri(to_data_uri(smooth, "jpeg"))
    assert np.abs(jpeg.astype(int) - smooth).max() < 12
    for wrong in (
        "x",
        "data:image/png;base64,",
        "data:image/png;base64,!!",
        "data:text/plain;base64,QQ==",
        "data:image/png;base64,QQ==",
    ):
        with pytest.raises(ArgumentError, match=r"data:image|cannot be read"):
            from_data_uri(wrong)
    with pytest.raises(ArgumentError, match="uint8"):
        to_data_uri(IMAGE.astype(np.float32))


class Leaf(pydantic.BaseModel):
    size: int = pydantic.Field(ge=2, le=5)
    kind: Literal["a", "b"] | None
    share: float = pydantic.Field(ge=0, le=1)


class Tree(pydantic.BaseModel):
    name: str = pydantic.Field(max_length=5)
    leaves: list[Leaf] = pydantic.Field(max_length=3)
    alive: bool


@given(st.randoms(use_true_random=False))
def test_instances_fit_their_schema(random: Any) -> None:
    def choose(before: str, options: Any) -> int:
        return int(random.randrange(len(options)))

    text = generate_instance(Tree.model_json_schema(), choose, lambda before, least, most: '"\\\n"'[:most])
    Tree.model_validate(json.loads(text))


def test_a_recorded_answer_is_given_again_and_nothing_else(tmp_path: Path) -> None:
    reply = ask(MockClient(), IMAGE, choices=("a", "b"))
    exchange = {
        "model": "mock",
        "said": [
            {"call": said.call, **json.loads(json.dumps(said.completion.to_json()))} for said in reply.completions
        ],
    }
    run = tmp_path / "100%41? #1"  # which means something in an address
    run.mkdir()
    with sqlite3.connect(run / "run.sqlite") as connection:
        connection.execute("CREATE TABLE decision (exchanges TEXT)")
        connection.execute("INSERT INTO decision VALUES (?), ('[]')", (json.dumps([exchange]),))
    replay = connect(f"replay:{run}")
    assert replay.model == "mock"
    np.testing.assert_array_equal(ask(replay, IMAGE, choices=("a", "b")).probabilities, reply.probabilities)
    with pytest.raises(VlmError, match="has no answer") as error:
        ask(replay, IMAGE, choices=("a", "c"))
    assert error.value.kind == "missing"
    with pytest.raises(FileError, match="one model, got none"):
        connect(f"replay:{run}", model="another")
    with pytest.raises(FileError, match="no run at"):
        connect(f"replay:{tmp_path / 'nowhere'}")


def test_a_local_model_answers_by_the_scores_of_the_first_token(tiny: Path) -> None:
    import torch

    client = connect(f"transformers:{tiny}", device="cpu")
    reply = ask(client, "Which?", IMAGE, choices=("a", "b", "c"))
    mock = MockClient()
    ask(mock, "Which?", IMAGE, choices=("a", "b", "c"))
    inputs = client._prepare_inputs(mock.calls[0].messages)
    with torch.inference_mode():
        scores = torch.softmax(client._network(**inputs).logits[0, -1].double(), -1)
    words = client._tokenizer.get_vocab()
    slow = [float(scores[words[letter]] + scores[words["\u2581" + letter]]) for letter in "ABC"]
    np.testing.assert_allclose(reply.probabilities, np.array(slow) / sum(slow), rtol=1e-4)
    assert reply.mass == pytest.approx(sum(slow), rel=1e-4)
    other = ask(client, "Which?", 255 - IMAGE, choices=("a", "b", "c"))
    assert not np.array_equal(reply.probabilities, other.probabilities), "the image is not looked at"


@pytest.mark.parametrize(
    "text",
    [
        '<think>Maybe {"reason": "draft", "actions": ["forward"]}? No, a wall.</think>ANSWER',
        "<think>the goal {sofa} is left</think>\nANSWER",
        "From {forward, turn_left, turn_right} I choose:\nANSWER",
        'The form is {"reason": ..., "actions": [...]}. Here: ```json ANSWER```',
        "I turn $22.5^{\\circ}$ left: ANSWER",
        '{"reason": "draft", "actions": ["forward"]} is wrong, so: ANSWER',
    ],
)
def test_the_last_object_that_fits_is_the_answer(text: str) -> None:
    answer = '{"reason": "r", "actions": ["turn_left"]}'
    found = structured.parse_object(Completion(text.replace("ANSWER", answer)), Plan)
    assert not isinstance(found, Problem) and found[0].actions == ["turn_left"]


def test_a_draft_does_not_stand_for_an_answer_that_was_cut_off() -> None:
    draft = '{"reason": "draft", "actions": ["forward"]}'
    for text, kind in (
        (f'{draft} is wrong, so: {{"reason": "r", "act', "truncated"),
        (f"<think>Maybe {draft}", "malformed"),
    ):
        found = structured.parse_object(Completion(text, "length"), Plan)
        assert isinstance(found, Problem) and found.kind == kind


def test_letters_with_next_to_no_probability_are_no_choice() -> None:
    assert choices.read_logprobs([("<think>", math.log(0.9999)), ("A", math.log(8e-7))], "ABC") is None
    assert choices.read_logprobs([("Well", math.log(0.9)), ("A", math.log(0.02))], "ABC") is not None


def test_a_local_model_writes_text_and_objects(tiny: Path) -> None:
    client = pickle.loads(pickle.dumps(connect(f"transformers:{tiny}", device="cpu")))
    first, again, other = client.ask(
        [Request((user("Say", IMAGE),), temperature=1.0, seed=seed, max_tokens=12) for seed in (0, 0, 1)]
    )
    assert first.text == again.text != other.text
    plan = ask(client, "Plan!", IMAGE, schema=Plan, temperature=1.0)
    assert 1 <= len(plan.value.actions) <= 4 and not plan.repaired
    assert client.spent["vlm_input_tokens"] > 4 * 49 and client.spent["vlm_output_tokens"] > 20


def test_a_local_model_weighs_the_ways_to_go_on(tiny: Path) -> None:
    """As the product of its tokens' probabilities among those with which the texts go on, one text after the other."""
    import torch

    client = connect(f"transformers:{tiny}", device="cpu")
    messages, texts = (user("Plan!", IMAGE),), ['"forward"', '"turn_left"', '"turn_right"']

    def after(begun: str) -> Any:
        with torch.inference_mode():
            return torch.softmax(client._network(**client._prepare_inputs(messages, begun)).logits[0, -1].double(), -1)

    words = client._tokenizer.get_vocab()
    first, second = after('["'), after('["turn_')
    turn = float(first[words["t"]] / (first[words["t"]] + first[words["f"]]))
    left = float(second[words["l"]] / (second[words["l"]] + second[words["r"]]))
    found = client._compute_logprobs(messages, "[", texts).exp().numpy()
    np.testing.assert_allclose(found, [1 - turn, turn * left, turn * (1 - left)], rtol=1e-4)
    numbers = client._compute_logprobs(messages, "[", [str(number) for number in range(12)])
    assert float(numbers.exp().sum()) == pytest.approx(1, abs=1e-5)


def test_answers_of_folders_of_one_name_are_kept_apart(tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    from wiw.vlm.tiny import make_tiny

    said = []
    for seed in (0, 1, 0):
        folder = make_tiny(tmp_path / f"run{len(said)}/checkpoint", seed)
        client = connect(f"transformers:{folder}", device="cpu", cache=ReplyCache(tmp_path))
        said.append(ask(client, "Which?", IMAGE, choices=("a", "b")).probabilities.tolist())
    assert said[0] == said[2] != said[1] and client.spent["vlm_calls"] == 0


def test_weights_that_are_not_there(tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    with pytest.raises(WeightsError, match=r"config\.json"):
        connect(f"transformers:{tmp_path}")
