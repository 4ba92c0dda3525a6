# SPDX-License-Identifier: Apache-2.0
"""How language models' servers are reached, and what is said where they are not."""

from __future__ import annotations

import json
import socket
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("openai", reason="needs wiw[vlm]")

from wiw.errors import VlmError
from wiw.serving.vlm_server import VlmServer
from wiw.vlm import Request, connect, user
from wiw.vlm import openai as openai_client
from wiw.vlm.mock import MockClient
from wiw.wire.address_book import ServerAddress

NOWHERE = "http://127.0.0.1:9"
ASKED = [Request((user("Where?"),))]


@pytest.fixture
def proxied(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.setenv(name, NOWHERE)
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)


def find_route(client: openai_client.OpenAIClient, address: str) -> str:
    """Return "proxy" or "direct": how a client reaches an address."""
    http = client._find_sdk(ServerAddress(address, None))._client
    transport = http._transport_for_url(http.build_request("GET", address).url)
    return "direct" if transport is http._transport else "proxy"


def test_proxies_are_for_servers_elsewhere(proxied: None, tmp_path: Path) -> None:
    with VlmServer(MockClient()) as server:
        assert connect(server.url, attempts=1).ask(ASKED)[0].problem is None
    elsewhere = "http://node17:8000/v1"
    assert find_route(connect(elsewhere), elsewhere) == "proxy"
    assert find_route(connect(f"remote:{tmp_path}"), elsewhere) == "direct"


def test_a_server_that_answers_in_another_way_is_not_said_to_be_absent() -> None:
    with VlmServer(MockClient()) as server, pytest.raises(VlmError, match=r"APIConnectionError: .*SSL") as caught:
        _ = connect(server.url.replace("http://", "https://"), attempts=1).model
    assert "no server answers there" not in str(caught.value)


def test_patience_begins_when_a_server_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first one works for longer than that, then its job ends; the next one comes a moment later."""
    monkeypatch.setattr(openai_client, "GLANCE", 0.02)
    patience, file = 1.0, tmp_path / "1.json"
    with VlmServer(MockClient(), token="second") as second, socket.create_server(("127.0.0.1", 0)) as first:
        file.write_text(json.dumps({"address": f"http://127.0.0.1:{first.getsockname()[1]}/v1", "token": "first"}))

        def work() -> None:
            connection, _ = first.accept()
            connection.recv(1 << 16)
            time.sleep(1.5 * patience)
            file.unlink()
            connection.close()
            first.close()
            time.sleep(patience / 4)
            file.write_text(json.dumps({"address": second.url, "token": "second"}))

        threading.Thread(target=work, daemon=True).start()
        client = connect(f"remote:{tmp_path}", model="mock", patience=patience, attempts=1)
        assert client.ask(ASKED)[0].problem is None
    with pytest.raises(VlmError, match=r"no server|APIConnectionError"):
        connect(f"remote:{tmp_path}", model="mock", patience=0.1, attempts=1).ask(ASKED)
