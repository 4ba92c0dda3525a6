# SPDX-License-Identifier: Apache-2.0
"""The OpenAI client against the loopback server: every dialect, and everything that a server can do wrong."""

from __future__ import annotations

import gc
import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing, contextmanager, suppress
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any, Literal
from urllib.error import HTTPError
from urllib.request import Request as HttpRequest
from urllib.request import urlopen

import numpy as np
import pytest

pydantic = pytest.importorskip("pydantic")
pytest.importorskip("openai")

from misbehaviour import FAULTS, MisbehavingVlmServer, Misbehaviour  # noqa: E402
from wiw.cli.serve_vlm import _make_client, _make_server  # noqa: E402
from wiw.errors import ArgumentError, VlmError  # noqa: E402
from wiw.serving import vlm_server  # noqa: E402
from wiw.serving.vlm_server import VlmServer  # noqa: E402
from wiw.vlm import Request, connect, user  # noqa: E402
from wiw.vlm import openai as openai_client  # noqa: E402
from wiw.vlm.cache import ReplyCache  # noqa: E402
from wiw.vlm.mock import MockClient  # noqa: E402
from wiw.vlm.openai import _Retries  # noqa: E402
from wiw.vlm.servers import Servers  # noqa: E402
from wiw.wire.address_book import ServerAddress, announce_server, read_addresses  # noqa: E402

SECRET_HEADERS = ("OpenAI-Organization", "OpenAI-Project")
IMAGE = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)


class Plan(pydantic.BaseModel):
    reason: str
    actions: list[Literal["forward", "turn_left"]] = pydantic.Field(min_length=1, max_length=4)


REQUESTS = [
    Request((user("Which?", IMAGE),), choices=("a", "b", "c")),
    Request((user("Plan!", IMAGE, IMAGE),), schema=Plan, temperature=1.0, seed=3),
    Request((user("Say"),), max_tokens=10),
    Request((user("Which?"),), choices=tuple(f"o{i}" for i in range(27))),
]


def failing(rates: dict[str, float], **options: Any) -> Misbehaviour:
    return Misbehaviour(rates, slow_seconds=0.5, retry_after=0.05, **options)


def parts_of(call: Any) -> tuple[Any, ...]:
    return tuple(part if isinstance(part, str) else part.tobytes() for part in call.messages[0].content)


@pytest.mark.parametrize("dialect", ["openai", "vllm", "legacy"])
def test_what_goes_over_the_wire_is_what_was_asked(dialect: str) -> None:
    with VlmServer(MockClient()) as server:
        client = connect(server.url, dialect=dialect)
        assert client.model == "mock"
        replies = client.ask(REQUESTS)
        asked = server.client.calls
        direct = MockClient()
        direct.ask(REQUESTS)
        twins = {parts_of(call): call for call in direct.calls}
        for call in (call for call in asked if parts_of(call) in twins):
            twin = twins[parts_of(call)]
            assert call.schema == twin.schema and call.temperature in (twin.temperature, 1.0)
            assert call.labels == (() if dialect == "openai" else twin.labels)
            if call.logprobs:
                assert (call.seed, call.max_tokens, call.logprobs) == (twin.seed, twin.max_tokens, twin.logprobs)
        assert {parts_of(call) for call in direct.calls[:3]} <= {parts_of(call) for call in asked}
        assert all(reply.problem is None for reply in replies)
        assert [reply.by for reply in replies] == ["logprobs", "", "", "logprobs"]
        assert client.spent["vlm_calls"] == len(asked) and client.spent["vlm_retries"] == 0
        assert client.spent["vlm_input_tokens"] > 0
        extra = {"openai": "response_format", "vllm": "structured_outputs", "legacy": "guided_choice"}[dialect]
        assert any(extra in body for body in server.requests)


def test_a_busy_or_failing_server_is_asked_again_as_it_wishes() -> None:
    with MisbehavingVlmServer(MockClient(), misbehaviour=failing({"429": 0.3, "500": 0.1}, seed=5)) as server:
        client = connect(server.url, dialect="vllm", attempts=8, concurrency=2)
        replies = client.ask(REQUESTS * 3)
        assert all(reply.problem is None for reply in replies)
        assert client.spent["vlm_retries"] == server.count - client.spent["vlm_calls"] > 0


def test_retry_after_is_heeded() -> None:
    faults = Misbehaviour({"429": 1.0}, retry_after=0.4)
    with MisbehavingVlmServer(MockClient(), misbehaviour=faults) as server:
        begin = time.monotonic()
        with pytest.raises(VlmError, match=r"429.*\(3 tries\)") as error:
            connect(server.url, model="mock", attempts=3).ask(REQUESTS[2:3])
        assert error.value.kind == "status" and time.monotonic() - begin >= 0.8 and server.count == 3


@pytest.mark.parametrize(
    ("fault", "kind"),
    [("truncated", "truncated"), ("refusal", "refusal"), ("huge", "huge")],
)
def test_answers_that_no_one_can_use_are_outcomes(fault: str, kind: str) -> None:
    with MisbehavingVlmServer(MockClient(), misbehaviour=failing({fault: 1.0})) as server:
        client = connect(server.url, model="mock", dialect="vllm")
        (reply,) = client.ask([Request((user("Plan!"),), schema=Plan, tries=2)])
        assert reply.problem is not None and reply.problem.kind == kind and reply.value is None
        assert len(reply.problem.raw) <= 500 and server.count == 2
        if fault != "truncated":  # half a letter is none, and then votes are asked for
            (choice,) = client.ask([REQUESTS[0]])
            assert choice.problem is not None and choice.problem.kind == kind and choice.probabilities is None


def test_malformed_answers_are_outcomes_too() -> None:
    with MisbehavingVlmServer(MockClient(), misbehaviour=failing({"malformed": 1.0})) as server:
        client = connect(server.url, model="mock", dialect="vllm")
        replies = client.ask([Request((user(f"Plan {k}!"),), schema=Plan, tries=1) for k in range(24)])
        kinds = {reply.problem.kind for reply in replies if reply.problem}
        assert kinds <= {"malformed", "schema", "truncated", "empty"} and "schema" in kinds
        for reply in replies:
            assert (reply.value is None) != (reply.problem is None)


def test_a_slow_server_is_not_waited_for() -> None:
    with MisbehavingVlmServer(MockClient(), misbehaviour=failing({"slow": 1.0})) as server:
        client = connect(server.url, model="mock", timeout=0.1, attempts=2)
        with pytest.raises(VlmError) as error:
            client.ask(REQUESTS[2:3])
        assert error.value.kind == "timeout"


def test_a_server_that_is_not_there_and_one_that_refuses() -> None:
    with VlmServer(MockClient()) as server:
        url = server.url
        client = connect(url.replace("/v1", "/v2"), model="mock")
        with pytest.raises(VlmError, match="404") as error:
            client.ask(REQUESTS[:1])
        assert error.value.kind == "refused" and server.count == 0
    with pytest.raises(VlmError, match="tries") as gone:
        connect(url, attempts=2).ask(REQUESTS[:1])
    assert gone.value.kind == "unreachable"


@contextmanager
def speaking(bodies: list[bytes]) -> Iterator[str]:
    """A server that answers with the given bodies, whatever is asked; the last one goes on."""

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None: ...

        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["content-length"]))
            body = bodies.pop(0) if len(bodies) > 1 else bodies[0]
            self.send_response(200)
            self.send_header("Content-Length", str(len(body) + (body == b"cut off")))
            self.end_headers()
            self.wfile.write(body)

    http = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=http.serve_forever, args=(0.05,), daemon=True).start()
    yield f"http://127.0.0.1:{http.server_address[1]}/v1"
    http.shutdown()
    http.server_close()


GOOD = json.dumps({"choices": [{"message": {"content": "fine \ud800"}}]}).encode()


@pytest.mark.parametrize(
    "body",
    [b"", b"<html>", b"[]", b"null", b'{"choices": []}', b'{"choices": [{"message": null}]}', b"\xff\xfe", b"[" * 99999,
     b'{"choices": [{"message": {"content": "x"}, "logprobs": {"content": [{"top_logprobs": [{"token": 1}]}]}}]}',
     b'{"choices": [{"message": {"content": "x"}}], "usage": {"prompt_tokens": Infinity}}',
     b'{"choices": [{"message": {"content": "x"}}], "usage": {"prompt_tokens": -5}}',
     b'{"choices": [{"message": {"content": "x"}}], "usage": {"completion_tokens": 1e300}}',
     b'{"choices": [{"message": {"content": "x"}, "logprobs": {"content": [{"top_logprobs": [{"token": "A", '
     b'"logprob": 1' + b"0" * 400 + b'}]}]}}]}'],
)  # fmt: skip
def test_bodies_that_are_no_completions_are_asked_for_again(body: bytes) -> None:
    with speaking([body, GOOD]) as url:
        client = connect(url, model="m", attempts=2)
        (reply,) = client.ask(REQUESTS[2:3])
        assert reply.text == "fine ?" and client.spent["vlm_retries"] == 1
    with speaking([body]) as url, pytest.raises(VlmError) as error:
        connect(url, model="m", attempts=1).ask(REQUESTS[2:3])
    assert error.value.kind == "protocol"


@pytest.mark.parametrize("pause", [0.0, 0.2])
def test_an_error_that_does_not_end_is_not_read_to_its_end(pause: float) -> None:
    written = []

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None: ...

        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["content-length"]))
            self.send_response(500)
            self.end_headers()
            with suppress(OSError):
                while len(written) < 3000:
                    self.wfile.write(b"broken" * (10 if pause else 10000))
                    written.append(None)
                    time.sleep(pause)

    http = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=http.serve_forever, args=(0.05,), daemon=True).start()
    with pytest.raises(VlmError, match="500") as error:
        connect(f"http://127.0.0.1:{http.server_address[1]}/v1", model="m", attempts=1, timeout=1.0).ask(REQUESTS[2:3])
    http.shutdown()
    http.server_close()
    assert error.value.kind == "status" and len(written) < 1000


@pytest.mark.parametrize("dripped", ["headers", "status line", "body"])
def test_a_reply_that_drips_in_takes_no_longer_than_the_timeout(dripped: str) -> None:
    """The server would need hours; each byte comes well within the time that a single read may take."""
    opening = {
        "headers": b"HTTP/1.1 200 OK\r\nX-Drip: ",
        "status line": b"HTTP/1.1 2",
        "body": b"HTTP/1.1 200 OK\r\n\r\n",
    }
    ended = threading.Event()

    def drip(connection: socket.socket) -> None:
        with connection, suppress(OSError):
            connection.recv(1 << 16)
            connection.sendall(opening[dripped])
            while not ended.wait(0.05):
                connection.sendall(b"0")

    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with suppress(OSError):
                while True:
                    threading.Thread(target=drip, args=(listener.accept()[0],), daemon=True).start()

        threading.Thread(target=serve, daemon=True).start()
        client = connect(f"http://127.0.0.1:{listener.getsockname()[1]}/v1", model="m", attempts=2, timeout=0.5)
        with ThreadPoolExecutor(1) as pool:
            asked = pool.submit(client.ask, REQUESTS[2:3])
            done = wait([asked], 60).done
            ended.set()
        assert done, "the client still waits for the headers"
        with pytest.raises(VlmError, match=r"not complete within 0\.5 s \(2 tries\)") as error:
            asked.result()
        assert error.value.kind == "timeout"


def test_a_reply_that_is_cut_off_is_asked_for_again() -> None:
    with speaking([b"cut off", GOOD]) as url:
        (reply,) = connect(url, model="m", attempts=2, timeout=5).ask(REQUESTS[2:3])
        assert reply.text == "fine ?"


def test_content_in_odd_shapes_is_no_answer() -> None:
    for message in ({}, {"content": None}, {"content": ["x"]}, {"content": [{"type": "image"}]}, {"content": 3}):
        with speaking([json.dumps({"choices": [{"message": message}]}).encode()]) as url:
            (reply,) = connect(url, model="m").ask([Request((user("Say"),), tries=1)])
            assert reply.problem is not None and reply.problem.kind == "empty"


def test_content_in_parts_is_joined() -> None:
    parts = [{"type": "text", "text": "fi"}, {"type": "text", "text": "ne"}]
    with speaking([json.dumps({"choices": [{"message": {"content": parts}}]}).encode()]) as url:
        assert connect(url, model="m").ask([Request((user("Say"),), tries=1)])[0].text == "fine"


@pytest.mark.parametrize("end", [{"finish_reason": "abort"}, {"finish_reason": {"type": "abort"}}, {"error": "OOM"}])
def test_a_completion_that_the_server_broke_off_is_no_answer(end: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wiw.vlm.openai._Retries.pause", lambda self: 0.0)
    broken = json.dumps({"choices": [{"message": {"content": "Hal"}, "finish_reason": "stop", **end}]}).encode()
    with speaking([broken, GOOD]) as url:
        assert connect(url, model="m", attempts=2).ask(REQUESTS[2:3])[0].text == "fine ?"
    with speaking([broken, broken]) as url, pytest.raises(VlmError, match="broke the completion off") as error:
        connect(url, model="m", attempts=2).ask(REQUESTS[2:3])
    assert error.value.kind == "protocol"


def test_a_wish_for_no_wait_at_all_does_not_use_up_the_tries_at_once() -> None:
    faults = Misbehaviour({"429": 1.0}, retry_after=0.0)
    with MisbehavingVlmServer(MockClient(), misbehaviour=faults) as server:
        begin = time.monotonic()
        with pytest.raises(VlmError):
            connect(server.url, model="mock", attempts=3).ask(REQUESTS[2:3])
        assert time.monotonic() - begin > 0.75 * (0.5 + 1.0)


def test_two_servers_with_models_of_one_name_do_not_share_answers(tmp_path: Path) -> None:
    said = []
    for text in ("one", "two"):
        with VlmServer(MockClient(lambda call, text=text: text)) as server:
            client = connect(server.url, model="mock", cache=ReplyCache(tmp_path))
            said += [client.ask([Request((user("Say"),))])[0].text for _ in range(2)]
            assert client.spent["vlm_cached"] == 1
    assert said == ["one", "one", "two", "two"]


@pytest.mark.parametrize("wait", ["nan", "-1", "soon", "Mon, 01 Jan 99999 00:00:00 GMT"])
def test_odd_wishes_to_wait_do_no_harm(wait: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wiw.vlm.openai._Retries.pause", lambda self: 0.0)
    monkeypatch.setattr("wiw.vlm.openai._Retries.pause_for_quota", lambda self: 0.0)
    send_header = BaseHTTPRequestHandler.send_header

    def odd(self: Any, name: str, value: str) -> None:
        send_header(self, name, wait if name == "Retry-After" else value)

    monkeypatch.setattr(BaseHTTPRequestHandler, "send_header", odd)
    with (
        MisbehavingVlmServer(MockClient(), misbehaviour=failing({"429": 1.0})) as server,
        pytest.raises(VlmError) as error,
    ):
        connect(server.url, attempts=2).ask(REQUESTS[2:3])
    assert error.value.kind == "status"


def test_a_model_that_thinks_first_gets_its_own_limit_and_no_temperature() -> None:
    """As OpenAI's, which refuse the other names."""

    class Thinker(VlmServer):
        def respond(self, body: dict[str, Any], number: int) -> Any:
            for name in {"max_tokens", "temperature"} & set(body):
                raise ArgumentError(f"Unsupported parameter: '{name}' is not supported with this model.")
            return super().respond(body, number)

    with Thinker(MockClient()) as server:
        with pytest.raises(VlmError, match=r"dialect=reasoning") as error:
            connect(server.url, attempts=1).ask(REQUESTS[1:2])
        assert error.value.kind == "refused"
        replies = connect(server.url, dialect="reasoning", thinking_tokens=90).ask(REQUESTS[1:3])
        assert all(reply.problem is None for reply in replies)
        asked = sorted(each["max_completion_tokens"] for each in server.requests[-2:])  # at once, in either order
        assert asked == [10 + 90, REQUESTS[1].max_tokens + 90]


def test_a_server_without_quota_is_given_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    """Quotas are per minute; hosted models do not always say how long to wait."""
    pauses = []

    def note_pause(self: Any) -> float:
        pauses.append(pause(self))
        return 0.0

    pause = _Retries.pause_for_quota
    monkeypatch.setattr(_Retries, "pause_for_quota", note_pause)
    monkeypatch.setattr(_Retries, "pause", lambda self: 0.0)
    send_header = BaseHTTPRequestHandler.send_header
    monkeypatch.setattr(
        BaseHTTPRequestHandler,
        "send_header",
        lambda self, name, value: send_header(self, "X-Other" if name == "Retry-After" else name, value),
    )
    for fault, tries in (("429", 4), ("500", 0)):
        pauses.clear()
        with MisbehavingVlmServer(MockClient(), misbehaviour=failing({fault: 1.0})) as server:
            with pytest.raises(VlmError, match=rf"{fault}.*\(4 tries\)"):
                connect(server.url, model="mock").ask(REQUESTS[2:3])
            assert server.count == 4 and len(pauses) == tries
        assert sorted(pauses) == pauses and (not pauses or sum(pauses[:-1]) > 40), "none follows the last"


def test_an_address_with_a_password_is_refused_and_not_repeated() -> None:
    with pytest.raises(ArgumentError, match=r"https://host:8443/v1.*OPENAI_API_KEY") as error:
        connect("https://me:s3cret@host:8443/v1", model="m")
    assert "s3cret" not in str(error.value)


def test_what_is_of_openai_is_told_to_openai_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_ORG_ID", "org-mine")
    monkeypatch.setenv("OPENAI_PROJECT_ID", "project-mine")
    for url, told in (("https://api.openai.com/v1", True), ("http://127.0.0.1:8000/v1", False)):
        headers = connect(url, model="m")._make_sdk(ServerAddress(url)).default_headers
        assert [headers.get(name) in ("org-mine", "project-mine") for name in SECRET_HEADERS] == [told, told]


@pytest.mark.parametrize("fault", [KeyError("plan"), IndexError("none"), TypeError("odd")])
def test_an_error_of_the_script_is_the_servers_not_the_clients(fault: Exception) -> None:
    def script(call: Any) -> str:
        raise fault

    with (
        VlmServer(MockClient(script)) as server,
        pytest.raises(VlmError, match=rf"500.*{type(fault).__name__}.*{fault.args[0]}") as error,
    ):
        connect(server.url, attempts=1).ask(REQUESTS[2:3])
    assert error.value.kind == "status"


def test_what_was_paid_for_is_counted_though_another_question_fails(tmp_path: Path) -> None:
    def script(call: Any) -> str:
        if parts_of(call)[0] == "Bad":
            raise ValueError("never")
        return "fine"

    with VlmServer(MockClient(script)) as server:
        client = connect(server.url, concurrency=1, cache=ReplyCache(tmp_path))
        with pytest.raises(VlmError, match="never"):
            client.ask([Request((user("Say"),)), Request((user("Bad"),))])
        assert client.spent["vlm_calls"] == 1 and client.spent["vlm_input_tokens"] > 0


@pytest.mark.parametrize("concurrency", [1, 3])
def test_what_was_paid_for_is_not_asked_again_though_another_question_fails(tmp_path: Path, concurrency: int) -> None:
    """Keep those of choices in rounds and votes, too, where one question takes several calls."""
    failing_now = True

    def script(call: Any) -> Any:
        if failing_now and call.labels == ("A", "B"):  # the final of the many choices
            raise ValueError("never")
        return {"A": 0.75, "B": 0.25} if call.labels else "fine"

    many = tuple(f"o{k}" for k in range(6))
    requests = [Request((user("Which?", IMAGE),), choices=many), *(Request((user(f"Say {k}"),)) for k in range(3))]
    with VlmServer(MockClient(script)) as server:
        options = {"dialect": "vllm", "top_logprobs": 3, "concurrency": concurrency, "attempts": 1}
        with pytest.raises(VlmError, match="never"):
            connect(server.url, cache=ReplyCache(tmp_path), **options).ask(requests)
        assert server.count == 6
        failing_now = False
        replies = connect(server.url, cache=ReplyCache(tmp_path), **options).ask(requests)
        assert server.count == 7 and all(reply.problem is None for reply in replies)


def test_answers_that_arrived_beside_a_failure_are_kept(tmp_path: Path) -> None:
    arrived = threading.Event()

    def script(call: Any) -> str:
        if parts_of(call)[0] == "Bad":
            raise ValueError("never")
        arrived.set()
        return "fine"

    with VlmServer(MockClient(script)) as server:
        requests = [Request((user("Bad"),)), Request((user("Say"),))]
        with pytest.raises(VlmError, match="never"):
            connect(server.url, concurrency=2, attempts=1, cache=ReplyCache(tmp_path)).ask(requests)
        assert arrived.is_set()
        again = connect(server.url, cache=ReplyCache(tmp_path))
        assert again.ask(requests[1:])[0].text == "fine" and again.spent["vlm_calls"] == 0


@pytest.mark.parametrize("fault", ["slow", "429"])
def test_an_interrupted_client_neither_waits_nor_asks_again(fault: str) -> None:
    """Ctrl-C in a process that asks a server which is slow, or asks for a pause of half a minute."""
    asking = (
        "import signal, sys; from wiw.vlm import Request, connect, user\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # shells start background jobs without one
        "client = connect(sys.argv[1], model='mock', concurrency=2)\n"
        "client.ask([Request((user(f'Say {k}'),)) for k in range(6)])\n"
    )
    faults = Misbehaviour({fault: 1.0}, slow_seconds=30.0, retry_after=30.0)
    with MisbehavingVlmServer(MockClient(), misbehaviour=faults) as server:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        with subprocess.Popen(
            [sys.executable, "-c", asking, server.url], env=environment, stderr=subprocess.PIPE, text=True
        ) as process:
            until = time.monotonic() + 120
            while server.count < 2 and time.monotonic() < until:
                time.sleep(0.05)
            time.sleep(0.3)
            begin = time.monotonic()
            process.send_signal(signal.SIGINT)
            try:
                _, said = process.communicate(timeout=15)
            finally:
                process.kill()
        assert "KeyboardInterrupt" in said and time.monotonic() - begin < 15 and server.count == 2


def test_clients_that_hung_up_have_no_turn() -> None:
    """A model that is slower than its clients' patience would else answer no one."""
    begun, go_on = threading.Event(), threading.Event()

    def script(call: Any) -> str:
        begun.set()
        go_on.wait(30)
        return "fine"

    client = MockClient(script)
    with VlmServer(client) as server:
        port = int(server.url.split(":")[2][:-3])

        def send(text: str) -> HTTPConnection:
            http = HTTPConnection("127.0.0.1", port, timeout=30)
            http.request("POST", "/v1/chat/completions", json.dumps({"messages": [{"role": "user", "content": text}]}))
            return http

        first = send("first")
        assert begun.wait(30)
        impatient, patient = send("impatient"), send("patient")
        until = time.monotonic() + 30
        while server.count < 3 and time.monotonic() < until:
            time.sleep(0.01)
        impatient.close()
        go_on.set()
        for http in (first, patient):
            assert http.getresponse().status == 200
            http.close()
        assert sorted(parts_of(call)[0] for call in client.calls) == ["first", "patient"]


def test_a_mock_served_by_the_command_records_no_calls(tmp_path: Path) -> None:
    """Their images would fill the memory of a server that runs for days."""
    script = tmp_path / "script.py"
    script.write_text("def answer(call):\n    return 'fine'\n")
    for name in ("mock", f"{script}:answer"):
        client = _make_client(name, 0, str(tmp_path))
        client.ask(REQUESTS[2:3])
        assert isinstance(client, MockClient) and client.calls == []


def test_what_was_answered_before_a_failure_is_kept(tmp_path: Path) -> None:
    texts = iter(["fine", "", VlmError("gone")])

    def script(call: Any) -> Any:
        said = next(texts)
        if isinstance(said, VlmError):
            raise said
        return said

    client = MockClient(script, cache=ReplyCache(tmp_path))
    with pytest.raises(VlmError, match="gone"):
        client.ask([Request((user("Say"),)), Request((user("More"),))])
    (reply,) = MockClient(lambda call: "asked again", cache=ReplyCache(tmp_path)).ask([Request((user("Say"),))])
    assert reply.text == "fine"


def test_a_server_that_refuses_to_list_tokens_is_asked_for_votes() -> None:
    def script(call: Any) -> str:
        if call.logprobs:
            raise ValueError("logprobs are not supported")
        return "B"

    with VlmServer(MockClient(script)) as server:
        with pytest.raises(VlmError, match="to 0 to vote on choices"):
            connect(server.url).ask(REQUESTS[:1])
        client = connect(server.url, top_logprobs=0)
        few, many = client.ask([REQUESTS[0], REQUESTS[3]])
    assert few.by == many.by == "votes" and few.probabilities.tolist() == [0, 1, 0]
    assert len(many.probabilities) == 27 and client.spent["vlm_calls"] == 5 + 5


def test_answers_are_kept_by_how_they_were_asked_for(tmp_path: Path) -> None:
    with VlmServer(MockClient()) as server:
        for options in ({}, {"image_format": "jpeg"}, {"dialect": "vllm"}):
            client = connect(server.url, cache=ReplyCache(tmp_path), **options)
            for calls in (1, 1):
                client.ask(REQUESTS[:1])
                assert client.spent["vlm_calls"] == calls


def test_a_script_that_fails_is_told_of() -> None:
    def script(call: Any) -> str:
        raise ZeroDivisionError("in the script")

    with VlmServer(MockClient(script)) as server, pytest.raises(VlmError, match="ZeroDivisionError: in the script"):
        connect(server.url, attempts=1).ask(REQUESTS[:1])


def test_no_web_page_is_answered() -> None:
    script = MockClient()
    with VlmServer(script) as server:
        page = {"Origin": "https://example.org", "Content-Type": "text/plain"}
        body = json.dumps({"messages": [{"role": "user", "content": "x"}]}).encode()
        with pytest.raises(HTTPError, match="403"):
            urlopen(HttpRequest(f"{server.url}/chat/completions", body, page), timeout=10)
        del page["Origin"]
        with urlopen(HttpRequest(f"{server.url}/chat/completions", body, page), timeout=10) as said:
            assert said.status == 200
    assert len(script.calls) == 1


def test_ports_and_addresses_that_are_none() -> None:
    with pytest.raises(ArgumentError, match=r"cannot listen at 127\.0\.0\.1 port 99999: .*choose another --port"):
        VlmServer(MockClient(), 99999)
    with pytest.raises(ArgumentError, match=r"cannot listen at 192\.0\.2\.77 port 0: .*an address of this machine"):
        VlmServer(MockClient(), host="192.0.2.77", token="secret")


@pytest.mark.usefixtures("ipv6")
def test_addresses_of_ipv6() -> None:
    with VlmServer(MockClient(), host="::1") as server:
        assert server.url.startswith("http://[::1]:")
        assert connect(server.url).model == "mock"
    with VlmServer(MockClient(), host="::", token="secret") as server:
        assert server.url.startswith("http://[::]:")
        assert connect(server.url.replace("[::]", "[::1]"), key="secret").model == "mock"


@pytest.mark.parametrize("length", ["-5", "x", ""])
def test_a_body_without_a_length_is_refused(length: str) -> None:
    with (
        VlmServer(MockClient()) as server,
        closing(HTTPConnection("127.0.0.1", int(server.url.split(":")[2][:-3]), timeout=10)) as http,
    ):
        http.putrequest("POST", "/v1/chat/completions")
        http.putheader("Content-Length", length)
        http.endheaders()
        assert http.getresponse().status == 411


@pytest.mark.parametrize(
    "sent", [b"", b"POST /v1/chat", b"POST /v1/chat/completions HTTP/1.1\r\nContent-Length: 99\r\n\r\n{"]
)
def test_a_client_that_says_no_more_is_sent_away(sent: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else each would hold a thread."""
    monkeypatch.setattr(vlm_server._Handler, "timeout", 0.2)
    with VlmServer(MockClient()) as server:
        port = int(server.url.split(":")[2][:-3])
        with closing(socket.create_connection(("127.0.0.1", port), timeout=10)) as client:
            client.sendall(sent)
            assert client.recv(1) == b""
        assert connect(server.url).model == "mock"


def test_wrong_requests_are_told_so() -> None:
    with VlmServer(MockClient()) as server:
        import openai

        sdk = openai.OpenAI(base_url=server.url, api_key="-", max_retries=0)
        image = {"type": "image_url", "image_url": {"url": "http://elsewhere/x.png"}}
        for body in (
            {"messages": [{"role": "user", "content": [image]}]},
            {"messages": [{"role": "user", "content": "x"}], "n": 2},
        ):
            with pytest.raises(openai.BadRequestError, match=r"data:image|n = 1"):
                sdk.chat.completions.create(model="mock", **body)
        said = sdk.chat.completions.create(
            model="mock", messages=[{"role": "user", "content": "x"}], logprobs=True, top_logprobs=3, max_tokens=1,
            extra_body={"structured_outputs": {"choice": ["A", "B"]}},
        )  # fmt: skip
        assert said.usage is not None and said.usage.total_tokens > 0
        assert {each.token for each in said.choices[0].logprobs.content[0].top_logprobs} == {"A", "B"}  # type: ignore[union-attr]


def test_faults_come_as_often_as_they_should_and_to_the_same_requests() -> None:
    faults = Misbehaviour({"429": 0.2, "slow": 0.1, "malformed": 0.05}, seed=1)
    drawn = [faults.fault(k) for k in range(4000)]
    for name, rate in (("429", 0.2), ("slow", 0.1), ("malformed", 0.05), (None, 0.65)):
        assert drawn.count(name) / 4000 == pytest.approx(rate, abs=0.025)
    assert set(FAULTS) > set(faults.rates)


def test_a_client_can_be_sent_to_another_process() -> None:
    client = pickle.loads(pickle.dumps(connect("http://127.0.0.1:1/v1", model="m", dialect="legacy", timeout=3.0)))
    assert (client.dialect, client.timeout, client.model) == ("legacy", 3.0, "m")
    with pytest.raises(ArgumentError, match="dialect"):
        connect("http://x", dialect="klingon")
    with pytest.raises(ArgumentError, match="above 0"):
        connect("http://x", attempts=0)


def test_the_command_names_scripts_by_their_content(tmp_path: Path) -> None:
    """Answers are kept under the model's name, so an edited script must have another one."""
    from wiw.cli.serve_vlm import _make_client

    file = tmp_path / "script.py"
    file.write_text("def answer(call):\n    return 'one'\n")
    first = _make_client(f"{file}:answer", 0, "")
    file.write_text("def answer(call):\n    return 'two'\n")
    second = _make_client(f"{file}:answer", 0, "")
    request = Request((user("Say"),))
    assert [client.ask([request])[0].text for client in (first, second)] == ["one", "two"]
    assert first.model.startswith("answer-") and first.model != second.model
    assert _make_client("mock", 0, "").model == "mock"


def test_a_server_with_a_token_answers_nobody_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "another")
    with VlmServer(MockClient(), token="secret") as server:
        told = connect(server.url, key="secret", attempts=1).ask(REQUESTS[2:3])
        assert told[0].text and server.count == 1
        for given in ({}, {"key": "secre"}, {"key": "secret2"}):
            with pytest.raises(VlmError, match="401") as error:
                connect(server.url, model="mock", attempts=1, **given).ask(REQUESTS[2:3])
            assert error.value.kind == "refused"
        with pytest.raises(VlmError, match="401"):
            connect(server.url, attempts=1).model  # noqa: B018 - asks for the list of models
        assert server.count == 1
        monkeypatch.setenv("OPENAI_API_KEY", "secret")
        assert pickle.loads(pickle.dumps(connect(server.url, key="secret"))).model == "mock"
    for token in (None, ""):  # an empty one anybody could send
        with pytest.raises(ArgumentError, match="set WIW_TOKEN"):
            VlmServer(MockClient(), host="0.0.0.0", token=token)
    monkeypatch.setenv("OPENAI_API_KEY", "another")
    with VlmServer(MockClient(), token="") as server:
        assert connect(server.url, attempts=1).model == "mock"


def test_the_command_announces_where_it_serves_and_ends_when_nobody_asks(tmp_path: Path) -> None:
    from wiw.cli import main

    found: list[Any] = []
    file = tmp_path / "server.json"

    def look() -> None:
        deadline = time.monotonic() + 60
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        client = connect(f"remote:{file}", patience=20)
        found.extend([client.model, *read_addresses(file), file.stat().st_mode & 0o777])
        for _ in range(6):  # it is not idle meanwhile
            time.sleep(0.4)
            found.append(client.ask([REQUESTS[0]])[0].problem)

    looking = threading.Thread(target=look)
    looking.start()
    arguments = ["--model", "mock", "--port", "0", "--token", "secret", "--announce", str(file), "--idle", "2"]
    before = signal.getsignal(signal.SIGTERM)
    assert main(["serve-vlm", *arguments]) == 0
    looking.join()
    model, server, mode, *problems = found
    assert (model, server.token, mode) == ("mock", "secret", 0o600) and server.address.startswith("http://127.0.0.1:")
    assert problems == [None] * 6 and not file.exists() and signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize("was_asked", [False, True])
def test_a_server_waits_for_its_first_request_longer_than_for_another_one(was_asked: bool) -> None:
    from wiw.cli.serve_vlm import _wait_for_end

    with VlmServer(MockClient()) as server:
        assert not server.was_asked
        if was_asked:
            assert connect(server.url, attempts=1).model == "mock" and server.was_asked
        begin = time.monotonic()
        _wait_for_end(server, (30.0 if was_asked else 0.8, 0.15))
        seconds = time.monotonic() - begin
        assert seconds < 20 if was_asked else seconds >= 0.8


def test_a_request_in_flight_keeps_a_server_from_being_idle() -> None:
    gate, asked = threading.Event(), threading.Event()

    def slow(call: Any) -> str:
        asked.set()
        gate.wait(20)
        return "done"

    with VlmServer(MockClient(slow)) as server, ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(connect(server.url, model="m").ask, [REQUESTS[2]])
        assert asked.wait(20)
        time.sleep(0.05)
        assert server.idle_seconds == 0
        gate.set()
        waiting.result()
        deadline = time.monotonic() + 20
        while server.idle_seconds == 0:
            assert time.monotonic() < deadline


def test_the_next_announced_server_is_asked_when_one_is_lost(tmp_path: Path) -> None:
    """Three are announced: one was killed, and the port of another one has a server with another token."""
    folder = tmp_path / "servers"
    folder.mkdir()
    with pytest.raises(VlmError, match=f"no server is announced in {folder} yet") as error:
        connect(f"remote:{folder}", patience=0, attempts=1).model  # noqa: B018
    assert error.value.kind == "unreachable"
    (folder / "0.json").write_text('{"address": "http://127.0.0.1:9/v1", "token": "killed"}')
    with VlmServer(MockClient(), token="other") as other, VlmServer(MockClient(), token="first") as first:
        (folder / "1.json").write_text(json.dumps({"address": other.url, "token": "of the killed one"}))
        with announce_server(ServerAddress(first.url, "first"), folder / "2.json"):
            client = connect(f"remote:{folder}", attempts=1)
            expected = client.ask(REQUESTS[:1])[0].text
            assert first.count == 1 and other.count == 0
            client = pickle.loads(pickle.dumps(client))
            assert client.ask(REQUESTS[:1])[0].text == expected and first.count == 2
    with VlmServer(MockClient(), token="third") as third, ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(client.ask, REQUESTS[:1])
        time.sleep(0.2)  # nobody is there yet
        assert not waiting.done()
        with announce_server(ServerAddress(third.url, "third"), folder / "2.json"):
            assert waiting.result(60)[0].text == expected and third.count == 1
    assert client.manner == f"png vllm remote:{folder}", "wherever its servers are"


def test_a_served_model_answers_as_it_does_in_the_process_that_asks(tmp_path: Path) -> None:
    """With more choices than tokens are listed, the server too tells how likely each is."""
    pytest.importorskip("torch")
    pytest.importorskip("transformers")
    from wiw.vlm.tiny import make_tiny
    from wiw.vlm.transformers import TransformersClient

    asked = [Request((user("Which?", IMAGE),), choices=tuple("abcdefghijkl"))]
    names = []
    for seed in (0, 1):
        own = TransformersClient(make_tiny(tmp_path / f"step{seed}/model", seed), device="cpu", top_logprobs=5)
        (expected,) = own.ask(asked)
        with _make_server(own, 0, "127.0.0.1", "key") as server:
            (tmp_path / "1.json").write_text(json.dumps({"address": server.url, "token": "key"}))
            served = connect(f"remote:{tmp_path}", top_logprobs=5)
            (found,) = served.ask(asked)
            assert expected.raw is not None and (expected.raw > 0).all()
            assert np.array_equal(found.raw, expected.raw)
            names.append(served.model)
    assert names[0] != names[1] and {name.partition("-")[0] for name in names} == {"model"}, "answers are kept by name"


def test_waiting_for_a_server_uses_up_no_attempts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openai_client, "GLANCE", 0.01)
    client = connect(f"remote:{tmp_path}", model="m", attempts=2)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(client.ask, REQUESTS[2:3])
        time.sleep(0.3)
        tried = (failing({"500": 0.5}, seed=seed) for seed in range(100))
        faults = next(each for each in tried if each.fault(0) and not each.fault(1))
        with MisbehavingVlmServer(MockClient(), misbehaviour=faults) as server:
            (tmp_path / "1.json").write_text(json.dumps({"address": server.url}))
            (reply,) = waiting.result(60)
    assert reply.problem is None and client.spent["vlm_retries"] == 1
    assert _Retries(waits=100_000).pause_for_server() == 0.01


def test_a_lost_server_is_passed_over_once_however_many_lose_it(tmp_path: Path) -> None:
    for name in "012":
        (tmp_path / f"{name}.json").write_text(json.dumps({"address": f"http://{name}/v1"}))
    (tmp_path / "odd.json").write_text('{"address": 5}')
    servers = Servers(f"remote:{tmp_path}", None)
    first = servers.choose()
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: servers.pass_over(first), range(200)))
    second = servers.choose()
    servers.pass_over(first)
    assert second != first and servers.choose() == second


def test_an_announced_server_is_visited_as_long_as_there_is_a_client(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(openai_client, "VISIT", 0.05)
    with VlmServer(MockClient()) as server:
        (tmp_path / "1.json").write_text(json.dumps({"address": server.url}))
        client = connect(f"remote:{tmp_path}")
        assert client.model == "mock"
        longest = 0.0
        for _ in range(100):
            time.sleep(0.01)
            longest = max(longest, server.idle_seconds)
        assert longest < 0.8
        del client
        deadline = time.monotonic() + 30
        while server.idle_seconds < 1:
            assert time.monotonic() < deadline
            gc.collect()  # more than once: a visit may hold the client just now
            time.sleep(0.05)


def test_requests_are_answered_in_the_order_in_which_they_come() -> None:
    gate, order = threading.Event(), []

    def slow(call: Any) -> str:
        gate.wait(20)
        order.append(call.messages[0].content[0])
        return "done"

    with VlmServer(MockClient(slow)) as server, ThreadPoolExecutor(20) as pool:
        client, waiting = connect(server.url, model="m"), []
        for number in range(20):
            waiting.append(pool.submit(client.ask, [Request((user(f"Say {number}"),))]))
            deadline = time.monotonic() + 20
            while server.count <= number:
                assert time.monotonic() < deadline
                time.sleep(0.002)
            time.sleep(0.01)  # it is counted just before it has its turn
        gate.set()
        wait(waiting)
    assert [text.split()[1] for text in order] == [str(number) for number in range(20)]


def test_the_key_of_a_hosted_model_is_not_sent_to_announced_servers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "mine")
    with VlmServer(MockClient(), token="mine") as server:
        assert connect(server.url, attempts=1).model == "mock"
        (tmp_path / "1.json").write_text(json.dumps({"address": server.url}))
        with pytest.raises(VlmError, match="401"):
            connect(f"remote:{tmp_path}", attempts=1, patience=0).model  # noqa: B018
