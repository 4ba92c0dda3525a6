# SPDX-License-Identifier: Apache-2.0
"""Detectors and segmenters: what the interfaces promise, the simulator's truth, and a detector behind HTTP."""

from __future__ import annotations

import contextlib
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from http.server import BaseHTTPRequestHandler, HTTPServer
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from locations import ROOT

from wiw.errors import ArgumentError, ContractError, RemoteError
from wiw.perception.boxes import find_box
from wiw.perception.detection import Detections, Detector, compute_iou, suppress_duplicates
from wiw.perception.segmentation import Segmenter
from wiw.perception.semantics import (
    CATEGORIES,
    OTHER_CATEGORY,
    TrueSemantics,
    find_category_id,
    read_semantic_categories,
)
from wiw.perception.simulator import read_categories
from wiw.registry import DETECTORS, SEGMENTERS, SEMANTICS

IMAGES = np.zeros((2, 20, 30, 3), np.uint8)
IDS = np.zeros((2, 20, 30), np.uint32)
IDS[0, 2:8, 3:9], IDS[0, 10:12, 20:30], IDS[1, 0:5, 0:30] = 1, 2, 3
THINGS = {1: "chair", 2: "Coffee_Table", 3: "chair", 4: "sofa"}


class Fixed(Detector):
    """Answers every image with the same detections."""

    def __init__(self, boxes: Any, scores: Any, labels: Sequence[str]) -> None:
        self.answer = Detections(np.array(boxes, np.float32), np.array(scores, np.float32), tuple(labels))

    def find(self, images: Any, names: Any, ids: Any) -> list[Detections]:
        return [self.answer for _ in images]


def test_boxes_are_cut_at_the_image_and_sorted() -> None:
    detector = Fixed([[-5, 2, 10, 40], [3, 3, 3, 9], [40, 0, 50, 9], [1, 1, 5, 5]], [0.2, 0.9, 0.8, 0.5], "abab")
    for found in detector.detect(IMAGES, ["a", "b"]):
        np.testing.assert_array_equal(found.boxes, [[1, 1, 5, 5], [0, 2, 10, 20]])
        np.testing.assert_allclose(found.scores, [0.5, 0.2])
        assert found.labels == ("b", "a")
    assert [len(found) for found in detector.detect(IMAGES, [])] == [0, 0]
    assert detector.detect([], ["a"]) == []


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (([[0, 0, 1, 1]], [0.5], ["chair"]), "expected boxes"),
        (([[0, 0, 1, 1]], [0.5, 0.5], ["a"]), "expected boxes"),
        (([[0, 0, 1]], [0.5], ["a"]), "expected boxes"),
        (([[0, 0, np.nan, 1]], [0.5], ["a"]), "not finite"),
    ],
)
def test_answers_that_break_the_contract_are_named(answer: Any, reason: str) -> None:
    with pytest.raises(ContractError, match=reason):
        Fixed(*answer).detect(IMAGES, ["a"])


@pytest.mark.parametrize(
    ("images", "names", "message"),
    [
        (IMAGES[0], ["a"], "uint8 \\[H, W, 3\\]"),
        (IMAGES.astype(float), ["a"], "float64"),
        (IMAGES, ["a", "a"], "distinct, non-empty names"),
        (IMAGES, "chair", r"a list of names, such as \['chair'\], got 'chair'"),
        (IMAGES, [" "], "non-empty"),
    ],
)
def test_questions_are_checked(images: Any, names: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        Fixed([], [], []).detect(images, names)


def test_duplicates_go_within_a_name_only() -> None:
    boxes = np.array([[0, 0, 10, 10], [0, 0, 10, 8], [0, 0, 10, 9], [20, 0, 30, 10]], np.float32)
    found = Detections(boxes, np.array([0.5, 0.9, 0.7, 0.1], np.float32), ("a", "a", "b", "a"))
    assert suppress_duplicates(found, 0.5).take(np.arange(3)).labels == ("a", "b", "a")
    np.testing.assert_allclose(suppress_duplicates(found, 0.5).scores, [0.9, 0.7, 0.1])
    assert len(suppress_duplicates(found, 0.8)) == 4
    np.testing.assert_allclose(compute_iou(boxes[0], boxes), [1, 0.8, 0.9, 0])


def test_the_simulator_finds_what_is_visible() -> None:
    detector = DETECTORS.make("simulator", categories=THINGS)
    first, second = detector.detect(IMAGES, ["coffee table", "chair", "sofa"], ids=IDS)
    assert dict(zip(first.labels, first.boxes.tolist(), strict=True)) == {
        "chair": [3, 2, 9, 8],
        "coffee table": [20, 10, 30, 12],
    }
    assert second.labels == ("chair",)
    large = DETECTORS.make("simulator", categories=THINGS, least_pixels=21)
    assert large.detect(IMAGES, ["coffee table"], ids=IDS)[0].labels == ()
    with pytest.raises(ArgumentError, match="pass ids="):
        detector.detect(IMAGES, ["chair"])
    with pytest.raises(ArgumentError, match="expected ids of the images' sizes"):
        detector.detect(IMAGES, ["chair"], ids=IDS[:, :5])


def test_the_simulator_fills_boxes() -> None:
    segmenter = SEGMENTERS.make("simulator")
    boxes = [[[2, 2, 10, 9], [18, 9, 30, 13], [12, 14, 15, 18]], np.zeros((0, 4))]
    first, second = segmenter.segment(IMAGES, boxes, ids=IDS)
    np.testing.assert_array_equal(first, [IDS[0] == 1, IDS[0] == 2, np.zeros((20, 30), bool)])
    assert second.shape == (0, 20, 30)
    with pytest.raises(ArgumentError, match="left < right"):
        segmenter.segment(IMAGES[:1], [[[20, 0, 5, 9]]], ids=IDS[:1])
    with pytest.raises(ArgumentError, match="one array of boxes per image"):
        segmenter.segment(IMAGES, boxes[:1], ids=IDS)


def test_masks_of_another_shape_break_the_contract() -> None:
    class Flat(Segmenter):
        def predict_masks(self, images: Any, boxes: Any, ids: Any) -> Any:
            return [np.zeros((len(given), 3, 3), bool) for given in boxes]

    with pytest.raises(ContractError, match=r"Flat: expected masks bool \[\(1, 20, 30\)\]"):
        Flat().segment(IMAGES[:1], [[[0, 0, 5, 5]]])


def test_truth_of_a_rendered_scene_agrees_with_itself() -> None:
    from wiw.render import Renderer
    from wiw.scenes import Scene

    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    meshes = [
        {"positions": square + np.float32([shift, 0, -4]), "triangles": triangles, "category": category}
        for shift, category in ((-1.5, "chair"), (1.5, "bed"))
    ]
    scene = Scene.from_arrays(meshes)
    shown = Renderer(scene, "cpu").perspective(np.eye(4), (40, 60), 90.0, ("color", "instance"))
    categories = read_categories(scene)
    (found,) = DETECTORS.make("simulator", categories=categories).detect(
        shown["color"], ["bed", "chair"], ids=shown["instance"]
    )
    masks = SEGMENTERS.make("simulator").segment(shown["color"], [found.boxes], ids=shown["instance"])[0]
    assert {box[0] < 20: label for box, label in zip(found.boxes, found.labels, strict=True)} == {
        True: "chair",
        False: "bed",
    }
    for box, mask in zip(found.boxes, masks, strict=True):
        assert find_box(mask) == tuple(box)
    true = SEMANTICS.make("simulator", categories=categories).label_panoramas(shown["color"], ids=shown["instance"])
    assert set(np.unique(true)) == {0, CATEGORIES.index("chair"), CATEGORIES.index("bed")}


def test_a_scans_own_labels_come_before_words() -> None:
    """Matterport3D's scans say of each object which of these categories it is."""
    things = [
        {"id": 1, "category": "bath cabinet", "attributes": {"mpcat40": "cabinet"}},
        {"id": 2, "category": "side board", "attributes": {"mpcat40": "chest_of_drawers"}},
        {"id": 3, "category": "ceiling lamp", "attributes": {}},
    ]
    found = read_semantic_categories(SimpleNamespace(instances=things))
    assert found == {1: "cabinet", 2: "chest_of_drawers", 3: "ceiling lamp"}
    ids = np.array([[[1, 2], [3, 0]]], np.uint32)
    labels = TrueSemantics(found).label_panoramas(np.zeros((1, 2, 2, 3), np.uint8), ids=ids)
    assert [[CATEGORIES[number] for number in row] for row in labels[0]] == [
        ["cabinet", "chest of drawers"],
        ["lighting", "void"],
    ]


def test_words_become_categories() -> None:
    assert [find_category_id(word) for word in ("wall", "TV_monitor", "couch", "fridge", "unicorn")] == [
        1,
        22,
        10,
        37,
        OTHER_CATEGORY,
    ]
    assert (len(CATEGORIES), CATEGORIES[16], CATEGORIES[40]) == (41, "stairs", "misc")
    ids = np.array([[[0, 5], [7, 9]]], np.uint32)
    found = TrueSemantics({5: "sofa", 7: "unicorn"}).label_panoramas(np.zeros((1, 2, 2, 3), np.uint8), ids=ids)
    np.testing.assert_array_equal(found, [[[0, 10], [OTHER_CATEGORY, OTHER_CATEGORY]]])
    with pytest.raises(ArgumentError, match="expected ids"):
        TrueSemantics({}).label_panoramas(np.zeros((1, 2, 2, 3), np.uint8))


FAKE = """
class Boxes:
    def __init__(self, array):
        self.array = array
    def tolist(self):
        return self.array

class YOLOWorld:
    def __init__(self, weights):
        assert weights == "mine.pt"
    def set_classes(self, names):
        self.names = names
    def predict(self, images, conf, verbose):
        for image in images:
            boxes = type("B", (), {})()
            red = image[..., 2].astype(int) > 100  # BGR
            rows, columns = red.nonzero()
            there = len(rows) > 0
            corners = []
            if there:
                corners = [[*map(float, (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))]]
            boxes.xyxy, boxes.conf, boxes.cls = Boxes(corners), Boxes([0.75] * there), Boxes([1.0] * there)
            yield type("R", (), {"boxes": boxes})()
"""


@pytest.fixture(scope="module")
def documented_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The script of docs/perception.md as it stands there, with a package in place of ultralytics."""
    folder = tmp_path_factory.mktemp("yolo")
    document = (ROOT / "docs/perception.md").read_text(encoding="utf-8")
    (script,) = [block for block in re.findall(r"```python\n(.*?)```", document, re.S) if "ultralytics" in block]
    script = script.replace(").serve_forever()", ")").replace("HTTPServer((", "server = HTTPServer((")
    script += "print(server.server_port, flush=True)\nserver.serve_forever()\n"
    (folder / "server.py").write_text(script)
    (folder / "ultralytics.py").write_text(FAKE)
    environment = {"PORT": "0", "WEIGHTS": "mine.pt", "PATH": ""}
    process = subprocess.Popen([sys.executable, folder / "server.py"], stdout=subprocess.PIPE, env=environment)
    assert process.stdout is not None
    yield f"http://127.0.0.1:{int(process.stdout.readline())}"
    process.kill()
    process.wait()


def test_the_documented_server_answers(documented_server: str) -> None:
    images = IMAGES.copy()
    images[1, 4:9, 5:25, 0] = 255
    empty, found = DETECTORS.make(f"remote:{documented_server}").detect(images, ["bed", "chair"])
    assert len(empty) == 0
    assert (found.labels, found.boxes.tolist(), found.scores.tolist()) == (("chair",), [[5, 4, 25, 9]], [0.75])


class Misbehaving(BaseHTTPRequestHandler):
    """Answers as the server's `says` has it."""

    def do_POST(self) -> None:
        status, body, wait = self.server.says  # type: ignore[attr-defined]
        self.rfile.read(int(self.headers["Content-Length"]))
        time.sleep(wait)
        self.send_response(status)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args: Any) -> None:
        pass


@pytest.mark.parametrize(
    ("says", "kind", "words"),
    [
        ((500, b"no GPU memory", 0), "raised", "500: no GPU memory"),
        ((200, b"hello", 0), "message", "got b'hello'"),
        ((200, b'{"found": []}', 0), "message", "KeyError"),
        ((200, b'{"detections": [[{"box": [1, 2], "score": 1, "label": "a"}]]}', 0), "message", "boxes"),
        ((200, b"[" * 100_000, 0), "message", "RecursionError"),
        (
            (200, b'{"detections": [[{"box": [0, 0, 1, 1' + b"0" * 400 + b'], "score": 1, "label": "a"}]]}', 0),
            "message",
            "OverflowError",
        ),
        ((200, b"{}", 1), "deadline", "no answer within 0.5 s"),
    ],
)
def test_a_server_that_misbehaves_is_named(says: Any, kind: str, words: str) -> None:
    with HTTPServer(("127.0.0.1", 0), Misbehaving) as server:
        server.says = says  # type: ignore[attr-defined]
        thread = threading.Thread(target=server.handle_request)
        thread.start()
        seconds = 0.5 if kind == "deadline" else 60
        detector = DETECTORS.make(f"remote:http://127.0.0.1:{server.server_port}", seconds=seconds)
        with pytest.raises(RemoteError, match=words) as raised:
            detector.detect(IMAGES[:1], ["a"])
        thread.join()
    assert raised.value.kind == kind


def test_an_answer_that_comes_drop_by_drop_is_not_waited_for() -> None:
    class Dripping(BaseHTTPRequestHandler):
        def log_message(self, *args: Any) -> None: ...

        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(200)
            self.end_headers()
            with contextlib.suppress(OSError):
                for _ in range(300):
                    self.wfile.write(b" ")
                    time.sleep(0.1)

    with HTTPServer(("127.0.0.1", 0), Dripping) as server:
        thread = threading.Thread(target=server.handle_request)
        thread.start()
        begin = time.monotonic()
        with pytest.raises(RemoteError, match="no answer within"):
            DETECTORS.make(f"remote:http://127.0.0.1:{server.server_port}", seconds=0.5).detect(IMAGES[:1], ["a"])
        assert time.monotonic() - begin < 20
        thread.join()


def test_nobody_is_there() -> None:
    with HTTPServer(("127.0.0.1", 0), Misbehaving) as server:
        address = f"http://127.0.0.1:{server.server_port}"
    with pytest.raises(RemoteError, match=r"docs/perception\.md") as raised:
        DETECTORS.make(f"remote:{address}").detect(IMAGES, ["a"])
    assert raised.value.kind == "connection"
    with pytest.raises(ArgumentError, match="http://HOST:PORT"):
        DETECTORS.make("remote:localhost")
    for wrong in ("http://", "http://127.0.0.1:port", "http://[::1"):
        with pytest.raises(ArgumentError, match="http://HOST:PORT"):
            DETECTORS.make(f"remote:{wrong}")


def test_an_error_whose_text_does_not_arrive_is_the_servers() -> None:
    class Failing(BaseHTTPRequestHandler):
        def log_message(self, *args: Any) -> None: ...

        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(500)
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
            self.wfile.write(b"no number\r\n")

    with HTTPServer(("127.0.0.1", 0), Failing) as server:
        thread = threading.Thread(target=server.handle_request)
        thread.start()
        with pytest.raises(RemoteError, match="answered 500") as raised:
            DETECTORS.make(f"remote:http://127.0.0.1:{server.server_port}").detect(IMAGES[:1], ["a"])
        thread.join()
    assert raised.value.kind == "raised"
