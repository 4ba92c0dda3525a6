# SPDX-License-Identifier: Apache-2.0
"""A small OpenAI-compatible server of chat completions, with any `Client` behind it.

It speaks log-probabilities, images as data URIs, JSON schemas, choices and usage, as far as `wiw` and its tests use
them.
"""

from __future__ import annotations

import hmac
import json
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from typing import Any

from wiw.errors import ArgumentError, Error
from wiw.vlm.base import Client
from wiw.vlm.images import from_data_uri
from wiw.vlm.messages import Call, Completion, Message, Part
from wiw.wire.loopback import is_loopback

MOST_BYTES = 256 << 20
"""Maximum size of a request's body in bytes."""
UNHEARD = 60.0
"""Seconds for which a client may send nothing, or take nothing of its answer, before it is disconnected."""
UNCLEAR = (Error, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError)
"""Error for a request that makes no sense; anything else is a fault of the model or script behind the server."""


@dataclass(frozen=True)
class Response:
    """The answer to a request."""

    status: int
    body: Mapping[str, Any]
    headers: Mapping[str, str] = field(default_factory=dict)


class ClientGoneError(Exception):
    """The client of a request has hung up: nobody would read the answer."""


class ModelFaultError(Exception):
    """An error of the model or script behind the server, for which the request is not to blame."""


class VlmServer:
    """Serves from `start` to `stop`; works as a context manager.

    Args:
        client: answers the completions.
        port: 0 takes a free one; see `url`.
        host: address to listen on.
        token: secret that clients must send, as OpenAI's API key; required unless `host` is a loopback address.
        model: name under which the model is served; None means the client's.

    Raises:
        ArgumentError: it cannot listen there, or others than this machine could ask it without a token.
    """

    def __init__(
        self, client: Client, port: int = 0, host: str = "127.0.0.1", token: str | None = None, model: str | None = None
    ) -> None:
        if not token and not is_loopback(host):
            raise ArgumentError(
                f"serve-vlm: {host} can be reached from other machines: set WIW_TOKEN (or --token) to a secret that "
                "clients send as OPENAI_API_KEY, such as the output of `openssl rand -hex 16`"
            )
        self.client, self.token = client, token or None  # an empty one is none: anybody could send it
        self.model = client.model if model is None else model
        self.requests: list[dict[str, Any]] = []
        """Bodies of the latest 1000 requests, without their images' data."""
        self.count = 0
        self.was_asked = False
        """Whether there has been any request."""
        self.serving = threading.local()
        """Its `connection` is the socket of the request that this thread serves."""
        self._asking, self._counting = _Queue(), threading.Lock()
        self._in_flight, self._last_end = 0, time.monotonic()
        try:
            self._http = _Http((host, port), _Handler)
        except (OSError, OverflowError) as error:
            raise ArgumentError(
                f"serve-vlm: cannot listen at {host} port {port}: {error}; choose another --port (0 takes a free one), "
                "or an address of this machine as --host"
            ) from None
        self._host = host
        self._http.server = self

    @property
    def url(self) -> str:
        """Address for clients, as in "http://127.0.0.1:8000/v1"."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"http://{host}:{self._http.server_address[1]}/v1"

    @property
    def idle_seconds(self) -> float:
        """Time since the last request; 0 while there is one."""
        with self._counting:
            return 0.0 if self._in_flight else time.monotonic() - self._last_end

    def start(self) -> VlmServer:
        """Serve in a thread."""
        threading.Thread(target=self._http.serve_forever, args=(0.05,), daemon=True, name="wiw serve-vlm").start()
        return self

    def stop(self) -> None:
        """End serving."""
        self._http.shutdown()
        self._http.server_close()

    def __enter__(self) -> VlmServer:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def respond(self, body: dict[str, Any], number: int) -> Response:
        """Answer one request.

        Raises:
            Error: the request cannot be understood.
        """
        return Response(200, make_chat_completion(self.complete(body), self.model, number))

    def complete(self, body: dict[str, Any]) -> Completion:
        """Return the completion of a request.

        Raises:
            ClientGoneError: the client hung up while others had their turn.
            ModelFaultError: the model or script raised an error with which it does not refuse the request.
        """
        call = parse_call(body)
        with self._asking:
            if _has_hung_up(getattr(self.serving, "connection", None)):
                raise ClientGoneError
            try:
                (completion,) = self.client.complete([call])
            except (Error, ValueError):  # with which models and scripts refuse a request
                raise
            except Exception as error:
                raise ModelFaultError(f"{type(error).__name__}: {error}") from error
        return completion

    @contextmanager
    def attend(self) -> Iterator[None]:
        """Count a request as in flight as long as the context lasts."""
        with self._counting:
            self._in_flight, self.was_asked = self._in_flight + 1, True
        try:
            yield
        finally:
            with self._counting:
                self._in_flight, self._last_end = self._in_flight - 1, time.monotonic()

    def count_request(self, body: dict[str, Any]) -> int:
        """Number a request and keep it."""
        with self._counting:
            self.requests = [*self.requests[-999:], _without_images(body)]
            self.count += 1
            return self.count - 1


class _Queue:
    """A lock that threads get in the order in which they come."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._tickets, self._turn = count(), 0

    def __enter__(self) -> None:
        with self._changed:
            own = next(self._tickets)
            self._changed.wait_for(lambda: self._turn == own)

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._turn += 1
            self._changed.notify_all()


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    server: VlmServer

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        super().__init__(address, handler)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version = "wiw"
    timeout = UNHEARD  # of the connection: its thread ends

    def log_message(self, *_: Any) -> None:
        """Log nothing: the server is asked thousands of times."""

    def do_GET(self) -> None:
        server: VlmServer = self.server.server  # type: ignore[attr-defined]
        if not self._is_welcome(server.token):
            return
        with server.attend():
            if self.path.rstrip("/") == "/v1/models":
                models = [{"id": server.model, "object": "model", "created": 0, "owned_by": "wiw"}]
                self._send(200, {"object": "list", "data": models})
            elif self.path == "/health":
                self._send(200, {})
            else:
                self._send(404, _error(f"no such path: {self.path}"))

    def do_POST(self) -> None:
        server: VlmServer = self.server.server  # type: ignore[attr-defined]
        if self.headers.get("origin"):  # a browser names the page that asks; no page has business here
            self.close_connection = True
            self._send(403, _error("requests from web pages are refused"))
            return
        if not self._is_welcome(server.token):
            return
        declared = self.headers.get("content-length", "")
        if not declared.isdecimal():
            self.close_connection = True
            self._send(411, _error("expected a body with its content-length"))
            return
        length = int(declared)
        if self.path.rstrip("/") != "/v1/chat/completions" or length > MOST_BYTES:
            self.close_connection = True
            self._send(404 if length <= MOST_BYTES else 413, _error(f"{self.path}: {length} bytes"))
            return
        try:
            data = self.rfile.read(length)
        except TimeoutError:
            self.close_connection = True
            return
        try:
            body = json.loads(data)
            server.serving.connection = self.connection
            with server.attend():
                response = server.respond(body, server.count_request(body))
            self._send(response.status, response.body, response.headers)
        except ClientGoneError:
            self.close_connection = True
        except Exception as error:
            self._send(400 if isinstance(error, UNCLEAR) else 500, _error(f"{type(error).__name__}: {error}"))

    def _is_welcome(self, token: str | None) -> bool:
        """Return whether a client has sent the server's secret, if it has one; refuse it otherwise."""
        shown = self.headers.get("authorization", "").encode("latin-1", "replace")
        if token is None or hmac.compare_digest(shown, f"Bearer {token}".encode()):
            return True
        self.close_connection = True
        self._send(401, _error("expected the server's token as API key"))
        return False

    def _send(self, status: int, body: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> None:
        data = json.dumps(body).encode()
        try:
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(data)))
            for name, value in (headers or {}).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(data)
        except (BrokenPipeError, ConnectionResetError, TimeoutError):  # the client has had enough
            self.close_connection = True


def _has_hung_up(connection: socket.socket | None) -> bool:
    """Return whether the other end of a connection is closed; False where there is none to look at."""
    if connection is None:
        return False
    patience = connection.gettimeout()
    connection.settimeout(0)  # with any other, Python waits for data, whatever the flags
    try:
        return not connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    except OSError:
        return True
    finally:
        connection.settimeout(patience)


def parse_call(body: Mapping[str, Any]) -> Call:
    """Return the call of a request.

    Raises:
        ArgumentError: an image that is not a data URI, or several completions at once.
        KeyError: no messages.
    """
    if int(body.get("n") or 1) != 1 or body.get("stream"):
        raise ArgumentError("expected n = 1 and no streaming")
    outputs = body.get("structured_outputs") or {}
    labels = outputs.get("choice") or body.get("guided_choice") or ()
    wanted = body.get("response_format") or {}
    schema = (wanted.get("json_schema") or {}).get("schema") or outputs.get("json") or body.get("guided_json")
    return Call(
        messages=tuple(Message(each["role"], _parts(each["content"])) for each in body["messages"]),
        temperature=float(body.get("temperature") or 0.0),
        seed=int(body.get("seed") or 0),
        max_tokens=int(body.get("max_tokens") or body.get("max_completion_tokens") or 256),
        labels=tuple(str(label) for label in labels),
        logprobs=int(body.get("top_logprobs") or 0) if body.get("logprobs") else 0,
        schema=schema,
    )


def _parts(content: Any) -> tuple[Part, ...]:
    if isinstance(content, str):
        return (content,)
    return tuple(
        str(part["text"]) if part["type"] == "text" else from_data_uri(part["image_url"]["url"]) for part in content
    )


def _without_images(body: dict[str, Any]) -> dict[str, Any]:
    return {
        **body,
        "messages": [
            {
                **each,
                "content": each["content"]
                if isinstance(each["content"], str)
                else [part if part["type"] == "text" else {"type": "image_url"} for part in each["content"]],
            }
            for each in body["messages"]
        ],
    }


def make_chat_completion(completion: Completion, model: str, number: int) -> dict[str, Any]:
    refused = completion.finish == "refusal"
    message = {
        "role": "assistant",
        "content": None if refused else completion.text,
        "refusal": completion.text if refused else None,
    }
    choice: dict[str, Any] = {
        "index": 0,
        "message": message,
        "finish_reason": "content_filter" if refused else completion.finish,
        "logprobs": None,
    }
    if completion.logprobs is not None:
        listed = [{"token": token, "logprob": value, "bytes": None} for token, value in completion.logprobs]
        choice["logprobs"] = {"content": [{**listed[0], "top_logprobs": listed}]} if listed else {"content": []}
    tokens = completion.prompt_tokens, completion.completion_tokens
    return {
        "id": f"chatcmpl-{number}",
        "object": "chat.completion",
        "created": int(time.time()),
        "model": model,
        "choices": [choice],
        "usage": {"prompt_tokens": tokens[0], "completion_tokens": tokens[1], "total_tokens": sum(tokens)},
    }


def _error(message: str) -> dict[str, Any]:
    return {"error": {"message": message, "type": "invalid_request_error", "code": None}}
