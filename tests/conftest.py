# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gc
import inspect
import os
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import hypothesis
import pytest

import wiw
from boxes import COLORS, TWO_ROOMS, write_boxes

ROOT = Path(__file__).parents[1]

# Torch reads this when it is loaded: pytest-xdist has a worker for every core already.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Examples are drawn from fixed seeds, so that a commit gets one verdict. (Hypothesis mixes in constants of the modules
# that are loaded, so other tests beside may change some.) --hypothesis-profile=explore looks for new ones.
hypothesis.settings.register_profile("fixed", derandomize=True, deadline=None)
hypothesis.settings.register_profile("explore", max_examples=1000, deadline=None)
hypothesis.settings.load_profile("fixed")


@pytest.fixture(scope="module")
def ray() -> Iterator[Any]:
    """A cluster of two cores, for all tests of a module: starting one takes seconds."""
    found = pytest.importorskip("ray", reason="needs ray: pip install 'wiw[ray]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent / "python"), *sys.path]))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("OMP_NUM_THREADS", "1")
        found.init(num_cpus=2, object_store_memory=10**8, include_dashboard=False, log_to_driver=False)
        yield found
        found.shutdown()


@pytest.fixture(autouse=True, scope="session")
def no_salt() -> Iterator[None]:
    """Leave keys plain where a test gives no salt: two runs draw the same, and test agents know an episode again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("wiw.loop.keys.draw_salt", lambda: "")
        yield


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Leave what collection makes out of garbage collections: modules and tests live until the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that have slow tests, so that no worker is left alone with one of them at the end.

    Tests with a cluster are marked `extra`, for `make nightly`.
    """
    for item in items:
        if "ray" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.extra)
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(scope="session", autouse=True)
def scene_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep scenes in a folder of the test run, not in the user's: an apartment is generated once for all workers."""
    cache, run = tmp_path_factory.mktemp("cache"), tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = run.parent / "scenes"
        shared.mkdir(exist_ok=True)
        (cache / "scenes").symlink_to(shared)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WIW_CACHE", str(cache))
        yield


@pytest.fixture(scope="module")
def one_torch_thread() -> Iterator[None]:
    """Threads that wait for each other spin: on a busy machine two are slower than one."""
    from wiw.networks import single_thread

    with single_thread():
        yield


@pytest.fixture(scope="module")
def fewer_denoising_steps() -> Iterator[None]:
    """A tenth of the steps of video generators: with random weights there is only noise to see."""
    from wiw.world_models.video.model import VideoModel

    stock = VideoModel.__post_init__

    def shorten(self: VideoModel) -> None:
        self.steps = max(1, self.steps // 10)
        stock(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(VideoModel, "__post_init__", shorten)
        yield


@pytest.fixture(scope="session")
def franka_urdf() -> Path:
    """The maker's description of the Panda with its meshes: `WIW_PANDA_URDF`, or package example-robot-data."""
    if named := os.environ.get("WIW_PANDA_URDF"):
        return Path(named)
    try:
        files = metadata.files("example-robot-data") or []
    except metadata.PackageNotFoundError:
        pytest.skip("needs example-robot-data, or WIW_PANDA_URDF")
    return Path(next(file for file in files if str(file).endswith("panda_description/urdf/panda.urdf")).locate())


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Real inputs, where the machine has them."""
    for folder in (os.environ.get("WIW_TEST_DATA"), ROOT.parent / "shared/data"):
        if folder and Path(folder).is_dir():
            return Path(folder)
    pytest.skip("no real data: set WIW_TEST_DATA to a folder with small_house, nav and openeqa")


@pytest.fixture(scope="session")
def world_model_options(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Callable[[str], dict[str, Any]]]:
    """What a built-in world model is made with in tests: tiny random weights, saved once, or a service on the loopback.

    Those that are trained for actions follow primitives, or with kind="pose7" poses of a gripper.

    Skips a model whose packages are not installed.
    """
    folder, saved = tmp_path_factory.mktemp("weights"), set()
    stack = ExitStack()

    def options(name: str, kind: str = "discrete") -> dict[str, Any]:
        found = wiw.registry.WORLD_MODELS.find(name)
        if inspect.isfunction(found):  # makes a model of each plan space, and needs nothing
            return {} if kind == "discrete" else {"space": kind}
        requires = found.requires
        if missing := requires.missing():
            pytest.skip(f"no {', '.join(missing)}: pip install 'wiw[{requires.extra}]'")
        if name == "runway-gen4":
            return runway()
        if requires.served:
            return {"address": served(name)}
        if not requires.weights:  # none, or those that come with it
            return {}
        import tiny_pipelines

        if name not in saved:
            tiny_pipelines.save(name, folder / name)
            saved.add(name)
        trained = (
            {"checkpoint": tiny_pipelines.checkpoint(name, folder / name, kind)} if name.endswith("-action") else {}
        )
        return {"weights": str(folder / name), "device": "cpu", **tiny_pipelines.OPTIONS[name], **trained}

    @cache
    def runway() -> dict[str, Any]:
        import fake_runway

        stack.enter_context(pytest.MonkeyPatch.context()).setenv("RUNWAYML_API_SECRET", "a key")
        server = stack.enter_context(fake_runway.serving())
        return {"url": server.url, "poll": 0.0, "size": (64, 64)}

    @cache
    def served(name: str) -> str:
        import fake_panoramic

        fake_panoramic.install(folder / "official")
        return stack.enter_context(fake_panoramic.serving(folder / "official", name))

    with stack:
        yield options


@pytest.fixture(scope="session")
def two_rooms(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Path of an OBJ with two furnished rooms of 4 x 4 m, joined by a door: a scene spec that loads in milliseconds."""
    folder = tmp_path_factory.mktemp("scene")
    write_boxes(folder / "two_rooms.obj", TWO_ROOMS, COLORS)
    return str(folder / "two_rooms.obj")
