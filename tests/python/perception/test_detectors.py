# SPDX-License-Identifier: Apache-2.0
"""OWL-ViT, Grounding DINO and SAM 2 with tiny random weights: questions are put and answers read as they should be."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw.errors import ArgumentError, DependencyError, WeightsError
from wiw.perception.detection import Detections
from wiw.registry import DETECTORS, SEGMENTERS

torch = pytest.importorskip("torch", reason="torch is not installed: pip install wiw[torch]")
transformers = pytest.importorskip("transformers", reason="transformers is not installed: pip install wiw[torch]")

import tiny_detectors  # noqa: E402 - it needs both

NAMES = ["chair", "a bed", "table"]
WIDE, HIGH = (48, 72), (64, 40)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Where each network's weights are."""
    folder = tmp_path_factory.mktemp("detectors")
    saved = {kind.lower(): tiny_detectors.save_owl(folder / kind, kind) for kind in ("OwlViT", "Owlv2")}
    saved["grounding-dino"] = tiny_detectors.save_grounding_dino(folder / "dino")
    for name, video in (("sam2", False), ("sam2_video", True)):
        saved[name] = tiny_detectors.save_sam2(folder / name, video)
    return saved


def images() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 255, (*size, 3), np.uint8) for size in (WIDE, WIDE, HIGH)]


def detector(folders: dict[str, Path], kind: str, **options: Any) -> Any:
    name = "grounding-dino" if kind == "grounding-dino" else "owlvit"
    return DETECTORS.make(name, weights=folders[kind], device="cpu", **{"threshold": 0.0, "overlap": 1.0, **options})


def assert_same(found: Detections, expected: Detections) -> None:
    np.testing.assert_allclose(found.boxes, expected.boxes, atol=1e-3)
    np.testing.assert_allclose(found.scores, expected.scores, atol=1e-4)
    assert found.labels == expected.labels


@pytest.mark.parametrize("kind", ["owlvit", "owlv2", "grounding-dino"])
def test_answers_are_repeatable_and_do_not_depend_on_the_batch(folders: dict[str, Path], kind: str) -> None:
    together, alone = (detector(folders, kind, batch=batch).detect(images(), NAMES) for batch in (2, 1))
    for found, again, image in zip(together, alone, images(), strict=True):
        assert len(found) > 0
        assert_same(found, again)
        assert (found.boxes[:, 2:] <= [image.shape[1], image.shape[0]]).all()
    sure = detector(folders, kind, threshold=float(together[0].scores[1])).detect(images()[:1], NAMES)[0]
    assert_same(sure, together[0].take(np.arange(2)))


@pytest.mark.parametrize("kind", ["owlvit", "owlv2"])
def test_owl_reads_what_the_library_reads(folders: dict[str, Path], kind: str) -> None:
    """Against the processor of the library, from the very outputs of the network."""
    asked = detector(folders, kind)
    outputs: list[Any] = []
    asked._model.register_forward_hook(lambda *call: outputs.append(call[2]))
    (found,) = asked.detect(images()[:1], NAMES)
    read = asked._prepare.post_process_object_detection
    (expected,) = read(outputs[0], threshold=0.0, target_sizes=[WIDE])
    boxes = expected["boxes"].numpy().clip(0, [WIDE[1], WIDE[0]] * 2)
    rows = [row for row in expected["scores"].argsort(descending=True) if (boxes[row, 2:] > boxes[row, :2]).all()]
    np.testing.assert_allclose(found.boxes, boxes[rows], atol=1e-3)
    np.testing.assert_allclose(found.scores, expected["scores"].numpy()[rows], atol=1e-6)
    assert found.labels == tuple(NAMES[int(expected["labels"][row])] for row in rows)


def test_the_texts_of_owl_are_in_the_template(folders: dict[str, Path]) -> None:
    plain, spelled = (detector(folders, "owlvit", template=text) for text in ("{}", "one {}"))
    (found,) = spelled.detect(images()[:1], ["bed"])
    (same,) = plain.detect(images()[:1], ["one bed"])
    np.testing.assert_allclose(found.scores, same.scores, atol=1e-5)
    assert set(found.labels) == {"bed"}


def test_grounding_dino_scores_names_by_their_surest_token(folders: dict[str, Path], monkeypatch: Any) -> None:
    asked = detector(folders, "grounding-dino", threshold=0.6)
    seen: list[list[int]] = []

    def answer(input_ids: Any, pixel_values: Any, **rest: Any) -> Any:
        """Box 0: a token of "ox"; box 1: the first full stop alone; box 2: "cat" more than "ox"."""
        seen.append(input_ids[0].tolist())
        logits = torch.full((1, 3, 16), -torch.inf)
        logits[0, 0, 6], logits[0, 1, 4], logits[0, 2, 2], logits[0, 2, 5] = 1.0, 5.0, 3.0, 2.0
        boxes = torch.tensor([[[0.5, 0.5, 0.5, 0.25], [0.5, 0.5, 1, 1], [0.25, 0.5, 0.5, 1]]])
        return type("Said", (), {"logits": logits, "pred_boxes": boxes})()

    monkeypatch.setattr(asked, "_model", type("Model", (), {"config": asked._model.config, "__call__": None})())
    monkeypatch.setattr(type(asked._model), "__call__", lambda self, **inputs: answer(**inputs))
    (found,) = asked.detect(images()[:1], ["Cat", "ox"])
    letters = {letter: 200 + i for i, letter in enumerate("abcdefghijklmnopqrstuvwxyz")}
    rest = {letter: number + 100 for letter, number in letters.items()}
    assert seen == [[101, letters["c"], rest["a"], rest["t"], 1012, letters["o"], rest["x"], 1012, 102]]
    assert found.labels == ("Cat", "ox")
    np.testing.assert_allclose(found.boxes, [[0, 0, 36, 48], [18, 18, 54, 30]])
    np.testing.assert_allclose(found.scores, 1 / (1 + np.exp([-3.0, -1.0])), atol=1e-6)


def test_more_names_than_a_text_holds_are_asked_in_several(folders: dict[str, Path]) -> None:
    """The text of the tiny network has room for 14 tokens: two names of five letters, with their full stops."""
    asked = detector(folders, "grounding-dino")
    assert [list(text) for text in asked._split_into_texts(["chair", "table", "house"])] == [
        ["chair", "table"],
        ["house"],
    ]
    (whole,) = asked.detect(images()[:1], ["chair", "table", "house"])
    parts = [asked.detect(images()[:1], names)[0] for names in (["chair", "table"], ["house"])]
    np.testing.assert_allclose(
        np.sort(whole.scores), np.sort(np.concatenate([part.scores for part in parts])), atol=1e-5
    )
    with pytest.raises(ArgumentError, match="has 15 tokens, expected 1 to 13"):
        asked.detect(images()[:1], ["a" * 15])


@pytest.mark.parametrize("kind", ["sam2", "sam2_video"])
def test_sam2_answers_as_the_network_asked_directly(folders: dict[str, Path], kind: str) -> None:
    segmenter = SEGMENTERS.make("sam2", weights=folders[kind], device="cpu", batch=2)
    boxes = [np.float32([[5, 6, 40, 30], [20, 2, 70, 40]]), np.float32([[1, 1, 30, 30]]), np.zeros((0, 4))]
    found = segmenter.segment(images(), boxes)
    assert [masks.shape for masks in found] == [(2, *WIDE), (1, *WIDE), (0, *HIGH)]
    model = transformers.Sam2Model.from_pretrained(folders[kind]).eval()
    side = tiny_detectors.SIDE
    for image, given, masks in zip(images(), boxes, found, strict=True):
        if not len(given):
            continue
        pixels = torch.from_numpy(image).permute(2, 0, 1)[None] / 255
        pixels = torch.nn.functional.interpolate(pixels, (side, side), mode="bilinear", antialias=True)
        pixels = (pixels - torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)) / torch.tensor(
            [0.229, 0.224, 0.225]
        ).view(3, 1, 1)
        corners = torch.from_numpy(given) * side / torch.tensor([WIDE[1], WIDE[0]] * 2)
        with torch.no_grad():
            logits = model(pixel_values=pixels, input_boxes=corners[None], multimask_output=False).pred_masks[0]
        whole = torch.nn.functional.interpolate(logits, WIDE, mode="bilinear")[:, 0]
        clear = (whole.abs() > 0.01 * whole.abs().max()).numpy()
        np.testing.assert_array_equal(masks[clear], (whole > 0).numpy()[clear])
        assert clear.mean() > 0.5


def test_weights_that_do_not_do_are_refused(folders: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="no folder") as raised:
        DETECTORS.make("owlvit", weights=tmp_path / "none")
    assert raised.value.kind == "missing"
    with pytest.raises(WeightsError, match="holds a 'grounding-dino': expected owlvit or owlv2") as raised:
        DETECTORS.make("owlvit", weights=folders["grounding-dino"])
    assert raised.value.kind == "unfit"
    with pytest.raises(WeightsError, match="save_pretrained") as raised:
        DETECTORS.make("grounding-dino", weights=tmp_path)
    with pytest.raises(ArgumentError, match="is a revision of a hub repository"):
        SEGMENTERS.make("sam2", weights=folders["sam2"], revision="main")
    with pytest.raises(ArgumentError, match="device: expected a torch device"):
        SEGMENTERS.make("sam2", weights=folders["sam2"], device="gpu")
    with pytest.raises(ArgumentError, match=r"device: torch .* cannot use 'hpu' on this machine"):
        SEGMENTERS.make("sam2", weights=folders["sam2"], device="hpu")


@pytest.mark.parametrize("batch", [0, -1])
def test_a_batch_has_an_image(batch: int) -> None:
    for name in ("owlvit", "grounding-dino"):
        with pytest.raises(ArgumentError, match=f"expected a batch of at least 1, got {batch}"):
            DETECTORS.make(name, batch=batch)
    with pytest.raises(ArgumentError, match=f"Sam2Image: expected a batch of at least 1, got {batch}"):
        SEGMENTERS.make("sam2", batch=batch)


def test_a_folder_that_lacks_weights_is_refused(folders: dict[str, Path], tmp_path: Path) -> None:
    """The library would draw what is missing at random."""
    from safetensors.torch import load_file, save_file

    folder = tmp_path / "holed"
    shutil.copytree(folders["owlvit"], folder)
    state = load_file(folder / "model.safetensors")
    lost = next(name for name in state if "box_head" in name)
    save_file({name: value for name, value in state.items() if name != lost}, folder / "model.safetensors")
    with pytest.raises(WeightsError, match=f"no weights for 1 parts of OwlViTForObjectDetection: {lost}"):
        DETECTORS.make("owlvit", weights=folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "model_type": "nothing"}))
    with pytest.raises(WeightsError, match="nothing"):
        DETECTORS.make("owlvit", weights=folder)


@pytest.mark.parametrize("name", ["owlvit", "grounding-dino"])
def test_the_hub_out_of_reach_is_told(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import huggingface_hub

    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(WeightsError, match="hf download nobody/nothing") as raised:
        DETECTORS.make(name, weights="nobody/nothing")
    assert raised.value.kind == "network"


@pytest.mark.parametrize("name", ["owlvit", "grounding-dino", "sam2"])
def test_it_says_what_to_install(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(DependencyError, match=r"transformers not installed; pip install 'wiw\[torch\]'"):
        (SEGMENTERS if name == "sam2" else DETECTORS).make(name)


def test_torchvision_is_not_imported() -> None:
    assert "torchvision" not in sys.modules
