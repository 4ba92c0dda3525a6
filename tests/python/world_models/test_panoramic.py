# SPDX-License-Identifier: Apache-2.0
"""PathDreamer and SE3DS behind the real shim, in a process of its own, with arithmetic for the official networks."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import fake_panoramic
import wiw
from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT, to_viewpoints
from wiw.cli import main
from wiw.errors import RemoteError
from wiw.types import Conditioning, Control
from wiw.wire.messages import Ask, Hello, Refusal, Welcome, decode, encode
from wiw.wire.rows import pack_row, row_id
from wiw.world_models.base import answer_deadline
from wiw.world_models.panoramic.served import Served
from wiw.world_models.status import is_served

SIZE = (576, 1024)
SIDE = 64
"""Pixels that a column of the networks' 64 is wide, in 1024."""


@pytest.fixture(scope="module")
def official(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("official")
    fake_panoramic.install(folder)
    return folder


@pytest.fixture(scope="module")
def pathdreamer(official: Path) -> Iterator[Served]:
    with fake_panoramic.serving(official, "pathdreamer") as address:
        model = wiw.world_model("pathdreamer", address=address)
        yield model
        model.close()


@pytest.fixture(scope="module")
def se3ds(official: Path) -> Iterator[Served]:
    with fake_panoramic.serving(official, "se3ds") as address:
        model = wiw.world_model("se3ds", address=address)
        yield model
        model.close()


def make_conditioning(
    rows: int = 1, category: int = 3, metres: float = 2.0, semantic: bool = True, seed: int = 0
) -> Conditioning:
    """Soft panoramas in the middle of a round room."""
    random = np.random.default_rng(seed)
    coarse = random.integers(40, 216, (rows, 18, 32, 3)).repeat(32, 1).repeat(32, 2).astype(np.uint8)
    depth = np.full((rows, *SIZE), metres, np.float32)
    labels = np.full((rows, *SIZE), category, np.uint32) if semantic else None
    return Conditioning(coarse, depth=depth, semantic=labels)


def plan(*actions: int, shared: int = 0) -> Control:
    ids = np.array(actions, np.int8)
    trajectory, viewpoints = wiw.action.to_trajectory(ids), to_viewpoints(ids)
    return Control(ids, trajectory, viewpoints, length=len(ids), shared=shared)


def imagine_plans(model: Served, observations: Conditioning, *plans: Control, seed: int = 5) -> np.ndarray:
    seeds = np.arange(seed, seed + len(plans), dtype=np.uint64)
    with answer_deadline(30):
        return model.rollout(observations, plans, seeds)


def test_turns_roll_the_observation_and_standing_still_keeps_it(se3ds: Served) -> None:
    observations = make_conditioning(semantic=False)
    frames = imagine_plans(se3ds, observations, plan(TURN_LEFT, STOP, TURN_LEFT))[0]
    image = observations.image[0]
    for frame, columns in zip(frames, (0, SIDE, SIDE, 2 * SIDE), strict=True):
        np.testing.assert_array_equal(frame, np.roll(image, columns, axis=1))


def test_a_turn_after_a_step_rolls_what_was_imagined(pathdreamer: Served) -> None:
    frames = imagine_plans(pathdreamer, make_conditioning(), plan(FORWARD, TURN_LEFT, TURN_LEFT))[0]
    assert np.abs(frames[1].astype(int) - frames[0]).mean() > 1
    np.testing.assert_array_equal(frames[2], np.roll(frames[1], SIDE, axis=1))
    np.testing.assert_array_equal(frames[3], np.roll(frames[1], 2 * SIDE, axis=1))


def extent(frame: np.ndarray, channel: int) -> int:
    """Rows that a thing of one primary colour takes ahead."""
    column = frame[:, 500:524].astype(int).mean(1)
    rows = np.flatnonzero(column[:, channel] - column[:, 1 - channel] > 60)
    return int(np.ptp(rows)) if rows.size else 0


def test_frames_are_projections_from_the_viewpoints(se3ds: Served) -> None:
    """Steps along any heading show the points of the room from there: what is ahead grows as it comes nearer."""
    image = np.full((1, *SIZE, 3), 60, np.uint8)
    image[0, 240:336, 464:560] = (200, 20, 20)  # ahead
    image[0, 240:336, 720:816] = (20, 200, 20)  # to the right
    room = Conditioning(image, depth=np.full((1, *SIZE), 1.0, np.float32))
    ahead = imagine_plans(se3ds, room, plan(FORWARD, FORWARD))[0]
    right = imagine_plans(se3ds, room, plan(*[TURN_RIGHT] * 4, FORWARD, FORWARD))[0]
    assert 90 < extent(ahead[0], 0) < extent(ahead[2], 0) and extent(ahead[2], 1) == 0
    assert 90 < extent(right[4], 1) < extent(right[6], 1) and extent(right[6], 0) == 0
    assert extent(ahead[2], 0) == pytest.approx(96 / 0.6, abs=36)  # two pixels of the networks
    far = Conditioning(image, depth=np.full((1, *SIZE), 19.0, np.float32))
    assert extent(imagine_plans(se3ds, far, plan(FORWARD, FORWARD))[0, 2], 0) < extent(ahead[2], 0)


def test_semantics_and_depth_reach_the_networks(pathdreamer: Served) -> None:
    """Holes are painted by category and depth; at the masked top there is nothing else."""
    for category in (3, 40):
        top = imagine_plans(pathdreamer, make_conditioning(category=category), plan(FORWARD))[0, 1, 20:60, :, 0].astype(
            int
        )
        assert (np.abs(top - 255 * category / 41) < 8).mean() > 0.3
    for metres in (2.0, 6.0):
        top = imagine_plans(pathdreamer, make_conditioning(metres=metres), plan(FORWARD))[0, 1, 20:60, :, 1].astype(int)
        assert (np.abs(top - 255 * metres / 10) < 15).mean() > 0.3


def test_what_is_beyond_the_scale_or_nothing_is_a_hole(pathdreamer: Served, se3ds: Served) -> None:
    for metres in (0.0, 10.0, 30.0):
        frame = imagine_plans(pathdreamer, make_conditioning(metres=metres), plan(FORWARD))[0, 1]
        assert np.abs(frame[..., 0].astype(int) - 255 / 41).max() < 3  # all walls, as the structure fills them
    frame = imagine_plans(se3ds, make_conditioning(metres=12.0, semantic=False), plan(FORWARD))[0, 1]
    assert np.ptp(frame[100:-100]) > 20  # 20 m is the other one's scale


def test_predictions_are_remembered(se3ds: Served) -> None:
    """Holes of one frame are known in the next: the grey that was imagined stays where it is."""
    frames = imagine_plans(se3ds, make_conditioning(metres=30.0, semantic=False), plan(FORWARD, FORWARD))[0]
    assert np.abs(frames[1:].astype(int) - 127).max() <= 1


def test_rows_do_not_meet_and_equal_questions_have_equal_answers(pathdreamer: Served, official: Path) -> None:
    one, two = make_conditioning(1, 3), make_conditioning(1, 7, seed=1)
    both = Conditioning(
        np.concatenate([one.image, two.image]),
        depth=np.concatenate([one.depth, two.depth]),
        semantic=np.concatenate([one.semantic, two.semantic]),
    )
    plans = plan(FORWARD, FORWARD), plan(FORWARD, TURN_LEFT)
    frames = imagine_plans(pathdreamer, both, *plans)
    np.testing.assert_array_equal(imagine_plans(pathdreamer, two, plans[1], seed=9)[0], frames[1])
    with fake_panoramic.serving(official, "pathdreamer") as address:
        other = wiw.world_model("pathdreamer", address=address)
        np.testing.assert_array_equal(imagine_plans(other, one, plans[0])[0], frames[0])
        assert other.fingerprint() == pathdreamer.fingerprint() and other.describe() == pathdreamer.describe()
        other.close()


def test_shared_frames_are_computed_but_do_not_travel(pathdreamer: Served) -> None:
    whole = imagine_plans(pathdreamer, make_conditioning(), plan(FORWARD, FORWARD, TURN_LEFT))[0]
    tail = imagine_plans(pathdreamer, make_conditioning(), plan(FORWARD, FORWARD, TURN_LEFT, shared=1))[0]
    np.testing.assert_array_equal(tail[2:], whole[2:])


def test_noise_is_drawn_from_the_seed(official: Path) -> None:
    with fake_panoramic.serving(official, "pathdreamer", "--noise") as address:
        model = wiw.world_model("pathdreamer", address=address)
        room = make_conditioning(metres=30.0)
        first, other = (imagine_plans(model, room, plan(FORWARD), seed=seed)[0, 1] for seed in (1, 2))
        assert (first != other).any() and not model.accepts.causal
        np.testing.assert_array_equal(imagine_plans(model, room, plan(FORWARD, TURN_LEFT), seed=1)[0, 1], first)
        model.close()


def test_what_a_network_raises_is_told_and_others_go_on(se3ds: Served) -> None:
    white = Conditioning(np.full((1, *SIZE, 3), 255, np.uint8), depth=np.ones((1, *SIZE), np.float32))
    with pytest.raises(RemoteError, match="out of memory") as caught:
        imagine_plans(se3ds, white, plan(FORWARD))
    assert caught.value.kind == "raised"
    imagine_plans(se3ds, make_conditioning(semantic=False), plan(FORWARD))


def test_unknown_categories_are_refused(pathdreamer: Served) -> None:
    with pytest.raises(RemoteError, match="categories below 42") as caught:
        imagine_plans(pathdreamer, make_conditioning(category=42), plan(FORWARD))
    assert caught.value.kind == "row"


def test_another_model_no_server_and_a_wrong_token_are_told_plainly(official: Path, se3ds: Served) -> None:
    address = se3ds._arguments[0]
    with pytest.raises(RemoteError, match="serves SE3DS, not PathDreamer") as caught:
        wiw.world_model("pathdreamer", address=address)
    assert caught.value.kind == "model"
    with pytest.raises(RemoteError, match=r"nobody serves.*shim\.py pathdreamer --code") as caught:
        wiw.world_model("pathdreamer", address="ws://127.0.0.1:9", patience=0.2)
    assert caught.value.kind == "connection"
    assert is_served("SE3DS", address) and not is_served("PathDreamer", address)
    assert not is_served("SE3DS", "ws://127.0.0.1:9")
    with fake_panoramic.serving(official, "se3ds", token="secret") as guarded:
        with pytest.raises(RemoteError) as caught:
            wiw.world_model("se3ds", address=guarded, token="guess")
        assert caught.value.kind == "token"
        wiw.world_model("se3ds", address=guarded, token="secret").close()


def test_pages_of_browsers_are_refused(se3ds: Served) -> None:
    with pytest.raises(InvalidStatus), connect(se3ds._arguments[0], origin="http://example.com"):
        pass


def dialogue(address: str, *messages: Any) -> Any:
    """What a server says last to messages of a client that has said hello."""
    with connect(address, max_size=None, compression=None) as client:
        client.send(encode(Hello("test")))
        assert isinstance(decode(client.recv()), Welcome)
        for message in messages:
            client.send(message)
        return decode(client.recv(timeout=20)), client


def row(**changes: Any) -> bytes:
    packed = msgpack.unpackb(pack_row(make_conditioning(semantic=False), 0, plan(FORWARD), 1))
    return msgpack.packb({**packed, **changes})


def ask(data: bytes, **changes: Any) -> bytes:
    message = msgpack.unpackb(encode(Ask(row_id(data), data, 5.0, 0)))
    return msgpack.packb({**message, **changes})


def array(dtype: str, shape: list[int], data: bytes = b"") -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data": data}


POLE = np.eye(4)[None].copy()
POLE[0, 1, 1] = 0.5
BAD_ROWS: dict[str, Callable[[], bytes]] = {
    "no map": lambda: b"\x01",
    "a field is missing": lambda: msgpack.packb({"image": None}),
    "no depth": lambda: row(depth=None),
    "semantics nobody takes": lambda: row(semantic=array("<u4", [1, 1], bytes(4))),
    "another size": lambda: row(image=array("|u1", [8, 8, 3], bytes(192))),
    "too few bytes": lambda: row(image=array("|u1", [576, 1024, 3], b"\0")),
    "an odd dtype": lambda: row(actions=array("|O8", [1], bytes(8))),
    "a negative side": lambda: row(actions=array("|i1", [-1], b"")),
    "length beyond the plan": lambda: row(length=2),
    "shared beyond the length": lambda: row(shared=2),
    "no actions": lambda: row(actions=array("|i1", [0]), trajectory=array("<f8", [0, 3]), length=0),
    "NaN": lambda: row(viewpoints=array("<f8", [1, 4, 4], np.full((1, 4, 4), np.nan).tobytes())),
    "a pitched camera": lambda: row(viewpoints=array("<f8", [1, 4, 4], POLE.tobytes())),
    "a seed of text": lambda: row(seed="1"),
}


@pytest.mark.parametrize("name", BAD_ROWS)
def test_bad_rows_are_refused_and_the_server_goes_on(name: str, se3ds: Served) -> None:
    said, _ = dialogue(se3ds._arguments[0], ask(BAD_ROWS[name]()))
    assert isinstance(said, Refusal) and said.id and said.kind in ("row", "message")


BAD_MESSAGES: dict[str, Callable[[], Any]] = {
    "text": lambda: "hello",
    "not valid msgpack": lambda: b"\xc1",
    "no map": lambda: msgpack.packb([1]),
    "another version": lambda: ask(b"", v=2),
    "unknown type": lambda: ask(b"", type="answer"),
    "another field": lambda: ask(b"", more=1),
    "seconds of text": lambda: ask(b"", seconds="1"),
    "endless seconds": lambda: ask(b"", seconds=float("inf")),
    "an id that is no digest": lambda: ask(b"row", id=b"0" * 16),
    "deep": lambda: msgpack.packb({"v": 1, "type": "ask", "id": [[[]] * 20] * 20}),
    "a second hello": lambda: encode(Hello("again")),
}


@pytest.mark.parametrize("name", BAD_MESSAGES)
def test_malformed_messages_end_their_connection(name: str, se3ds: Served) -> None:
    said, client = dialogue(se3ds._arguments[0], BAD_MESSAGES[name]())
    assert isinstance(said, Refusal) and not said.id and said.kind in ("message", "version")
    with pytest.raises(ConnectionClosed):
        client.recv(timeout=5)


def test_killed_in_mid_run_and_started_again_it_answers(official: Path) -> None:
    begin = fake_panoramic.command(official, "se3ds", "--port", "0")
    environment = {"PYTHONPATH": str(official), "PATH": "/usr/bin"}
    first = subprocess.Popen(begin, env=environment, stdout=subprocess.PIPE, text=True)
    assert first.stdout is not None
    address = first.stdout.readline().split()[-1]
    model = wiw.world_model("se3ds", address=address)
    expected = imagine_plans(model, make_conditioning(semantic=False), plan(FORWARD, FORWARD))
    first.send_signal(signal.SIGKILL)
    first.wait()
    with fake_panoramic.serving(official, "se3ds", port=int(address.rpartition(":")[2])):
        again = imagine_plans(model, make_conditioning(semantic=False), plan(FORWARD, FORWARD))
    np.testing.assert_array_equal(again, expected)
    model.close()


def test_sigterm_ends_it(official: Path) -> None:
    with fake_panoramic.serving(official, "se3ds") as address:
        wiw.world_model("se3ds", address=address).close()
    with pytest.raises(RemoteError):
        wiw.world_model("se3ds", address=address, patience=0.2)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (["--code", "/nowhere"], "git clone https://github.com/google-research/se3ds"),
        (["--weights", "/nowhere"], "expected one checkpoint se3ds_ckpt.index"),
        (["--host", "0.0.0.0"], "WIW_TOKEN"),
        (["--noise"], "has no randomness"),
    ],
)
def test_a_wrong_start_says_what_to_do(official: Path, change: list[str], told: str) -> None:
    command = fake_panoramic.command(official, "se3ds", *change)
    environment = {"PYTHONPATH": str(official), "PATH": "/usr/bin"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2 and told in done.stderr and "Traceback" not in done.stderr


def test_the_list_shows_them(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["list", "world-models"]) == 0
    shown = [line.split("  ") for line in capsys.readouterr().out.splitlines()]
    lines = [[cell.strip() for cell in line if cell.strip()] for line in shown]
    for name, needs in (("pathdreamer", "depth + semantic"), ("se3ds", "depth")):
        place = next(place for place, line in enumerate(lines) if line[:1] == [name])
        assert lines[place] == [name, "viewpoint", f"panorama + {needs}", "panorama", "576x1024", "any"]
        below = " ".join(lines[place + 1])
        assert f"gresearch/{name}/" in below and ("needs a server at ws://" in below or "ready" in below)
