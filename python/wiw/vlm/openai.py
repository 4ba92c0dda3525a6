# SPDX-License-Identifier: Apache-2.0
"""Any server that speaks OpenAI's chat completions: vLLM, SGLang, hosted models, `wiw serve-vlm`."""

from __future__ import annotations

import email.utils
import json
import random
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, as_completed, wait
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from threading import Thread
from typing import Any, Literal
from urllib.parse import urlsplit, urlunsplit
from weakref import ref

from wiw.errors import ArgumentError, DependencyError, VlmError
from wiw.vlm.base import Client
from wiw.vlm.images import ImageFormat, to_data_uri
from wiw.vlm.messages import Call, Completion, Message
from wiw.vlm.servers import UNKNOWN_TOKEN, Servers
from wiw.wire.address_book import ServerAddress
from wiw.wire.loopback import is_loopback

Dialect = Literal["openai", "reasoning", "vllm", "legacy"]
DIALECTS = ("openai", "reasoning", "vllm", "legacy")
MOST_BYTES = 4 << 20
"""Maximum size of a reply's body in bytes; what goes beyond is not read."""
MOST_OF_AN_ERROR = 1 << 16
"""Bytes of an error's body that are read."""
LONGEST_WAIT = 60.0
"""Maximum wait in seconds before a request is sent again, whatever the server demands."""
GLANCE, VISIT = 5.0, 300.0
"""Seconds between two looks whether a server has been announced, at most, and between two visits that keep it up."""
REFUSED_LOGPROBS = (
    "; set top_logprobs= to the number of first tokens that the server lists, or to 0 to vote on choices instead"
)
OPENAI_HOST = "api.openai.com"
"""The only host that is told `$OPENAI_ORG_ID` and `$OPENAI_PROJECT_ID`."""
QUOTA_WAIT = 8.0
"""Seconds before a request is sent again for which there was no quota; doubled each time, as quotas are per minute."""
REFUSED_SAMPLING = (
    "; set dialect=reasoning for a model that thinks first: it sends max_completion_tokens, no temperature"
)
NOBODY_THERE = (
    ": no server answers there; start one (docs/vlm.md), give another with --vlm URL, or use --vlm mock for a dry run "
    "without a model"
)
NO_PROXY = {"http://": None, "https://": None}
"""Routes of the transport past the proxies that the environment names, to servers on this machine or cluster."""
NONE_ANNOUNCED = "; start one (`wiw serve-vlm --announce`), or submit the run again"
BROKEN = ("abort", "error", "cancelled")
"""Ends of a completion that the server broke off."""
_NO_QUOTA = 429
_PASSING = (408, 409, 425, _NO_QUOTA)
"""Client errors that may pass; so may all of the server's, 500 and above."""


class OpenAIClient(Client):
    """Asks a server over HTTP.

    Args:
        base_url: such as "http://localhost:8000/v1"; or "remote:FOLDER", where servers of one model announce
            themselves (`wiw.vlm.servers`).
        model: its name there; None means the only one that the server offers.
        dialect: how choices and schemas are sent beside the prompt; None means "openai", but "vllm" for announced
            servers, as `wiw serve-vlm` understands it. "openai": `response_format`; "reasoning": the same,
            for hosted models that think first: the limit is `max_completion_tokens`, and no temperature is sent;
            "vllm": `structured_outputs` too, for choices; "legacy": `guided_choice` and `guided_json` (vLLM before
            0.12).
        thinking_tokens: how many tokens a model of dialect "reasoning" may think with, beside those of its answer.
        concurrency: maximum number of requests at a time.
        timeout: seconds that one request may take; None means 120, or for announced servers, at which many may wait,
            600.
        attempts: times that it is sent in all while the server is busy or fails; how long it asks to wait is heeded.
        patience: seconds for which it is sent again after announced servers have been lost, as weights are loaded.
        image_format: "png", or "jpeg" for slow connections.
        key: the server's; None means `$OPENAI_API_KEY`. Announced servers announce their own.
        options: see `Client`.

    Raises:
        ArgumentError: an option out of range, or an address with a user or password, which would be recorded.
    """

    def __init__(
        self,
        base_url: str,
        model: str | None = None,
        *,
        dialect: Dialect | None = None,
        thinking_tokens: int = 8192,
        concurrency: int = 8,
        timeout: float | None = None,
        attempts: int = 4,
        patience: float = 270.0,
        image_format: ImageFormat = "png",
        key: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        _refuse_credentials(base_url)
        self._servers = Servers(base_url, key)
        shared = self._servers.are_announced
        dialect = ("vllm" if shared else "openai") if dialect is None else dialect
        timeout = (600.0 if shared else 120.0) if timeout is None else timeout
        if dialect not in DIALECTS or image_format not in ("png", "jpeg"):
            raise ArgumentError(
                f"vlm: expected dialect {', '.join(DIALECTS)}, image_format png or jpeg, got {dialect}, {image_format}"
            )
        if concurrency < 1 or attempts < 1 or not timeout > 0 or not patience >= 0 or thinking_tokens < 0:
            raise ArgumentError(
                "vlm: expected concurrency, attempts and timeout above 0, and thinking_tokens and patience of 0 or "
                f"more, got {concurrency}, {attempts}, {timeout}, {thinking_tokens} and {patience}"
            )
        self.base_url, self.dialect, self.image_format = base_url, dialect, image_format
        self.thinking_tokens = thinking_tokens
        self.concurrency, self.timeout, self.attempts = concurrency, timeout, attempts
        self.patience = patience if shared else 0.0
        self._model = model
        self._sdks: dict[ServerAddress, Any] = {}
        self._given: dict[str, Any] = {
            "model": model,
            "dialect": dialect,
            "thinking_tokens": thinking_tokens,
            "concurrency": concurrency,
            "key": key,
        }
        self._given |= {"timeout": timeout, "attempts": attempts, "patience": patience, "image_format": image_format}
        self._given |= options

    def __reduce__(self) -> Any:
        return _rebuild_client, (self.base_url, self._given)

    @property
    def model(self) -> str:
        """The model's name at the server; asked for once where it was not given.

        Raises:
            VlmError: the server cannot be reached, or offers none or several.
        """
        if self._model is None:
            names = [str(each.id) for each in self._ask_with_retries(lambda sdk: list(sdk.models.list()))]
            if len(names) != 1:
                raise VlmError(
                    f"{self.base_url} offers {', '.join(names) or 'no models'}; choose one with model=", "refused"
                )
            self._model = names[0]
        return self._model

    @property
    def manner(self) -> str:
        """The images' format, what constrains the answer, and the server: others may have another model of its name."""
        thinking = f" {self.thinking_tokens}" if self.dialect == "reasoning" else ""
        return f"{self.image_format} {self.dialect}{thinking} {self.base_url}"

    def complete(self, calls: Sequence[Call]) -> list[Completion]:
        """All calls, at most `concurrency` at a time."""
        found = dict(self.iterate_completions(calls))
        return [found[place] for place in range(len(calls))]

    def iterate_completions(self, calls: Sequence[Call]) -> Iterator[tuple[int, Completion]]:
        """Yield the place of each call with its completion, as they arrive.

        After an error, requests that were not sent are dropped, and those in flight are waited for: they have their
        price, too. After an interruption, such as Ctrl-C, nothing is waited for or sent again.
        """
        bodies = self._make_bodies(calls)
        stopped: Future[None] = Future()
        pool = ThreadPoolExecutor(min(self.concurrency, len(bodies)))
        try:
            sent = {pool.submit(self._request_completion, body, stopped): place for place, body in enumerate(bodies)}
            yield from _iterate_results(sent)
        finally:
            stopped.set_result(None)
            pool.shutdown(wait=False, cancel_futures=True)

    def _make_bodies(self, calls: Sequence[Call]) -> list[dict[str, Any]]:
        """Return the bodies of requests; an image that several calls show is encoded once."""
        images: dict[int, str] = {}
        for call in calls:
            for message in call.messages:
                for part in message.content:
                    if not isinstance(part, str) and id(part) not in images:
                        images[id(part)] = to_data_uri(part, self.image_format)
        return [self._body(call, images) for call in calls]

    def _find_sdk(self, server: ServerAddress) -> Any:
        """Return the SDK's client of a server."""
        if server not in self._sdks:
            if self._servers.are_announced and not self._sdks:
                Thread(target=_keep_server, args=(ref(self),), daemon=True, name="wiw vlm server").start()
            self._sdks[server] = self._make_sdk(server)
        return self._sdks[server]

    def _make_sdk(self, server: ServerAddress) -> Any:
        try:
            import openai
        except ImportError:
            raise DependencyError("OpenAI-compatible servers need openai: pip install 'wiw[vlm]'") from None
        import os

        hosted = None if self._servers.are_announced else os.environ.get("OPENAI_API_KEY")
        key = server.token or hosted or "none"
        direct = self._servers.are_announced or is_loopback(urlsplit(server.address).hostname or "")
        routes: dict[str, Any] = {"mounts": dict(NO_PROXY)} if direct else {}
        http = openai.DefaultHttpxClient(event_hooks={"response": [self._cut_off]}, **routes)
        sdk = openai.OpenAI(base_url=server.address, api_key=key, timeout=self.timeout, max_retries=0, http_client=http)
        if sdk.base_url.host != OPENAI_HOST:  # what the SDK reads from the environment is no business of others
            sdk.organization = sdk.project = None
        return sdk

    def _cut_off(self, response: Any) -> None:
        """Truncate the body of an error, which the SDK would read whole."""
        if response.is_error:
            response.stream = _begin(response, self.timeout / 4)

    def _body(self, call: Call, images: dict[int, str]) -> dict[str, Any]:
        body: dict[str, Any] = {
            "model": self.model,
            "messages": [_message(message, images) for message in call.messages],
            "seed": call.seed,
        }
        if self.dialect == "reasoning":
            body["max_completion_tokens"] = call.max_tokens + self.thinking_tokens
        else:
            body |= {"temperature": call.temperature, "max_tokens": call.max_tokens}
        if call.logprobs:
            body |= {"logprobs": True, "top_logprobs": call.logprobs}
        extra: dict[str, Any] = {}
        if call.labels and self.dialect in ("vllm", "legacy"):
            choice = list(call.labels)
            extra = (
                {"guided_choice": choice} if self.dialect == "legacy" else {"structured_outputs": {"choice": choice}}
            )
        if call.schema is not None and self.dialect == "legacy":
            extra = {"guided_json": call.schema}
        elif call.schema is not None:
            schema = {"name": "answer", "schema": call.schema, "strict": True}
            body["response_format"] = {"type": "json_schema", "json_schema": schema}
        return {**body, "extra_body": extra} if extra else body

    def _request_completion(self, body: dict[str, Any], stopped: Future[None]) -> Completion:
        retries = _Retries()
        completion = self._ask_with_retries(lambda sdk: self._receive_completion(sdk, body), retries, stopped)
        return replace(completion, retries=retries.count)

    def _receive_completion(self, sdk: Any, body: dict[str, Any]) -> Completion:
        """Send one request; read the body piece by piece, with limits on length and time."""
        until = time.monotonic() + self.timeout
        data = bytearray()
        with sdk.chat.completions.with_streaming_response.create(**body) as response:
            for piece in _iterate_body(response):
                data += piece
                if len(data) > MOST_BYTES:
                    return Completion(data[:1000].decode("utf-8", "replace"), "huge")
                if time.monotonic() > until:
                    raise TimeoutError(f"the reply was not complete within {self.timeout:g} s")
        return _completion(bytes(data))

    def _ask_with_retries(self, work: Any, retries: _Retries | None = None, stopped: Future[None] | None = None) -> Any:
        """Call the server, with retries for errors that may pass, until it is stopped.

        Raises:
            VlmError: all `attempts` failed, or the server refused the request.
            CancelledError: it was stopped.
        """
        import openai

        retries, stopped = retries or _Retries(), stopped or Future()
        lost: float | None = None
        while True:
            server = None
            try:
                server = self._servers.choose()
                return _run_within(self.timeout, partial(work, self._find_sdk(server)), stopped)
            except (openai.APIError, ConnectionError, TimeoutError, _NoCompletionError, _BrokenOffError) as error:
                failure = self._read_failure(error, retries)
            if server is not None and failure.kind in ("unreachable", "timeout"):
                self._servers.pass_over(server)
            lost = None if failure.kind != "unreachable" else time.monotonic() if lost is None else lost
            may_return = lost is not None and time.monotonic() < lost + self.patience
            if not failure.is_passing or (retries.count + 1 >= self.attempts and not may_return):
                raise self._make_error(failure, retries)
            pause = retries.pause_for_server() if may_return else max(failure.pause or 0.0, retries.pause())
            if wait([stopped], min(LONGEST_WAIT, pause)).done:
                raise CancelledError
            if may_return:
                retries.waits += 1
            else:
                retries.count += 1

    def _read_failure(self, error: Exception, retries: _Retries) -> _Failure:
        """Return what an error says of the server."""
        import openai

        if isinstance(error, openai.APIStatusError):
            said = f"{error.status_code} {_shorten(error)}"
            if self._servers.are_announced and error.status_code in UNKNOWN_TOKEN:
                return _Failure("unreachable", said)
            pause = _read_retry_after(error)
            if pause is None and error.status_code == _NO_QUOTA:
                pause = retries.pause_for_quota()
            is_passing = error.status_code in _PASSING or error.status_code >= 500
            return _Failure("status" if is_passing else "refused", said, pause, is_passing)
        if isinstance(error, openai.APITimeoutError | TimeoutError):
            return _Failure("timeout", _shorten(error) or f"no answer within {self.timeout:g} s")
        if isinstance(error, openai.APIError):
            cause = f" ({_shorten(error.__cause__)})" if error.__cause__ else ""
            hint = NOBODY_THERE if _is_nobody_there(error) else ""
            return _Failure("unreachable", f"{type(error).__name__}: {_shorten(error)}{cause}", hint=hint)
        return _Failure("protocol" if isinstance(error, _NoCompletionError) else "unreachable", _shorten(error))

    def _make_error(self, failure: _Failure, retries: _Retries) -> VlmError:
        times = f"{retries.count + 1} tries" if retries.count else "1 try"
        hint = _explain_refusal(failure.said) if failure.kind == "refused" else failure.hint
        hint = NONE_ANNOUNCED if failure.said.startswith("no server is announced") else hint
        return VlmError(f"{self.base_url}: {failure.said} ({times}){hint}", failure.kind)


def _keep_server(client: ref[OpenAIClient]) -> None:
    """Ask an announced server for its models from time to time, so that it is not idle while a client is alive."""
    while True:
        time.sleep(VISIT)
        asking = client()
        if asking is None:
            return
        with suppress(Exception):  # another one will be looked for when there is a question
            asking._find_sdk(asking._servers.choose()).models.list()
        del asking


def _explain_refusal(said: str) -> str:
    """Return what to do about a request that was refused, by what the server says of it; empty if that is unknown."""
    if "logprob" in said:
        return REFUSED_LOGPROBS
    return REFUSED_SAMPLING if "max_tokens" in said or "temperature" in said else ""


def _iterate_results(sent: Mapping[Future[Completion], int]) -> Iterator[tuple[int, Completion]]:
    """Yield the place and result of each piece of work as it ends; after an error, of those that have begun.

    Raises the first error at the end.
    """
    failure: BaseException | None = None
    for each in as_completed(sent):
        if each.cancelled():
            continue
        error = each.exception()
        if error is None:
            yield sent[each], each.result()
        elif failure is None:
            failure = error
            for other in sent:
                other.cancel()
    if failure is not None:
        raise failure


def _run_within(seconds: float, work: Callable[[], Any], stopped: Future[None]) -> Any:
    """Do the work in a separate thread, which is abandoned after `seconds`, or once it is stopped.

    The transport limits each read but not their sum, so headers that drip in would take any time.

    Raises:
        TimeoutError: it took longer; and whatever the work raises.
        CancelledError: it was stopped.
    """
    outcome: Future[Any] = Future()

    def run() -> None:
        try:
            outcome.set_result(work())
        except BaseException as error:
            outcome.set_exception(error)

    Thread(target=run, daemon=True, name="wiw vlm request").start()
    if stopped in wait([outcome, stopped], seconds, FIRST_COMPLETED).done:
        raise CancelledError
    if not outcome.done():
        raise TimeoutError(f"the reply was not complete within {seconds:g} s")
    return outcome.result()


@dataclass(frozen=True)
class _Failure:
    """A failed attempt of a request."""

    kind: str
    """As of `VlmError`."""
    said: str
    pause: float | None = None
    """Seconds that the server asks to wait."""
    is_passing: bool = True
    """Whether it may succeed if it is sent again."""
    hint: str = ""
    """Remedy, for the message."""


@dataclass
class _Retries:
    """The number of failed attempts of a request."""

    count: int = 0
    waits: int = 0
    """Attempts while no announced server could be reached, which are not counted."""

    def pause(self) -> float:
        """Return the seconds to wait: doubling from a half, with jitter."""
        return float(0.5 * 2**self.count * (0.75 + 0.5 * random.random()))

    def pause_for_server(self) -> float:
        """Return the seconds until the announcements are looked at again."""
        return min(GLANCE, 0.5 * 2 ** min(self.waits, 16))

    def pause_for_quota(self) -> float:
        """Return the seconds to wait where the server has no quota left and does not say for how long."""
        return float(QUOTA_WAIT * 2**self.count * (0.75 + 0.5 * random.random()))


class _NoCompletionError(Exception):
    """A reply that is not a chat completion."""


class _BrokenOffError(Exception):
    """A connection that ended before the reply did."""


def _iterate_body(response: Any) -> Iterator[bytes]:
    """Yield the body in pieces; the transport's errors, which have private classes, become `_BrokenOffError`."""
    try:
        yield from response.iter_bytes()
    except Exception as error:
        raise _BrokenOffError(f"{type(error).__name__}: {error}") from error


def _begin(response: Any, seconds: float) -> Any:
    """Return a response's stream that ends after some bytes or some time."""
    transport: Any = import_module(type(response).__module__.partition(".")[0])  # httpx, or what the SDK has instead
    stream = response.stream

    class Begin(transport.SyncByteStream):
        def __iter__(self) -> Iterator[bytes]:
            until, count = time.monotonic() + seconds, 0
            for piece in stream:
                yield piece
                count += len(piece)
                if count > MOST_OF_AN_ERROR or time.monotonic() > until:
                    return

        def close(self) -> None:
            stream.close()

    return Begin()


def _refuse_credentials(base_url: str) -> None:
    """Check that an address has no user and password, which records and reports would show."""
    address = urlsplit(base_url)
    if address.username is not None or address.password is not None:
        host = address.netloc.rpartition("@")[2]
        raise ArgumentError(
            f"vlm: expected an address without user and password, got one with them for {host}; addresses are "
            f"recorded, so give {urlunsplit(address._replace(netloc=host))}, and the key as $OPENAI_API_KEY or key="
        )


def _rebuild_client(base_url: str, options: dict[str, Any]) -> OpenAIClient:
    return OpenAIClient(base_url, **options)


def _is_nobody_there(error: BaseException | None) -> bool:
    """Return whether a connection was refused, or a host is not known, rather than that something is wrong with it."""
    while error is not None and not isinstance(error, ConnectionRefusedError | socket.gaierror):
        error = error.__cause__ or error.__context__
    return error is not None


def _shorten(error: BaseException) -> str:
    return " ".join(str(error).split())[:300]


def _read_retry_after(error: Any) -> float | None:
    """Return the seconds of the header `Retry-After`, which is a number or a date."""
    value = error.response.headers.get("retry-after")
    if value is None:
        return None
    try:
        return max(0.0, float(value))
    except ValueError:
        when = email.utils.parsedate_tz(value)
    try:
        return None if when is None else max(0.0, email.utils.mktime_tz(when) - time.time())
    except (ValueError, OverflowError):  # no such date
        return None


def _message(message: Message, images: dict[int, str]) -> dict[str, Any]:
    parts = [
        {"type": "text", "text": part.encode("utf-8", "replace").decode()}
        if isinstance(part, str)
        else {"type": "image_url", "image_url": {"url": images[id(part)]}}
        for part in message.content
    ]
    return {"role": message.role, "content": parts}


def _completion(data: bytes) -> Completion:
    """Parse a chat completion; raise _NoCompletionError for anything else."""
    try:
        body = json.loads(data)
        choice = body["choices"][0]
        message, usage = choice["message"], body.get("usage") or {}
        refusal, text = message.get("refusal"), _join_text(message.get("content"))
        finish = "refusal" if refusal else _read_finish(choice)
        return Completion(
            _clean(str(refusal) if refusal else text),
            finish,
            _first_token(choice.get("logprobs")),
            _tokens(usage.get("prompt_tokens")),
            _tokens(usage.get("completion_tokens")),
        )
    except (ValueError, OverflowError, KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
        begin = data[:300].decode("utf-8", "replace")
        raise _NoCompletionError(f"expected a chat completion, got '{begin}' ({type(error).__name__})") from None


def _join_text(content: Any) -> str:
    """Return a message's text, which some servers give in parts."""
    if isinstance(content, list):
        return "".join(str(part.get("text") or "") for part in content if isinstance(part, dict))
    return content if isinstance(content, str) else ""


def _read_finish(choice: Mapping[str, Any]) -> str:
    """Return why a completion ended.

    Raises:
        _NoCompletionError: it was broken off by the server, which is no answer of the model.
    """
    reason = choice.get("finish_reason")
    reason = str((reason.get("type") if isinstance(reason, dict) else reason) or "stop")
    if reason in BROKEN or choice.get("error"):
        raise _NoCompletionError(f"the server broke the completion off: {choice.get('error') or reason}")
    return reason


def _tokens(count: Any) -> int:
    """Return a token count; 0 where the server gives none."""
    if not 0 <= int(count or 0) < 2**31:
        raise ValueError(f"{count} tokens")
    return int(count or 0)


def _clean(text: str) -> str:
    """Return the text without lone surrogates, so that it can be encoded."""
    return text.encode("utf-8", "replace").decode()


def _first_token(logprobs: Any) -> tuple[tuple[str, float], ...] | None:
    """Return the likeliest first tokens; None if the server lists none."""
    tokens = (logprobs or {}).get("content") or []
    listed = tokens[0].get("top_logprobs") or [] if tokens else []
    pairs = tuple((_clean(str(each["token"])), float(each["logprob"])) for each in listed)
    return pairs or None
