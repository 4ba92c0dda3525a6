# SPDX-License-Identifier: Apache-2.0
"""Everything that reads bytes which strangers may have made, with a whole sample for each, and ways of damage."""

from __future__ import annotations

import gzip
import json
import math
import random
import re
import shutil
import socket
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import msgpack
import numpy as np
from jinja2 import TemplateSyntaxError

import wiw
from wiw import _core
from wiw.errors import Error
from wiw.mapping_files import parse_yaml

Read = Callable[[bytes, Path], Any]
"""Reads bytes, for which it may use a folder."""
Mutate = Callable[[bytes, random.Random], bytes]
CONFIGS = Path(wiw.__file__).parent / "configs"
DATASET_CONFIG = "tiny.scene_dataset_config.json"
"""Name of the configuration that `scan_files.write_scene_dataset` writes."""
MOST_BYTES = 3 << 30
"""Memory that a process which reads damaged bytes may take."""


@dataclass(frozen=True)
class Reader:
    """A reader, which takes bytes or refuses them by an error of wiw's or of the kinds named."""

    make_sample: Callable[[Path], bytes]
    read: Read
    structure: str = ""
    """The format in which values may be exchanged with the whole still well-formed; see `STRUCTURES`."""
    refusals: tuple[type[BaseException], ...] = ()
    """Errors beyond wiw's own that its caller expects."""

    def refuses(self, error: BaseException) -> bool:
        return isinstance(error, (Error, *self.refusals))


# -- damage ------------------------------------------------------------------------------------------------------------


def damage(data: bytes, draw: random.Random, structure: str) -> bytes:
    """Return the bytes with one to four changes, half of them within the structure where there is one."""
    from test_damaged_files import mutate

    return STRUCTURES[structure](data, draw) if structure and draw.random() < 0.5 else mutate(data, draw)


def damage_json(data: bytes, draw: random.Random) -> bytes:
    from test_episode_files_mutated import as_json, change_value

    return as_json(change_value(json.loads(data), draw))


def damage_yaml(data: bytes, draw: random.Random) -> bytes:
    return damage_json(json.dumps(parse_yaml(data.decode())).encode(), draw)  # JSON is YAML


def damage_msgpack(data: bytes, draw: random.Random) -> bytes:
    from test_episode_files_mutated import change_value

    changed = change_value(msgpack.unpackb(data, strict_map_key=False), draw)
    try:
        return bytes(msgpack.packb(changed))
    except (OverflowError, ValueError, UnicodeEncodeError):  # a number or a depth that it has not
        return data[: draw.randrange(len(data))]


def damage_glb(data: bytes, draw: random.Random) -> bytes:
    """Change a value of the document, and leave lengths and the other chunk as they must be."""
    (length,) = struct.unpack_from("<I", data, 12)
    document = damage_json(data[20 : 20 + length], draw)
    document += b" " * (-len(document) % 4)
    chunks = struct.pack("<II", len(document), 0x4E4F534A) + document + data[20 + length :]
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def damage_safetensors(data: bytes, draw: random.Random) -> bytes:
    """Change a value of the header, or of the card and the sizes in it; tensors stay where they are."""
    (length,) = struct.unpack_from("<Q", data)
    header = json.loads(data[8 : 8 + length])
    metadata = header["__metadata__"]
    if draw.random() < 0.5:
        metadata["header"] = damage_json(metadata["header"].encode(), draw).decode()
        document = json.dumps(header).encode()
    else:
        document = damage_json(json.dumps(header).encode(), draw)
    return struct.pack("<Q", len(document)) + document + data[8 + length :]


def damage_sqlite(data: bytes, draw: random.Random) -> bytes:
    """Change the values of a column, the text of a table's schema, or the number of the schema."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "damaged.sqlite"
        path.write_bytes(data)
        with closing(sqlite3.connect(path)) as connection, connection:
            tables = connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchall()
            for _ in range(draw.randrange(1, 4)):
                table, text = draw.choice(tables)
                kind = draw.random()
                if kind < 0.4:
                    change_column(connection, table, draw)
                elif kind < 0.8:
                    connection.execute("PRAGMA writable_schema = ON")
                    changed = damage_words(text, draw)
                    connection.execute("UPDATE sqlite_master SET sql = ? WHERE name = ?", (changed, table))
                else:
                    connection.execute(f"PRAGMA user_version = {draw.randrange(-1, 14)}")
        return path.read_bytes()


def change_column(connection: sqlite3.Connection, table: str, draw: random.Random) -> None:
    from test_episode_files_mutated import as_json, change_value

    column = draw.choice([row[1] for row in connection.execute(f"PRAGMA table_info({table})")])
    values = [value for (value,) in connection.execute(f"SELECT {column} FROM {table}")]
    other = draw.choice((None, -1, 2**62, 0.5, math.inf, "", "x", b"\xff", "done"))
    if values and isinstance(values[0], str) and values[0][:1] in ("{", "[") and draw.random() < 0.8:
        with suppress(ValueError, RecursionError):  # damaged before
            other = as_json(change_value(json.loads(draw.choice(values)), draw)).decode()
    connection.execute("PRAGMA ignore_check_constraints = ON")
    with suppress(sqlite3.IntegrityError):  # a key cannot be text
        connection.execute(f"UPDATE OR IGNORE {table} SET {column} = ?", (other,))


def damage_words(text: str, draw: random.Random) -> str:
    """Remove, double or replace a word, or change a letter."""
    words = re.findall(r"\w+|\W+", text)
    at = draw.randrange(2, len(words))
    words[at] = draw.choice(("", words[at] * 2, draw.choice(words), words[at][:-1] + chr(draw.randrange(1, 300))))
    return "".join(words)


STRUCTURES: dict[str, Mutate] = {
    "json": damage_json,
    "yaml": damage_yaml,
    "msgpack": damage_msgpack,
    "glb": damage_glb,
    "safetensors": damage_safetensors,
    "sqlite": damage_sqlite,
}


# -- readers -----------------------------------------------------------------------------------------------------------


def from_file(name: str, read: Callable[[Path], Any]) -> Read:
    """Return a reader of bytes, given one of files of such a name."""

    def read_bytes(data: bytes, folder: Path) -> Any:
        (folder / name).write_bytes(data)
        return read(folder / name)

    return read_bytes


def write_and_take(name: str, write: Callable[[Path], Any]) -> Callable[[Path], bytes]:
    """Return the bytes of a file that `write` makes."""

    def make(folder: Path) -> bytes:
        write(folder / name)
        return (folder / name).read_bytes()

    return make


def make_navmesh(path: Path) -> None:
    floor = np.array([[0, 0, 0], [4, 0, 0], [4, 0, 4], [0, 0, 4]], np.float32)
    wiw.nav.NavMesh.from_triangles(floor, np.array([[0, 2, 1], [0, 3, 2]])).save(path)


def read_navmesh(path: Path) -> Any:
    mesh = wiw.nav.NavMesh.load(path)
    mesh.triangles()
    return mesh.distance_matrix(np.array([[1, 0, 1], [3, 0, 3]], np.float32))


def make_scene_cache(path: Path) -> None:
    from test_damaged_files import PLY, plain

    path.with_suffix(".ply").write_bytes(PLY)
    _core.scene.write_cache(plain(path.with_suffix(".ply")), path)


def read_scene_cache(path: Path) -> Any:
    scene = _core.scene.map_cache(path)
    return scene.describe(), scene.bounds


def make_frames(path: Path) -> None:
    from test_navigation_data import made_up

    from wiw.datasets.navigation_files import build_table, navigation_schema, write_frames

    schema = navigation_schema(True, {})
    write_frames(path, schema, [build_table(made_up(np.random.default_rng(0), 3, 1, True, True), schema)])


def read_frames(path: Path) -> Any:
    from wiw.datasets.navigation_files import FrameFile

    return FrameFile(path).read_segment(0)


def make_lerobot_info(folder: Path) -> bytes:
    """Export a demonstration of three frames into the folder; return what describes the files of the dataset."""
    from test_lerobot import make_up

    from wiw.datasets import shards
    from wiw.datasets.lerobot import export_lerobot

    made, lerobot = folder / "made", folder / "lerobot"
    made.mkdir()
    manifest = {"tasks": ["made"], "episodes": 1, "size": 8, "depth": False}
    (made / "manifest.json").write_text(json.dumps(manifest))
    shards.write(made / "made-00000.parquet", [make_up(np.random.default_rng(0), 3, 0, False)], {"task": "made"})
    export_lerobot(made, lerobot)
    return (lerobot / "meta/info.json").read_bytes()


def read_lerobot_info(data: bytes, folder: Path) -> Any:
    from wiw.datasets.lerobot import manipulation
    from wiw.datasets.lerobot.reading import LeRobotFolder

    (folder / "lerobot/meta/info.json").write_bytes(data)
    found = LeRobotFolder(folder / "lerobot")
    return list(found.read_episodes(manipulation.describe_features(found.source["manifest"]), manipulation.FACTS))


def make_weights(path: Path) -> None:
    from wiw.policies.navigator import weights
    from wiw.policies.navigator.network import Network

    weights.save(path, Network(8, 2), {"scenes": "none"})


def read_weights(path: Path) -> Any:
    from wiw.policies.navigator import weights

    return weights.load(path)


def make_store(path: Path) -> None:
    from crash_victims import evaluate

    with TemporaryDirectory(dir=path.parent) as folder:
        evaluate(f"{folder}/run", episodes=1, keep_images=0)
        shutil.copy(f"{folder}/run/run.sqlite", path)


def read_store(path: Path) -> Any:
    from wiw.studies.run_log import load_run

    log = load_run(path)
    try:
        store = log.store
        keys = [(row["arm"], row["episode"], row["decision"]) for row in store.decisions()]
        pictures = [store.images(*key) for key in keys]
        tables = log.numbers(), log.costs(), log.fidelity(), log.blame(), log.breakdown("anytime")
        return store.outcomes(), store.episodes(), store.info, store.judges, pictures, tables
    finally:
        log.close()


def make_questions(path: Path) -> None:
    from test_openeqa import ITEM

    path.write_text(json.dumps([ITEM]))


def read_questions(path: Path) -> Any:
    from wiw.datasets.questions import openeqa

    return openeqa.load(path)


def make_episodes(path: Path) -> None:
    from test_episode_files_mutated import own_file

    path.write_bytes(gzip.compress(own_file(path), mtime=0) if path.suffix == ".gz" else own_file(path))


def read_episodes(path: Path) -> Any:
    from wiw.datasets import episodes

    return episodes.load(path)


def read_preset(path: Path) -> Any:
    from wiw.tasks.presets import load_preset

    return load_preset("imagenav", path)


def read_study(path: Path) -> Any:
    from wiw.studies.study_file import load_study

    return load_study(path)


def read_recipe(path: Path) -> Any:
    from wiw.training.post_training.recipe import load_recipe

    return load_recipe("pocket", path)


def make_scene_instance(path: Path) -> None:
    from scan_files import write_scene_dataset

    written = write_scene_dataset(path.parent)
    shutil.copy(written, path)


def read_scene_instance(data: bytes, folder: Path) -> Any:
    from wiw.scenes.scans import scene_dataset

    path = folder / "scenes/home.scene_instance.json"
    path.write_bytes(data)
    return scene_dataset.read(path, {}).scene.describe()


def make_dataset_config(path: Path) -> None:
    """Write the configuration of a dataset with one scene, and leave the scene beside it."""
    from scan_files import write_scene_dataset

    write_scene_dataset(path.parent)
    shutil.copy(path.parent / DATASET_CONFIG, path)


def read_dataset_config(data: bytes, folder: Path) -> Any:
    """Read the scene that a configuration leads to, and list all that it has."""
    from wiw.scenes.scans import scene_dataset

    (folder / DATASET_CONFIG).write_bytes(data)
    scene = scene_dataset.read(folder / "scenes/home.scene_instance.json", {}).scene
    return scene.describe(), scene_dataset.find(folder, "")


def read_lexicon(data: bytes, folder: Path) -> Any:
    from wiw.scenes.scans.scene_dataset import Dataset

    (folder / "lexicon.json").write_bytes(data)
    body = {"semantic_scene_descriptor_instances": {"paths": {".json": ["lexicon.json"]}}}
    return Dataset(folder / DATASET_CONFIG, body).read_class_names(None)


def read_names(data: bytes, folder: Path) -> Any:
    from wiw.scenes.scans.scene_dataset import Dataset

    (folder / "semantics").mkdir(exist_ok=True)
    (folder / "semantics/objects.csv").write_bytes(data)
    return Dataset(folder / DATASET_CONFIG, {}).listed_names


def make_annotations(folder: Path) -> bytes:
    from scan_files import annotation_text

    return annotation_text().encode()


def read_annotations(path: Path) -> Any:
    from wiw.scenes.scans import hm3d

    return hm3d.read_annotations(path)


def make_house(folder: Path) -> bytes:
    from scan_files import house_text

    return house_text().encode()


def read_house(path: Path) -> Any:
    from wiw.scenes.scans import matterport

    return matterport.read_house(path)


def make_replica_table(folder: Path) -> bytes:
    from scan_files import write_replica

    return (write_replica(folder).parent / "info_semantic.json").read_bytes()


def read_replica_table(path: Path) -> Any:
    from wiw.scenes.scans import replica

    return replica.read_objects(path)


def read_model_index(path: Path) -> Any:
    from wiw.world_models.video.weights import require_kind

    return require_kind(path.parent, ["WanPipeline"], {"boundary_ratio": True, "expand_timesteps": False})


def make_action_config(path: Path) -> None:
    from wiw.world_models.video.actions.config import ActionConfig

    ActionConfig(base="wan2.1", weights="w", width=8, stride=4).save(path.parent)


def read_action_config(path: Path) -> Any:
    from wiw.world_models.video.actions.config import ActionConfig

    return ActionConfig.load(path.parent).ids


def make_rollout(path: Path) -> None:
    from wiw.loop.rollout_cache import RolloutCache

    RolloutCache(path.parent / "cache").put("ab" + "0" * 30, 0, np.arange(96, dtype=np.uint8).reshape(2, 4, 4, 3))
    (made,) = path.parent.rglob("*.frames")
    shutil.copy(made, path)


def read_rollout(data: bytes, folder: Path) -> Any:
    from wiw.loop.rollout_cache import RolloutCache

    path = folder / "ab" / ("0" * 30 + ".frames")
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return RolloutCache(folder).get("ab" + "0" * 30, 0, np.empty((2, 4, 4, 3), np.uint8))


TEMPLATE = b"""You see its {{ obs_key }}.{# a remark #}
{% for name, meaning in actions.items() if plan_num > 0 %}
- {{ name | upper }}: {{ meaning }}
{% endfor %}
{% set braces %}{% raw %}{{ }}{% endraw %}{% endset %}
{% if captions and shown == "strip" %}
Give {{ look_ahead_action_num * 2 }} of {{ [1, 2.5, "three"][:2] | join(", ") }}.
{% else %}
{{ braces ~ centred }}
{% endif %}
"""


def read_prompts(data: bytes, folder: Path) -> Any:
    """Read a folder with one template, which is parsed here too: no fuzzer sees the process that fills it."""
    from wiw.policies.vlm.prompts import templates
    from wiw.vlm.template_worker import ENVIRONMENT

    path = folder / "imagenav" / "planner.j2"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    with suppress(UnicodeDecodeError, TemplateSyntaxError, RecursionError):  # Prompts says what is wrong
        ENVIRONMENT.parse(data.decode())
    with patch.object(templates, "TemplateFiller", start_filler):
        return templates.Prompts(folder).digest


@cache
def start_filler() -> Any:
    """Return one process for all templates: it takes a third of a second to start."""
    from wiw.vlm.template_filler import TemplateFiller

    return TemplateFiller()


def make_paper(path: Path) -> None:
    from test_prompt_import import PLANNER, write_paper

    write_paper(path.parent, ("ImageNav Planner Prompt", PLANNER), ("AR Answerer Prompt", "Name \\emph{it}."))


def read_paper(path: Path) -> Any:
    from wiw.policies.vlm.prompt_import.slots import convert_slots
    from wiw.policies.vlm.prompt_import.sources import read_source

    return {name: convert_slots(name, prompt) for name, prompt in read_source(path)[0].items()}


def read_announcement(path: Path) -> Any:
    from wiw.wire.address_book import read_addresses

    return read_addresses(path)


def read_job_list(path: Path) -> Any:
    from wiw.runs.submission import read_jobs

    return read_jobs(path.parent)


def read_message(data: bytes, folder: Path) -> Any:
    from wiw.wire.messages import decode

    return decode(data)


def make_message(folder: Path) -> bytes:
    from test_wire import MESSAGES

    from wiw.wire.messages import encode

    return max(map(encode, MESSAGES), key=len)


def make_row(folder: Path) -> bytes:
    from test_wire import ROW

    return bytes(ROW)


def read_row(data: bytes, folder: Path) -> Any:
    from wiw.wire.rows import unpack_row

    return unpack_row(data)


def read_reply(data: bytes, folder: Path) -> Any:
    """Read what a model's process answers, as the run's side of the firewall does."""
    from wiw.isolation.connection import send
    from wiw.isolation.process import ChildProcess, _build_error

    ours, theirs = socket.socketpair()
    with ours, theirs:
        process = object.__new__(ChildProcess)
        process._connection, process._await_reply = ours, lambda until: None  # type: ignore[method-assign]
        send(theirs, data)
        reply = process._receive(None)
    return _build_error(reply["error"]) if "error" in reply else reply.get("value")


def make_reply(folder: Path) -> bytes:
    error = {"type": "RolloutError", "kind": "raised", "text": "why"}
    return bytes(msgpack.packb({"held": True, "value": {"shape": [2, 3], "dtype": "uint8"}, "error": error}))


def make_glb(folder: Path) -> bytes:
    from test_damaged_files import textured_glb

    return textured_glb()


def make_stl(folder: Path) -> bytes:
    faces = np.zeros(4, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces["corners"] = corners[[[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]]
    return b"\0" * 80 + struct.pack("<I", 4) + faces.tobytes()


def read_mesh(path: Path) -> Any:
    from test_damaged_files import plain

    return plain(path).describe()


def read_link(path: Path) -> Any:
    return wiw.physics.read_surface(path, link="hand")


def take_config(name: str) -> Callable[[Path], bytes]:
    return lambda folder: (CONFIGS / name).read_bytes()


READERS: dict[str, Reader] = {
    "glb": Reader(make_glb, from_file("m.glb", read_mesh), "glb"),
    "link stl": Reader(make_stl, from_file("m.stl", read_link)),
    "navmesh": Reader(write_and_take("m.navmesh", make_navmesh), from_file("m.navmesh", read_navmesh)),
    "scene cache": Reader(write_and_take("m.wiwscene", make_scene_cache), from_file("m.wiwscene", read_scene_cache)),
    "store": Reader(write_and_take("run.sqlite", make_store), from_file("run.sqlite", read_store), "sqlite"),
    "episodes": Reader(write_and_take("e.json", make_episodes), from_file("e.json", read_episodes), "json"),
    "questions": Reader(write_and_take("q.json", make_questions), from_file("q.json", read_questions), "json"),
    "preset": Reader(take_config("default/imagenav.yaml"), from_file("p.yaml", read_preset), "yaml"),
    "scene instance": Reader(write_and_take("s.json", make_scene_instance), read_scene_instance, "json"),
    "scene dataset": Reader(write_and_take("d.json", make_dataset_config), read_dataset_config, "json"),
    "lexicon": Reader(lambda folder: b'{"classes": [{"id": 3, "name": "Couch"}]}', read_lexicon, "json"),
    "names of objects": Reader(lambda folder: b'id,name,main_category\n7af3,"sofa, grey",sofa\n8b,lamp,\n', read_names),
    "labels of HM3D": Reader(make_annotations, from_file("s.semantic.txt", read_annotations)),
    "house of Matterport3D": Reader(make_house, from_file("s.house", read_house)),
    "table of Replica": Reader(make_replica_table, from_file("info_semantic.json", read_replica_table), "json"),
    "model index": Reader(
        lambda folder: b'{"_class_name": "WanPipeline", "boundary_ratio": 0.9, "vae": ["diffusers", "Autoencoder"]}',
        from_file("model_index.json", read_model_index),
        "json",
    ),
    "action config": Reader(
        write_and_take("config.json", make_action_config), from_file("config.json", read_action_config), "json"
    ),
    "study": Reader(take_config("studies/vlm.yaml"), from_file("s.yaml", read_study), "yaml"),
    "recipe": Reader(take_config("post-training/pocket.yaml"), from_file("r.yaml", read_recipe), "yaml"),
    "rollout": Reader(write_and_take("r.frames", make_rollout), read_rollout),
    "prompts": Reader(lambda folder: TEMPLATE, read_prompts),
    "paper": Reader(write_and_take("main.tex", make_paper), from_file("main.tex", read_paper)),
    "announcement": Reader(
        lambda folder: b'{"address": "ws://a:1", "token": "t"}', from_file("1.json", read_announcement), "json"
    ),
    "jobs": Reader(
        lambda folder: b'[{"cluster": "slurm", "id": "7_1", "arguments": ["run", "imagenav"]}]',
        from_file("jobs.json", read_job_list),
        "json",
    ),
    "message": Reader(make_message, read_message, "msgpack"),
    "row": Reader(make_row, read_row, "msgpack"),
    "reply": Reader(make_reply, read_reply, "msgpack", (OSError,)),  # a model's process that broke its protocol
    "weights": Reader(
        write_and_take("w.safetensors", make_weights), from_file("w.safetensors", read_weights), "safetensors"
    ),
    "info of LeRobot": Reader(make_lerobot_info, read_lerobot_info, "json"),
    "frames": Reader(write_and_take("f.parquet", make_frames), from_file("f.parquet", read_frames)),
}
