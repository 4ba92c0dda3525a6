# SPDX-License-Identifier: Apache-2.0
"""Tasks in which an agent walks: where their episodes come from, and the environments they are run in."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from wiw.datasets import episodes as episode_file
from wiw.datasets.scene_sources import digest_scenes
from wiw.datasets.worlds import World, navmesh_file, world
from wiw.envs.episode_state import NavigationSpec
from wiw.envs.navigation import NavigationEnv
from wiw.envs.vector import VectorEnv
from wiw.errors import ArgumentError, FileError
from wiw.render import resolve_backend
from wiw.scenes import absolute, resolve
from wiw.tasks import presets
from wiw.tasks.base import Task
from wiw.typed_values import require_known
from wiw.types import Episode, check_seed

DEFAULT_SCENES, DEFAULT_PER_SCENE = "apartments:val", 5


class NavigationTask(NavigationSpec, Task):
    """Base of the tasks in which an agent walks; a subclass says what its goal is and when it is reached.

    Args:
        scenes: scene spec, e.g. "apartments:test:40", or the path of a mesh or SDF world; None: "apartments:val". If
            Habitat's navigation mesh is beside it ("house.navmesh" for "house.glb"), that one is used.
        seed: seed of the generated episodes and of the run.
        preset: "default", "paper", "official", "foresight", or the path of a YAML file; `rules` overrides its fields.
        episode_file: a JSON episode file to use instead of generating; habitat-lab's and World-in-World's are read too.
        scene_folder: folder that scene paths in an episode file are relative to; if not given, the folder of a file of
            wiw, else the present one.
        per_scene: generated episodes a scene, 5 (None); of each tier, where there are several.
        backend: renderer, "auto", "cpu" or "gpu".
        rules: rules of the task, and of the generator (`generator_class`).

    Raises:
        ArgumentError: rules that are not known, a `per_scene` below 1, or options that an episode file leaves no use
            for.
    """

    rules_class: type
    generator_class: type
    """Dataclass of the rules that generated episodes satisfy, all with defaults."""
    has_guide = True

    def __init__(
        self,
        scenes: str | Path | None = None,
        seed: int = 0,
        preset: str | Path = presets.DEFAULT,
        episode_file: str | Path | None = None,
        scene_folder: str | Path = "",
        per_scene: int | None = None,
        backend: Literal["auto", "cpu", "gpu"] = "auto",
        **rules: Any,
    ) -> None:
        own, generator = presets.rule_names(self.rules_class), presets.rule_names(self.generator_class)
        named = [name for name in inspect.signature(NavigationTask).parameters if name != "rules"]
        require_known(rules, [*named, *own, *generator], self.name, "option")
        self.overridden = {name: value for name, value in rules.items() if name in own}
        """Rules that were given as options."""
        owner = presets.find_owner(type(self))
        self.rules: Any = presets.load_rules(self.rules_class, owner, preset, self.overridden)
        self.preset = presets.make_absolute(preset)
        self.preset_settings = presets.load_preset(owner, preset)
        given = {name: value for name, value in rules.items() if name not in own}
        self._require_use({"scenes": scenes, "per_scene": per_scene, **given}, episode_file, scene_folder)
        self._generator_rules = {**self.preset_settings.generator, **given}
        self.generator: Any = presets.load_rules(self.generator_class, "", presets.DEFAULT, self._generator_rules)
        if per_scene is not None and (not isinstance(per_scene, int | np.integer) or per_scene < 1):
            raise ArgumentError(f"{self.name}: per_scene: expected a whole number of at least 1, got {per_scene!r}")
        self.scenes, self.seed = absolute(DEFAULT_SCENES if scenes is None else scenes), check_seed(seed)
        self.backend, self.per_scene = backend, DEFAULT_PER_SCENE if per_scene is None else per_scene
        self.episode_file = None if episode_file is None else str(Path(episode_file).expanduser().absolute())
        self.scene_folder = str(Path(scene_folder).expanduser().absolute()) if scene_folder else ""
        self._episodes: list[Episode] = []
        self._blocks: dict[int, list[Episode]] = {}
        """Generated blocks by number, where they are made one by one."""

    def _require_use(self, generating: Mapping[str, Any], file: str | Path | None, folder: str | Path) -> None:
        """Refuse options of generated episodes beside a file of episodes, and the folder of its scenes without one."""
        idle = [name for name, value in generating.items() if value is not None]
        if file is not None and idle:
            raise ArgumentError(
                f"{self.name}: {', '.join(idle)}: only for generated episodes, but those of {file} are run as they "
                "are; leave it out, or the episode file"
            )
        if file is None and folder:
            raise ArgumentError(
                f"{self.name}: scene_folder is where the scenes of an episode file are; also give episode_file, or "
                "name the scenes (scenes=...)"
            )

    # -- what a task says of itself, besides `NavigationSpec` ----------------------------------------------------------

    def load_episodes(self) -> list[Episode]:
        """Return the episodes of `episode_file`."""
        assert self.episode_file is not None
        return episode_file.load(self.episode_file, self.scene_folder)

    def generate_episodes(self, place: World, first: int, before: list[Episode]) -> list[Episode]:
        """Return a `block` of generated episodes of a scene, from its number `first` on, after those `before`."""
        raise NotImplementedError(
            f"{type(self).__name__}: implement generate_episodes, or generate_first for all scenes"
        )

    # ------------------------------------------------------------------------------------------------------------------

    @staticmethod
    def make_portable(options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the same options, with absolute paths and the renderer that "auto" stands for."""
        ways: dict[str, Callable[[Any], str]] = {
            "scenes": absolute,
            "preset": presets.make_absolute,
            "backend": resolve_backend,
            "episode_file": lambda path: str(Path(path).expanduser().absolute()),
            "scene_folder": lambda path: str(Path(path).expanduser().absolute()),
        }
        return {
            name: ways[name](value) if name in ways and value not in (None, "") else value
            for name, value in {"backend": "auto", **options}.items()
        }

    @property
    def motion(self) -> str:
        """Rule for blocked moves: "refuse" or "slide"."""
        return str(self.rules.motion)

    @property
    def decisions(self) -> int:
        """K: decisions that an episode may take."""
        return int(self.rules.decisions)

    @property
    def budget(self) -> int:
        """Primitives an episode may take."""
        execute = self.defaults["execute"]
        return int(self.rules.decisions * (execute if execute > 0 else max(1, self.rules.horizon + execute)))

    @property
    def episode_count(self) -> int | None:
        """How many episodes there are; None if a single scene gives as many as are requested."""
        if self.episode_file:
            return len(self._read_file())
        scenes = resolve(self.scenes)
        return None if len(scenes) == 1 else len(scenes) * self.block

    @property
    def drawn_count(self) -> int:
        """Among how many episodes a seed draws: all of a file; of generated ones those of a usual run, as each may
        depend on all before it.
        """
        count = super().drawn_count
        return count if self.episode_file else min(count, super().default_episodes)

    @property
    def block(self) -> int:
        """Episodes generated in a scene at a time."""
        return self.per_scene

    @property
    def default_episodes(self) -> int:
        """All of an episode file; else 20."""
        return len(self._read_file()) if self.episode_file else super().default_episodes

    @property
    def defaults(self) -> dict[str, Any]:
        """Options for `wiw.Agent` that the task prescribes."""
        return {"candidates": self.rules.candidates, "horizon": self.rules.horizon, "execute": self.rules.execute}

    @property
    def file_header(self) -> dict[str, Any]:
        """Header of a file of its episodes."""
        return {"seed": self.seed, "scenes": self.scenes}

    def describe(self) -> dict[str, Any]:
        """Return the JSON-able identity: what must be equal for two runs to be comparable."""
        source: dict[str, Any] = {"scenes": self.scenes, "per_scene": self.per_scene}
        if self._generator_rules:
            source["generator"] = self._generator_rules
        if self.episode_file:
            source = {"episode_file": self.episode_file}
        backend = resolve_backend(self.backend)
        return {"task": self.name, "seed": self.seed, **source, "backend": backend, **asdict(self.rules)}

    def environment(self, depth: bool = False) -> NavigationEnv:
        """Return a gymnasium environment of this task; `depth` adds it to the observations."""
        return NavigationEnv(self, depth)

    def vector_environment(self, num_envs: int, depth: bool = False) -> VectorEnv:
        """Return a gymnasium vector environment of this task, with `num_envs` episodes at a time."""
        return VectorEnv(self, num_envs, depth)

    def episodes(self, count: int) -> list[Episode]:
        """Return the first `count` episodes; generated scene by scene, a `block` each.

        Raises:
            ArgumentError: the episode file or the scenes hold fewer.
        """
        if self.episode_file:
            return self._first_of_file(count)
        if len(self._episodes) < count:
            self._episodes = self.generate_first(count)
        return self._episodes[:count]

    def generate_first(self, count: int) -> list[Episode]:
        """Return the first `count` generated episodes: scene by scene, a `block` each, all of a single scene.

        Raises:
            ArgumentError: the scenes give fewer.
        """
        scenes = resolve(self.scenes)
        if len(scenes) > 1 and count > len(scenes) * self.block:
            raise ArgumentError(
                f"{self.name}: {count} episodes were requested, but there are only {len(scenes) * self.block}; name "
                "more scenes (apartments:SPLIT:N) or increase per_scene"
            )
        made = list(self._episodes)
        while len(made) < count:
            made += self.generate_block(scenes, len(made) // self.block, made)
        return made

    def generate_block(self, scenes: Sequence[str], number: int, before: list[Episode]) -> list[Episode]:
        """Return a block of generated episodes, by its number, after those `before`: of a scene of its own where there
        are several.
        """
        alone = len(scenes) == 1
        place = world(scenes[0] if alone else scenes[number], self.backend)
        made = self.generate_episodes(place, self.block * number if alone else 0, before)
        return [replace(each, episode_id=f"{self.block * number + i:04d}") for i, each in enumerate(made)]

    def _first_of_file(self, count: int) -> list[Episode]:
        found = self._read_file()
        if len(found) < count:
            raise ArgumentError(
                f"{self.name}: {count} episodes were requested, but {self.episode_file} has only {len(found)}; request "
                "fewer, or omit the number to run all of them"
            )
        return found[:count]

    def _read_file(self) -> list[Episode]:
        """Return the episodes of the file, which is read once."""
        self._episodes = self._episodes or self.load_episodes()
        return self._episodes

    def require(self, episodes: Iterable[Episode]) -> dict[str, dict[str, str]]:
        """Check that the scenes of episodes are there, without loading any; each file is read once for its digest.

        Returns:
            For each scene, what it is used with: its "navmesh", a file or "built"; and of a scene that is a file the
            digest of its "content" (`wiw.datasets.scene_sources`).

        Raises:
            FileError: one is not; names it, and the episode file.
        """
        used: dict[str, dict[str, str]] = {}
        for episode in episodes:
            scene = episode.scene
            if scene in used:
                continue
            try:
                resolve(scene)
            except (FileError, ArgumentError) as error:
                where = f"{self.episode_file}: episode {episode.episode_id}: scene: " if self.episode_file else ""
                raise FileError(f"{where}{error}") from error
            used[scene] = {"navmesh": str(navmesh_file(scene) or "built")}
        for scene, digest in digest_scenes({scene: scene for scene in used}).items():
            used[scene]["content"] = digest
        return used

    def episode(self, index: int) -> Episode:
        """Return episode `index` of the task."""
        return Task.episode(self, index)

    def open_world(self, episode: Episode) -> World:
        """Return the scene of an episode with renderer and navigation mesh."""
        return world(episode.scene, self.backend)
