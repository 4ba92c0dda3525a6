# SPDX-License-Identifier: Apache-2.0
"""Runway's service on the loopback: tasks that take a few looks to end, and videos that follow from the order."""

from __future__ import annotations

import base64
import http.server
import json
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

COST = 25
CREATED = "2026-01-01T00:00:00Z"
FRAMES = 12


class FakeRunway(http.server.ThreadingHTTPServer):
    """`orders` are the bodies that came; `plan` is what each next task goes through, the last state for ever."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.orders: list[dict[str, Any]] = []
        self.looks: list[int] = []
        self.plan = ("PENDING", "THROTTLED", "RUNNING", "SUCCEEDED")
        self.broken_videos = 0
        self.cut_videos = 0
        self.refusals: list[int] = []
        self.lock = threading.Lock()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def begin(self, order: dict[str, Any]) -> str:
        with self.lock:
            self.orders.append(order)
            self.looks.append(0)
            return str(len(self.orders) - 1)

    def state(self, task: str) -> dict[str, Any]:
        with self.lock:
            number = int(task)
            status = self.plan[min(self.looks[number], len(self.plan) - 1)]
            self.looks[number] += 1
        said: dict[str, Any] = {"id": task, "createdAt": CREATED, "status": status}
        if status in ("PENDING", "THROTTLED", "RUNNING"):
            return said | {"estimatedCost": {"credits": COST}, "progress": 0.5}
        charged = COST if status == "SUCCEEDED" else 0
        said |= {"cost": {"credits": charged}}
        if status == "SUCCEEDED":
            said |= {"output": [f"{self.url}/videos/{task}"]}
        return said | ({"failure": "it broke", "failureCode": "INTERNAL"} if status == "FAILED" else {})

    def video(self, task: str) -> bytes:
        """The ordered picture, brighter and brighter from frame to frame, and tinted by the seed."""
        order = self.orders[int(task)]
        png = base64.b64decode(order["promptImage"].partition(",")[2])
        picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "clip.mp4"
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 24, (96, 96))
            for k in range(FRAMES):
                shade = np.full((96, 96, 3), 20 * k, np.uint8)
                shade[:, :48] = cv2.resize(picture, (48, 96)) // 8 + order["seed"] % 64
                writer.write(shade)
            writer.release()
            return path.read_bytes()


class Handler(http.server.BaseHTTPRequestHandler):
    server: FakeRunway

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        if self.server.refusals:
            self._answer(self.server.refusals.pop(0), b'{"error": "no"}')
        else:
            self._answer(200, json.dumps({"id": self.server.begin(body)}).encode())

    def do_GET(self) -> None:
        kind, _, task = self.path.strip("/").removeprefix("v1/").partition("/")
        if kind == "tasks":
            self._answer(200, json.dumps(self.server.state(task)).encode())
        elif self.server.broken_videos:
            self.server.broken_videos -= 1
            self._answer(200, b"no video", "video/mp4")
        elif self.server.cut_videos:
            self.server.cut_videos -= 1
            self._answer(200, self.server.video(task), "video/mp4", lost=16)
        else:
            self._answer(200, self.server.video(task), "video/mp4")

    def _answer(self, status: int, content: bytes, kind: str = "application/json", lost: int = 0) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content[: len(content) - lost])

    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def serving() -> Iterator[FakeRunway]:
    """The service, while the block runs."""
    with FakeRunway() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()
