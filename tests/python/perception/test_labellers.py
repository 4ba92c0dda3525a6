# SPDX-License-Identifier: Apache-2.0
"""Labellers: the oracle, a detector with a segmenter, and the learned one, on small networks and on shipped weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import World, world
from wiw.errors import ArgumentError, ContractError, WeightsError
from wiw.networks import single_thread
from wiw.perception.detection import Detections, Detector
from wiw.perception.detector_labeller import DetectorLabeller
from wiw.perception.oracle_labeller import OracleLabeller
from wiw.perception.scene_labels import CATEGORIES, STATES, STRUCTURE, Labeller, SceneLabels
from wiw.perception.segmentation import Segmenter
from wiw.perception.simulator import TrueBoxes, TrueMasks, read_categories
from wiw.registry import LABELLERS

SIZE, FIELD = (96, 112), 105.0


def instance(number: int, category: str, state: str = "") -> dict[str, Any]:
    return {"id": number, "category": category, "attributes": {"state": state} if state else {}}


INSTANCES = [
    instance(1, "wall"),
    instance(2, "door frame", "fixed"),
    instance(3, "television", "on"),
    instance(4, "passage", "open"),
    instance(5, "curtain", "half drawn"),
]
IDS = np.array([[[0, 1, 2], [3, 4, 5]]], np.uint32)


def blank(ids: Any) -> Any:
    return np.zeros((*ids.shape, 3), np.uint8)


# -- the oracle --------------------------------------------------------------------------------------------------------


def test_the_oracle_looks_up_categories_and_states() -> None:
    oracle = OracleLabeller(INSTANCES)
    assert oracle.categories == ("", "curtain", "opening", "television", "wall") and oracle.privileged
    found = oracle.label(blank(IDS), FIELD, IDS)
    names = [oracle.categories[i] for i in found.category.ravel()]
    assert names == ["", "wall", "opening", "television", "opening", "curtain"]
    assert [STATES[i] for i in found.state.ravel()] == ["", "", "", "on", "open", ""]
    assert found.confidence.ravel().tolist() == [0, 1, 1, 1, 1, 1]


def test_the_oracle_uses_the_names_of_another_labeller() -> None:
    found = OracleLabeller(INSTANCES, CATEGORIES).label(blank(IDS), FIELD, IDS)
    assert [CATEGORIES[i] for i in found.category.ravel()[3:]] == ["television", "opening", "curtain"]
    partly = OracleLabeller(INSTANCES, ("", "television")).label(blank(IDS), FIELD, IDS)
    assert partly.category.ravel().tolist() == [0, 0, 0, 1, 0, 0] == partly.confidence.ravel().tolist()


@pytest.mark.parametrize("categories", [("wall",), ("", "wall", "wall"), ("", *map(str, range(256)))])
def test_the_oracle_refuses_such_categories(categories: tuple[str, ...]) -> None:
    with pytest.raises(ArgumentError, match="OracleLabeller: expected"):
        OracleLabeller(INSTANCES, categories)


def test_the_oracle_needs_ids_of_its_scene() -> None:
    oracle = OracleLabeller(INSTANCES)
    with pytest.raises(ArgumentError, match=r"reads the simulator's instance ids.*imagined views have none"):
        oracle.label(blank(IDS), FIELD)
    with pytest.raises(ArgumentError, match="got uint32 \\(1, 2, 2\\)"):
        oracle.label(blank(IDS), FIELD, IDS[:, :, :2])
    with pytest.raises(ArgumentError, match="ids up to 5, got 6: these views are of another scene"):
        oracle.label(blank(IDS), FIELD, IDS + 1)


# -- what all labellers refuse -----------------------------------------------------------------------------------------


class Careless(Labeller):
    categories = ("", "wall")

    def compute_labels(self, images: Any, hfov_deg: float, ids: Any, depth: Any) -> SceneLabels:
        assert ids is None  # it does not ask for them
        empty = np.zeros(images.shape[:3], np.int64)
        return SceneLabels(empty, empty, empty)


def test_views_and_labels_are_checked() -> None:
    images = np.zeros((2, 4, 6, 3), np.uint8)
    for wrong, came in ((images[0], "uint8 \\(4, 6, 3\\)"), (images.astype(float), "float64"), ([1], "list")):
        with pytest.raises(ArgumentError, match=f"expected images uint8 \\[N, H, W, 3\\], got {came}"):
            Careless().label(wrong, FIELD)  # type: ignore[arg-type]
    for field in (0.0, 180.0, float("nan")):
        with pytest.raises(ArgumentError, match="expected hfov_deg above 0 and below 180"):
            Careless().label(images, field)
    with pytest.raises(ContractError, match="Careless: expected category uint8"):
        Careless().label(images, FIELD, np.zeros((2, 4, 6), np.uint32))
    assert Careless().label(images[:0], FIELD).category.shape == (0, 4, 6)


@pytest.mark.parametrize("field, value", [("category", 2), ("state", 5), ("confidence", np.nan), ("confidence", 2)])
def test_labels_out_of_range_are_not_mapped(field: str, value: float) -> None:
    class Wrong(Careless):
        def compute_labels(self, images: Any, hfov_deg: float, ids: Any, depth: Any) -> SceneLabels:
            empty = np.zeros(images.shape[:3], np.uint8)
            found = SceneLabels(empty, empty.astype(np.float32), empty.copy())
            getattr(found, field)[0, 1, 1] = value
            return found

    with pytest.raises(ContractError, match="Wrong: expected categories below 2, states below 5 and confidence from 0"):
        Wrong().label(np.zeros((1, 4, 6, 3), np.uint8), FIELD)


def test_the_vocabulary() -> None:
    assert CATEGORIES[0] == "" == STATES[0] and len(set(CATEGORIES)) == len(CATEGORIES) < 256
    assert set(STRUCTURE) < set(CATEGORIES)


# -- detectors ---------------------------------------------------------------------------------------------------------


class Squares(Detector):
    """Finds one lamp left above, and a chair in the middle."""

    def find(self, images: Any, names: Any, ids: Any) -> list[Detections]:
        boxes = np.array([[0, 0, 4, 4], [2, 2, 6, 6], [5, 0, 8, 2]], np.float32)
        return [Detections(boxes, np.array([0.9, 0.5, 0.1], np.float32), ("lamp", "chair", "lamp")) for _ in images]


class Whole(Segmenter):
    def predict_masks(self, images: Any, boxes: Any, ids: Any) -> list[Any]:
        masks = []
        for image, found in zip(images, boxes, strict=True):
            covers = np.zeros((len(found), *image.shape[:2]), bool)
            for row, (left, top, right, bottom) in enumerate(found.astype(int)):
                covers[row, top:bottom, left:right] = True
            masks.append(covers)
        return masks


def test_the_surest_detection_is_on_top() -> None:
    labeller = DetectorLabeller(Squares(), Whole(), ("chair", "lamp"), least_score=0.3)
    found = labeller.label(np.zeros((2, 8, 8, 3), np.uint8), FIELD)
    expected = np.zeros((8, 8), np.uint8)
    expected[2:6, 2:6] = 1
    expected[0:4, 0:4] = 2
    for view in range(2):
        np.testing.assert_array_equal(found.category[view], expected)
        np.testing.assert_allclose(found.confidence[view], np.array([0, 0.5, 0.9], np.float32)[expected])
    assert not found.state.any() and not labeller.privileged
    assert labeller.describe()["detector"] == "Squares" and labeller.describe()["names"] == ["chair", "lamp"]
    with pytest.raises(ArgumentError, match="1 to 255 distinct names"):
        DetectorLabeller(Squares(), Whole(), ("chair", "chair"))
    with pytest.raises(ArgumentError, match="1 to 255 distinct names, got 'lamp'"):
        DetectorLabeller(Squares(), Whole(), "lamp")


@pytest.fixture(scope="module")
def apartment() -> World:
    return world("apartments:val/0")


def look(place: World, count: int = 2) -> tuple[Any, Any]:
    """Views from places where an agent can stand, and their ids."""
    points = place.ground.put_down(place.navmesh.sample(count, 5)).astype(np.float64)
    poses = np.stack([camera_pose(point, 2.0 * i) for i, point in enumerate(points)])
    shown = place.renderer.perspective(poses, SIZE, FIELD, outputs=("color", "instance"))
    return shown["color"], shown["instance"]


def test_true_boxes_and_masks_agree_with_the_oracle(apartment: World) -> None:
    images, ids = look(apartment)
    detected = DetectorLabeller(TrueBoxes(read_categories(apartment.scene)), TrueMasks())
    assert detected.privileged and detected.needs == ("ids",)
    truth = OracleLabeller(apartment.scene.instances, detected.categories).label(images, FIELD, ids)
    found = detected.label(images, FIELD, ids)
    assert (truth.category > 0).mean() > 0.02
    assert (found.category == truth.category).mean() > 0.99  # two things may have one box


# -- the learned labeller ----------------------------------------------------------------------------------------------

torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.perception.labeller_weights import load, save  # noqa: E402
from wiw.perception.labelling_network import (  # noqa: E402
    FOCAL,
    InputSize,
    Network,
    compute_tangents,
    fuse,
    resize_view,
    sample_cells,
    to_network_input,
)
from wiw.perception.learned_labeller import LearnedLabeller, find_impossible_states  # noqa: E402

CARD = {"categories": ["", "wall", "lamp", "toilet"], "states": {"lamp": ["on", "off"], "toilet": ["closed"]}}


def small_network(seed: int = 0) -> Network:
    torch.manual_seed(seed)
    return Network(4, len(STATES), (6, 8, 8, 10), normalised=False)


@pytest.fixture(scope="module")
def small() -> LearnedLabeller:
    return LearnedLabeller.of(small_network(), CARD)


def as_bytes(labels: SceneLabels) -> list[bytes]:
    arrays = (labels.category, labels.confidence, labels.state)
    return [b"".join(array[view].tobytes() for array in arrays) for view in range(len(labels))]


@pytest.mark.parametrize("which", ["small", "shipped"])
def test_labels_of_a_view_do_not_depend_on_the_others(which: str, small: LearnedLabeller) -> None:
    labeller = small if which == "small" else LearnedLabeller()
    images = np.random.default_rng(0).integers(0, 256, (3, *SIZE, 3), np.uint8)
    together = as_bytes(labeller.label(images, FIELD))
    assert len(set(together)) == 3
    assert [as_bytes(labeller.label(image[None], FIELD))[0] for image in images] == together
    assert as_bytes(labeller.label(images[::-1], FIELD)) == together[::-1]
    with_ids = labeller.label(images, FIELD, np.ones((3, *SIZE), np.uint32))
    assert as_bytes(with_ids) == together and not labeller.privileged


VIEWS = (((384, 448), 105.0), ((192, 192), 90.0), ((50, 31), 60.0), ((9, 7), 120.0))


@pytest.mark.parametrize(("size", "field"), VIEWS)
def test_views_of_any_size(small: LearnedLabeller, size: tuple[int, int], field: float) -> None:
    image = np.random.default_rng(1).integers(0, 256, (1, *size, 3), np.uint8)
    found = small.label(image, field)
    assert found.category.shape == (1, *size) and found.category.max() < 4
    assert ((found.confidence > 0) & (found.confidence <= 1)).all()


def label_plainly(labeller: LearnedLabeller, image: np.ndarray, depth: np.ndarray, field: float) -> SceneLabels:
    """Label a view [H, W, 3] from the logits that the network gives cells in the order of the view."""
    size = InputSize.of(image.shape[:2], field)
    shown, distances = resize_view(image, size), sample_cells(depth, size)
    with torch.inference_mode():
        views = to_network_input(shown[None], compute_tangents(image.shape[:2], size)[None], distances[None])
        logits, states = labeller._network(views)
        confidence, category = (each[0].numpy() for each in logits.permute(0, 2, 3, 1).softmax(dim=3).max(dim=3))
    impossible = find_impossible_states(labeller.categories, labeller.card["states"])[category]
    state = np.where(impossible, -np.inf, states[0].permute(1, 2, 0).numpy()).argmax(axis=2)
    rows, columns = (np.arange(n) * cells // n for n, cells in zip(depth.shape, (size.height, size.width), strict=True))
    where = np.ix_(rows, columns)
    return SceneLabels(
        category[where][None].astype(np.uint8), confidence[where][None], state[where][None].astype(np.uint8)
    )


@pytest.mark.parametrize("which", ["small", "shipped"])
@pytest.mark.parametrize(("size", "field"), VIEWS)
def test_labels_are_those_of_the_likeliest_logits(
    which: str, small: LearnedLabeller, size: tuple[int, int], field: float
) -> None:
    labeller = small if which == "small" else LearnedLabeller()
    rng = np.random.default_rng(4)
    image = rng.integers(0, 256, (*size, 3), np.uint8)
    depth = rng.uniform(-1, 5, size).clip(0).astype(np.float32)
    with single_thread():
        expected = label_plainly(labeller, image, depth, field)
    assert as_bytes(labeller.label(image[None], field, depth=depth[None])) == as_bytes(expected)


def test_bytes_become_values_from_minus_one_to_one() -> None:
    view = np.random.default_rng(5).integers(0, 256, (1, 32, 64, 3), np.uint8)
    found = to_network_input(view, np.zeros((1, 16, 32, 2), np.float32)).permute(0, 2, 3, 1)[0].numpy()
    for row, column in ((0, 0), (3, 30), (15, 31)):
        cell = view[0, 2 * row : 2 * row + 2, 2 * column : 2 * column + 2].ravel()
        np.testing.assert_array_equal(found[row, column, :12], (cell * (1 / 127.5)).astype(np.float32) - 1)
        assert not found[row, column, 12:].any()


def test_only_possible_states_are_named(small: LearnedLabeller) -> None:
    images = np.random.default_rng(2).integers(0, 256, (4, *SIZE, 3), np.uint8)
    found = small.label(images, FIELD)
    possible = {0: {""}, 1: {""}, 2: {"on", "off"}, 3: {"closed"}}
    for category in np.unique(found.category):
        named = {STATES[state] for state in np.unique(found.state[found.category == category])}
        assert named <= possible[int(category)]
    impossible = find_impossible_states(CARD["categories"], CARD["states"])  # type: ignore[arg-type]
    assert [np.flatnonzero(~row).tolist() for row in impossible] == [[0], [0], [1, 2], [4]]


def test_pixels_point_where_their_rays_do() -> None:
    size = InputSize.of((384, 448), 105.0)
    assert (size.height, size.width) == (176, 208) and abs(size.focal * 208 / 448 - FOCAL) < 0.5
    tangents = compute_tangents((384, 448), size)
    half = 224 / size.focal
    assert np.isclose(half, np.tan(np.radians(52.5)))
    np.testing.assert_allclose(tangents[0, [0, -1], 0], [half * (1 / 208 - 1), half * (1 - 1 / 208)], rtol=1e-5)
    np.testing.assert_allclose(tangents[[0, -1], 0, 1], np.array([1, -1]) * 192 / size.focal * (1 - 1 / 176), rtol=1e-5)
    assert InputSize.of((3, 3), 10.0).height == 16  # never less than the network can halve


def test_fused_networks_compute_the_same() -> None:
    torch.manual_seed(1)
    network = Network(5, len(STATES), (6, 8, 8, 10))
    views = to_network_input(
        np.random.default_rng(3).integers(0, 256, (2, 64, 96, 3), np.uint8),
        compute_tangents((32, 48), InputSize(32, 48, 24.0)),
    )
    for _ in range(20):  # running means away from 0 and 1
        network.train()(views)
    with torch.inference_mode():
        expected = network.eval()(views)
        found = fuse(network)(views)
    for a, b in zip(expected, found, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)
        assert a.std() > 1e-3


def test_weights_are_stored_and_checked(tmp_path: Path, small: LearnedLabeller) -> None:
    file = tmp_path / "small.safetensors"
    save(file, small_network(), CARD)
    once, again = LearnedLabeller(file), LearnedLabeller.of(*load(file))
    assert once.categories == ("", "wall", "lamp", "toilet") and once.card == CARD
    assert once.describe()["digest"] == again.describe()["digest"]
    assert once.describe()["digest"] != LearnedLabeller.of(small_network(1), CARD).describe()["digest"]
    file.write_bytes(file.read_bytes()[:-10])
    with pytest.raises(WeightsError, match="expected complete weights of perception"):
        LearnedLabeller(file)
    with pytest.raises(WeightsError, match="wiw train perception"):
        LearnedLabeller(tmp_path / "nothing")


def test_labellers_have_names(apartment: World) -> None:
    assert isinstance(LABELLERS.make("learned"), LearnedLabeller)
    assert isinstance(LABELLERS.make("oracle", instances=apartment.scene.instances), OracleLabeller)
    assert isinstance(LABELLERS.make("detector", detector=Squares(), segmenter=Whole()), DetectorLabeller)


@pytest.fixture(scope="module")
def held_out() -> Any:
    from wiw.training.labelled_views import HELD_OUT_FIELD, ViewRules, merge_views, record_views

    rules = ViewRules(places=6, fields=(HELD_OUT_FIELD, HELD_OUT_FIELD))
    return merge_views([record_views(world(f"apartments:val/{number}"), 1, rules) for number in (0, 1)])


def test_the_shipped_labeller_on_two_apartments(held_out: Any) -> None:
    from wiw.training.perception import evaluate

    labeller = LearnedLabeller()
    assert labeller.categories == CATEGORIES
    assert labeller.card["scenes"].startswith("apartments:train")
    found = evaluate(labeller._network, labeller.card["states"], held_out, 0)
    assert found["plain"]["pixel_accuracy"] > SHIPPED["pixel_accuracy"]
    assert found["plain"]["mean_iou"] > SHIPPED["mean_iou"]
    assert found["plain"]["state_accuracy"] > SHIPPED["state_accuracy"]
    assert found["degraded"]["pixel_accuracy"] > SHIPPED["degraded"]


SHIPPED = {"pixel_accuracy": 0.94, "mean_iou": 0.6, "state_accuracy": 0.85, "degraded": 0.9}
"""Floors for the shipped weights on two val apartments, some way below what was measured there."""


def test_a_network_of_chance_is_below_the_floors(held_out: Any) -> None:
    from wiw.training.perception import evaluate

    torch.manual_seed(0)
    states = LearnedLabeller().card["states"]
    network = Network(len(CATEGORIES), len(STATES), (6, 8, 8, 10), normalised=False)
    per_view = ("images", "depth", "category", "state", "hfov_deg")
    few = replace(held_out, **{name: getattr(held_out, name)[:4] for name in per_view})
    found = evaluate(network, states, few, 0)
    assert found["plain"]["pixel_accuracy"] < 0.5 and found["plain"]["mean_iou"] < 0.1
