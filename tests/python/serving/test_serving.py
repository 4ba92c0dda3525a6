# SPDX-License-Identifier: Apache-2.0
"""A served world model answers as it would at home, whoever asks, and survives whatever it is told."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import pickle
import resource
import shutil
import ssl
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import chain
from types import SimpleNamespace

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.sync.server import serve as serve_sync

import wiw
from wiw.cli import main
from wiw.cli.serve import _end_if_idle
from wiw.errors import ArgumentError, ContractError, InfrastructureError, RemoteError, RolloutError
from wiw.loop import attempts
from wiw.loop.attempts import Attempted
from wiw.serving import outbox
from wiw.serving import server as serving
from wiw.serving.answer_cache import AnswerCache
from wiw.serving.background import serve_in_background
from wiw.serving.queue import ANNOUNCED, Job, Queue
from wiw.serving.server import Server, Settings
from wiw.types import Conditioning, Control, History
from wiw.wire.address_book import ServerAddress, announce_server, read_addresses
from wiw.wire.messages import MOST_BYTES, Answer, Ask, Hello, Refusal, Wait, Welcome, decode, encode
from wiw.wire.rows import Row, pack_row, row_id
from wiw.world_models.base import answer_deadline
from wiw.world_models.remote import link
from wiw.world_models.remote.limits import check_row
from wiw.world_models.remote.model import Remote

SIZE = (8, 16)


def make_conditioning(batch, needs=(), start=0):
    shades = np.arange(start, start + batch).astype(np.uint8)[:, None, None]
    image = np.broadcast_to(shades[..., None], (batch, *SIZE, 3)).copy()
    return Conditioning(
        image,
        depth=np.broadcast_to(shades, (batch, *SIZE)).astype(np.float32) if "depth" in needs else None,
        semantic=np.broadcast_to(shades, (batch, *SIZE)).astype(np.uint32) if "semantic" in needs else None,
        history=past(image) if "history" in needs else None,
    )


def past(image, most=3):
    """A history that ends with the image, of one row more of the shade before than of the next."""
    batch = len(image)
    places = np.arange(batch)
    return History(
        np.stack([image - 1, image, image], 1)[:, :most],
        np.repeat(places[:, None, None], 3, 1) * np.ones(3),
        np.broadcast_to(np.arange(4, dtype=np.int8), (batch, 2, 4)) * (np.arange(4) < places[:, None, None] % 4 + 1),
        np.repeat(places[:, None] % 4 + 1, 2, 1),
        1 + places % 3,
    )


def plans(batch, count=5, length=None, shared=0):
    one = Control(
        np.ones(count, np.int8),
        np.arange(3.0 * count).reshape(count, 3),
        np.tile(np.eye(4), (count, 1, 1)),
        length=count if length is None else length,
        shared=shared,
    )
    return [one] * batch


class Mixing(wiw.WorldModel):
    """Its frames are a function of all that a row is given; notes the batches that it is asked for."""

    accepts = wiw.accepts("trajectory", size=SIZE, best_batch=8, needs=("depth", "semantic", "history"), history=3)

    def __init__(self, seconds=0.0):
        self.seconds, self.batches, self.gate = seconds, [], None

    def rollout(self, observations, controls, seeds):
        self.batches.append([len(control.actions) for control in controls])
        if self.gate is not None:
            self.gate.wait(20)
        time.sleep(self.seconds)
        assert seeds.dtype == np.uint64
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        for row, control in enumerate(controls):
            facts = [
                seeds[row] % np.uint64(251),
                observations.depth[row].sum(),
                observations.semantic[row].sum(),
                observations.history.images[row].sum(),
                5 * observations.history.poses[row].sum(),
                7 * (observations.history.actions[row] * np.arange(1, 3)[:, None]).sum(),
                11 * observations.history.lengths[row].sum() + 13 * observations.history.count[row],
                control.trajectory.sum() * 3,
            ]
            frames[row, 1:] += np.uint8(int(sum(map(int, facts))) % 256)
            frames[row, 1:] += np.arange(len(control.actions), dtype=np.uint8)[:, None, None, None]
        return frames

    def describe(self):
        return {"name": "Mixing"}

    def fingerprint(self):
        return "mixing 1"


class Plain(wiw.WorldModel):
    """Repeats the image, after a while, or does what it is told."""

    accepts = wiw.accepts("image", size=SIZE, best_batch=4)

    def __init__(self, act=None, name="plain"):
        self.act, self.name, self.rows = act, name, []

    def rollout(self, observations, controls, seeds):
        self.rows.append(observations.image[:, 0, 0, 0].tolist())
        answer = self.act(observations) if self.act else None
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1) if answer is None else answer

    def fingerprint(self):
        return self.name


def ask(model, batch=4, start=0, count=5):
    return model.rollout(
        make_conditioning(batch, model.accepts.needs, start), plans(batch, count), np.arange(batch, dtype=np.uint64)
    )


@contextlib.contextmanager
def remote(model, **options):
    with serve_in_background(model, **options) as server:
        client = Remote(server.address, options.get("token"))
        try:
            yield client, server
        finally:
            client.close()


# -- the same answers --------------------------------------------------------------------------------------------------


def test_it_answers_as_at_home_and_says_what_it_is():
    model = Mixing()
    given = (
        make_conditioning(20, model.accepts.needs),
        plans(20),
        np.arange(20, dtype=np.uint64) + np.uint64(2**64 - 20),
    )
    home = model.rollout(*given)
    with remote(model) as (client, _):
        np.testing.assert_array_equal(client.rollout(*given), home)
        assert client.describe() == {"name": "Remote", "model": {"name": "Mixing"}, "fingerprint": "mixing 1"}
        assert client.fingerprint() == "mixing 1"
        assert client.accepts.needs == model.accepts.needs and client.accepts.best_batch >= model.accepts.best_batch


def test_only_a_rows_own_frames_travel():
    model = Mixing()
    given = make_conditioning(2, model.accepts.needs), plans(2, length=4, shared=1), np.arange(2, dtype=np.uint64)
    home = model.rollout(*given)
    with remote(model) as (client, _):
        found = client.rollout(*given)
    np.testing.assert_array_equal(found[:, 2:5], home[:, 2:5])
    np.testing.assert_array_equal(found[:, 0], given[0].image)


def test_workers_find_the_server_again_and_rows_of_clients_share_batches():
    model = Mixing(seconds=0.2)
    with remote(model) as (client, _):
        others = [pickle.loads(pickle.dumps(client)) for _ in range(4)]
        ask(client)  # so that the others are there when the next batch is made
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(lambda place: ask(others[place], 4, 20 * place), range(4)))
        for other in others:
            other.close()
        for place in range(4):
            np.testing.assert_array_equal(found[place], ask(model, 4, 20 * place))
    assert max(map(len, model.batches)) == 8  # of two clients with four rows each


def test_rows_of_different_lengths_never_share_a_batch():
    model = Mixing(seconds=0.05)
    with remote(model) as (client, _), ThreadPoolExecutor(4) as pool:
        counts = [2, 3, 2, 3]
        found = list(pool.map(lambda place: ask(client, 3, 30 * place, counts[place]), range(4)))
    assert all(len(set(batch)) == 1 for batch in model.batches)
    assert [len(answer[0]) for answer in found] == [3, 4, 3, 4]


def test_a_whole_run_is_the_same_as_at_home(two_rooms, tmp_path):
    from wiw.runs.store import RunStore
    from wiw.tasks.imagenav import ImageNav

    def facts(model, name):
        agent = wiw.Agent("heuristic", model, reviser="matcher")
        out = tmp_path / name
        wiw.evaluate(ImageNav(scenes=two_rooms, decisions=2), agent, 2, out=out, progress=False, workers=1)
        with RunStore.read(out) as store:
            return [row["scores"] for row in store.decisions()], [row["metrics"] for row in store.outcomes()]

    with remote("warp") as (client, _):
        assert facts(client, "remote") == facts("warp", "home")


# -- what goes wrong ---------------------------------------------------------------------------------------------------


def test_a_row_that_the_model_cannot_do_fails_alone():
    def act(observations):
        if (observations.image == 2).any():
            raise MemoryError("no room\nfor two")

    model = Plain(act)
    with remote(model) as (client, _):
        with pytest.raises(RemoteError, match="MemoryError: no room for two") as caught:
            ask(client)
        assert caught.value.kind == "raised"
        before = len(model.rows)
        np.testing.assert_array_equal(
            ask(client, 2)[:, 5], make_conditioning(2).image
        )  # known: rows 0 and 1 were answered
        assert len(model.rows) == before and [2] in model.rows


def test_an_error_whose_words_are_not_utf_8_is_an_answer_too():
    def act(observations):
        raise FileNotFoundError("no file 'caf\udce9.png'")

    with remote(Plain(act)) as (client, _), answer_deadline(20), pytest.raises(RemoteError, match="caf") as caught:
        ask(client, 1)
    assert caught.value.kind == "raised" and str(caught.value) == r"FileNotFoundError: no file 'caf\udce9.png'"


def test_an_error_without_words_does_not_end_the_server():
    class SpeechlessError(Exception):
        def __str__(self):
            raise KeyError("words")

    def act(observations):
        if (observations.image == 0).all():
            raise SpeechlessError

    with remote(Plain(act)) as (client, _), answer_deadline(20):
        with pytest.raises(RemoteError, match=r"SpeechlessError: its text cannot be had \(KeyError\)"):
            ask(client, 1)
        assert ask(client, 1, start=1).shape == (1, 6, *SIZE, 3)


def test_a_row_that_shows_another_place_fails_alone():
    """The others may be another client's."""

    def act(observations):
        frames = np.repeat(observations.image[:, None], 6, 1)
        frames[observations.image[:, 0, 0, 0] == 2] ^= 255  # inverted
        return frames

    images = np.random.default_rng(0).integers(10, 246, (4, *SIZE, 3), np.uint8)
    images[:, 0, 0, 0] = range(4)
    model = Plain(act)
    with remote(model) as (client, _):
        with pytest.raises(ContractError, match="frame 0 is not the observation: it is inverted"):
            client.rollout(Conditioning(images), plans(4), np.arange(4, dtype=np.uint64))
        before = len(model.rows)
        answered = client.rollout(Conditioning(images[:2]), plans(2), np.arange(2, dtype=np.uint64))
        np.testing.assert_array_equal(answered[:, 5], images[:2])
        assert len(model.rows) == before and [2] in model.rows


@pytest.mark.parametrize(
    ("answer", "kind"),
    [
        (np.zeros((4, 6, 9, 16, 3), np.uint8), "shape"),
        (np.zeros((4, 7, *SIZE, 3), np.uint8), "frames"),
        (np.full((4, 6, *SIZE, 3), np.nan), "nan"),
        (np.zeros((4, 6, *SIZE, 3)), "dtype"),
        ("frames", "type"),
    ],
)
def test_a_broken_contract_is_named_as_at_home(answer, kind, monkeypatch):
    monkeypatch.setattr(attempts, "PAUSES", (0.0, 0.0))
    with remote(Plain(lambda observations: answer)) as (client, _):
        with pytest.raises(ContractError, match=r"Plain\.rollout: expected uint8") as caught:
            ask(client)
        assert caught.value.kind == kind
        assert (".astype(numpy.uint8)" in str(caught.value)) == (kind == "dtype")
        with pytest.raises(RolloutError) as caught:
            Attempted(client, 60.0).rollout(make_conditioning(4), plans(4), np.arange(4, dtype=np.uint64))
        assert caught.value.kind == kind


def test_a_deadline_that_passes_is_a_typed_error_and_the_row_is_not_begun(monkeypatch):
    monkeypatch.setattr(attempts, "TRIES", 1)
    gate = threading.Event()
    model = Plain(lambda observations: gate.wait(20) and None)
    with remote(model) as (client, server):
        begin = time.monotonic()
        with pytest.raises(RemoteError, match="busy or hung") as caught, answer_deadline(0.5):
            ask(client, 4)
        assert caught.value.kind == "deadline" and time.monotonic() - begin < 5
        with pytest.raises(RolloutError) as caught:
            Attempted(client, 0.5).rollout(make_conditioning(4, start=90), plans(4), np.arange(4, dtype=np.uint64))
        assert caught.value.kind == "deadline"
        wait_for(lambda: len(server.queue) == 0)
        gate.set()
        ask(client, 4, 40)
    assert not any(90 in rows for rows in model.rows)


def test_a_row_that_is_asked_for_again_while_it_is_computed_gets_its_answer_and_disturbs_nobody():
    gate = threading.Event()
    model = Plain(lambda observations: gate.wait(20) and None)
    with remote(model) as (client, _), ThreadPoolExecutor(2) as pool:
        with pytest.raises(RemoteError, match="busy or hung"), answer_deadline(0.3):
            ask(client, 4)
        again, other = pool.submit(ask, client, 4), pool.submit(ask, client, 2, 90)
        time.sleep(0.3)
        gate.set()
        np.testing.assert_array_equal(again.result(20)[:, 5], make_conditioning(4).image)
        np.testing.assert_array_equal(other.result(20)[:, 5], make_conditioning(2, start=90).image)
    assert sorted(chain(*model.rows)) == [0, 1, 2, 3, 90, 91]


def test_a_row_whose_first_asker_waited_too_short_is_asked_for_again():
    gate = threading.Event()
    model = Plain(lambda observations: gate.wait(20) and None)
    with remote(model) as (client, server), ThreadPoolExecutor(2) as pool:
        busy = pool.submit(ask, client, 4, 90)
        wait_for(lambda: model.rows)
        # whichever of the two sees first that the time is over
        with pytest.raises(RemoteError, match=r"busy or hung|the queue is long"), answer_deadline(0.3):
            ask(client, 2)
        again = pool.submit(ask, client, 2)
        wait_for(lambda: len(server.queue) == 2)
        time.sleep(0.5)  # the first question's deadline at the server passes meanwhile
        gate.set()
        np.testing.assert_array_equal(again.result(20)[:, 5], make_conditioning(2).image)
        busy.result(20)


def test_the_callers_deadline_counts_however_long_it_is(monkeypatch):
    with remote(Plain()) as (client, _):
        given = []
        rows = client._link.ask
        monkeypatch.setattr(client._link, "ask", lambda *a: given.append(a[1] - time.monotonic()) or rows(*a))
        ask(client)
        with answer_deadline(1000.0):
            ask(client)
    assert given == [pytest.approx(300.0, abs=30), pytest.approx(950.0, abs=30)]


def test_announced_rows_that_are_known_are_not_waited_for():
    with remote(Plain()) as (client, server):
        ask(client, 1)
        rows = make_conditioning(2)
        rows.image[1] = 77
        swapped = Conditioning(rows.image[::-1].copy())
        client.rollout(swapped, plans(2), np.zeros(2, np.uint64))  # the second one is known
        assert not any(server.queue._coming.values())


def test_a_model_may_use_its_memory_again():
    size = (256, 512)

    class Reusing(wiw.WorldModel):
        accepts = wiw.accepts("image", size=size, best_batch=8)
        memory = np.zeros((8, 3, *size, 3), np.uint8)

        def rollout(self, observations, controls, seeds):
            self.memory[: len(seeds)] = seeds.astype(np.uint8)[:, None, None, None, None]
            return self.memory[: len(seeds)]

        def fingerprint(self):
            return "reusing"

    with remote(Reusing()) as (client, _):
        frames = client.rollout(
            Conditioning(np.zeros((64, *size, 3), np.uint8)), plans(64, 2), np.arange(64, dtype=np.uint64)
        )
    assert (frames[:, 1:] == np.arange(64)[:, None, None, None, None]).all()


def wait_for(condition, seconds=20):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_full_queue_tells_the_client_to_wait_and_all_is_answered():
    model = Plain(lambda observations: time.sleep(0.02))
    with remote(model, queue=4) as (client, _):
        said = []
        decoded = decode
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("wiw.world_models.remote.link.decode", lambda data: said.append(decoded(data)) or said[-1])
            np.testing.assert_array_equal(ask(client, 16)[:, 5], make_conditioning(16).image)
    waits = [message for message in said if isinstance(message, Wait)]
    assert waits and all(0 < message.seconds <= 2 and message.reason == "the queue is full" for message in waits)
    assert sorted(chain(*model.rows)) == list(range(16))


def test_a_lost_connection_is_mended_and_no_row_is_computed_twice():
    model = Plain(lambda observations: time.sleep(0.3))
    with remote(model) as (client, server), ThreadPoolExecutor(1) as pool:
        answer = pool.submit(ask, client, 8)
        for lost in range(3):
            wait_for(lambda lost=lost: len(model.rows) > min(lost, 1) and server.clients == 1)
            for connection in list(server._unanswered):
                server._loop.call_soon_threadsafe(connection.transport.abort)
            time.sleep(0.05)
        np.testing.assert_array_equal(answer.result(30)[:, 5], make_conditioning(8).image)
    assert sorted(chain(*model.rows)) == list(range(8))


def test_a_server_that_comes_back_is_not_asked_for_what_was_answered():
    gate = threading.Event()
    with serve_in_background(first := Plain()) as server, ThreadPoolExecutor(1) as pool:
        port = int(server.address.rpartition(":")[2])
        client = Remote(server.address)
        first.act = lambda observations: None if len(first.rows) == 1 else gate.wait(20) and None
        answer = pool.submit(ask, client, 8)
        wait_for(lambda: len(first.rows) == 2 and len(client._link._open) == 8)
        wait_for(lambda: sum(question.answer.done() for question in client._link._open.values()) == 4)
        object.__setattr__(server.settings, "grace", 0.0)
        server._loop.call_soon_threadsafe(server.end)
        wait_for(lambda: not server.clients)
        with serve_in_background(second := Plain(), port=port):
            np.testing.assert_array_equal(answer.result(30)[:, 5], make_conditioning(8).image)
        gate.set()
    client.close()
    assert sorted(chain(*second.rows)) == [4, 5, 6, 7]


def test_a_server_that_comes_back_with_another_model_is_refused():
    with serve_in_background(Plain(name="first")) as server:
        port = int(server.address.rpartition(":")[2])
        client = Remote(server.address)
        ask(client)
    with serve_in_background(Plain(name="second"), port=port):
        with pytest.raises(RemoteError, match="has come back with different") as caught:
            ask(client, start=50)
        assert caught.value.kind == "model"
    with serve_in_background(Plain(name="first"), port=port):
        ask(client, start=60)
    client.close()


def test_nobody_there():
    begin = time.monotonic()
    with pytest.raises(
        RemoteError, match=r"nobody serves a world model at ws://127\.0\.0\.1:1: ConnectionRefused"
    ) as caught:
        Remote("ws://127.0.0.1:1", patience=0.3)
    assert caught.value.kind == "connection" and time.monotonic() - begin < 5
    with serve_in_background(Plain()) as server:
        client = Remote(server.address)
    with pytest.raises(RemoteError, match="could not be reached in time") as caught, answer_deadline(0.5):
        ask(client)
    assert caught.value.kind == "connection"


@pytest.mark.parametrize(
    "address", ["http://127.0.0.1:1", "127.0.0.1:1", "ws://", "ws://u:secret@h:1", "ws://h:1/?token=x", "ws://h:x"]
)
def test_addresses_that_are_none(address):
    with pytest.raises(ArgumentError, match="remote:"):
        wiw.world_model(f"remote:{address}")


def test_servers_are_found_where_they_announce_themselves_and_the_next_when_one_is_gone(tmp_path, monkeypatch):
    """One of two that are announced was killed; the other one ends in the midst, and a third comes in its place."""
    folder = tmp_path / "servers"
    folder.mkdir()
    with pytest.raises(RemoteError, match=f"no server is announced in {folder} yet"):
        wiw.world_model(f"remote:{folder}", patience=0.5)
    (folder / "0.json").write_text('{"address": "ws://127.0.0.1:9", "token": "killed"}')
    (folder / "broken.json").write_text("{")
    with serve_in_background(Plain(), token="first") as server:
        with announce_server(ServerAddress(server.address, "first"), folder / "1.json"):
            assert len(read_addresses(folder)) == 2 and read_addresses(folder / "1.json")[0].token == "first"
            model = wiw.world_model(f"remote:{folder}")
            expected = ask(model)
        assert not (folder / "1.json").exists()
    with (
        serve_in_background(Plain(), token="third") as server,
        announce_server(ServerAddress(server.address, "third"), folder / "2.json"),
    ):
        assert np.array_equal(ask(model), expected)
        assert pickle.loads(pickle.dumps(model)).accepts == model.accepts
    model.close()


def test_an_announcement_left_behind_is_passed_over_though_another_server_listens_there(tmp_path, monkeypatch):
    """It was killed, and a server with another token has its port."""
    with serve_in_background(Plain(), token="own") as server:
        (tmp_path / "0.json").write_text(f'{{"address": "{server.address}", "token": "of the killed one"}}')
        monkeypatch.setattr(os, "getpid", lambda: 0)  # begins with the first
        with pytest.raises(RemoteError, match="401"):
            wiw.world_model(f"remote:{tmp_path}", patience=0.5)
        (tmp_path / "1.json").write_text(f'{{"address": "{server.address}", "token": "own"}}')
        wiw.world_model(f"remote:{tmp_path}").close()


def test_a_client_that_was_closed_says_so_at_once():
    gate = threading.Event()
    with (
        serve_in_background(Plain(lambda observations: gate.wait(20) and None)) as server,
        ThreadPoolExecutor(1) as pool,
    ):
        client = Remote(server.address)
        waiting = pool.submit(ask, client)
        wait_for(lambda: server.pending_rows)
        begin = time.monotonic()
        client.close()
        for question in (waiting.result, lambda: ask(client)):
            with pytest.raises(RemoteError, match="closed on this side"):
                question()
        assert time.monotonic() - begin < 60
        gate.set()


def test_a_row_that_is_too_large_is_told_of_at_once():
    with remote(Mixing()) as (client, _):
        observations = make_conditioning(1, ("depth", "semantic"))
        history = make_conditioning(1, ("history",)).history
        history = replace(history, images=np.zeros((1, 3000, *SIZE, 3), np.uint8))
        observations = replace(observations, history=history)
        with pytest.raises(RemoteError, match="or a shorter history if it needs one") as caught:
            client.rollout(observations, plans(1), np.zeros(1, np.uint64))
        assert caught.value.kind == "row"


def test_clients_threads_end_with_them():
    gc.collect()  # those of other tests
    with serve_in_background(Plain()) as server:
        before = threading.active_count()
        clients = [Remote(server.address) for _ in range(3)]
        assert threading.active_count() == before + 3
        del clients
        gc.collect()
        wait_for(lambda: threading.active_count() <= before)


# -- who may ask what --------------------------------------------------------------------------------------------------


def test_oracle_none_and_what_is_no_model_are_not_served():
    with pytest.raises(ArgumentError, match="needs the simulator, which cannot leave"):
        Server(wiw.world_model("oracle"))
    for what in (None, 3):
        with pytest.raises(ArgumentError, match="expected a world model"):
            Server(what)


def test_beyond_this_machine_a_token_is_asked_for():
    for host in ("0.0.0.0", "::", "gpu-machine", ""):
        with pytest.raises(ArgumentError, match="set WIW_TOKEN"):
            Settings(host)
        assert Settings(host, token="secret").token
    for host in ("127.0.0.1", "::1", "localhost", "127.1.2.3"):
        Settings(host)


@pytest.mark.parametrize("wrong", [{"port": 70000}, {"queue": 0}, {"window": -1.0}, {"grace": -1.0}])
def test_settings_out_of_range(wrong):
    with pytest.raises(ArgumentError, match="serve: expected"):
        Settings(**wrong)


def test_a_misspelt_setting_has_a_hint():
    with (
        pytest.raises(ArgumentError, match=r"unknown setting 'windw'; .*Did you mean window\?"),
        serve_in_background(Plain(), windw=0.1),
    ):
        pass


def test_the_token_opens_and_no_other(monkeypatch):
    with serve_in_background(Plain(), token="secret") as server:
        for token in (None, "", "Secret", "secret2", "é"):
            with pytest.raises(RemoteError, match="expects a different token"):
                Remote(server.address, token).close()
        assert server.refused >= 5
        client = Remote(server.address, "secret")
        ask(client)
        client.close()
        monkeypatch.setenv("WIW_TOKEN", "secret")
        wiw.world_model(f"remote:{server.address}").close()


def test_no_web_page_may_ask():
    with serve_in_background(Plain()) as server, pytest.raises(InvalidStatus, match="403"):
        connect(server.address, origin="http://somewhere", proxy=None)


def test_more_clients_than_a_server_takes():
    with serve_in_background(Plain(), clients=1) as server:
        client = Remote(server.address)
        with pytest.raises(InvalidStatus, match="503"):
            connect(server.address, proxy=None)
        with pytest.raises(RemoteError, match=r"503: 1 clients are already connected; .*--clients"):
            Remote(server.address, patience=0.5)
        client.close()


@pytest.mark.parametrize("command", [["serve", "warp"], ["serve-vlm", "--model", "mock"]])
def test_an_announcement_that_no_client_would_read_is_refused(command, tmp_path):
    with pytest.raises(ArgumentError, match=r"expected a file such as .*/1\.json, got .*/1: clients read \.json"):
        main([*command, "--port", "0", "--announce", str(tmp_path / "1"), "--idle", "0.1", "--debug"])


@pytest.mark.parametrize(("served", "at_first"), [(False, 0.8), (True, 30.0)])
def test_a_server_waits_for_its_first_client_longer_than_for_another_one(served, at_first):
    """Its client, if there is one, leaves soon."""

    async def wait():
        ended, ready = asyncio.Event(), asyncio.Event()
        server = SimpleNamespace(clients=int(served), end=ended.set)
        ready.set()
        asyncio.get_running_loop().call_later(0.15, setattr, server, "clients", 0)
        await asyncio.wait_for(_end_if_idle(server, at_first, 0.2, ready), 20)
        return ended.is_set()

    begin = time.monotonic()
    assert asyncio.run(wait()) and (served or time.monotonic() - begin >= at_first)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"port": -1}, "a port from 0 to 65535, got -1"),
        ({"port": 65536}, "a port from 0 to 65535, got 65536"),
        ({"queue": 0}, "a queue of at least 1, got 0"),
        ({"window": -0.1}, "a window of at least 0, got -0.1"),
        ({"grace": float("nan")}, "a grace of at least 0 seconds, got nan"),
    ],
)
def test_only_what_is_out_of_range_is_named(given, expected):
    with pytest.raises(ArgumentError) as error:
        Settings(**given)
    assert str(error.value) == f"serve: expected {expected}"


def test_a_port_that_is_taken():
    with serve_in_background(Plain()) as server:
        port = int(server.address.rpartition(":")[2])
        with pytest.raises(InfrastructureError, match="cannot listen"), serve_in_background(Plain(), port=port):
            pass


@pytest.mark.usefixtures("ipv6")
def test_an_address_of_ipv6():
    with serve_in_background(Plain(), host="::1") as server:
        assert server.address.startswith("ws://[::1]:")
        with contextlib.closing(wiw.world_model(f"remote:{server.address}")) as model:
            assert model.accepts.frames == Plain.accepts.frames


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificate")
def test_certificates_that_are_none_are_named(tmp_path):
    (tmp_path / "text.pem").write_text("no certificate")
    for name, reason in (("nowhere.pem", "No such file"), ("text.pem", "PEM")):
        with (
            pytest.raises(ArgumentError, match=rf"{name}: .*{reason}"),
            serve_in_background(Plain(), certificate=tmp_path / name),
        ):
            pass
    with pytest.raises(ArgumentError, match="nothing would be encrypted"):
        Settings(key=tmp_path / "key.pem")


def test_behind_tls(tmp_path, monkeypatch):
    files = {"certificate": tmp_path / "certificate.pem", "key": tmp_path / "key.pem"}
    command = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:P-256",
        "-nodes",
        "-days",
        "2",
    ]
    command += ["-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1"]
    subprocess.run([*command, "-keyout", files["key"], "-out", files["certificate"]], check=True, capture_output=True)
    with serve_in_background(Plain(), **files) as server:
        assert server.address.startswith("wss://")
        with pytest.raises(RemoteError, match="SSLCertVerificationError"):
            Remote(server.address, patience=0.5)
        monkeypatch.setenv("SSL_CERT_FILE", str(files["certificate"]))
        assert ssl.get_default_verify_paths().cafile
        client = Remote(server.address)
        ask(client)
        client.close()


# -- versions and nonsense ---------------------------------------------------------------------------------------------


@contextlib.contextmanager
def raw(server):
    with connect(server.address, proxy=None, compression=None, max_size=MOST_BYTES) as connection:
        yield connection


def greeted(connection):
    connection.send(encode(Hello("test")))
    return decode(connection.recv())


def row(count=5, **changes):
    return pack_row(make_conditioning(1), 0, plans(1, count, **changes)[0], 7)


def test_another_version_is_refused_at_the_handshake():
    later = msgpack.packb({**msgpack.unpackb(encode(Hello("wiw 9.9"))), "v": 9})
    with serve_in_background(Plain()) as server, raw(server) as connection:
        connection.send(later)
        said = decode(connection.recv())
        assert isinstance(said, Refusal) and said.kind == "version" and "version 1" in said.text and " 9" in said.text
        with pytest.raises(ConnectionClosed, match="1008"):
            connection.recv()

    def another(connection):
        connection.recv()
        connection.send(later)

    with serve_sync(another, "127.0.0.1", 0) as old:
        threading.Thread(target=old.serve_forever, daemon=True).start()
        with pytest.raises(RemoteError, match="speaks version 1 of the protocol, the other 9") as caught:
            Remote(f"ws://127.0.0.1:{old.socket.getsockname()[1]}")
        assert caught.value.kind == "version"
        old.shutdown()


def test_a_server_that_says_nothing_is_given_up_when_patience_ends(monkeypatch):
    monkeypatch.setattr(link, "HANDSHAKE", 0.2)
    with serve_sync(lambda connection: time.sleep(1.0), "127.0.0.1", 0) as mute:
        threading.Thread(target=mute.serve_forever, daemon=True).start()
        with pytest.raises(RemoteError, match="TimeoutError") as caught:
            Remote(f"ws://127.0.0.1:{mute.socket.getsockname()[1]}", patience=2.0)
        assert caught.value.kind == "connection"
        mute.shutdown()


@pytest.mark.parametrize("description", ["no JSON", "[" * 100_000 + "]" * 100_000, '"a name"'])
def test_a_server_that_describes_its_model_in_nonsense_is_refused(description):
    with serve_in_background(Plain()) as server:
        server._welcome = replace(server._welcome, model=description)
        with pytest.raises(RemoteError, match="description of its model") as caught:
            Remote(server.address)
        assert caught.value.kind == "message"


def test_rows_that_the_model_does_not_take_are_refused_one_by_one():
    other_size = pack_row(Conditioning(np.zeros((1, 4, 4, 3), np.uint8)), 0, plans(1)[0], 7)
    wrong = {
        "pixels": other_size,
        "does not take it": pack_row(make_conditioning(1, ("depth",)), 0, plans(1)[0], 7),
        "at least 1": row(0),
        "not valid msgpack": b"\xc1",
        "missing fields": b"\x80",
    }
    model = Plain()
    with serve_in_background(model) as server, raw(server) as connection:
        assert isinstance(greeted(connection), Welcome)
        for text, data in wrong.items():
            connection.send(encode(Ask(row_id(data), data, 5.0, 0)))
            said = decode(connection.recv())
            assert isinstance(said, Refusal) and said.id == row_id(data) and text in said.text
        connection.send(encode(Ask(row_id(row()), row(), 5.0, 0)))
        assert isinstance(decode(connection.recv()), Answer)
        assert server.refused == len(wrong)


def test_an_answer_that_could_not_be_sent_is_not_computed():
    image = np.zeros((576, 1024, 3), np.uint8)
    for count, fits in ((100, True), (200, False)):
        asked = Row(image, None, None, None, plans(1, count)[0], 0)
        with contextlib.nullcontext() if fits else pytest.raises(RemoteError, match="too many to send"):
            check_row(asked, wiw.accepts("image"))


def test_fixed_lengths_and_needs_are_held_to():
    class Fixed(Mixing):
        accepts = wiw.accepts("action", size=SIZE, frames=4, needs=("depth",))

    with serve_in_background(Fixed()) as server, raw(server) as connection:
        greeted(connection)
        for text, data in {
            "row.depth: missing": row(3),
            "row.ids": pack_row(make_conditioning(1, ("depth",)), 0, plans(1, 3)[0], 7),
        }.items():
            connection.send(encode(Ask(row_id(data), data, 5.0, 0)))
            assert text in decode(connection.recv()).text


@pytest.mark.parametrize(
    "first",
    [
        b"",
        b"\x00",
        b"\xff" * 100,
        encode(Ask(row_id(row()), row(), 5.0, 0)),
        encode(Wait(b"", 1.0, "")),
        "text",
        b"\xdd\xff\xff\xff\xff" * 1000,
    ],
)
def test_what_is_no_hello_ends_the_connection_with_a_reason(first):
    with serve_in_background(Plain()) as server:
        with raw(server) as connection:
            connection.send(first)
            said = decode(connection.recv())
            assert isinstance(said, Refusal) and said.id == b"" and said.kind in ("message", "version")
            with pytest.raises(ConnectionClosed, match="1008"):
                connection.recv()
        alive(server)


def test_an_id_that_is_not_the_rows_is_refused():
    with serve_in_background(Plain()) as server, raw(server) as connection:
        greeted(connection)
        connection.send(encode(Ask(b"1", row(), 5.0, 0)))
        assert "digest" in decode(connection.recv()).text


def alive(server):
    with raw(server) as connection:
        assert isinstance(greeted(connection), Welcome)
        connection.send(encode(Ask(row_id(row()), row(), 20.0, 0)))
        assert isinstance(decode(connection.recv()), Answer)


@pytest.fixture(scope="module")
def target():
    with serve_in_background(Plain()) as server:
        yield server


GOOD = encode(Ask(row_id(row()), row(), 5.0, 0))


@st.composite
def damaged(draw):
    kind = draw(st.sampled_from(("random", "cut", "altered", "another")))
    if kind == "random":
        return draw(st.binary(max_size=200))
    if kind == "cut":
        return GOOD[: draw(st.integers(0, len(GOOD) - 1))]
    if kind == "altered":
        data = bytearray(GOOD)
        for place in draw(st.lists(st.integers(0, len(GOOD) - 1), min_size=1, max_size=4)):
            data[place] ^= draw(st.integers(1, 255))
        return bytes(data)
    return msgpack.packb(
        draw(
            st.dictionaries(st.text(max_size=5), st.integers() | st.binary(), max_size=4).filter(
                lambda values: all(not isinstance(value, int) or -(2**63) <= value < 2**64 for value in values.values())
            )
        )
    )


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damaged(), st.booleans())
def test_nonsense_is_answered_or_closed_and_the_server_lives_on(target, data, polite):
    with raw(target) as connection:
        if polite:
            greeted(connection)
        connection.send(data)
        try:
            assert isinstance(decode(connection.recv(timeout=20)), Refusal | Answer | Wait)
        except ConnectionClosed as closed:
            assert closed.rcvd is not None and closed.rcvd.code in (1002, 1003, 1007, 1008, 1009)
    assert target.worker.is_alive()


def test_after_all_that_it_still_answers_and_has_taken_no_memory(target):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for bomb in (
        b"\xdd\x00\x3f\xff\xff" * 500,
        b"\xdd\x00\x0f\xff\xff" + b"\x90" * 2**19,
        b"\xdf\xff\xff\xff\xff" * 100,
    ):
        with raw(target) as connection:
            greeted(connection)
            connection.send(bomb)
            assert isinstance(decode(connection.recv(timeout=20)), Refusal)
    with raw(target) as connection:
        greeted(connection)
        with pytest.raises(ConnectionClosed) as caught:
            connection.send(bytes(2**22))  # more than any row of this model
            connection.recv(timeout=20)
        assert caught.value.rcvd is None or caught.value.rcvd.code == 1009
    alive(target)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_a_client_that_says_nothing_is_sent_away(monkeypatch):
    monkeypatch.setattr(serving, "HANDSHAKE", 0.2)
    with serve_in_background(Plain()) as server, raw(server) as connection:
        with pytest.raises(ConnectionClosed):
            connection.recv(timeout=20)
        alive(server)


# -- ending ------------------------------------------------------------------------------------------------------------


def test_told_to_end_it_finishes_what_it_has_taken_and_takes_no_more():
    gate = threading.Event()
    model = Plain(lambda observations: gate.wait(20) and None)
    with remote(model) as (client, server), ThreadPoolExecutor(1) as pool:
        answer = pool.submit(ask, client, 8)
        wait_for(lambda: server.pending_rows == 8 and len(model.rows) == 1)
        server._loop.call_soon_threadsafe(server.end)
        with raw(server) as late:
            greeted(late)
            late.send(encode(Ask(row_id(row()), row(), 5.0, 0)))
            said = decode(late.recv())
            assert isinstance(said, Wait) and said.reason == "the server is shutting down"
            gate.set()
            np.testing.assert_array_equal(answer.result(20)[:, 5], make_conditioning(8).image)
            with pytest.raises(ConnectionClosed, match="1001"):
                late.recv(timeout=20)


# -- the queue ---------------------------------------------------------------------------------------------------------


def job(place=0, count=5, arrived=0.0, expires=1e9):
    return Job(
        str(place).encode(),
        Row(np.zeros((*SIZE, 3), np.uint8), None, None, None, plans(1, count)[0], 0),
        arrived,
        expires,
    )


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def filled(*jobs, batch=4, window=0.0, rest=0, clients=("a",), clock=None):
    queue = Queue(batch, 100, window, clock or Clock())
    for client in clients:
        queue.join(client)
    for one in jobs:
        assert queue.put(one, "a", rest)
    return queue


def test_a_full_batch_goes_at_once_and_first_come_is_first_served():
    jobs = [job(place) for place in range(6)]
    queue = filled(*jobs)
    assert queue.take() == jobs[:4] and queue.take() == jobs[4:]


def test_a_batch_is_of_one_shape_and_no_shape_starves():
    jobs = [job(place, 2 + place % 2) for place in range(6)]
    queue = filled(*jobs, batch=2)
    taken = [queue.take() for _ in range(4)]
    assert taken == [[jobs[0], jobs[2]], [jobs[1], jobs[3]], [jobs[4]], [jobs[5]]]


def test_announced_rows_are_waited_for_but_not_for_ever():
    clock = Clock()
    queue = filled(job(), rest=2, clock=clock)
    assert queue.find_due()[1] == ANNOUNCED
    clock.now = 0.6
    queue.put(job(1), "a", 1)
    assert queue.find_due()[1] == ANNOUNCED
    clock.now = 0.6 + ANNOUNCED
    assert queue.find_due()[1] <= 0
    queue.put(job(2), "a", 0)
    assert queue.find_due()[1] == 0.0


def test_clients_that_may_still_ask_are_waited_for_a_share_of_a_batch():
    clock = Clock()
    queue = filled(job(), window=0.1, clients=("a", "b"), clock=clock)
    assert queue.find_due()[1] == 0.0  # nothing is known of the time that a batch takes
    queue.batch_seconds = 2.0
    assert queue.find_due()[1] == pytest.approx(0.2)
    queue.batch_seconds = 1000.0
    assert queue.find_due()[1] == 1.0
    queue.put(job(1), "b")
    assert queue.find_due()[1] == 0.0  # all have asked


def test_what_nobody_waits_for_is_not_begun():
    clock = Clock()
    queue = filled(job(0, expires=1.0), job(1, expires=3.0), clock=clock)
    clock.now = 2.0
    assert [one.id for one in queue.find_due()[0]] == [b"1"]
    assert [one.id for one in queue.take_expired()] == [b"0"]
    assert len(queue) == 1


def test_a_client_that_has_gone_leaves_only_what_others_want():
    own, shared = job(0), job(1)
    queue = filled(own, shared, clients=("a", "b"))
    own.askers, shared.askers = {"a"}, {"a", "b"}
    assert queue.leave("a") == [own] and queue.find_due()[0] == [shared]


def test_a_queue_takes_no_more_than_it_may_and_ends():
    queue = Queue(4, 2, 0.0)
    queue.join("a")
    assert [queue.put(job(place), "a") for place in range(3)] == [True, True, False]
    queue.end()
    assert len(queue.take()) == 2 and queue.take() is None


def test_answers_are_kept_up_to_a_size():
    known = AnswerCache(10)
    for name in (b"a", b"b", b"c"):
        known.put(name, b"1234")
    assert known.get(b"a") is None and known.get(b"b") == b"1234"
    known.put(b"d", b"1234")
    assert known.get(b"c") is None and known.get(b"b")
    known.put(b"e", b"1" * 11)
    assert known.get(b"e") is None and known.get(b"b") is None


# -- a client that does not read ---------------------------------------------------------------------------------------


class Pictures(Plain):
    """Large frames: five of a row are 2 MB."""

    accepts = wiw.accepts("image", size=(256, 512), best_batch=4)


ANSWER = 5 * 256 * 512 * 3


def large_ask(shade, seed=0):
    row = pack_row(Conditioning(np.full((1, 256, 512, 3), shade, np.uint8)), 0, plans(1)[0], seed)
    return Ask(row_id(row), row, 60.0, 0)


@contextlib.contextmanager
def unread(server):
    """A client that has said hello and reads no more than its first message."""
    with connect(server.address, compression=None, max_size=None, max_queue=1, close_timeout=0.1) as client:
        client.send(encode(Hello("lazy")))
        decode(client.recv())
        yield client


def unsent(server):
    """Bytes in the buffers of the server's connections, and those that wait to get there."""
    return sum(client.transport.get_write_buffer_size() for client in list(server._unanswered)) + server.unsent_bytes


@pytest.mark.parametrize("known", [False, True])
def test_a_client_that_does_not_read_fills_no_memory_and_is_sent_away(monkeypatch, known):
    monkeypatch.setattr(outbox, "UNSENT_BYTES", 3 * ANSWER)
    monkeypatch.setattr(serving, "UNREAD", 1.0)
    peak = 0
    with serve_in_background(Pictures()) as server, unread(server) as client:

        def insist():
            with contextlib.suppress(ConnectionClosed):
                if known:
                    client.send(encode(large_ask(0)))
                    wait_for(lambda: server.worker.rows == 1 and not server.pending_rows)
                for number in range(100):
                    client.send(encode(large_ask(0, 0 if known else number)))

        asking = threading.Thread(target=insist, daemon=True)
        asking.start()
        while server.clients and peak < 6 * ANSWER:
            peak = max(peak, unsent(server))
            time.sleep(0.002)
        asking.join(20)
        assert not asking.is_alive() and server.refused == 1
        assert 2 * ANSWER < peak < 6 * ANSWER
        with remote_of(server) as other:  # and nobody else is disturbed
            assert other.rollout(
                Conditioning(np.zeros((1, 256, 512, 3), np.uint8)), plans(1), np.zeros(1, np.uint64)
            ).shape == (1, 6, 256, 512, 3)


def test_a_client_that_reads_late_gets_all_answers(monkeypatch):
    monkeypatch.setattr(outbox, "UNSENT_BYTES", 2 * ANSWER)
    with serve_in_background(Pictures()) as server, unread(server) as client:
        asks = {said.id: said for said in (large_ask(shade) for shade in range(8))}
        for said in asks.values():
            client.send(encode(said))
        wait_for(lambda: server.pending_rows == 0 and server.worker.rows == len(asks))
        answers, waited = {}, 0
        while len(answers) < len(asks):
            heard = decode(client.recv(20))
            if isinstance(heard, Wait):
                waited += 1
                assert heard.reason == "earlier answers have not been read yet"
                client.send(encode(asks[heard.id]))
            else:
                answers[heard.id] = heard.frames[0, 0, 0, 0]
        assert waited and [answers[each] for each in asks] == list(range(8))


@contextlib.contextmanager
def remote_of(server):
    client = Remote(server.address)
    try:
        yield client
    finally:
        client.close()
