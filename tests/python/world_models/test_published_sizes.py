# SPDX-License-Identifier: Apache-2.0
"""Sizes that the benchmarks of video world models give their networks, and their measurements with tiny ones."""

from __future__ import annotations

import json
import math
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


TRAINED = [name for name in PUBLISHED if name != "hunyuan"]
TINY = {"svd": {"frames": 3, "size": (64, 128)}, "ltx": {"frames": 9, "size": (64, 128)}}
"""Clips that the tiny networks take, where they differ from `SMALL`."""
SMALL = {"frames": 5, "size": (32, 64), "batch": 4, "rows": 1}


@pytest.fixture(scope="module")
def training_costs():
    pytest.importorskip("peft", reason="no peft: pip install 'wiw[diffusers]'")
    pytest.importorskip("pyarrow", reason="no pyarrow: pip install 'wiw[export]'")
    import video_training_costs

    return video_training_costs


@pytest.fixture(scope="module")
def panoramas(training_costs, tmp_path_factory):
    return training_costs.collect(tmp_path_factory.mktemp("panoramas") / "data", size=(64, 128))


def choose_options(name, rank):
    return {**SMALL, **TINY.get(name, {}), **({"lora": 4} if rank else {})}


def test_all_recipes_but_that_of_nwm_are_measured(training_costs):
    from wiw.training.post_training.families import FAMILIES

    assert set(training_costs.RECIPES) == set(FAMILIES) - {"nwm-action"} == {f"{name}-action" for name in TRAINED}


@pytest.mark.parametrize("name", TRAINED)
def test_a_training_step_of_each_recipe_is_measured(name, training_costs, panoramas):
    from wiw.training.post_training.recipe import load_recipe

    rank = load_recipe(f"{name}-action").lora
    options = choose_options(name, rank)
    cost = training_costs.measure(f"{name}-action", shrink(name), panoramas, "cpu", steps=2, options=options)
    one_pass, update = cost.seconds_per_pass, cost.seconds_per_update
    seconds = [cost.seconds_loading, cost.seconds_encoding, cost.seconds_first, *cost.seconds_timed, one_pass, update]
    assert all(math.isfinite(value) and value > 0 for value in seconds)
    assert math.isfinite(cost.loss)
    assert (cost.passes, cost.passes_timed, len(cost.seconds_timed)) == (4, 2, 2)
    assert sum(cost.seconds_timed) == pytest.approx(2 * (2 * one_pass + update))
    assert cost.seconds_per_step == pytest.approx(4 * one_pass + update)
    assert cost.clips_per_hour == pytest.approx(3600 * 4 / cost.seconds_per_step)
    assert (cost.billions_trained < cost.billions) == bool(rank)
    assert (cost.recipe["batch"], cost.recipe["clips"]) == (4, 40_000)


@pytest.mark.parametrize("name", TRAINED)
def test_networks_in_training_have_the_types_of_loaded_ones(name, training_costs, panoramas, tmp_path):
    from wiw.training.post_training.corpora import open_corpus
    from wiw.training.post_training.families import PretrainedWeights, find_family
    from wiw.training.post_training.recipe import load_recipe

    family, recipe = find_family(f"{name}-action"), load_recipe(f"{name}-action")
    recipe = load_recipe(f"{name}-action", options=choose_options(name, recipe.lora))
    corpus, recipe = family.fit(open_corpus(panoramas, "all"), recipe)
    made = training_costs.make_trainer(family, shrink(name), corpus, recipe, "cpu").model
    weights = PretrainedWeights(str(tiny_pipelines.save(name, tmp_path)), device="cpu")
    loaded = family.load(corpus, recipe, weights).model
    for place in PUBLISHED[name].networks:
        own, other = (each.objective.pipeline.components[place] for each in (made, loaded))
        assert list_types(own) == list_types(other), place
        assert own.training == other.training, place
    for place in made.places:
        kinds = [{key: value.shape for key, value in each.list_trained(place).items()} for each in (made, loaded)]
        assert kinds[0] == kinds[1]


def test_training_costs_are_printed_and_written_and_so_are_errors(training_costs, panoramas, tmp_path, capsys):
    def fail():
        raise ValueError("no such network\nat all")

    sizes = {"ltx": shrink("ltx"), "svd": Published({"unet": fail}, lambda: None)}
    options = {"steps": 1, "options": choose_options("ltx", 0)}
    names = ["ltx-action", "svd-action"]
    training_costs.run(names, 600, tmp_path / "costs.json", sizes, data=panoramas, device="cpu", **options)
    ltx, svd = json.loads((tmp_path / "costs.json").read_text())["models"]
    assert ltx["model"] == "ltx-action" and ltx["seconds_per_clip"] > 0 and ltx["recipe"]["size"] == [64, 128]
    assert svd["error"] == "ValueError: no such network" and svd["options"]["frames"] == 9
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("ltx ") and lines[2].split() == ["svd", *svd["error"].split()]


def test_a_training_that_does_not_fit_says_what_to_lower(training_costs, panoramas, monkeypatch):
    def fail(*_):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(training_costs, "time_steps", fail)
    options = {"data": panoramas, "device": "cpu", "options": choose_options("ltx", 0)}
    row, record = training_costs.attempt("ltx-action", shrink("ltx"), **options)
    assert "does not fit: DeviceMemoryError" in row and "optimizer=adamw8bit" in record["error"]
