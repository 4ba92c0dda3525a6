# SPDX-License-Identifier: Apache-2.0
"""The rollout cache: the same question is put to a world model once, and never answered by another one's frames."""

from __future__ import annotations

import errno
import io
import logging
import pickle
import threading
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import wiw
from wiw.action import FORWARD, TURN_LEFT, TextTemplate
from wiw.errors import ArgumentError
from wiw.loop import rollout_cache
from wiw.loop.attempts import Attempted
from wiw.loop.rollout_cache import Cached, RolloutCache, cache_rollouts, default_folder
from wiw.runs.recipes import TaskRecipe
from wiw.types import Conditioning, Control
from wiw.world_models.base import Accepts

H, W = 8, 16


class Counting(wiw.WorldModel):
    """A small image in which everything that it was asked can be read; counts the rows of all instances."""

    accepts = wiw.accepts(control="trajectory", size=(H, W), causal=True, cacheable=True)
    version = "1"
    rows: ClassVar[int] = 0

    def __init__(self, weights: float = 1.0) -> None:
        self.weights = weights

    def rollout(self, observations, controls, seeds):
        Counting.rows += len(controls)
        frames = np.empty((len(controls), len(controls[0].actions) + 1, H, W, 3), np.uint8)
        for row, (control, seed) in enumerate(zip(controls, seeds, strict=True)):
            for k in range(frames.shape[1]):
                said = int(observations.image[row, 0, 0, 0]) + 31 * int(seed) + 7 * control.actions[:k].sum()
                frames[row, k] = (said * int(self.weights) + 13 * k) % 256
        return frames


def question(*plans, image=5, seeds=None, shared=0):
    length = max(map(len, plans))
    controls = [
        Control(
            np.array([*plan, *[0] * (length - len(plan))], np.int8), np.zeros((length, 3)), np.zeros((length, 4, 4)),
            length=len(plan), shared=shared if row else 0,
        )
        for row, plan in enumerate(plans)
    ]  # fmt: skip
    images = np.full((len(plans), H, W, 3), image, np.uint8)
    return (
        Conditioning(images),
        controls,
        np.arange(len(plans), dtype=np.uint64) if seeds is None else np.array(seeds, np.uint64),
    )


def imagine_rows(ask, *given):
    before = Counting.rows
    frames = ask.rollout(*given)
    return frames, Counting.rows - before


def make(folder, model=None, **options):
    return Cached(Attempted(model or Counting()), RolloutCache(folder, **options))


def own(frames, controls):
    return [frames[row, 1 + control.shared : 1 + control.length] for row, control in enumerate(controls)]


FF, FL = [FORWARD, FORWARD], [FORWARD, TURN_LEFT]


def test_a_question_is_put_once_also_by_another_process_and_in_other_company(tmp_path) -> None:
    given = question(FF, FL)
    fresh, rows = imagine_rows(make(tmp_path), *given)
    assert rows == 2
    again, rows = imagine_rows(make(tmp_path), *given)
    assert rows == 0
    for mine, theirs in zip(own(fresh, given[1]), own(again, given[1]), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    more, rows = imagine_rows(make(tmp_path), *question(FL, FF, [TURN_LEFT, FORWARD], seeds=[1, 0, 9]))
    assert rows == 1
    np.testing.assert_array_equal(more[0, 1:], fresh[1, 1:])
    np.testing.assert_array_equal(more[2, 1:], Counting().rollout(*question([TURN_LEFT, FORWARD], seeds=[9]))[0, 1:])


def test_equal_templates_share_entries_and_others_do_not(tmp_path) -> None:
    def count_rows(prompt: str) -> int:
        model = Counting()
        model.accepts = wiw.accepts("text", size=(H, W), template=TextTemplate(prompt), cacheable=True)
        return imagine_rows(make(tmp_path, model), *question(FF))[1]

    assert [count_rows("Go: {actions}"), count_rows("Go: {actions}"), count_rows("Walk: {actions}")] == [1, 0, 1]


@pytest.mark.parametrize(
    "other",
    [
        question(FL),
        question(FF, image=6),
        question(FF, seeds=[1]),
        (replace(question(FF)[0], depth=np.ones((1, H, W), np.float32)), *question(FF)[1:]),
        (question(FF)[0], [replace(question(FF)[1][0], text="go")], question(FF)[2]),
        (question(FF)[0], [replace(question(FF)[1][0], ids=np.array([1, 2]))], question(FF)[2]),
        (question(FF)[0], [replace(question(FF)[1][0], trajectory=np.ones((2, 3)))], question(FF)[2]),
    ],
    ids=["plan", "image", "seed", "depth", "text", "ids", "trajectory"],
)
def test_another_question_is_another_entry(tmp_path, other) -> None:
    imagine_rows(make(tmp_path), *question(FF))
    assert imagine_rows(make(tmp_path), *question(FF))[1] == 0
    assert imagine_rows(make(tmp_path), *other)[1] == 1


def test_another_model_is_another_entry(tmp_path) -> None:
    class Other(Counting):
        pass

    imagine_rows(make(tmp_path), *question(FF))
    for model in (Counting(2.0), Other()):
        frames, rows = imagine_rows(make(tmp_path, model), *question(FF))
        assert rows == 1
        np.testing.assert_array_equal(frames[:, 1:], model.rollout(*question(FF))[:, 1:])


def test_an_entry_serves_rows_that_need_less_of_it(tmp_path) -> None:
    short = question(FF, FF, seeds=[0, 0], shared=1)
    whole, _ = imagine_rows(make(tmp_path), *question(FF))
    frames, rows = imagine_rows(make(tmp_path), *short)
    assert rows == 0
    np.testing.assert_array_equal(frames[1, 2], whole[0, 2])
    imagine_rows(make(tmp_path / "b"), *question([TURN_LEFT], FF, seeds=[4, 0], shared=1))
    assert imagine_rows(make(tmp_path / "b"), *question(FF))[1] == 1  # its first frame was another row's


@pytest.mark.parametrize("harm", ["truncate", "frames", "header", "longer", "empty"])
def test_a_damaged_entry_is_dropped_named_and_imagined_anew(tmp_path, caplog, harm) -> None:
    fresh, _ = imagine_rows(make(tmp_path), *question(FF))
    (path,) = tmp_path.rglob("*.frames")
    data = bytearray(path.read_bytes())
    if harm in ("frames", "header"):
        data[-5 if harm == "frames" else 9] ^= 1
    path.write_bytes({"truncate": data[:-7], "longer": data + b"x", "empty": b""}.get(harm, data))
    with caplog.at_level(logging.WARNING, "wiw.rollouts"):
        again, rows = imagine_rows(make(tmp_path), *question(FF))
    assert rows == 1 and path.name in caplog.text
    np.testing.assert_array_equal(fresh[:, 1:], again[:, 1:])
    assert imagine_rows(make(tmp_path), *question(FF))[1] == 0


def test_an_entry_that_cannot_be_read_now_is_kept(tmp_path, caplog, monkeypatch) -> None:
    def refuse(*_, **__):
        raise OSError(errno.EMFILE, "Too many open files")

    imagine_rows(make(tmp_path), *question(FF))
    (path,) = tmp_path.rglob("*.frames")
    whole = path.read_bytes()
    with monkeypatch.context() as patched, caplog.at_level(logging.WARNING, "wiw.rollouts"):
        patched.setattr(Path, "open", refuse)
        assert imagine_rows(make(tmp_path), *question(FF))[1] == 1
    assert f"{path} cannot be read now ([Errno 24] Too many open files)" in caplog.text
    assert path.read_bytes() == whole and imagine_rows(make(tmp_path), *question(FF))[1] == 0


def test_the_least_recently_used_goes_when_the_budget_is_spent(tmp_path) -> None:
    size = 32 + 2 * H * W * 3
    ask = make(tmp_path, budget_gb=10 * size / 2**30)
    for image in range(10):
        imagine_rows(ask, *question(FF, image=image))
    assert imagine_rows(ask, *question(FF, image=0))[1] == 0  # used again: no longer the oldest
    for image in range(10, 13):
        imagine_rows(ask, *question(FF, image=image))
    assert sum(path.stat().st_size for path in tmp_path.rglob("*.frames")) <= 10 * size
    assert imagine_rows(ask, *question(FF, image=0))[1] == 0 and imagine_rows(ask, *question(FF, image=12))[1] == 0
    assert imagine_rows(ask, *question(FF, image=1))[1] == 1
    with pytest.raises(ArgumentError, match="budget"):
        RolloutCache(tmp_path, 0)


def test_where_nothing_can_be_written_the_run_goes_on_and_says_so_once(tmp_path, caplog) -> None:
    (tmp_path / "file").write_text("")
    ask = make(tmp_path / "file" / "cache")
    with caplog.at_level(logging.WARNING, "wiw.rollouts"):
        assert imagine_rows(ask, *question(FF))[1] == 1 and imagine_rows(ask, *question(FF, image=9))[1] == 1
    assert caplog.text.count("no longer cached") == 1


class HalfWritten(io.FileIO):
    """A file on a disk that is full after half of the first write."""

    def write(self, data):
        if self.tell():
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(memoryview(data)[: len(data) // 2])


@pytest.mark.parametrize("buffer", [16, 8192], ids=["while it is written", "when it is closed"])
def test_a_disk_that_fills_up_within_an_entry_costs_the_cache_and_leaves_no_draft(
    tmp_path, caplog, monkeypatch, buffer
) -> None:
    opened, drafts = Path.open, []

    def open_half(path, mode="r", **options):
        if path.suffix != ".draft":
            return opened(path, mode, **options)
        drafts.append(path)
        return io.BufferedWriter(HalfWritten(path, "w"), buffer)

    ask = make(tmp_path)
    with monkeypatch.context() as patched, caplog.at_level(logging.WARNING, "wiw.rollouts"):
        patched.setattr(Path, "open", open_half)
        for image in (0, 9):
            frames, rows = imagine_rows(ask, *question(FF, image=image))
            assert rows == 1 and (frames[:, 0] == image).all()
    assert len(drafts) == 1 and not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert caplog.text.count("no longer cached: [Errno 28] No space left on device") == 1
    assert [imagine_rows(make(tmp_path), *question(FF))[1] for _ in range(2)] == [1, 0]


def test_a_file_system_without_locks_costs_the_cache_and_no_rollout(tmp_path, caplog, monkeypatch) -> None:
    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(rollout_cache.fcntl, "flock", refuse)
    ask = make(tmp_path / "cache")
    with caplog.at_level(logging.WARNING, "wiw.rollouts"):
        for image in (0, 9):
            frames, rows = imagine_rows(ask, *question(FF, image=image))
            assert rows == 1 and (frames[:, 0] == image).all()
    assert caplog.text.count("no longer cached: [Errno 37] No locks available") == 1


def test_many_writers_and_readers_agree(tmp_path) -> None:
    """Threads with caches of their own stand for processes: they share nothing but the folder."""
    right = {image: Counting().rollout(*question(FF, image=image)) for image in range(8)}
    wrong = []

    def work(seed):
        order = np.random.default_rng(seed).permutation(np.repeat(np.arange(8), 8))
        ask = make(tmp_path, budget_gb=6 * (32 + 2 * H * W * 3) / 2**30)
        wrong.extend(i for i in order if (ask.rollout(*question(FF, image=i))[0, 1:] != right[i][0, 1:]).any())

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong and not list(tmp_path.rglob("*.draft"))


def test_who_is_cached(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("WIW_CACHE", str(tmp_path))
    kept = cache_rollouts(Attempted(Counting()), "auto")
    assert isinstance(kept, Cached) and kept.cache.folder == default_folder() == tmp_path / "rollouts"
    warp, oracle = Attempted(wiw.world_model("warp")), Attempted(wiw.world_model("oracle"))
    assert cache_rollouts(warp, "auto") is warp and isinstance(cache_rollouts(warp, tmp_path / "x"), Cached)
    assert cache_rollouts(oracle, tmp_path / "x") is oracle
    assert not isinstance(cache_rollouts(Attempted(Counting()), "off"), Cached)


def fingerprint_of(**changes) -> str:
    """Of a model whose class, options or declaration differ in something."""
    options = {name: changes.pop(name) for name in ("weights", "_hidden") if name in changes}
    model = type("Counting", (Counting,), changes)()
    vars(model).update(options)
    return model.fingerprint()


def test_a_version_and_public_options_name_what_is_kept() -> None:
    plain = fingerprint_of()
    assert len(plain) == 40 and plain == fingerprint_of() == fingerprint_of(_hidden=object())
    others = [fingerprint_of(version="2"), fingerprint_of(weights=2.0), fingerprint_of(__qualname__="Other")]
    assert len({plain, *others}) == 4
    assert fingerprint_of(weights=2.0, immaterial=("weights",)) == fingerprint_of(weights=3.0, immaterial=("weights",))


@pytest.mark.parametrize("kind", [str, Path])
def test_files_among_the_options_count_by_content(tmp_path, kind) -> None:
    file = tmp_path / "weights.bin"
    file.write_bytes(b"one")
    first = fingerprint_of(weights=kind(file))
    file.write_bytes(b"two")
    assert first != fingerprint_of(weights=kind(file))
    file.write_bytes(b"one")
    assert first == fingerprint_of(weights=kind(file))


def test_a_model_without_a_version_is_never_cached_and_a_warning_names_it(tmp_path, caplog) -> None:
    class Nameless(Counting):
        version = ""

    ask = Attempted(Nameless())
    assert not ask.model.fingerprint()
    with caplog.at_level(logging.WARNING, "wiw.rollouts"):
        assert cache_rollouts(ask, tmp_path / "x") is ask and cache_rollouts(ask, "auto") is ask
        assert cache_rollouts(ask, "off") is ask
    assert caplog.text.count("rollouts of Nameless are not cached: it declares no version") == 1
    assert "version = '1'" in caplog.text and not (tmp_path / "x").exists()


def test_an_edited_file_is_another_model(tmp_path) -> None:
    file = tmp_path / "logged.py"
    file.write_text(MODEL)
    before = wiw.world_model(f"{file}:Logged").fingerprint()
    assert before == wiw.world_model(f"{file}:Logged").fingerprint()
    file.write_text(MODEL.replace("251", "2510"))
    assert before != wiw.world_model(f"{file}:Logged").fingerprint()


@pytest.mark.parametrize("name", ["copy", "warp", "warpnet", "armnet"])
def test_built_in_models_declare_a_version(name) -> None:
    if name.endswith("net"):
        pytest.importorskip("torch")
    model = wiw.world_model(name)
    assert model.version and model.fingerprint() == wiw.world_model(name).fingerprint() != ""


def test_whatever_is_cacheable_declares_a_version() -> None:
    for name in wiw.registry.list_world_models():
        kind = wiw.registry.WORLD_MODELS.find(name) if not name.endswith(":") else None
        if isinstance(kind, type) and isinstance(kind.accepts, Accepts) and kind.accepts.cacheable:
            assert kind.version or kind.fingerprint is not wiw.WorldModel.fingerprint, name


MODEL = """
from pathlib import Path

import numpy as np
import wiw


class Logged(wiw.WorldModel):
    accepts = wiw.accepts(control="trajectory", size=(64, 64), view="perspective", cacheable=True)
    version = "1"

    def rollout(self, observations, controls, seeds):
        with Path(__file__).with_suffix(".log").open("a") as log:
            log.write("asked\\n")
        fill = np.array([int(seed) % 251 for seed in seeds], np.uint8)
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        frames[:, 1:] = fill[:, None, None, None, None]
        return frames
"""


def test_the_same_run_twice_asks_nothing(tmp_path, two_rooms) -> None:
    (tmp_path / "logged.py").write_text(MODEL)
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 2})
    agent = wiw.runs.recipes.AgentRecipe("heuristic", f"{tmp_path}/logged.py:Logged", reviser="matcher")
    quiet = {"progress": False, "keep_images": 0}

    def run(name, **options):
        log = wiw.evaluate(task, agent, 2, out=tmp_path / name, cache=tmp_path / "cache", **quiet, **options)
        lines = (tmp_path / "logged.log").read_text().count("asked")
        facts = [(row["episode"], row["decision"], row["scores"], row["executed"]) for row in log.decisions]
        return facts, lines

    first, calls = run("a")
    again, after = run("b", live=1)
    assert calls > 0 and after == calls and again == first
    processes, after = run("p", workers=2)
    assert after == calls and processes == first
    uncached = wiw.evaluate(task, agent, 2, out=tmp_path / "c", cache="off", **quiet)
    assert [(r["episode"], r["decision"], r["scores"], r["executed"]) for r in uncached.decisions] == first
    assert (tmp_path / "logged.log").read_text().count("asked") > calls


class Constructed(wiw.WorldModel):
    """Keeps none of its arguments as they are."""

    accepts = wiw.accepts(control="trajectory", size=(H, W), cacheable=True)
    version = "1"

    def __init__(self, weights=None, gain: float = 1.0, network=None, other=None, **more) -> None:
        self._numbers = gain * np.ones(3)
        self._network = network

    rollout = Counting.rollout


def test_arguments_of_the_constructor_count_though_no_attribute_holds_them(tmp_path) -> None:
    file = tmp_path / "weights.pt"
    file.write_bytes(b"one")
    made = [Constructed(), Constructed(gain=0.1), Constructed(file), Constructed(shift=2)]
    names = [model.fingerprint() for model in made]
    assert len(set(names)) == 4 and "" not in names and Constructed(gain=1.0).fingerprint() == names[0]
    (tmp_path / "copy.pt").write_bytes(b"one")
    assert Constructed(tmp_path / "copy.pt").fingerprint() == names[2], "on another machine it may lie elsewhere"
    file.write_bytes(b"two")
    assert made[2].fingerprint() != names[2] and made[2].files() == [file]
    assert Constructed(key="SECRET").describe() == {"name": "Constructed"}, "records are shown and passed on"
    assert pickle.loads(pickle.dumps(made[1])).fingerprint() == names[1]
    assert Constructed(other=object()).fingerprint() == "", "nobody can tell it from others"
    own = type("Own", (Constructed,), {"describe": lambda self: {"name": "Own"}})
    assert own(other=object()).fingerprint()


def test_networks_given_in_memory_count_by_their_parameters(tmp_path, caplog) -> None:
    torch = pytest.importorskip("torch")
    one, two = (torch.nn.Linear(3, 2) for _ in range(2))
    names = [Constructed(network=network).fingerprint() for network in (one, two, one)]
    assert names[0] == names[2] != names[1] and "" not in names
    with torch.no_grad():
        one.weight += 1
    assert Constructed(network=one).fingerprint() != names[0]
    with caplog.at_level(logging.WARNING, "wiw.rollouts"):
        unknown = Attempted(Constructed(other=one))  # it is no attribute
        assert cache_rollouts(unknown, "auto") is unknown
    assert "made with an object that does not identify it" in caplog.text
