# SPDX-License-Identifier: Apache-2.0
"""RedNet: the published weights' names and shapes, what it computes, and checkpoints saved as its training does."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw import panorama
from wiw.errors import ArgumentError, WeightsError
from wiw.registry import SEMANTICS

torch = pytest.importorskip("torch", reason="torch is not installed: pip install wiw[torch]")

from torch.nn import functional  # noqa: E402

from wiw.perception.rednet_network import RedNet, create_empty  # noqa: E402

PUBLISHED = {
    "conv1.weight": (64, 3, 7, 7),
    "conv1_d.weight": (64, 1, 7, 7),
    "bn1_d.running_var": (64,),
    "layer1.0.downsample.0.weight": (256, 64, 1, 1),
    "layer1_d.2.conv3.weight": (256, 64, 1, 1),
    "layer2.3.conv2.weight": (128, 128, 3, 3),
    "layer3_d.5.bn3.weight": (1024,),
    "layer4_d.0.downsample.1.bias": (2048,),
    "agant0.0.weight": (64, 64, 1, 1),
    "agant4.0.weight": (512, 2048, 1, 1),
    "agant3.1.num_batches_tracked": (),
    "deconv1.4.conv2.weight": (512, 512, 3, 3),
    "deconv1.5.conv2.weight": (512, 256, 3, 3),
    "deconv1.5.upsample.0.weight": (512, 256, 2, 2),
    "deconv2.3.upsample.1.weight": (128,),
    "deconv3.2.conv1.weight": (128, 128, 3, 3),
    "deconv4.2.upsample.0.weight": (64, 64, 2, 2),
    "final_conv.2.conv2.weight": (64, 64, 3, 3),
    "final_deconv_custom.weight": (64, 40, 2, 2),
    "final_deconv_custom.bias": (40,),
    "out5_conv_custom.weight": (40, 256, 1, 1),
    "out4_conv_custom.weight": (40, 128, 1, 1),
    "out3_conv_custom.weight": (40, 64, 1, 1),
    "out2_conv_custom.bias": (40,),
}
"""Names and shapes in Semantic-MapNet's checkpoints, which hold 928 tensors."""


def test_names_and_shapes_are_those_of_the_published_weights() -> None:
    state = {name: tuple(value.shape) for name, value in create_empty(40, 64).state_dict().items()}
    assert {name: state.get(name) for name in PUBLISHED} == PUBLISHED
    assert len(state) == 928
    assert not any("upsample" in name for name in state if name.startswith("final_conv"))


@pytest.fixture(scope="module")
def network() -> RedNet:
    """A narrow one, with statistics of normalisation that are not the initial ones."""
    torch.manual_seed(0)
    network = RedNet(width=2).eval()
    for name, value in network.state_dict().items():
        if name.endswith(("running_mean", "running_var")):
            value.uniform_(0.5, 1.5)
    return network


@pytest.fixture(scope="module")
def checkpoint(network: RedNet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Saved as by parallel training: a prefix to all names, and a score of NumPy's beside them."""
    path = tmp_path_factory.mktemp("rednet") / "rednet_semmap_mp3d_tuned.pth"
    state = {f"module.{name}": value for name, value in network.state_dict().items()}
    torch.save({"epoch": 7, "best_iou": np.float64(0.5), "model_state": state}, path)
    return path


class Twin:
    """The paper's network, written down from the names of its weights."""

    def __init__(self, state: dict[str, Any]) -> None:
        self.state = state

    def norm(self, name: str, x: Any) -> Any:
        mean, var, weight, bias = (
            self.state[f"{name}.{part}"] for part in ("running_mean", "running_var", "weight", "bias")
        )
        return functional.batch_norm(x, mean, var, weight, bias)

    def conv(self, name: str, x: Any, stride: int = 1) -> Any:
        kernel = self.state[f"{name}.weight"]
        return functional.conv2d(x, kernel, stride=stride, padding=kernel.shape[-1] // 2)

    def grown(self, name: str, x: Any) -> Any:
        kernel = self.state[f"{name}.weight"]
        padding = 1 if kernel.shape[-1] == 3 else 0
        return functional.conv_transpose2d(x, kernel, stride=2, padding=padding, output_padding=padding)

    def encode(self, stage: int, suffix: str, x: Any) -> Any:
        for block in range((3, 4, 6, 3)[stage - 1]):
            name, stride = f"layer{stage}{suffix}.{block}", 2 if stage > 1 and block == 0 else 1
            y = self.norm(f"{name}.bn1", self.conv(f"{name}.conv1", x)).relu()
            y = self.norm(f"{name}.bn2", self.conv(f"{name}.conv2", y, stride)).relu()
            y = self.norm(f"{name}.bn3", self.conv(f"{name}.conv3", y))
            if block == 0:
                x = self.norm(f"{name}.downsample.1", self.conv(f"{name}.downsample.0", x, stride))
            x = (x + y).relu()
        return x

    def decode(self, stage: str, blocks: int, x: Any) -> Any:
        for block in range(blocks):
            name = f"{stage}.{block}"
            grows = f"{name}.upsample.0.weight" in self.state
            y = self.norm(f"{name}.bn1", self.conv(f"{name}.conv1", x)).relu()
            y = self.norm(f"{name}.bn2", (self.grown if grows else self.conv)(f"{name}.conv2", y))
            if grows:
                x = self.norm(f"{name}.upsample.1", self.grown(f"{name}.upsample.0", x))
            x = (x + y).relu()
        return x

    def skip(self, level: int, x: Any) -> Any:
        return self.norm(f"agant{level}.1", self.conv(f"agant{level}.0", x)).relu()

    def __call__(self, colour: Any, depth: Any) -> Any:
        x = self.norm("bn1", self.conv("conv1", colour, 2)).relu()
        d = self.norm("bn1_d", self.conv("conv1_d", depth, 2)).relu()
        fused = [x + d]
        x, d = functional.max_pool2d(fused[0], 3, 2, 1), functional.max_pool2d(d, 3, 2, 1)
        for stage in range(1, 5):
            x, d = self.encode(stage, "", x), self.encode(stage, "_d", d)
            x = x + d
            fused.append(x)
        x = self.skip(4, fused[4])
        for stage, blocks in ((1, 6), (2, 4), (3, 3), (4, 3)):
            x = self.decode(f"deconv{stage}", blocks, x) + self.skip(4 - stage, fused[4 - stage])
        x = self.decode("final_conv", 3, x)
        return self.grown("final_deconv_custom", x) + self.state["final_deconv_custom.bias"][:, None, None]


def test_it_computes_what_its_twin_does(network: RedNet) -> None:
    colour, depth = torch.randn(2, 3, 64, 96), torch.randn(2, 1, 64, 96)
    with torch.no_grad():
        scores, expected = network(colour, depth), Twin(network.state_dict())(colour, depth)
    assert scores.shape == (2, 40, 64, 96)
    torch.testing.assert_close(scores, expected, rtol=1e-4, atol=1e-4)
    assert expected.std() > 1e-3


def make_views(count: int = 2) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (count, 32, 64, 3), np.uint8)
    return images, rng.uniform(0, 12, (count, 32, 64)).astype(np.float32)


def test_views_are_fed_as_the_weights_were_trained(network: RedNet, checkpoint: Path) -> None:
    source = SEMANTICS.make("rednet", weights=checkpoint, device="cpu", batch=1)
    images, depth = make_views()
    fed: list[Any] = []
    source._model.register_forward_pre_hook(lambda module, inputs: fed.append(inputs))
    found = source.label_views(images, depth)
    colour = (images / 255 - [0.493, 0.468, 0.438]) / [0.544, 0.521, 0.499]
    part = (np.clip(depth / 10, 0, 1) - 0.213) / 0.285
    for row in range(2):
        np.testing.assert_allclose(fed[row][0][0].permute(1, 2, 0), colour[row], atol=1e-5)
        np.testing.assert_allclose(fed[row][1][0, 0], part[row], atol=1e-5)
        with torch.no_grad():
            scores = network(*fed[row])[0]
        best = scores.topk(2, dim=0).values
        clear = (best[0] - best[1] > 1e-5 * best[0].abs()).numpy()
        np.testing.assert_array_equal(found[row][clear], (scores.argmax(0) + 1).numpy()[clear])
        assert clear.mean() > 0.9
    assert found.dtype == np.uint32


def test_it_is_described_by_its_weights_not_by_their_files_name(
    network: RedNet, checkpoint: Path, tmp_path: Path
) -> None:
    same, other = tmp_path / "renamed.pth", tmp_path / checkpoint.name
    shutil.copy(checkpoint, same)
    state = {f"module.{name}": value + value.is_floating_point() for name, value in network.state_dict().items()}
    torch.save({"epoch": 7, "model_state": state}, other)
    described = [SEMANTICS.make("rednet", weights=each, device="cpu").describe() for each in (checkpoint, same, other)]
    assert described[0] == described[1] != described[2]


def test_panoramas_are_looked_at_by_the_faces_of_their_cube(checkpoint: Path) -> None:
    source = SEMANTICS.make("rednet", weights=checkpoint.parent, device="cpu", face=32)
    images, depth = make_views()
    found = source.label_panoramas(images, depth)
    assert (found.shape, found.dtype) == ((2, 32, 64), np.dtype(np.uint32))
    np.testing.assert_array_equal(found[1:], source.label_panoramas(images[1:], depth[1:]))
    asked: list[Any] = []

    def answer(faces: Any, planar: Any) -> Any:
        """Each face is its own category, told by its order."""
        asked.append((faces.shape, planar))
        return np.broadcast_to(np.arange(1, 7, dtype=np.uint32)[:, None, None], planar.shape).copy()

    source.label_views = answer
    found = source.label_panoramas(images[:1], np.full_like(depth[:1], 5))
    assert asked[0][0] == (6, 32, 32, 3)
    assert asked[0][1].max() < 5 and asked[0][1].min() == pytest.approx(5 / np.sqrt(3), rel=0.05)
    assert [found[0, 16, column] for column in (32, 48, 0, 16)] == [1, 2, 3, 4]  # front, right, back, left
    assert set(found[0, 0]) == {5} and set(found[0, -1]) == {6}
    assert panorama.to_cubemap(images[0], 32).shape == asked[0][0]


def test_what_it_cannot_use_is_named(checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"CC BY-NC 4\.0") as raised:
        SEMANTICS.make("rednet", weights=tmp_path)
    assert raised.value.kind == "missing"
    with pytest.raises(ArgumentError, match="multiple of 32"):
        SEMANTICS.make("rednet", weights=checkpoint, face=48)
    with pytest.raises(ArgumentError, match="batch: expected at least 1, got 0"):
        SEMANTICS.make("rednet", weights=checkpoint, batch=0)
    with pytest.raises(ArgumentError, match="metres"):
        SEMANTICS.make("rednet", weights=checkpoint, metres=(5, 5))
    source = SEMANTICS.make("rednet", weights=checkpoint, device="cpu", face=32)
    images, depth = make_views()
    with pytest.raises(ArgumentError, match="depth"):
        source.label_panoramas(images)
    with pytest.raises(ArgumentError, match="multiples of 32"):
        source.label_views(images[:, :30], depth[:, :30])


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda network: b"nothing of the kind", "without running code"),
        (lambda network: b"hello: unpickling says KeyError", "without running code"),
        (lambda network: {"model_state": Path("a class of its own")}, "without running code"),
        (lambda network: {"weights": {}}, "'model_state'"),
        (lambda network: {"model_state": {"fc.weight": torch.zeros(1)}}, "expected 'conv1.weight'"),
        (lambda network: {"model_state": RedNet(13, 2).state_dict()}, "10 of 928 .*final_deconv_custom.bias"),
    ],
)
def test_other_checkpoints_are_refused(network: RedNet, tmp_path: Path, make: Any, reason: str) -> None:
    path, content = tmp_path / "other.pth", make(network)
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(WeightsError, match=reason) as raised:
        SEMANTICS.make("rednet", weights=path)
    assert raised.value.kind == "unfit"


def test_damaged_safetensors_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "rednet.safetensors"
    path.write_bytes(b"hello")
    with pytest.raises(WeightsError, match="expected RedNet's weights") as raised:
        SEMANTICS.make("rednet", weights=path)
    assert raised.value.kind == "unfit"


def test_safetensors_do_as_well(network: RedNet, tmp_path: Path) -> None:
    from safetensors.torch import save_file

    save_file(network.state_dict(), tmp_path / "rednet.safetensors")
    source = SEMANTICS.make("rednet", weights=tmp_path / "rednet.safetensors", device="cpu")
    expected = network.state_dict()
    for name, value in source._model.state_dict().items():
        assert torch.equal(value, expected[name]), name
