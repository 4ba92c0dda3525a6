# SPDX-License-Identifier: Apache-2.0
"""Messages survive the wire, and nothing else gets through, whatever it declares itself to be."""

from __future__ import annotations

import dataclasses
import tracemalloc

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from wiw.action import GripperTextTemplate, GripperVocabulary, TextTemplate
from wiw.errors import RemoteError
from wiw.types import Conditioning, Control, History
from wiw.wire.arrays import DTYPES, pack_array, unpack_array
from wiw.wire.messages import VERSION, Answer, Ask, Hello, Refusal, Wait, Welcome, decode, encode
from wiw.wire.rows import pack_row, row_id, stack, unpack_row
from wiw.world_models.base import accepts
from wiw.world_models.remote.declaration import declaration, parse_declaration, parse_description

HEIGHT, WIDTH = 4, 6
MESSAGES = [
    Hello("wiw"),
    Welcome("{}", "{}", "", "unknown", 64),
    Ask(b"id", b"row", 1.5, 3),
    Answer(b"id", np.arange(24, dtype=np.uint8).reshape(1, 2, 4, 3)),
    Wait(b"id", 0.5, "full"),
    Refusal(b"", "version", "another one"),
]


def plan(length=2, **changes):
    given = {
        "actions": np.array([1, 2, 1], np.int8),
        "trajectory": np.arange(9.0).reshape(3, 3),
        "viewpoints": np.stack([np.eye(4)] * 3),
        "text": "vorwärts",
        "length": length,
        "shared": 1,
    }
    return Control(**{**given, **changes})


def observations(batch=2):
    draw = np.random.default_rng(0)
    size = (batch, HEIGHT, WIDTH)
    return Conditioning(
        draw.integers(0, 256, (*size, 3), np.uint8),
        depth=draw.random(size, np.float32),
        semantic=draw.integers(0, 9, size).astype(np.uint32),
        history=History(
            draw.integers(0, 256, (batch, 3, HEIGHT, WIDTH, 3), np.uint8),
            draw.random((batch, 3, 3)),
            np.array([[[1, 2], [3, 0]], [[1, 0], [2, 0]]], np.int8)[:batch],
            np.array([[2, 1], [1, 1]])[:batch],
            np.array([3, 2])[:batch],
        ),
    )


ROW = pack_row(observations(), 1, plan(ids=np.array([4, 5, 6])), 2**64 - 1)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_messages_come_out_as_they_went_in(message):
    found = decode(encode(message))
    for field in dataclasses.fields(message):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(message, field.name))
    assert type(found) is type(message)


@given(
    npst.arrays(st.sampled_from(sorted(DTYPES)).map(np.dtype), npst.array_shapes(min_dims=0, min_side=0, max_dims=5))
)
def test_any_array_comes_out_with_its_dtype_shape_and_bytes(array):
    found = unpack_array("it", msgpack.unpackb(msgpack.packb(pack_array(array))))
    assert (found.dtype, found.shape, found.tobytes()) == (array.dtype, array.shape, array.tobytes())


def test_arrays_of_other_orders_and_kinds():
    turned = np.arange(6, dtype=">i4").reshape(2, 3).T
    np.testing.assert_array_equal(unpack_array("it", msgpack.unpackb(msgpack.packb(pack_array(turned)))), turned)
    with pytest.raises(RemoteError, match="cannot be sent"):
        pack_array(np.array([object()]))


def test_a_row_comes_out_as_it_went_in_and_stacks_to_the_batch():
    whole = observations()
    rows = [unpack_row(pack_row(whole, place, plan(), 2**64 - 1 - place)) for place in range(2)]
    found, controls, seeds = stack(rows)
    for name in ("image", "depth", "semantic"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
    assert rows[1].history.actions.shape == (1, 2, 1)  # the second row needs no more
    for field in dataclasses.fields(History):
        ours, theirs = getattr(found.history, field.name), getattr(whole.history, field.name)
        np.testing.assert_array_equal(ours, theirs)
        assert ours.dtype == theirs.dtype
    assert seeds.dtype == np.uint64 and seeds.tolist() == [2**64 - 1, 2**64 - 2]
    for field in dataclasses.fields(Control):
        np.testing.assert_array_equal(getattr(controls[1], field.name), getattr(plan(), field.name))
    assert found.simulators is None


def test_equal_questions_have_equal_ids_and_others_do_not():
    whole, other = observations(), observations()
    other.image[1, 0, 0, 0] ^= 1
    ids = {
        row_id(pack_row(seen, place, control, seed))
        for seen in (whole, other)
        for place in range(2)
        for control in (plan(), plan(length=3), plan(text="x"))
        for seed in (0, 1)
    }
    assert len(ids) == 3 * 3 * 2 and row_id(ROW) == row_id(bytes(ROW))


@pytest.mark.parametrize(
    "model",
    [
        accepts("image"),
        accepts("trajectory", "perspective", frames=14, needs=("depth", "history"), history=7, causal=True),
        accepts("action", vocabulary={1: [0.5, -1.0], 2: np.array([0.0, 1.0])}, null_first=True, best_batch=3),
        accepts("viewpoint", cacheable=True),
        accepts("image", frames=np.int64(14), best_batch=np.int64(3)),
        accepts("text", size=(64, 128), template=TextTemplate("Go: {actions}", separator=" - ", merge_runs=True)),
        accepts("action", vocabulary={"forward": 3, "turn_left": 1, "turn_right": 2}),
        accepts("text", "perspective", space="pose7", template=GripperTextTemplate("Do {actions}", "go to {x}")),
        accepts("action", "perspective", space="pose7", vocabulary=GripperVocabulary("quaternion_wxyz")),
        accepts(
            "action",
            "perspective",
            space="pose7",
            vocabulary=GripperVocabulary(bounds=([-0.3, -0.5, 0.6], [0.7, 0.5, 1.6])),
        ),
    ],
    ids=lambda model: model.control,
)
def test_declarations_come_out_as_they_went_in(model):
    found = parse_declaration(declaration(model))
    if isinstance(model.vocabulary, dict):
        own = {name: np.asarray(value).tolist() for name, value in model.vocabulary.items()}
        model = dataclasses.replace(model, vocabulary=own)
    assert found == model


LONG, DEEP = "x" * 2**20, "[" * 100_000 + "]" * 100_000


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"control": "flying"}', "null", DEEP, f'{{"vocabulary": {DEEP}}}'])
def test_a_declaration_that_is_none_is_refused(text):
    with pytest.raises(RemoteError, match="declaration"):
        parse_declaration(text)


@pytest.mark.parametrize("text", ["", "[]", "{", "null", '{"a": "\\ud800"}', DEEP, f'{{"a": "{LONG}"}}'])
def test_a_description_that_is_none_is_refused(text):
    with pytest.raises(RemoteError, match="description") as caught:
        parse_description(text)
    assert caught.value.kind == "message"


def test_another_version_is_told_from_nonsense():
    values = msgpack.unpackb(encode(Hello("wiw")))
    for version in (VERSION + 1, None, "1", True, 1.0):
        with pytest.raises(RemoteError, match="install the same version of wiw on both") as caught:
            decode(msgpack.packb({**values, "v": version}))
        assert caught.value.kind == "version"


def catch_refusal(data, read=decode):
    with pytest.raises(RemoteError) as caught:
        read(data)
    assert caught.value.kind in ("message", "version")


@given(st.binary(max_size=300))
def test_random_bytes_are_refused(data):
    catch_refusal(data)
    catch_refusal(data, unpack_row)


nested = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=9)
    | st.binary(max_size=9),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=9), inner, max_size=5),
    max_leaves=15,
)


@given(st.sampled_from(MESSAGES), st.data())
def test_a_field_of_another_type_is_refused(message, data):
    values = msgpack.unpackb(encode(message))
    name = data.draw(st.sampled_from(sorted(set(values) - {"v", "type"})))
    value = data.draw(nested.filter(lambda value: type(value) is not type(values[name])))
    catch_refusal(msgpack.packb({**values, name: value}))
    catch_refusal(msgpack.packb({**values, "more": value}))
    catch_refusal(msgpack.packb({key: kept for key, kept in values.items() if key != name}))


@given(st.integers(0, len(ROW) - 1))
def test_a_row_cut_short_is_refused(length):
    catch_refusal(ROW[:length], unpack_row)


@given(st.integers(0, len(ROW) - 1), st.integers(0, 255))
def test_a_row_with_a_byte_altered_is_refused_or_a_row(place, byte):
    data = bytearray(ROW)
    data[place] = byte
    try:
        row = unpack_row(bytes(data))
    except RemoteError as error:
        assert error.kind == "message"
    else:
        assert len(row.control.actions) == len(row.control.trajectory) == len(row.control.viewpoints)


ROW_VALUES = msgpack.unpackb(ROW)
LIES = {
    "more bytes": {"image": {**ROW_VALUES["image"], "data": b"1" * 73}},
    "fewer bytes": {"image": {**ROW_VALUES["image"], "shape": [2**31 - 1] * 3}},
    "too large for any number": {"image": {**ROW_VALUES["image"], "shape": [2**62] * 3}},
    "a negative side": {"image": {**ROW_VALUES["image"], "shape": [-4, -6, 3]}},
    "a side that is no number": {"image": {**ROW_VALUES["image"], "shape": [4.0, 6, 3]}},
    "objects": {"image": {**ROW_VALUES["image"], "dtype": "|O"}},
    "records": {"image": {**ROW_VALUES["image"], "dtype": "|V3"}},
    "another dtype": {"depth": ROW_VALUES["semantic"]},
    "another rank": {"image": ROW_VALUES["history"]["images"]},
    "a history without poses": {"history": {k: v for k, v in ROW_VALUES["history"].items() if k != "poses"}},
    "a history that is an array": {"history": ROW_VALUES["history"]["images"]},
    "poses for other images": {"history": {**ROW_VALUES["history"], "poses": pack_array(np.zeros((2, 3)))}},
    "gripper poses between primitives": {"history": {**ROW_VALUES["history"], "poses": pack_array(np.zeros((3, 7)))}},
    "poses that are nowhere": {"history": {**ROW_VALUES["history"], "poses": pack_array(np.full((3, 3), np.inf))}},
    "actions of other gaps": {"history": {**ROW_VALUES["history"], "actions": pack_array(np.zeros((1, 1), np.int8))}},
    "no room for actions": {"history": {**ROW_VALUES["history"], "actions": pack_array(np.zeros((2, 0), np.int8))}},
    "actions of another kind": {"history": {**ROW_VALUES["history"], "actions": pack_array(np.zeros((2, 1)))}},
    "more actions than there are": {"history": {**ROW_VALUES["history"], "lengths": pack_array(np.array([1, 2]))}},
    "fewer than no actions": {"history": {**ROW_VALUES["history"], "lengths": pack_array(np.array([1, -1]))}},
    "more frames than there are": {"history": {**ROW_VALUES["history"], "count": 4}},
    "no frame": {"history": {**ROW_VALUES["history"], "count": 0}},
    "a list of bytes": {"image": {**ROW_VALUES["image"], "data": [1] * 30}},
    "nan": {"trajectory": pack_array(np.full((3, 3), np.nan))},
    "other lengths": {"viewpoints": pack_array(np.zeros((2, 4, 4)))},
    "too many ids": {"ids": pack_array(np.zeros(9))},
    "shared beyond its end": {"shared": 3},
    "longer than its actions": {"length": 4},
    "a negative seed": {"seed": -1},
    "a seed that is no number": {"seed": True},
}


@pytest.mark.parametrize("lie", LIES)
def test_a_row_that_is_not_what_it_says_is_refused(lie):
    catch_refusal(msgpack.packb({**ROW_VALUES, **LIES[lie]}), unpack_row)


BOMBS = {
    "lists in lists, each of four million": b"\xdd\x00\x3f\xff\xff" * 500 + b"\x00" * 2**22,
    "empty lists": b"\xdd\x00\x3f\xff\xff" + b"\x90" * 2**22,
    "empty maps in lists of 32": (b"\xdc\x00\x20" + b"\x80" * 32) * 2**17,
    "a map of two thousand million": b"\xdf\x7f\xff\xff\xff" + b"\x00" * 64,
    "four gigabytes of bytes": b"\xc6\xff\xff\xff\xff" + b"\x00" * 64,
    "four gigabytes of text": b"\xdb\xff\xff\xff\xff" + b"\x00" * 64,
    "extension types": b"\xc9\xff\xff\xff\xff\x01" + b"\x00" * 64,
    "depth": b"\x91" * 2**20,
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_what_unpacks_to_much_more_takes_no_memory(bomb):
    data = BOMBS[bomb]
    tracemalloc.start()
    catch_refusal(data)
    catch_refusal(data, unpack_row)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 2**20


def test_only_binary_frames_are_read():
    catch_refusal("text")


def test_a_history_of_gripper_poses_comes_out_as_it_went_in():
    whole = observations(1)
    poses = np.arange(21.0).reshape(1, 3, 7)
    history = dataclasses.replace(whole.history, poses=poses, actions=np.arange(28.0).reshape(1, 2, 2, 7))
    found = unpack_row(pack_row(dataclasses.replace(whole, history=history), 0, plan(), 1)).history
    for field in dataclasses.fields(History):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(history, field.name))
