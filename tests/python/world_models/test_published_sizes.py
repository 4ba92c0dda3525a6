# SPDX-License-Identifier: Apache-2.0
"""Sizes that the benchmark of video world models gives their networks, and its measurements with tiny ones."""

from __future__ import annotations

import json
import sys

import pytest
from locations import TESTS

torch = pytest.importorskip("torch", reason="no torch: pip install 'wiw[diffusers]'")
pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")

sys.path.append(str(TESTS / "benchmark"))
import video_model_costs as costs  # noqa: E402
from published_sizes import PUBLISHED, Published  # noqa: E402

import tiny_pipelines  # noqa: E402
from wiw.registry import WORLD_MODELS  # noqa: E402

BILLIONS = {
    "svd": {"unet": 1.52, "image_encoder": 0.632, "vae": 0.098},
    "ltx": {"transformer": 1.92, "text_encoder": 4.76, "vae": 0.419},
    "cosmos-predict2": {"transformer": 1.96, "text_encoder": 4.86, "vae": 0.127},
    "wan2.2-5b": {"transformer": 5.0, "text_encoder": 5.68, "vae": 0.705},
    "wan2.1": {"transformer": 16.4, "text_encoder": 5.68, "image_encoder": 0.631, "vae": 0.127},
    "wan2.2-a14b": {"transformer": 14.3, "transformer_2": 14.3, "text_encoder": 5.68, "vae": 0.127},
    "hunyuan": {"transformer": 12.8, "text_encoder": 8.36, "text_encoder_2": 0.123, "vae": 0.246},
}
"""Parameters as their makers say, or from the sizes of the files."""


def shrink(name: str) -> Published:
    """The networks of the tiny pipeline in the places of the published ones."""
    pipeline = tiny_pipelines.BUILDERS[name]()

    def build_again(network):
        make = getattr(type(network), "from_config", type(network))
        return lambda: make(network.config)

    networks = {place: build_again(getattr(pipeline, place)) for place in PUBLISHED[name].networks}
    return Published(networks, PUBLISHED[name].scheduler)


@pytest.mark.parametrize("name", PUBLISHED)
def test_networks_have_the_published_sizes(name):
    for place, build in PUBLISHED[name].networks.items():
        with torch.device("meta"):
            network = build()
        billions = sum(each.numel() for each in network.parameters()) / 1e9
        assert billions == pytest.approx(BILLIONS[name][place], rel=0.006), place


def test_every_published_pipeline_is_a_world_model_and_complete():
    for name, published in PUBLISHED.items():
        pipeline = tiny_pipelines.BUILDERS[name]()
        networks = {place for place, part in pipeline.components.items() if isinstance(part, torch.nn.Module)}
        assert networks - {"safety_checker"} == set(published.networks), name


def test_every_weight_is_drawn_and_shared_ones_stay_shared():
    published = shrink("wan2.1")
    torch.use_deterministic_algorithms(True)  # which fills new memory with NaN
    try:
        networks = {
            place: costs.make_network(build, "cpu", torch.bfloat16) for place, build in published.networks.items()
        }
    finally:
        torch.use_deterministic_algorithms(False)
    for place, network in networks.items():
        values = dict(network.named_parameters()) | dict(network.named_buffers())
        assert all(value.isfinite().all() for value in values.values()), place
        assert all(value.any() for name, value in values.items() if name.endswith("weight")), place
    text = networks["text_encoder"]
    assert text.shared.weight is text.encoder.embed_tokens.weight


@pytest.mark.parametrize("name", PUBLISHED)
def test_types_and_tables_are_those_of_loaded_networks(name, tmp_path):
    kind = WORLD_MODELS.find(name)
    options = {**tiny_pipelines.OPTIONS[name], "device": "cpu", "precision": kind.half_precision}
    made = costs.make_model(name, shrink(name), tmp_path / "made", **options)
    loaded = kind(weights=str(tiny_pipelines.save(name, tmp_path / "loaded")), **options)
    for place in PUBLISHED[name].networks:
        own, other = made.pipeline.components[place], loaded.pipeline.components[place]
        assert list_types(own) == list_types(other), place
        for value, expected in zip(own.buffers(), other.buffers(), strict=True):
            assert value.equal(expected), place
    assert type(made.pipeline.scheduler) is type(loaded.pipeline.scheduler)


def list_types(network):
    return {name: value.dtype for name, value in (*network.named_parameters(), *network.named_buffers())}


def test_measures_prints_and_writes_each_model(tmp_path, capsys):
    sizes = {"ltx": shrink("ltx"), "svd": Published({}, lambda: None)}
    options = {"size": (32, 32), "frames": 9}
    costs.run(["ltx", "svd"], 600, tmp_path / "costs.json", sizes, device="cpu", **options)
    ltx, svd = json.loads((tmp_path / "costs.json").read_text())["models"]
    assert (ltx["model"], ltx["size"], ltx["frames"], ltx["steps"]) == ("ltx", [32, 32], 9, 50)
    assert ltx["seconds_timed"] > 0 and ltx["seconds_making"] > 0
    assert set(ltx["parameters"]) == set(sizes["ltx"].networks)
    assert svd["model"] == "svd" and "Error" in svd["error"]
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("ltx") and lines[2].startswith("svd") and "Error" in lines[2]


def test_starts_no_model_once_the_budget_is_used(tmp_path, capsys):
    costs.run(["ltx", "svd"], 0, None, {})
    assert "not run, since 0 s are used: ltx, svd" in capsys.readouterr().out
