# SPDX-License-Identifier: Apache-2.0
"""Several servers of one model answer as one would, whichever of them are there."""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wiw
from wiw.errors import ArgumentError, ContractError, RemoteError
from wiw.loop.attempts import Attempted
from wiw.runs.arm_text import split_arms
from wiw.runs.recipes import AgentRecipe
from wiw.serving.background import serve_in_background
from wiw.types import Conditioning, Control
from wiw.wire.address_book import ServerAddress, announce_server
from wiw.world_models.base import answer_deadline
from wiw.world_models.remote import links
from wiw.world_models.remote.model import Remote

SIZE = (8, 16)


class Counting(wiw.WorldModel):
    """Frames are a function of image and seed; counts its rows and may wait at a gate."""

    accepts = wiw.accepts("trajectory", size=SIZE, best_batch=4)

    def __init__(self, name: str = "counting 1", gate: threading.Event | None = None) -> None:
        self.name, self.gate, self.rows, self.begun = name, gate, 0, threading.Event()
        self.seeds: list[int] = []

    def rollout(self, observations: Conditioning, controls: Any, seeds: Any) -> Any:
        self.begun.set()
        if self.gate is not None:
            self.gate.wait(20)
        self.rows += len(controls)
        self.seeds += seeds.tolist()
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        frames[:, 1:] += (seeds % np.uint64(97)).astype(np.uint8)[:, None, None, None, None]
        return frames

    def describe(self) -> dict[str, Any]:
        return {"name": "Counting"}

    def fingerprint(self) -> str:
        return self.name


def make_rows(count: int) -> tuple[Conditioning, list[Control], Any]:
    image = np.broadcast_to(np.arange(count, dtype=np.uint8)[:, None, None, None], (count, *SIZE, 3)).copy()
    control = Control(np.ones(2, np.int8), np.zeros((2, 3)), np.tile(np.eye(4), (2, 1, 1)), length=2)
    return Conditioning(image), [control] * count, np.arange(count, dtype=np.uint64)


@contextlib.contextmanager
def serve(*models: wiw.WorldModel) -> Iterator[tuple[Remote, list[Any]]]:
    with contextlib.ExitStack() as stack:
        servers = [stack.enter_context(serve_in_background(model)) for model in models]
        client = Remote(",".join(server.address for server in servers))
        stack.callback(client.close)
        yield client, servers


def test_rows_are_spread_and_answered_as_by_one() -> None:
    models, given = [Counting(), Counting(), Counting()], make_rows(50)
    with serve(*models) as (client, _):
        np.testing.assert_array_equal(client.rollout(*given), Counting().rollout(*given))
        assert client.accepts.best_batch >= 3 * Counting.accepts.best_batch
        assert client.fingerprint() == "counting 1"
    assert min(model.rows for model in models) >= 4, "each has had its share"
    assert sum(model.rows for model in models) == 50, "and no row is computed twice"


FILE = """
import wiw
from helper_of_served import LEVEL

class Mine(wiw.WorldModel):
    accepts = wiw.accepts("trajectory", size=(8, 16))
    version = "1"

    def rollout(self, observations, controls, seeds):
        return observations.image[:, None].repeat(len(controls[0].actions) + 1, 1) // LEVEL
"""


def test_copies_of_a_file_on_several_machines_are_one_model(tmp_path: Path) -> None:
    names = {}
    for machine, level in (("a", 2), ("b", 2), ("c", 3)):
        folder = tmp_path / machine
        folder.mkdir()
        (folder / "served.py").write_text(FILE)
        (folder / "helper_of_served.py").write_text(f"LEVEL = {level}\n")
        names[machine] = f"{folder / 'served.py'}:Mine"
    with contextlib.ExitStack() as stack:
        models = {machine: wiw.world_model(name) for machine, name in names.items()}
        for model in models.values():
            stack.callback(model.close)
        with serve(models["a"], models["b"]) as (client, _):
            assert client.fingerprint() == models["a"].fingerprint() != ""
        with pytest.raises(RemoteError, match="serves a different model"), serve(models["a"], models["c"]):
            pass


class Relay:
    """A port that leads to a server until it is cut, as by a machine that dies at its work."""

    def __init__(self, address: str) -> None:
        self._target = int(address.rpartition(":")[2])
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._open = [self._listening]
        self.address = f"ws://127.0.0.1:{self._listening.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listening.accept()
                far = socket.create_connection(("127.0.0.1", self._target))
                self._open += [near, far]
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=self._pump, args=pair, daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                sink.sendall(data)

    def cut_connections(self) -> None:
        for each in self._open:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()


def test_a_server_that_dies_at_its_work_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "LOST", 0.3)
    gate, given = threading.Event(), make_rows(12)
    staying, dying = Counting(), Counting(gate=gate)
    found: list[Any] = []
    with serve_in_background(staying) as first, serve_in_background(dying) as second:
        relay = Relay(second.address)
        client = Remote(f"{first.address},{relay.address}")
        asking = threading.Thread(target=lambda: found.append(client.rollout(*given)))
        asking.start()
        assert dying.begun.wait(10)
        relay.cut_connections()
        asking.join(20)
        np.testing.assert_array_equal(found[0], Counting().rollout(*given))
        assert staying.rows == 12 and dying.rows == 0, "its rows went to the other"
        more = make_rows(20)
        began = time.monotonic()
        np.testing.assert_array_equal(client.rollout(*more), Counting().rollout(*more))
        assert time.monotonic() - began < 5, "the one that is gone is not waited for"
        client.close()
        gate.set()


def wait_for(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def make_other_rows(count: int, start: int) -> tuple[Conditioning, list[Control], Any]:
    image, controls, seeds = make_rows(count)
    return image, controls, seeds + np.uint64(start)


def ask_within(client: wiw.WorldModel, seconds: float, given: tuple[Conditioning, list[Control], Any]) -> float:
    """Ask for rows, check their frames, and return how long that took."""
    began = time.monotonic()
    with answer_deadline(seconds):
        frames = client.rollout(*given)
    np.testing.assert_array_equal(frames, Counting().rollout(*given))
    return time.monotonic() - began


def test_rows_of_a_server_that_hangs_go_to_the_other_and_it_comes_back_once_it_has_answered() -> None:
    """Its connection stays, as that of a server whose model is stuck in a GPU call."""
    gate = threading.Event()
    well, hanging = Counting(), Counting(gate=gate)
    with serve(hanging, well) as (client, servers):
        assert 1.5 < ask_within(client, 4.0, make_rows(12)) < 3.8
        assert servers[0].clients == 1 and hanging.begun.is_set() and (hanging.rows, well.rows) == (0, 12)
        assert ask_within(client, 60.0, make_other_rows(12, 100)) < 5, "it is passed over from now on"
        assert (hanging.rows, well.rows) == (0, 24)
        gate.set()
        wait_for(lambda: hanging.rows >= 4 and not servers[0].pending_rows)
        before = hanging.rows
        ask_within(client, 60.0, make_other_rows(12, 200))
        assert hanging.rows >= before + 4, "it has its share again"


def test_a_server_that_hung_over_rows_of_others_comes_back_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """It answers nothing that this client has asked for, which it refuses as late; single rows show that it is back."""
    monkeypatch.setattr(links, "PROBE", 0.1)
    gate = threading.Event()
    well, hanging = Counting(), Counting(gate=gate)
    with serve(hanging, well) as (client, servers), contextlib.closing(Remote(servers[0].address)) as other:
        asking = threading.Thread(target=lambda: other.rollout(*make_other_rows(4, 50)))
        asking.start()
        assert hanging.begun.wait(10)
        ask_within(client, 1.5, make_rows(8))
        wait_for(lambda: servers[0].pending_rows == 4)
        gate.set()
        asking.join(20)
        assert hanging.rows == 4

        starts = itertools.count(100, 10)

        def has_share() -> bool:
            before = hanging.rows
            ask_within(client, 60.0, make_other_rows(8, next(starts)))
            return hanging.rows >= before + 4

        wait_for(has_share)


def test_servers_that_are_all_slow_keep_their_rows() -> None:
    gate = threading.Event()
    models = [Counting(gate=gate), Counting(gate=gate)]
    with serve(*models) as (client, _):
        threading.Timer(3.0, gate.set).start()
        assert ask_within(client, 4.5, make_rows(8)) >= 2.9, "later than half of the deadline"
    require_own_shares_once(models)


def require_own_shares_once(models: list[Counting]) -> None:
    """Check that each of two slow servers has had its half of eight rows, and computed no row twice.

    Whichever answers first may be asked for rows of the other while that is about to answer.
    """
    assert min(model.rows for model in models) == 4 and {*models[0].seeds, *models[1].seeds} == set(range(8))
    assert all(len(set(model.seeds)) == len(model.seeds) for model in models)


def test_a_call_that_no_server_answers_ends_at_its_deadline_and_the_next_one_asks_again() -> None:
    gate = threading.Event()
    models = [Counting(gate=gate), Counting(gate=gate)]
    with serve(*models) as (client, _):
        began = time.monotonic()
        with answer_deadline(1.0), pytest.raises(RemoteError, match="8 of 8 rows were not answered in time") as caught:
            client.rollout(*make_rows(8))
        assert caught.value.kind == "deadline" and 0.8 < time.monotonic() - began < 5
        threading.Timer(0.5, gate.set).start()
        assert ask_within(client, 60.0, make_rows(8)) < 20
    require_own_shares_once(models)  # what they were computing in the first call is not computed again


def test_a_server_that_hangs_costs_no_try() -> None:
    gate = threading.Event()
    with serve(Counting(gate=gate), Counting()) as (client, _):
        attempted, given = Attempted(client, 3.0, checks_pictures=False), make_rows(3)
        np.testing.assert_array_equal(attempted.rollout(*given), Counting().rollout(*given))
        assert not attempted.spent.get("retries")
        gate.set()


@contextlib.contextmanager
def announce(folder: Path, *models: wiw.WorldModel) -> Iterator[list[Any]]:
    """Serve models and announce them in a folder."""
    with contextlib.ExitStack() as stack:
        servers = [stack.enter_context(serve_in_background(model)) for model in models]
        for place, server in enumerate(servers):
            stack.enter_context(announce_server(ServerAddress(server.address), folder / f"{place}.json"))
        yield servers


def test_an_announced_server_that_hangs_is_left_for_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getpid", lambda: 0)  # begins with the first
    gate = threading.Event()
    hanging, well = Counting(gate=gate), Counting()
    with announce(tmp_path, hanging, well) as servers, contextlib.closing(Remote(str(tmp_path))) as client:
        attempted = Attempted(client, 1.5, checks_pictures=False)
        for start, retries in ((0, 1), (100, 1)):
            given = make_other_rows(6, start)
            np.testing.assert_array_equal(attempted.rollout(*given), Counting().rollout(*given))
            assert attempted.spent["retries"] == retries, "the second call asks the server that is well at once"
        assert hanging.begun.is_set() and (hanging.rows, well.rows) == (0, 12)
        assert (servers[0].clients, servers[1].clients) == (0, 1)
        gate.set()


def test_the_only_announced_server_is_not_left(tmp_path: Path) -> None:
    gate = threading.Event()
    model = Counting(gate=gate)
    with announce(tmp_path, model) as servers, contextlib.closing(Remote(str(tmp_path))) as client:
        for _ in range(2):
            with answer_deadline(0.5), pytest.raises(RemoteError, match="busy or hung"):
                client.rollout(*make_rows(4))
        connections = set(servers[0]._unanswered)
        threading.Timer(0.3, gate.set).start()
        ask_within(client, 60.0, make_rows(4))
        assert set(servers[0]._unanswered) == connections and model.rows == 4


def test_another_model_is_refused_at_the_start() -> None:
    other = r"serves a different model than ws://.*fingerprint other, expected counting 1"
    with pytest.raises(RemoteError, match=other), serve(Counting(), Counting("other")):
        pass
    nameless = "several servers can only be used for a model that can be identified"
    with pytest.raises(RemoteError, match=nameless), serve(Counting(""), Counting("")):
        pass


def test_one_server_that_answers_is_enough_to_begin_and_the_other_joins_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "JOIN", 0.3)
    port, model = find_free_port(), Counting()
    with (
        serve_in_background(model) as server,
        contextlib.closing(Remote(f"ws://127.0.0.1:{port},{server.address}")) as client,
    ):
        assert client.accepts.best_batch >= 2 * Counting.accepts.best_batch
        ask_within(client, 20.0, make_rows(8))
        assert model.rows == 8
        late, starts = Counting(), itertools.count(100, 10)

        def has_joined() -> bool:
            ask_within(client, 20.0, make_other_rows(8, next(starts)))
            return late.rows >= 4

        with serve_in_background(late, port=port):
            wait_for(has_joined)
        assert len({*model.seeds, *late.seeds}) == model.rows + late.rows, "no row is computed twice"


@pytest.mark.parametrize(
    ("name", "said"), [("other", "serves a different model than ws://"), ("", "can be identified")]
)
def test_a_server_that_joins_later_is_held_to_the_first(monkeypatch: pytest.MonkeyPatch, name: str, said: str) -> None:
    monkeypatch.setattr(links, "JOIN", 0.3)
    port, wrong = find_free_port(), Counting(name)
    with (
        serve_in_background(Counting()) as server,
        contextlib.closing(Remote(f"{server.address},ws://127.0.0.1:{port}")) as client,
    ):
        with serve_in_background(wrong, port=port) as other, warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            for start in itertools.count(0, 10):
                ask_within(client, 20.0, make_other_rows(8, start))
                if told and start >= 30:
                    break
            assert other.clients == 1 and wrong.rows == 0
        (warning,) = told
        assert said in str(warning.message) and "It is not asked" in str(warning.message)


def test_servers_of_which_none_answers_are_all_named() -> None:
    ports = [find_free_port(), find_free_port()]
    addresses = ",".join(f"ws://127.0.0.1:{port}" for port in ports)
    with pytest.raises(RemoteError, match=f"nobody serves a world model: .*{ports[0]}: .*; .*{ports[1]}: ") as caught:
        Remote(addresses, patience=0.5)
    assert caught.value.kind == "connection"


def find_free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return int(found.getsockname()[1])


def test_without_any_server_the_call_ends_at_its_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "LOST", 0.2)
    with serve_in_background(Counting()) as one, serve_in_background(Counting()) as other:
        client = Remote(f"{one.address},{other.address}")
    with answer_deadline(1.0), pytest.raises(RemoteError, match="no server could be reached in time: ws://"):
        client.rollout(*make_rows(4))
    client.close()


def test_a_breach_of_the_contract_is_told_as_by_one() -> None:
    class Wrong(Counting):
        def rollout(self, observations: Any, controls: Any, seeds: Any) -> Any:
            return np.zeros((len(controls), 1, 2, 2, 3), np.uint8)

    with serve(Wrong(), Wrong()) as (client, _), pytest.raises(ContractError):
        client.rollout(*make_rows(8))


def test_addresses_are_checked() -> None:
    with pytest.raises(ArgumentError, match="expected different addresses"):
        Remote("ws://127.0.0.1:1,ws://127.0.0.1:1")
    with pytest.raises(ArgumentError, match="expected an address such as ws://"):
        Remote("ws://127.0.0.1:1,gpu-b")


def test_several_servers_are_one_arm() -> None:
    text = "remote:ws://a:1,ws://b:2"
    assert split_arms(f"none,{text},copy") == ["none", text, "copy"]
    assert split_arms("a=warpnet?size=[4, 8],wss") == ["a=warpnet?size=[4, 8]", "wss"]
    assert AgentRecipe("matcher", text).arm == "remote:a:1;b:2"
    assert AgentRecipe("matcher", "remote:ws://a:1").arm == "remote:a:1"
