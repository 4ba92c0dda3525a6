# SPDX-License-Identifier: Apache-2.0
"""Flags that choose a task and an agent, declared once for all commands that run agents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from wiw.cli.options import Options, model_options, policy_options, semantics_options, task_options, tracker_options
from wiw.errors import ArgumentError
from wiw.loop.config import PlanConfig

if TYPE_CHECKING:
    from wiw.runs.recipes import AgentRecipe, TaskRecipe

Name = Annotated[str, arg(metavar="NAME")]
MaybeName = Annotated[str | None, arg(metavar="NAME")]
Folder = Annotated[Path | None, arg(metavar="DIR")]


@dataclass(frozen=True, kw_only=True)
class TaskFlags:
    """A task's episodes and rules."""

    tasks: Annotated[str | None, arg(metavar="all|A,B,...")] = None
    """For manipulation: which of its tasks to run, taken in turn. Default: all."""
    scenes: Annotated[str | None, arg(metavar="SPEC")] = None
    """apartments:train|val|test[[:FIRST]:END], a mesh (GLB, glTF, OBJ, PLY, DAE), a Gazebo world, or scans
    (hm3d:DIR:val, mp3d:DIR, replica:DIR, hssd:DIR, replicacad:DIR, procthor:DIR). Default: apartments:val."""
    per_scene: Annotated[int | None, arg(metavar="N")] = None
    """Episodes generated in a scene before moving on to the next. Default: the task's."""
    tier: Literal["near", "far", "beyond", "all"] | None = None
    """For imagenav: goals 2 to 5 m away (near), 5 to 8 m away (far), or one corner beyond what is visible from the
    start, where the way forks (beyond); all: the three in turn, each with its own tables."""
    episode_file: Annotated[Path | None, arg(metavar="FILE")] = None
    """File of episodes to run instead of generated ones, from `wiw episodes`, habitat-lab or World-in-World."""
    scene_folder: Folder = None
    """Folder that the scene paths in that file are relative to. Default for files of wiw: the file's own folder."""
    motion: Literal["refuse", "slide"] | None = None
    """Treatment of blocked moves. Default: the preset's rule."""
    robot: Annotated[Path | None, arg(metavar="URDF")] = None
    """For manipulation: description of the robot arm. Default: the Franka Panda, in simple shapes."""
    preset: Annotated[str | None, arg(metavar="NAME|FILE")] = None
    """All settings that scores depend on: default, paper, official (the paper's published code), foresight (for ar and
    imagenav), paper-diffusion (for manipulation), or your own YAML file. The command line takes precedence. See
    `wiw list presets`."""
    task_option: Options = ()
    """A rule of the preset, such as decisions=10, or another option of the task, such as categories=bed,sofa; may be
    repeated."""
    backend: Literal["auto", "cpu", "gpu"] | None = None
    """Renderer. Default: auto."""
    allow_missing_textures: bool = False
    """Run on scans even if more than 5 % of the surface lacks its texture and is drawn grey."""

    def make_recipe(self, task: str, seed: int | None) -> TaskRecipe:
        """Return the recipe of a task; without a seed, that of a task that takes one has 0.

        Raises:
            ArgumentError: a task option that has a flag of its own, or that cannot be read.
        """
        from wiw.runs.recipes import TaskRecipe
        from wiw.scenes import allow_missing_textures

        if self.allow_missing_textures:
            allow_missing_textures()
        here = ("task_option", "allow_missing_textures")
        flags = {name: value for name, value in vars(self).items() if name not in here}
        return TaskRecipe(task, task_options(task, self.task_option, {**flags, "seed": seed})).with_default_seed()


@dataclass(frozen=True, kw_only=True)
class AgentFlags:
    """An agent's parts and their options."""

    world_model: Name = "none"
    """Name, path.py:Class or package.module:Class. See `wiw list`."""
    world_model_option: Options = ()
    """An option of --world-model, such as weights=FOLDER or steps=30; may be repeated. isolate=false runs your own
    model in the run's process."""
    policy: MaybeName = None
    """Policy that proposes plans: name, path.py:Class, or isolated:path.py:Class to run it in a separate process.
    Default: the task's (matcher, or navigator with preset foresight; for ar recogniser, for aeqa explorer, for
    manipulation scripted)."""
    policy_option: Options = ()
    """An option of --policy, such as weights=FILE; may be repeated. It also applies to privileged counterparts in
    --arms."""
    revision: MaybeName = None
    """Policy that scores imagined futures. Default: the policy's own choice."""
    revision_option: Options = ()
    """An option of --revision; may be repeated."""
    tracker: MaybeName = None
    """For ar: tracker that finds the target in imagined frames, such as sam2 or reprojection. See `wiw list trackers`.
    Default: frames for policy vlm; reprojection for recogniser, or growing with preset foresight."""
    tracker_option: Options = ()
    """An option of --tracker, such as weights=FOLDER for sam2; may be repeated."""
    vlm: Annotated[str | None, arg(metavar="URL")] = None
    """For policy vlm: an OpenAI-compatible server, remote:FOLDER (servers announced there), transformers:PATH,
    replay:RUN, or mock. Default: http://localhost:8000/v1."""
    vlm_model: MaybeName = None
    """The model's name on the server, or a preset from `wiw list`; not needed if the server has only one model."""
    vlm_prices: Annotated[Path | None, arg(metavar="FILE")] = None
    """YAML file of prices as `model: [read, written]`, dollars per million tokens, for the cost tables."""
    prompts: Annotated[str | None, arg(metavar="NAME|DIR")] = None
    """For policy vlm: a set of prompts, default or minimal, or your own folder, such as one written by `wiw prompts
    import`."""
    semantics: MaybeName = None
    """Source of semantic labels for world models that need them: simulator, rednet, or path.py:Class."""
    semantics_option: Options = ()
    """An option of --semantics, such as weights=FILE; may be repeated."""

    def make_recipe(
        self, task: str, preset: str | None, search: PlanConfig, policies: Sequence[str] = ()
    ) -> AgentRecipe:
        """Return the recipe of an agent for a task and its preset; `policies` are others that arms name.

        Raises:
            ArgumentError: options without the part that takes them; a width without depth.
        """
        from wiw.runs.recipes import AgentRecipe, TaskRecipe, absolute

        if search.width is not None and search.depth == 1:
            raise ArgumentError(
                "--width: a search with one level does not extend plans; give --depth 2 or more, or leave --width out"
            )
        policy, reviser = (
            absolute(self.policy or TaskRecipe(task, {"preset": preset}).find_policy()),
            self.revision and absolute(self.revision),
        )
        options = policy_options(policy, self.policy_option, self._vlm_options([policy, reviser or "", *policies]))
        options = policy_options(reviser, self.revision_option, options, "--revision-option")
        model = None if self.world_model == "none" else absolute(self.world_model)
        return AgentRecipe(
            policy, model, reviser, **vars(search),
            model_options=model_options(model, self.world_model_option),
            semantics=self.semantics and absolute(self.semantics),
            semantics_options=semantics_options(self.semantics, self.semantics_option),
            policy_options={name: _name_places(own) for name, own in options.items()},
            tracker=self.tracker and absolute(self.tracker),
            tracker_options=tracker_options(self.tracker, self.tracker_option),
        )  # fmt: skip

    def _vlm_options(self, policies: Sequence[str]) -> dict[str, Any]:
        """Return the options of policy vlm, with its address, so that the record says which server it used."""
        flags = {"vlm": self.vlm, "model": self.vlm_model, "prices": self.vlm_prices, "prompts": self.prompts}
        options = {name: _make_absolute(name, value) for name, value in flags.items() if value is not None}
        if "vlm" not in policies:
            if options:
                raise ArgumentError(
                    "--vlm, --vlm-model, --vlm-prices and --prompts are for policy vlm: give --policy vlm or "
                    "--revision vlm"
                )
            return {}
        return {"vlm": {"vlm": "http://localhost:8000/v1", **options}}


def _make_absolute(name: str, value: Any) -> str:
    """Return an option of policy vlm, made absolute if it is a path."""
    from wiw.policies.vlm.prompts.templates import SETS

    is_path = isinstance(value, Path) or (name == "prompts" and value not in SETS)
    return str(Path(value).expanduser().resolve()) if is_path else str(value)


def _name_places(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return a policy's options with the place of its language model, and of its roles', named from the root on."""
    made = dict(options)
    if isinstance(place := options.get("vlm"), str):
        made["vlm"] = _name_place(place)
    if isinstance(roles := options.get("roles"), Mapping):
        made["roles"] = {role: _name_places(own) if isinstance(own, Mapping) else own for role, own in roles.items()}
    return made


def _name_place(vlm: str) -> str:
    """Return where a language model is, with its folder or file, if it has one, named from the root on."""
    from wiw.runs.part_options import find_path
    from wiw.vlm.servers import ANNOUNCED

    kind, _, place = vlm.partition(":")
    if vlm.startswith(ANNOUNCED):  # there may be none yet
        return f"{ANNOUNCED}{Path(place).expanduser().resolve()}"
    path = find_path(place) if kind in ("transformers", "replay") else None  # else the name of a model on a hub
    return vlm if path is None else f"{kind}:{path}"
