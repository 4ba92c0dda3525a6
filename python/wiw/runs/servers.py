# SPDX-License-Identifier: Apache-2.0
"""Which parts of a run its own servers serve, by which commands, and the recipes of agents that ask these servers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from wiw.errors import ArgumentError
from wiw.loop.agent_spec import space_option
from wiw.registry import WORLD_MODELS
from wiw.runs.config import EngineConfig
from wiw.runs.recipes import REFERENCES, REMOTE, AgentRecipe, absolute
from wiw.tasks.base import Task
from wiw.world_models.remote.model import DEADLINE, ServedModel

LOCAL_VLM = "transformers:"
"""Beginning of a language model that is in the process that asks it."""
MOCK_VLM = "mock"
IN_PROCESS = ("device", "dtype")
"""Options of such a model that its servers do not take."""


@dataclass(frozen=True)
class ServerCommand:
    """A command of wiw that serves a part of a run; the one that starts it adds where to listen."""

    arguments: tuple[str, ...]
    count: int
    """How many servers."""
    gpus: float
    """GPUs of each."""


def require_servable(agents: Mapping[str, Any], config: EngineConfig) -> None:
    """Check that there is a model for each kind of server that a run is to start.

    Raises:
        ArgumentError: servers without Ray or without a model, or for several models.
    """
    if config.engine != "ray" and (config.servers or config.vlm_servers):
        command, flag = ("serve", "world-model") if config.servers else ("serve-vlm", "vlm")
        raise ArgumentError(
            "evaluate: servers are Ray actors, or jobs of `wiw submit`: give --engine ray (engine=), or start `wiw "
            f"{command}` and give its address as --{flag}"
        )
    if config.servers:
        find_served(agents, config.served)
    if config.vlm_servers:
        find_served_vlm(agents)


def find_served(agents: Mapping[str, Any], named: str | None) -> AgentRecipe:
    """Return the recipe of an agent whose world model is to be served: the one named, or the only one.

    Raises:
        ArgumentError: none or several of them, or one model with different options.
    """
    recipes = [recipe for recipe in agents.values() if isinstance(recipe, AgentRecipe)]
    models = {
        absolute(recipe.model)
        for recipe in recipes
        if isinstance(recipe.model, str) and recipe.model not in REFERENCES and not recipe.model.startswith(REMOTE)
    }
    named = next(iter(models)) if named is None and len(models) == 1 else named and absolute(named)
    found = [recipe for recipe in recipes if isinstance(recipe.model, str) and absolute(recipe.model) == named]
    if not found:
        raise ArgumentError(
            "servers: expected one of the arms' world models as --world-model or --served (served=), got "
            f"{named or 'none'}; the arms have {', '.join(sorted(models)) or 'only references'}"
        )
    if any(recipe.model_options != found[0].model_options for recipe in found):
        raise ArgumentError(
            f"servers: arms have '{named}' with different options, but all servers serve the same model; run them "
            "separately"
        )
    return found[0]


def find_served_vlm(agents: Mapping[str, Any]) -> str:
    """Return the language model that is to be served, as `--vlm` names it.

    Raises:
        ArgumentError: none or several of them.
    """
    asking = [
        options
        for recipe in agents.values()
        if isinstance(recipe, AgentRecipe)
        for options in recipe.policy_options.values()
        if _is_local(options)
    ]
    found = {str(options["vlm"]) for options in asking}
    if len(found) != 1:
        raise ArgumentError(
            "vlm_servers: expected one language model that runs in the worker process, --vlm transformers:PATH or "
            f"mock, got {', '.join(sorted(found)) or 'none'}"
        )
    if own := sorted({name for options in asking for name in IN_PROCESS if name in options}):
        raise ArgumentError(
            f"vlm_servers: {' and '.join(own)} are for a model in the worker process; a server uses a GPU if it has "
            "one, and the weights as they were saved: leave them out"
        )
    return found.pop()


def write_commands(task: Task, agents: Mapping[str, Any], config: EngineConfig) -> list[ServerCommand]:
    """Return the commands of the servers of world models."""
    if not config.servers:
        return []
    recipe = find_served(agents, config.served)
    name = str(recipe.model)
    space = recipe.find_space(task)
    options = {**space_option(WORLD_MODELS, name, space), **recipe.resolve_model_options(task)}
    flags = [part for item in options.items() for part in ("--world-model-option", _format_option(*item))]
    return [ServerCommand(("serve", name, *flags), config.servers, config.server_gpus)]


def write_vlm_commands(agents: Mapping[str, Any], config: EngineConfig) -> list[ServerCommand]:
    """Return the commands of the servers of language models."""
    if not config.vlm_servers:
        return []
    model = find_served_vlm(agents).removeprefix(LOCAL_VLM)
    return [ServerCommand(("serve-vlm", "--model", model), config.vlm_servers, config.vlm_server_gpus)]


def ask_servers(
    agents: Mapping[str, Any], served: str | None, addresses: Sequence[str], vlm: str | None, token: str
) -> dict[str, Any]:
    """Return the agents with what is served in place of their own.

    Args:
        agents: recipes by arm.
        served: name of the world model that is served.
        addresses: of its servers; none where none is served.
        vlm: address of the language model's server, if it is served.
        token: all servers'.
    """
    return {
        arm: _ask_servers(recipe, served, addresses, vlm, token) if isinstance(recipe, AgentRecipe) else recipe
        for arm, recipe in agents.items()
    }


def _ask_servers(
    recipe: AgentRecipe, served: str | None, addresses: Sequence[str], vlm: str | None, token: str
) -> AgentRecipe:
    if addresses and isinstance(recipe.model, str) and recipe.model == served:
        options = {"address": ",".join(addresses), "token": token, "patience": DEADLINE}
        recipe = replace(recipe, model=ServedModel, model_options=options)
    if vlm is None:
        return recipe
    asked = {
        policy: {"dialect": "vllm", **options, "vlm": vlm, "key": token} if _is_local(options) else options
        for policy, options in recipe.policy_options.items()
    }
    return replace(recipe, policy_options=asked)


def _is_local(options: Mapping[str, Any]) -> bool:
    """Return whether a policy's language model is in its own process, so that it can be served instead."""
    named = str(options.get("vlm", ""))
    return named == MOCK_VLM or named.startswith(LOCAL_VLM)


def _format_option(name: str, value: Any) -> str:
    """Return an option as the command line takes it: text as it is, all else as YAML on one line."""
    return f"{name}={value if isinstance(value, str) else json.dumps(value)}"
