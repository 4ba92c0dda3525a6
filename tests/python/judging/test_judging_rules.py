# SPDX-License-Identifier: Apache-2.0
"""Typed rules against pairs whose marks were written by hand, in many wordings."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path

import pytest

import wiw
from wiw import metrics
from wiw.errors import ArgumentError, FileError, JudgeError
from wiw.judging import Judgement, Reference, RuleJudge, TieredJudge, TokenF1Judge, make_judge
from wiw.judging.normalise import cut_after_last_period, normalise, read_counts, read_polarity
from wiw.judging.vocabulary import KINDS, Vocabulary, load_vocabulary
from wiw.judging.words import make_singular, split_words

DOOR, COUNT, COLOR = "Is the bathroom door open?", "How many chairs are there?", "What color is the sofa?"
MADE_OF, WHAT, STATE = "What is the desk made of?", "What is on the sideboard?", "Is the curtain open or closed?"
PIANO = "Is there a piano in the living room?"
WHERE, ROOM = "Where is the vase?", "Which room is the piano in?"
PAIRS = [  # type, question, right answer, answer, mark
    ("yes_no", DOOR, "yes", "yes", 5),
    ("yes_no", DOOR, "yes", "Yeah, it is", 5),
    ("yes_no", DOOR, "yes", "it is open", 5),
    ("yes_no", DOOR, "yes", "it is not closed", 5),
    ("yes_no", DOOR, "no", "it is shut", 5),
    ("yes_no", DOOR, "no", "No, it isn't open", 5),
    ("yes_no", DOOR, "no", "nope", 5),
    ("yes_no", DOOR, "yes", "no", 1),
    ("yes_no", DOOR, "yes", "it is not open", 1),
    ("yes_no", DOOR, "no", "yes", 1),
    ("yes_no", DOOR, "no", "certainly", 1),
    ("yes_no", DOOR, "yes", "maybe", 1),
    ("yes_no", DOOR, "no", "yes and no", 1),
    ("yes_no", "Are there plants in the study?", "no", "there are no plants", 5),
    ("yes_no", "Are there plants in the study?", "yes", "there are no plants", 1),
    ("yes_no", "Are there plants in the study?", "yes", "there are plants in the study", 5),
    ("yes_no", DOOR, "yes", "it's not shut", 5),
    ("yes_no", DOOR, "no", "it's not shut", 1),
    ("yes_no", DOOR, "yes", "it is not closed but open", 5),
    ("yes_no", DOOR, "no", "it's not open, it's closed", 5),
    ("yes_no", DOOR, "no", "I can't see it", 1),
    ("yes_no", "Is the lamp on?", "no", "it's not lit", 5),
    ("yes_no", "Is the lamp on?", "yes", "it's not lit", 1),
    ("yes_no", PIANO, "yes", "yes, not far from the window", 5),
    ("yes_no", PIANO, "no", "certainly not", 5),
    ("yes_no", PIANO, "no", "I don't see a piano", 5),
    ("yes_no", PIANO, "yes", "I don't see a piano", 1),
    ("yes_no", PIANO, "no", "there isn't one", 5),
    ("yes_no", PIANO, "no", "not that I can see", 5),
    ("yes_no", PIANO, "no", "the living room does not have a piano", 5),
    ("yes_no", PIANO, "yes", "the living room has a piano", 5),
    ("yes_no", PIANO, "yes", "I found two pianos", 5),
    ("yes_no", PIANO, "yes", "I see zero pianos", 1),
    ("yes_no", PIANO, "yes", "there is a living room", 1),
    ("yes_no", PIANO, "no", "I can't see the living room", 1),
    ("yes_no", PIANO, "yes", "I think so", 5),
    ("yes_no", PIANO, "yes", "I don't know", 1),
    ("yes_no", PIANO, "yes", "I", 1),  # cut off
    ("yes_no", "Is there a sofa in the study?", "yes", "there is a couch", 5),
    ("yes_no", PIANO, "yes", "There is a black piano in the living room.", 5),
    ("yes_no", PIANO, "yes", "there's a grand piano", 5),
    ("yes_no", PIANO, "yes", "There is a piano in the living room, next to the sofa.", 5),
    ("yes_no", PIANO, "yes", "I can see a piano against the wall of the living room", 5),
    ("yes_no", PIANO, "yes", "there is a sofa and a piano", 5),
    ("yes_no", PIANO, "yes", "there is a piano, not a guitar", 5),
    ("yes_no", PIANO, "no", "There is a black piano in the living room.", 1),
    ("yes_no", PIANO, "no", "There is no piano, only a sofa and a table", 5),
    ("yes_no", PIANO, "no", "There does not appear to be a piano", 5),
    ("yes_no", PIANO, "no", "I can't see a piano anywhere in the living room", 5),
    ("yes_no", PIANO, "no", "a piano is not in the living room", 5),
    ("yes_no", PIANO, "yes", "There does not appear to be a piano", 1),
    ("yes_no", PIANO, "yes", "there is a piano in the kitchen", 1),
    ("yes_no", PIANO, "no", "there is a piano in the kitchen", 1),
    ("yes_no", PIANO, "yes", "there is a piano stool", 1),
    ("yes_no", PIANO, "yes", "there is a picture of a piano", 1),
    ("yes_no", PIANO, "yes", "I am not sure whether there is a piano", 1),
    ("yes_no", PIANO, "no", "I am not sure whether there is a piano", 1),
    ("yes_no", PIANO, "yes", "there might be a piano", 1),
    ("yes_no", PIANO, "no", "I don't know if there is a piano", 1),
    ("count", COUNT, "4", "4", 5),
    ("count", COUNT, "four", "4", 5),
    ("count", COUNT, "4", "there are four chairs", 5),
    ("count", COUNT, "4", "three", 2),
    ("count", COUNT, "4", "5 chairs", 2),
    ("count", COUNT, "4", "six", 1),
    ("count", COUNT, "4", "several", 1),
    ("count", COUNT, "4", "4 or 5 or 6", 2),
    ("count", COUNT, "0", "none", 5),
    ("count", COUNT, "0", "none that I know of", 5),
    ("count", COUNT, "0", "There are no chairs as far as I can tell.", 5),
    ("count", COUNT, "0", "No chairs that I know of.", 5),
    ("count", COUNT, "0", "There are no chairs, I am sure.", 5),
    ("count", COUNT, "0", "I am not really sure", 1),
    ("count", COUNT, "0", "I don't know", 1),
    ("count", COUNT, "1", "There is a little chair.", 5),
    ("count", COUNT, "0", "I'm not sure", 1),
    ("count", COUNT, "0", "I cannot tell", 1),
    ("count", COUNT, "0", "no idea", 1),
    ("count", COUNT, "0", "not many", 1),
    ("count", COUNT, "1", "a few chairs", 1),
    ("count", COUNT, "1", "there is a small number of chairs", 1),
    ("count", COUNT, "24", "two dozen", 5),
    ("count", COUNT, "100", "a hundred", 5),
    ("count", COUNT, "1200", "1,200 chairs", 5),
    ("category", WHAT, "theremin", "a theremin", 5),
    ("category", WHAT, "theremin", "There is no theremin", 1),
    ("category", WHAT, "theremin", "never a theremin", 1),
    ("category", WHAT, "theremin", "not a piano, a theremin", 5),
    ("category", WHAT, "theremin", "a piano", 1),
    ("count", COUNT, "0", "there are no chairs", 5),
    ("count", COUNT, "1", "there are no chairs", 2),
    ("count", COUNT, "1", "a chair", 5),
    ("count", COUNT, "1", "there's a chair", 5),
    ("count", COUNT, "1", "I see a chair by the table", 5),
    ("count", COUNT, "twenty-one", "21", 5),
    ("count", COUNT, "2", "a couple", 5),
    ("color", COLOR, "red", "red", 5),
    ("color", COLOR, "grey", "gray", 5),
    ("color", COLOR, "purple", "violet", 5),
    ("color", COLOR, "blue", "navy blue", 4),
    ("color", COLOR, "blue", "light blue", 4),
    ("color", COLOR, "green", "greenish", 4),
    ("color", COLOR, "blue", "turquoise", 3),
    ("color", COLOR, "red", "orange", 3),
    ("color", COLOR, "white", "beige", 3),
    ("color", COLOR, "light blue", "dark blue", 3),
    ("color", COLOR, "red", "green", 1),
    ("color", COLOR, "black", "white", 1),
    ("color", COLOR, "red", "not red", 1),
    ("color", COLOR, "red", "not green but red", 5),
    ("color", COLOR, "red", "the red sofa is green", 1),
    ("color", COLOR, "black and white", "white and black", 5),
    ("color", COLOR, "white", "black and white", 3),
    ("color", COLOR, "red", "red or green or blue or white", 2),
    ("color", COLOR, "red", "no idea", 1),
    ("material", MADE_OF, "wood", "wooden", 5),
    ("material", MADE_OF, "wood", "it is made of wood", 5),
    ("material", MADE_OF, "wood", "oak", 4),
    ("material", MADE_OF, "wood parquet", "wood", 4),
    ("material", MADE_OF, "metal", "stainless steel", 4),
    ("material", MADE_OF, "ceramic", "porcelain", 4),
    ("material", MADE_OF, "fabric", "leather", 2),
    ("material", MADE_OF, "marble", "concrete", 2),
    ("material", MADE_OF, "wood", "glass", 1),
    ("material", MADE_OF, "fabric", "cloth", 5),
    ("category", WHAT, "sofa", "couches", 5),
    ("category", WHAT, "television", "TV", 5),
    ("category", WHAT, "refrigerator", "a fridge", 5),
    ("category", WHAT, "vase", "there is a vase on the sideboard", 5),
    ("category", WHAT, "books", "a book", 5),
    ("category", WHAT, "candles", "the thing on the sideboard is a candle", 5),
    ("category", WHAT, "bookshelf", "bookshelves", 5),
    ("category", WHAT, "armchair", "chair", 4),
    ("category", WHAT, "table lamp", "a lamp", 4),
    ("category", WHAT, "picture", "a photo", 4),
    ("category", WHAT, "coffee table", "table", 4),
    ("category", WHAT, "armchair", "sofa", 2),
    ("category", WHAT, "stove", "microwave", 2),
    ("category", WHAT, "wardrobe", "dresser", 2),
    ("category", WHAT, "vase", "bathtub", 1),
    ("category", WHAT, "sofa", "not a sofa", 1),
    ("category", WHAT, "sofa", "not a bed but a couch", 5),
    ("category", WHAT, "globe", "a globe", 5),
    ("category", WHAT, "globe", "a lamp", 1),
    ("state", STATE, "open", "opened", 5),
    ("state", STATE, "closed", "it is shut", 5),
    ("state", STATE, "closed", "not open", 5),
    ("state", STATE, "open", "it is closed", 1),
    ("state", STATE, "open", "half drawn", 2),
    ("state", "Is the lamp on or off?", "on", "it is switched on", 5),
    ("state", "Is the lamp on or off?", "off", "the lamp on the desk is off", 5),
    ("state", "Is the lamp on or off?", "off", "the lamp is on", 1),
    ("place", WHERE, "on the coffee table in the living room", "in the living room, on the coffee table", 5),
    ("place", WHERE, "on the coffee table in the living room", "on the table in the lounge", 5),
    ("place", WHERE, "on the coffee table in the living room", "on the coffee table", 4),
    ("place", WHERE, "on the coffee table in the living room", "the vase is on the coffee table", 4),
    ("place", WHERE, "on the coffee table in the living room", "in the living room", 3),
    ("place", WHERE, "on the coffee table in the living room", "on the shelf in the living room", 3),
    ("place", WHERE, "on the coffee table in the living room", "on the desk", 2),
    ("place", WHERE, "on the coffee table in the living room", "on a table in the kitchen", 2),
    ("place", WHERE, "on the coffee table in the living room", "in the bathroom", 1),
    ("place", WHERE, "on the coffee table in the living room", "next to the toilet", 1),
    ("place", WHERE, "next to the red sofa", "next to the green sofa", 2),
    ("place", WHERE, "next to the red sofa", "beside the couch", 5),
    ("place", WHERE, "on the table", "under the table", 2),
    ("place", WHERE, "left of the bed in the bedroom", "on the right of the bed in the bedroom", 3),
    ("place", WHERE, "in the kitchen", "in the kitchen", 5),
    ("place", WHERE, "in the kitchen", "in the kitchen or the bathroom or the bedroom", 1),
    ("place", ROOM, "study", "the office", 5),
    ("place", ROOM, "kids room", "the children's room", 5),
    ("place", ROOM, "kids room", "bedroom", 4),
    ("place", ROOM, "bedroom 1", "bedroom 2", 1),
    ("place", ROOM, "bedroom 1", "a bedroom", 5),
    ("place", ROOM, "study", "in the kitchen", 1),
]
WORDINGS: list[Callable[[str], str]] = [
    str,
    str.upper,
    lambda text: f"  {text}. ",
    lambda text: f"{text}. And I also",  # what follows the last period was cut off by the token limit
    lambda text: "".join(chr(ord(c) + 0xFEE0) if "!" <= c <= "~" and c not in ".'" else c for c in text),  # full width
]


def judge_pair(kind: str, question: str, right: str, answer: str) -> int:
    return RuleJudge().judge([Reference(question, right, answer_type=kind)], [answer])[0].mark


def test_marks_of_hand_written_pairs_in_many_wordings() -> None:
    rows = [(*pair[:3], word(pair[3]), pair[4]) for pair in PAIRS for word in WORDINGS]
    wrong = [(*row, got) for row in rows if (got := judge_pair(*row[:4])) != row[4]]
    assert len(rows) >= 300 and len(wrong) <= 0.02 * len(rows), wrong


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: f"{pair[2]}: {pair[3]}")
def test_a_pair_has_its_mark(pair: tuple[str, str, str, str, int]) -> None:
    assert judge_pair(*pair[:4]) == pair[4]


@pytest.mark.parametrize("spec", ["rules", "approximate"])
def test_the_right_answer_has_the_best_mark(spec: str) -> None:
    references = [Reference(question, right, answer_type=kind) for kind, question, right, *_ in PAIRS]
    marks = [each.mark for each in make_judge(spec).judge(references, [each.answer for each in references])]
    assert marks == [5] * len(references)


def test_shuffled_answers_fall_to_chance() -> None:
    numbers = random.Random(0)
    colors = ["red", "orange", "yellow", "green", "turquoise", "blue", "purple", "pink", "brown", "grey", "black"]
    cases = {
        "yes_no": (["yes", "no"], 50.0),
        "count": ([str(n) for n in range(10)], 10 + 18 / 100 * 25),
        "category": (list(load_vocabulary().names("object")), 0.0),
        "color": (colors, 100 / 11),
    }
    for kind, (answers, least) in cases.items():
        right = answers * (1200 // len(answers))
        shuffled = numbers.sample(right, len(right))
        references = [Reference("?", each, answer_type=kind) for each in right]
        marks = [each.mark for each in RuleJudge().judge(references, shuffled)]
        score = metrics.aeqa_score(marks)
        assert least - 4 < score < least + (4 if kind in ("yes_no", "count") else 20), (kind, score)


def test_the_best_of_several_right_answers_counts() -> None:
    reference = Reference(WHERE, "above the bed", ("in the kitchen", "next to the sofa"), "place")
    (judgement,) = RuleJudge().judge([reference], ["in the kitchen"])
    assert judgement == Judgement(5, "rules")


@pytest.mark.parametrize("answer", ["", "  ", "...", "?!", "\u200b"])
@pytest.mark.parametrize("spec", ["rules", "approximate"])
def test_an_empty_answer_is_unanswered(answer: str, spec: str) -> None:
    (judgement,) = make_judge(spec).judge([Reference(DOOR, "yes", answer_type="yes_no")], [answer])
    assert judgement.mark == 1 and judgement.unanswered


def test_free_text_is_beyond_the_rules_and_left_to_the_next_judge() -> None:
    free = Reference("Why is it dark?", "The curtains are closed because it is night")
    typed = Reference(COLOR, "red", answer_type="color")
    odd = Reference(COLOR, "like autumn leaves", answer_type="color")
    with pytest.raises(JudgeError, match="rules\\+approximate") as error:
        RuleJudge().judge([free], ["it is night"])
    assert error.value.kind == "no_rule"
    judge = make_judge("rules")
    assert isinstance(judge, TieredJudge)
    found = judge.judge([free, typed, odd], ["it is night", "dark red", "autumn leaves"])
    assert [(each.judge, each.approximate) for each in found] == [
        ("approximate", True),
        ("rules", False),
        ("approximate", True),
    ]
    assert [each.mark for each in found][1] == 4
    kept = TieredJudge([RuleJudge()]).judge_each([free, typed], ["night", "red"])
    assert isinstance(kept[0], JudgeError) and kept[1] == Judgement(5, "rules")


def test_word_overlap() -> None:
    def mark(right: str, answer: str) -> int:
        return TokenF1Judge().judge([Reference("?", right)], [answer])[0].mark

    assert mark("The couch is by the TV", "the sofas are by the television") == 4
    assert mark("a round mirror", "round mirrors") == 5
    assert mark("it is not on", "it is on") == 1
    assert mark("to wash hands", "sleeping") == 1
    assert mark("A", "a") == 5 and mark("A", "the letter A") == 3 and mark("A", "B") == 1


@pytest.mark.parametrize(
    ("text", "cut"),
    [("a. b", "a."), ("a b", "a b"), ("a.", "a."), ("2.5 metres", "2.5 metres"), ("a 2.5. b c", "a 2.5."), ("", "")],
)
def test_what_follows_the_last_period_is_cut_off(text: str, cut: str) -> None:
    assert cut_after_last_period(text) == cut


@pytest.mark.parametrize(
    ("text", "normal"),
    [
        ("The Couches", "sofa"),
        ("no knives", "no knife"),
        ("It's a TV.", "it is television"),
        ("Twenty-one BOOKS", "21 book"),
        ("\uff27\uff52\uff41\uff59 shelves", "grey shelf"),
        ("the children\u2019s room", "kids room"),
        ("She can't see glasses", "she can not see glass"),
    ],
)
def test_normal_forms(text: str, normal: str) -> None:
    assert normalise(text) == normal


def test_singulars() -> None:
    plurals = "boxes benches vases dishes buses shoes glasses leaves curtains berries children feet sofas stoves"
    singulars = "box bench vase dish bus shoe glass leaf curtain berry child foot sofa stove"
    assert [make_singular(word) for word in plurals.split()] == singulars.split()
    assert [make_singular(word) for word in singulars.split()] == singulars.split()


def test_polarity_and_counts() -> None:
    assert read_polarity("not false") is True and read_polarity("that is not true") is False
    assert read_polarity("purple") is None and read_polarity("") is None
    assert read_counts("2.5") == [] and read_counts("two or three") == [2, 3] and read_counts("some") == []


def test_the_vocabulary_knows_what_apartments_have() -> None:
    known = load_vocabulary()
    scene = wiw.scenes.apartment(0, "val")
    for instance in scene.instances:
        attributes = instance["attributes"]
        values = {kind: attributes[kind] for kind in ("color", "material", "state") if kind in attributes}
        for kind, value in {"object": instance["category"], **values}.items():
            words = split_words(value)
            assert [match.end for match in known.find(words, [kind])] == [len(words)], (kind, value)
    for room in scene.rooms:
        assert known.find(split_words(room["type"]), ["room"]), room["type"]


def test_every_name_of_the_vocabulary_is_itself() -> None:
    known = load_vocabulary()
    for kind in KINDS:
        for name in known.names(kind):
            words = split_words(name)
            (match,) = known.find(words, [kind])
            assert (match.concept.name, match.end) == (name, len(words))


OTHER_KINDS = "\nroom: {hall: {}}\ncolor: {red: {}}\nmaterial: {wood: {}}\nstate: {open: {}}"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("object: {cup: {}, mug: {also: [Cups]}}" + OTHER_KINDS, "'cup' names both 'cup' and 'mug'"),
        ("object: {mug: {is_a: [cup]}}" + OTHER_KINDS, "'mug' refers to 'cup'"),
        ("object: {mug: {}}", "room, color, material, state missing"),
        ("- mug", "object, room, color, material, state missing"),
        ("object: [", "expected a vocabulary in YAML"),
    ],
)
def test_a_vocabulary_that_contradicts_itself_is_refused(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(text)
    with pytest.raises(FileError, match=said):
        Vocabulary(file)


def test_wrong_use_is_refused() -> None:
    with pytest.raises(ArgumentError, match="answer type among yes_no"):
        Reference("?", "red", answer_type="colour")
    with pytest.raises(ArgumentError, match="answers with words"):
        Reference("?", " ")
    with pytest.raises(ArgumentError, match="answers with words"):
        Reference("?", "red", ("",))
    with pytest.raises(ArgumentError, match="one answer per reference"):
        RuleJudge().judge([Reference("?", "red", answer_type="color")], [])
    for mark in (0, 6, 2.5, True):
        with pytest.raises(ArgumentError, match="from 1 to 5"):
            Judgement(mark, "rules")  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="at least one judge"):
        TieredJudge([])


@pytest.mark.parametrize("spec", ["", "rule", "llm", "llm:", "rules+rules", "rules:1", "rules+magic"])
def test_an_unknown_judge_is_refused(spec: str) -> None:
    with pytest.raises(ArgumentError, match=r"llm:URL#MODEL"):
        make_judge(spec)


def test_options_are_of_language_models() -> None:
    with pytest.raises(ArgumentError, match="temperature are of language models"):
        make_judge("rules", temperature=0.1)


def test_judgements_and_judges_describe_themselves_as_json() -> None:
    judgement = Judgement(3, "llm", model="m", prompt_digest="d", reply="{}")
    assert Judgement.from_info(json.loads(json.dumps(judgement.to_info()))) == judgement
    rules, both = RuleJudge().describe(), make_judge("rules").describe()
    assert json.loads(json.dumps(both)) == both and both["tiers"][0] == rules
    assert rules["version"] == 4 and rules["vocabulary"] == load_vocabulary().digest
    assert make_judge("approximate").describe() != both
