# SPDX-License-Identifier: Apache-2.0
"""`wiw bench gpu` on the CPU: every network and every view is measured in small sizes, and what was not run is said."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import wiw
from wiw.cli import main
from wiw.errors import ArgumentError, BackendError
from wiw.studies import device_benchmark
from wiw.studies.device_benchmark import SHRINK, SIZES, Measurement

torch = pytest.importorskip("torch", reason="needs torch: pip install 'wiw[torch]'")

from wiw.studies.network_cases import compute_loss, list_cases  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
NETWORKS = ("warpnet", "armnet", "navigator", "recogniser", "perception", "pocket", "diffuser")


@pytest.fixture
def without_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def test_every_network_is_rolled_out_and_trained(without_gpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_benchmark, "LEAST", 1)
    found = wiw.benchmark_device(rendering=False, rows=[1], seconds=0)
    assert [row.what for row in found.rows] == [
        f"{n} {work}" for n in NETWORKS for work in ("rollout", "training step")
    ]
    assert all(row.ms > 0 and row.batch == 1 and row.memory_mb is None for row in found.rows)
    assert {row.device for row in found.rows} == {found.devices["cpu"]} and set(found.devices) == {"cpu"}
    assert len(found.not_run) == 1 and "CUDA" in found.not_run[0]


@pytest.mark.parametrize("name", NETWORKS)
def test_a_training_step_reaches_all_weights_that_a_rollout_uses(name: str) -> None:
    """The gradient of the loss is finite, and reaches nearly every parameter: the whole network is measured."""
    case = list_cases()[name]
    torch.manual_seed(0)
    with torch.device("cpu"):
        network = case.make().train()
        compute_loss(case, network, case.draw(network, 2)).backward()
    reached = {key for key, value in network.named_parameters() if value.grad is not None}
    assert all(bool(value.grad.isfinite().all()) for value in network.parameters() if value.grad is not None)
    assert len(reached) > 0.9 * len(dict(network.named_parameters()))


def test_networks_make_all_that_they_need_on_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a device without data a tensor that is left on the CPU is an error, as on a GPU."""
    monkeypatch.setattr("wiw.world_models.warpnet.network._log", math.log)  # a number of Python: it needs data
    for name in ("warpnet", "armnet", "navigator", "perception", "pocket"):
        case = list_cases()[name]
        with torch.device("cpu"):
            network = case.make()
        with torch.device("meta"):
            found = (case.roll_out or case.call)(network.to("meta"), *case.draw(network, 1))
        assert found is not None
    from wiw.world_models.warpnet.network import rays

    assert rays(8, 16).device.type == "cpu"  # maps are kept for each device


def test_views_are_drawn_in_small_sizes_without_a_gpu(
    two_rooms: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse() -> Any:
        raise BackendError("no libEGL")

    monkeypatch.setattr(device_benchmark, "render", SimpleNamespace(egl_devices=refuse))
    found = wiw.benchmark_device(two_rooms, networks=[], seconds=0)
    small = [f"{kind} {height // SHRINK}x{width // SHRINK}" for kind, (height, width) in SIZES.items()]
    assert [(row.what, row.batch) for row in found.rows] == [(what, count) for what in small for count in (1, 4)]
    assert any("no libEGL" in line for line in found.not_run)
    assert any("256 views in full size" in line for line in found.not_run)
    saved = json.loads(found.save(tmp_path / "gpu.json").read_text())
    assert saved["rows"][1]["ms_each"] == pytest.approx(saved["rows"][1]["ms"] / 4)
    assert saved["platform"]["cores"] and saved["wiw"] == wiw.__version__


@pytest.mark.gpu
def test_a_software_device_is_measured_and_named_as_such(two_rooms: str) -> None:
    devices = [each for each in device_benchmark.render.egl_devices() if not each["error"]]
    if not devices or not all(each["software"] for each in devices):
        pytest.skip("needs llvmpipe and no hardware device")
    found = wiw.benchmark_device(two_rooms, networks=[], views=[2], seconds=0)
    assert {row.device for row in found.rows} == {found.devices["cpu"], found.devices["egl"]}
    assert found.devices["egl"].endswith("(software)")
    assert any("hardware device" in line for line in found.not_run)


def test_the_command_prints_a_table_and_what_was_not_run(
    without_gpu: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "gpu.json"
    asked = ["bench", "gpu", "--networks", "navigator", "--no-rendering", "--seconds", "0.01", "--out", str(out)]
    assert main(asked) == 0
    shown = capsys.readouterr().out
    assert "navigator rollout" in shown and "not run  networks on CUDA" in shown
    assert [row["what"] for row in json.loads(out.read_text())["rows"]] == 2 * [
        "navigator rollout",
        "navigator training step",
    ]


def test_bad_requests_are_refused() -> None:
    with pytest.raises(ArgumentError, match="no network 'resnet'"):
        wiw.benchmark_device(rendering=False, networks=["resnet"])
    for numbers in ({"views": [0]}, {"rows": []}):
        with pytest.raises(ArgumentError, match="of at least 1"):
            wiw.benchmark_device(rendering=False, networks=[], **numbers)
    assert Measurement("x", "cpu", 4, "view", 8.0, None).ms_each == 2.0
