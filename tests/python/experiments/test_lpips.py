# SPDX-License-Identifier: Apache-2.0
"""LPIPS with random weights in files like the published ones: the formula, the files, and what is said without them."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import wiw
from wiw.errors import ArgumentError, WeightsError
from wiw.metrics import Lpips, lpips
from wiw.tasks.imagenav import ImageNav

CHANNELS = (3, 64, 192, 384, 256, 256)
KERNELS = (11, 5, 3, 3, 3)
NUMBERS = (0, 3, 6, 8, 10)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Both files under the published names and shapes, as `torch.save` wrote them then and writes them now."""
    torch = pytest.importorskip("torch")
    path, draw = tmp_path_factory.mktemp("weights"), torch.Generator().manual_seed(0)
    backbone = {"classifier.1.weight": torch.zeros(2, 2)}
    for stage, (number, size) in enumerate(zip(NUMBERS, KERNELS, strict=True)):
        before, after = CHANNELS[stage : stage + 2]
        scale = (2 / (before * size * size)) ** 0.5
        backbone[f"features.{number}.weight"] = scale * torch.randn(after, before, size, size, generator=draw)
        backbone[f"features.{number}.bias"] = 0.1 * torch.randn(after, generator=draw)
    heads = {
        f"lin{stage}.model.1.weight": torch.rand(1, channels, 1, 1, generator=draw)
        for stage, channels in enumerate(CHANNELS[1:])
    }
    torch.save(backbone, path / lpips.BACKBONE.name)
    torch.save(heads, path / lpips.HEADS.name, _use_new_zipfile_serialization=False)
    return path


@pytest.fixture
def published(folder, monkeypatch):
    """The same, taken for the published files."""
    for name in ("BACKBONE", "HEADS"):
        file = getattr(lpips, name)
        digest = hashlib.sha256((folder / file.name).read_bytes()).hexdigest()
        monkeypatch.setattr(lpips, name, replace(file, sha256=digest))
    lpips._read.cache_clear()
    yield folder
    lpips._read.cache_clear()


def twin(folder, a, b):
    """Zhang et al. 2018, equation 1, layer by layer, with torch's own layers."""
    import torch
    from torch import nn

    layers = [
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(),
        nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(), nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
    ]  # fmt: skip
    network = nn.ModuleDict({"features": nn.Sequential(*layers), "classifier": nn.ModuleDict({"1": nn.Linear(2, 2)})})
    network.load_state_dict(torch.load(folder / lpips.BACKBONE.name), strict=False)
    heads = torch.load(folder / lpips.HEADS.name)

    def features(image):
        x = 2 * torch.tensor(image / 255.0).permute(2, 0, 1)[None] - 1
        mean, deviation = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x = ((x - mean.view(1, 3, 1, 1)) / deviation.view(1, 3, 1, 1)).float()
        for layer in network["features"]:
            x = layer(x)
            if isinstance(layer, nn.ReLU):
                yield x[0]

    distance = 0.0
    for stage, (one, other) in enumerate(zip(features(a), features(b), strict=True)):
        unit, other_unit = one / one.norm(dim=0), other / other.norm(dim=0)
        unit, other_unit = (torch.nan_to_num(x) for x in (unit, other_unit))
        weighted = heads[f"lin{stage}.model.1.weight"].view(-1, 1, 1) * (unit - other_unit) ** 2
        distance += float(weighted.detach().sum() / weighted[0].numel())
    return distance


def images(count, size=(64, 72), seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, *size, 3), dtype=np.uint8)


def test_the_formula(published, monkeypatch) -> None:
    monkeypatch.setattr(lpips, "AT_ONCE", 2)
    measure, a = Lpips(published), images(3)
    b = np.stack([a[0], 255 - a[1], np.clip(a[2].astype(int) + 40, 0, 255).astype(np.uint8)])
    found = measure(a, b)
    np.testing.assert_allclose(found, [twin(published, *pair) for pair in zip(a, b, strict=True)], rtol=1e-4, atol=1e-6)
    assert found.dtype == np.float64 and found[0] == 0 < found[2] < found[1]
    assert measure(a[1], b[1]) == pytest.approx(found[1], rel=1e-5)
    np.testing.assert_allclose(measure(a.reshape(3, 1, *a.shape[1:]), b[:, None]), found[:, None], rtol=1e-5)


def test_images_that_it_cannot_measure(published) -> None:
    measure, a = Lpips(published), images(1)
    with pytest.raises(ArgumentError, match=r"two uint8 images"):
        measure(a, a.astype(np.float32))
    with pytest.raises(ArgumentError, match=r"one shape"):
        measure(a, a[:, 1:])
    with pytest.raises(ArgumentError, match=r"at least 32 pixels"):
        measure(a[:, :31], a[:, :31])
    assert measure(a[:, :32, :32], 255 - a[:, :32, :32]) > 0


@pytest.fixture
def convolutions(published, tmp_path, monkeypatch):
    """The backbone's convolutions, taken for the published ones, and a folder that has the other file alone."""
    backbone = pytest.importorskip("torch").load(published / lpips.BACKBONE.name)
    tensors = {name: backbone[name] for name in sorted(backbone) if name.startswith("features.")}
    digest = hashlib.sha256(b"".join(tensor.numpy().tobytes() for tensor in tensors.values())).hexdigest()
    monkeypatch.setattr(lpips, "CONVOLUTIONS_SHA256", digest)
    (tmp_path / lpips.HEADS.name).write_bytes((published / lpips.HEADS.name).read_bytes())
    return tensors, tmp_path


def test_the_convolutions_alone_serve_as_well(published, convolutions) -> None:
    tensors, folder = convolutions
    pytest.importorskip("safetensors.torch").save_file(tensors, folder / lpips.CONVOLUTIONS)
    a, b = images(2)
    assert Lpips(folder)(a, b) == Lpips(published)(a, b)


@pytest.mark.parametrize("change", ["value", "type", "less", "more", "cut"])
def test_other_convolutions_are_refused(convolutions, change) -> None:
    torch, safetensors = pytest.importorskip("torch"), pytest.importorskip("safetensors.torch")
    tensors, folder = convolutions
    if change == "value":
        tensors["features.0.bias"][0] += 1e-3
    elif change == "type":
        tensors = {name: tensor.half() for name, tensor in tensors.items()}
    elif change == "less":
        del tensors["features.10.bias"]
    elif change == "more":
        tensors["classifier.1.bias"] = torch.zeros(2)
    path = folder / lpips.CONVOLUTIONS
    safetensors.save_file(tensors, path)
    if change == "cut":
        path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(WeightsError, match=r"convolutions\.safetensors: (expected the conv|not a safe)") as told:
        Lpips(folder)
    assert told.value.kind == "unfit"


def test_without_the_published_files_there_is_no_lpips(folder, tmp_path, monkeypatch) -> None:
    with pytest.raises(WeightsError, match=r"7be5be79\.pth: expected the published file, of SHA-256 7be5be79") as told:
        Lpips(folder)
    assert told.value.kind == "unfit"
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / lpips.BACKBONE.name).write_bytes(b"")
    monkeypatch.setenv("WIW_CACHE", str(tmp_path))
    with pytest.raises(WeightsError, match=r"LPIPS: alex\.pth not found in .*/weights\. It needs two") as told:
        Lpips()
    assert told.value.kind == "missing"
    assert all(file.url in str(told.value) for file in (lpips.BACKBONE, lpips.HEADS))
    with pytest.raises(WeightsError, match=r"alexnet-owt-7be5be79\.pth and alex\.pth not found"):
        wiw.evaluate("imagenav", wiw.Agent("matcher"), 1, out=tmp_path / "run", lpips=tmp_path, scenes="nowhere")
    assert not (tmp_path / "run").exists()


class Front(wiw.WorldModel):
    """A perspective model in which nothing moves."""

    accepts = wiw.accepts(control="trajectory", view="perspective", size=(96, 96))

    def rollout(self, observations, controls, seeds):
        return np.repeat(observations.image[:, None], 1 + len(controls[0].actions), 1)


def test_a_run_measures_it_where_it_is_asked_to(two_rooms, published, tmp_path) -> None:
    task = ImageNav(scenes=two_rooms, decisions=1)
    log = wiw.evaluate(
        task, wiw.Agent("matcher", Front()), 1, out=tmp_path / "run", arms=["copy", "warp", "oracle"], lpips=published,
        progress=False,
    )  # fmt: skip
    found = {line["arm"]: line["lpips"] for line in log.fidelity()}
    assert found["oracle"] == 0 < found["warp"] < found["copy"]
    page = log.report().read_text()
    assert ">LPIPS</th>" in page and "SSIM" in page
    front = wiw.evaluate(
        task, wiw.Agent("matcher", Front()), 1, out=tmp_path / "front", fidelity=True, lpips=published, progress=False
    )
    assert front.fidelity()[0]["lpips"] > 0
    plain = wiw.evaluate(
        task, wiw.Agent("matcher", "copy"), 1, out=tmp_path / "plain", fidelity=True, progress=False
    ).report().read_text()  # fmt: skip
    assert "SSIM" in plain and "LPIPS" not in plain


def test_it_can_be_sent_to_another_process(published) -> None:
    import pickle

    a, b = images(2)
    measure = Lpips(published)
    assert pickle.loads(pickle.dumps(measure))(a, b) == measure(a, b)
    assert Path(measure.folder) == published
