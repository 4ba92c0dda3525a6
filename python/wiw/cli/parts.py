# SPDX-License-Identifier: Apache-2.0
"""Flags that choose a task and an agent, declared once for all commands that run agents."""

from __future__ import annotations

from collections.abc import Sequence
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
    """For manipulation: which of its tasks, taken in turn; all of them if not given."""
    scenes: Annotated[str | None, arg(metavar="SPEC")] = None
    """apartments:train|val|test[[:FIRST]:END], a mesh (GLB, glTF, OBJ, PLY, DAE), a Gazebo world, or scans
    (hm3d:DIR:val, mp3d:DIR, replica:DIR, hssd:DIR, replicacad:DIR, procthor:DIR); apartments:val if not given."""
    per_scene: Annotated[int | None, arg(metavar="N")] = None
    """Episodes generated in a scene before the next one's turn; the task's own number if not given."""
    tier: Literal["near", "far", "beyond", "all"] | None = None
    """For imagenav: goals 2 to 5 m away, 5 to 8 m away, or one corner beyond what the start sees, where the way forks;
    all: the three in turn, each with tables of its own."""
    episode_file: Annotated[Path | None, arg(metavar="FILE")] = None
    """Episodes to run instead of generated ones, from `wiw episodes`, habitat-lab or World-in-World."""
    scene_folder: Folder = None
    """Folder of the scene paths in that file; for files of wiw the file's own folder if not given."""
    motion: Literal["refuse", "slide"] | None = None
    """Rule for blocked moves; the preset's if not given."""
    robot: Annotated[Path | None, arg(metavar="URDF")] = None
    """For manipulation: description of an arm to work with; the Franka Panda, of simple shapes, if not given."""
    preset: Annotated[str | None, arg(metavar="NAME|FILE")] = None
    """All that a number depends on: default, paper, official (its published code), foresight (of ar and imagenav), or
    a YAML file of your own; what the command line says goes before it. See `wiw list presets`."""
    task_option: Options = ()
    """A rule of the preset, such as decisions=10, or another option of the task, such as categories=bed,sofa; may be
    given again."""
    backend: Literal["auto", "cpu", "gpu"] | None = None
    """Renderer; auto if not given."""
    allow_missing_textures: bool = False
    """Run on scans even where more than 5 % of the surface lacks its texture and is drawn grey."""

    def make_recipe(self, task: str, seed: int) -> TaskRecipe:
        """Return the recipe of a task.

        Raises:
            ArgumentError: a task option that has a flag of its own, or that cannot be read.
        """
        from wiw.runs.recipes import TaskRecipe
        from wiw.scenes import allow_missing_textures

        if self.allow_missing_textures:
            allow_missing_textures()
        here = ("task_option", "allow_missing_textures")
        flags = {name: value for name, value in vars(self).items() if name not in here}
        return TaskRecipe(task, task_options(task, self.task_option, {**flags, "seed": seed}))


@dataclass(frozen=True, kw_only=True)
class AgentFlags:
    """An agent's parts and what they are made with."""

    world_model: Name = "none"
    """Name, path.py:Class or package.module:Class. See `wiw list`."""
    world_model_option: Options = ()
    """An option of --world-model, such as weights=FOLDER or steps=30; may be given again. isolate=false runs a model of
    your own in the process of the run."""
    policy: MaybeName = None
    """Proposes plans; name, path.py:Class, or isolated:path.py:Class for a process of its own. If not given, the
    task's: matcher, for ar recogniser, for manipulation scripted."""
    policy_option: Options = ()
    """An option of --policy, such as weights=FILE; may be given again. Privileged counterparts in --arms take it
    too."""
    revision: MaybeName = None
    """Scores imagined futures; the policy's own choice if not given."""
    revision_option: Options = ()
    """An option of --revision; may be given again."""
    tracker: MaybeName = None
    """For ar: finds the target in imagined frames, such as sam2 or reprojection. See `wiw list trackers`. If not given,
    for policy vlm frames, for recogniser reprojection."""
    tracker_option: Options = ()
    """An option of --tracker, such as weights=FOLDER of sam2; may be given again."""
    vlm: Annotated[str | None, arg(metavar="URL")] = None
    """For policy vlm: an OpenAI-compatible server, transformers:PATH, replay:RUN, or mock; http://localhost:8000/v1 if
    not given."""
    vlm_model: MaybeName = None
    """Its name at the server, or a preset of `wiw list`; not needed where the server has one model."""
    vlm_prices: Annotated[Path | None, arg(metavar="FILE")] = None
    """YAML file of `model: [read, written]`, dollars per million tokens, for the costs."""
    prompts: Annotated[str | None, arg(metavar="NAME|DIR")] = None
    """For policy vlm: a set of prompts, default or minimal, or a folder of your own, such as `wiw prompts import`
    writes."""
    semantics: MaybeName = None
    """Tells world models that need it what each pixel is: simulator, rednet, or path.py:Class."""
    semantics_option: Options = ()
    """An option of --semantics, such as weights=FILE; may be given again."""

    def make_recipe(
        self, task: str, preset: str | None, search: PlanConfig, policies: Sequence[str] = ()
    ) -> AgentRecipe:
        """Return the recipe of an agent for a task and its preset; `policies` are further ones that arms name.

        Raises:
            ArgumentError: options without the part that takes them; a width without depth.
        """
        from wiw.runs.recipes import AgentRecipe, TaskRecipe, absolute

        if search.width is not None and search.depth == 1:
            raise ArgumentError(
                "--width: a search of one level extends no plan; give --depth 2 or more, or leave it out"
            )
        policy, reviser = (
            absolute(self.policy or TaskRecipe(task, {"preset": preset}).find_policy()),
            self.revision and absolute(self.revision),
        )
        options = policy_options(policy, self.policy_option, self._vlm_options([policy, reviser or "", *policies]))
        model = None if self.world_model == "none" else absolute(self.world_model)
        return AgentRecipe(
            policy, model, reviser, **vars(search),
            model_options=model_options(model, self.world_model_option),
            semantics=self.semantics and absolute(self.semantics),
            semantics_options=semantics_options(self.semantics, self.semantics_option),
            policy_options=policy_options(reviser, self.revision_option, options, "--revision-option"),
            tracker=self.tracker and absolute(self.tracker),
            tracker_options=tracker_options(self.tracker, self.tracker_option),
        )  # fmt: skip

    def _vlm_options(self, policies: Sequence[str]) -> dict[str, Any]:
        """Return options of policy vlm; its own address, so that the record says where it asked."""
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
    """Return an option of policy vlm, with its path, if it is one, made absolute."""
    from wiw.policies.vlm.prompts.templates import SETS

    is_path = isinstance(value, Path) or (name == "prompts" and value not in SETS)
    return str(Path(value).expanduser().resolve()) if is_path else str(value)
