# SPDX-License-Identifier: Apache-2.0
"""Policies of one's own, each in a separate process, by the name "isolated:policy.py:MyPolicy".

The memories of episodes stay in that process; the loop holds handles of them.
"""

from __future__ import annotations

import itertools
import json
import weakref
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ContractError, RegistryError
from wiw.isolation.child import Host
from wiw.isolation.source import Isolated, Source, build_signature, describe_class, read_file_version
from wiw.json_text import parse_json
from wiw.policies.base import FrameSpec, Policy, Situation, check_revision
from wiw.registry import POLICIES
from wiw.types import Answer, Decision, Exchange, Goal, Key, Proposal, Rollout, TextAnswer
from wiw.wire.arrays import pack_array, unpack_array

DOOR = {"memory_gb": (None, "float | None"), "deadline": (600.0, "float")}
"""Options of every isolated policy, which its constructor does not see."""


def find_isolated_policy(name: str) -> type[IsolatedPolicy]:
    """Return the class that stands for the policy of a name, such as "policy.py:MyPolicy".

    Raises:
        RegistryError: it cannot be imported, which is tried in a separate process; or it ships with wiw.
    """
    if not POLICIES.is_foreign(name):
        raise RegistryError(f"isolated: expected a policy of your own, as isolated:path.py:Class, got '{name}'")
    return _make_class(name, read_file_version(name))


@lru_cache(64)
def _make_class(name: str, version: tuple[str, str] | None) -> type[IsolatedPolicy]:
    """Return the class of a name; an edited file, or one of its own that it imports, has another one."""
    source = Source("policy", name, load_policy)
    described = source.description
    attributes: dict[str, Any] = {
        "source": source,
        "__signature__": build_signature(described["parameters"], DOOR),
        "__module__": described["module"],
        "__doc__": described["doc"],
        **_read_declaration(described),
    }
    return type(described["name"], (IsolatedPolicy,), attributes)


class _MemoryHandle:
    """Handle of an episode's memory, which stays in the policy's process; a deep copy is one of a copy of it there."""

    def __init__(self, policy: IsolatedPolicy, number: int) -> None:
        self.number, self._policy = number, policy

    def __deepcopy__(self, memo: dict[int, Any]) -> _MemoryHandle:
        return self._policy._copy_memory(self)


class IsolatedPolicy(Isolated, Policy):
    """Stands for a policy in a separate process.

    A call that fails or is late loses all memories: its episodes end with errors, or begin anew.

    Args:
        memory_gb: most gigabytes of memory that its process may take, without those that it starts; three quarters of
            the machine's if not given.
        deadline: most seconds for a call.
        options: what the policy is made with.

    Raises:
        ConstructionError: the constructor raised, did not return in time, or ended its process.
    """

    def __init__(self, memory_gb: float | None = None, deadline: float = 600.0, **options: Any) -> None:
        super().__init__(memory_gb)
        self._deadline, self._options = deadline, options
        self._forgotten: list[int] = []
        self._numbers = itertools.count()  # of memories, of all processes: none is taken for one of another's
        self._begin()

    def __reduce__(self) -> Any:
        options = {"memory_gb": self._memory_gb, "deadline": self._deadline, **self._options}
        return _make_again, (self.source.name, options)

    @property
    def can_revise(self) -> bool:
        """Whether the policy scores imagined futures itself."""
        return bool(self._declared["can_revise"])

    @property
    def can_extend(self) -> bool:
        """Whether the policy can propose from an imagined place."""
        return bool(self._declared["can_extend"])

    def describe(self) -> dict[str, Any]:
        """Return what the policy says of itself."""
        described: dict[str, Any] = parse_json(self._declared["described"])
        return described

    def begin(self, goal: Goal, key: Key) -> Any:
        """Begin an episode there; return a handle of its memory."""
        handle = self._make_handle()
        self._call(begin_episode, handle.number, goal, key)
        return handle

    def observe(self, situations: Sequence[Situation]) -> None:
        """Pass the call on."""
        self._call(observe, _hide_memories(situations))

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return the policy's plans."""
        return _read_plans(self._call(propose, _hide_memories(situations), candidates, horizon))

    def extend(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return the policy's continuations."""
        return _read_plans(self._call(extend, _hide_memories(situations), candidates, horizon))

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """Return the policy's scores."""
        found = self._call(score, _hide_memories(situations), proposals, rollouts)
        return [_read_array("score", each) for each in found]

    def revise(
        self, situation: Situation, proposals: Sequence[Proposal], scores: NDArray[np.float64]
    ) -> tuple[NDArray[Any], int | None]:
        """Return the policy's decision."""
        actions, chosen = self._call(revise, _hide_memories([situation])[0], proposals, scores)
        return _read_array("revise", actions), chosen

    def answer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> Sequence[Answer | TextAnswer | None]:
        """Return what the policy believes."""
        if not self._declared["answers"]:
            return [None] * len(situations)
        return [_read_answer(each) for each in self._call(answer, _hide_memories(situations), proposals, rollouts)]

    def draw(self, situation: Situation, decision: Decision, north: float) -> Mapping[str, NDArray[np.uint8]]:
        """Return the policy's pictures, in which the heading at the start is up: the true north stays here."""
        if not self._declared["draws"]:
            return {}
        found = self._call(draw, _hide_memories([situation])[0], replace(decision, key=None), 0.0)
        return {str(name): _read_array("draw", each) for name, each in found.items()}

    def exchanges(self, key: Key) -> tuple[Exchange, ...]:
        """Return the language model's exchanges of this decision."""
        if not self._declared["exchanges"]:
            return ()
        return tuple(
            Exchange(**{**each, "said": tuple(each["said"])}) for each in json.loads(self._call(list_exchanges, key))
        )

    def _make_handle(self) -> _MemoryHandle:
        handle = _MemoryHandle(self, next(self._numbers))
        weakref.finalize(handle, self._forgotten.append, handle.number).atexit = False
        return handle

    def _copy_memory(self, handle: _MemoryHandle) -> _MemoryHandle:
        """Return the handle of a copy: what is scored to measure fidelity must leave no trace in an episode's own."""
        copy = self._make_handle()
        self._call(copy_memory, handle.number, copy.number)
        return copy

    def _begin(self) -> None:
        """Make the policy in a process that has none."""
        self._declared: dict[str, Any] = self._make(make_policy, self._options, seconds=self._deadline)
        for attribute, value in _read_declaration(self._declared).items():
            setattr(self, attribute, value)

    def _call(self, function: Any, *arguments: Any) -> Any:
        process = self._find_process()
        forgotten, self._forgotten[:] = list(self._forgotten), []
        value, spent = process.call(run_policy, forgotten, function, *arguments, seconds=self._deadline)[0]
        self._count_spent(spent)
        return value


def _make_again(name: str, options: Mapping[str, Any]) -> Any:
    return find_isolated_policy(name)(**options)


def _hide_memories(situations: Sequence[Situation]) -> list[Situation]:
    """Return situations with the numbers of their memories."""
    return [replace(each, memory=each.memory.number) for each in situations]


def _read_declaration(declared: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "space": str(declared["space"]),
        "needs": tuple(map(str, declared["needs"])),
        "frames": _read_frames(**declared["frames"]),
        "default_revision": None if declared["default_revision"] is None else str(declared["default_revision"]),
        "longest_decision": None if declared["longest_decision"] is None else int(declared["longest_decision"]),
    }


def _read_frames(view: Any, size: Any, ends: Any, source_size: Any) -> FrameSpec:
    return FrameSpec(str(view), _read_size(size), bool(ends), None if source_size is None else _read_size(source_size))


def _read_size(packed: Any) -> tuple[int, int]:
    height, width = packed
    return int(height), int(width)


def _read_plans(packed: Any) -> list[list[Proposal]]:
    return [[Proposal(_read_array("propose", actions), *rest) for actions, *rest in own] for own in packed]


def _read_array(call: str, packed: Any) -> NDArray[Any]:
    return unpack_array(call, packed).copy()


def _read_answer(packed: Any) -> Answer | TextAnswer | None:
    if packed is None:
        return None
    if "text" in packed:
        return TextAnswer(str(packed["text"]), float(packed["confidence"]), bool(packed["final"]))
    raw = None if packed["raw"] is None else _read_array("answer", packed["raw"])
    return Answer(tuple(map(str, packed["choices"])), _read_array("answer", packed["probabilities"]), raw)


# -- in the policy's process -------------------------------------------------------------------------------------------


def load_policy(host: Host, name: str) -> dict[str, Any]:
    """Import the class or factory behind a name; return its description, which is available before any call."""
    host.thing = POLICIES.find_here(name)
    host.make = partial(POLICIES.make_here, name)
    return {**describe_class(host.thing), **_declare(host.thing)}


def _declare(thing: Any) -> dict[str, Any]:
    """Return what a class, or an instance, declares."""
    names = ("space", "needs", "frames", "default_revision", "longest_decision")
    defaults = {name: getattr(Policy, name) for name in names}
    found = {name: getattr(thing, name, default) for name, default in defaults.items()}
    declared = {name: defaults[name] if isinstance(value, property) else value for name, value in found.items()}
    frames = declared["frames"]
    return {**declared, "needs": list(declared["needs"]), "frames": asdict(frames)}


def make_policy(host: Host, options: Mapping[str, Any]) -> dict[str, Any]:
    """Make the policy; return what it declares and has."""
    host.made, host.memories = host.make(**options), {}
    made, kind = host.made, type(host.made)
    return {
        **_declare(made),
        "described": json.dumps(made.describe()),
        "can_revise": made.can_revise,
        "can_extend": made.can_extend,
        "answers": kind.answer is not Policy.answer,
        "draws": kind.draw is not Policy.draw,
        "exchanges": kind.exchanges is not Policy.exchanges,
    }


def run_policy(host: Host, forgotten: Sequence[int], function: Any, *arguments: Any) -> tuple[Any, dict[str, float]]:
    """Call a function of this module on the policy; return its value and what the policy has used up so far."""
    for number in forgotten:
        host.memories.pop(number, None)
    value = function(host, *arguments)
    return value, {name: float(amount) for name, amount in host.made.spent.items()}


def begin_episode(host: Host, number: int, goal: Goal, key: Key) -> None:
    """Begin an episode, whose memory has a number."""
    host.memories[number] = host.made.begin(goal, key)


def copy_memory(host: Host, number: int, copy: int) -> None:
    """Copy the memory of an episode under another number."""
    _require_memories(host, [number])
    host.memories[copy] = deepcopy(host.memories[number])


def observe(host: Host, situations: Sequence[Situation]) -> None:
    """Let the policy update its memories."""
    host.made.observe(_show_memories(host, situations))


def propose(host: Host, situations: Sequence[Situation], candidates: int, horizon: int) -> Any:
    """Return the policy's plans as plain values."""
    return _pack_plans(host.made.propose(_show_memories(host, situations), candidates, horizon))


def extend(host: Host, situations: Sequence[Situation], candidates: int, horizon: int) -> Any:
    """Return the policy's continuations as plain values."""
    return _pack_plans(host.made.extend(_show_memories(host, situations), candidates, horizon))


def score(host: Host, situations: Sequence[Situation], proposals: Any, rollouts: Any) -> Any:
    """Return the policy's scores."""
    return [_pack_values(each) for each in host.made.score(_show_memories(host, situations), proposals, rollouts)]


def revise(host: Host, situation: Situation, proposals: Any, scores: Any) -> Any:
    """Return the plan that the policy decides on, and its number."""
    revision = host.made.revise(_show_memories(host, [situation])[0], proposals, scores)
    actions, chosen = check_revision(host.made, revision, len(proposals))
    return _pack_values(actions), chosen


def answer(host: Host, situations: Sequence[Situation], proposals: Any, rollouts: Any) -> Any:
    """Return what the policy believes."""
    return [_pack_answer(each) for each in host.made.answer(_show_memories(host, situations), proposals, rollouts)]


def draw(host: Host, situation: Situation, decision: Decision, north: float) -> Any:
    """Return the policy's pictures."""
    found = host.made.draw(_show_memories(host, [situation])[0], decision, north)
    return {name: _pack_values(picture) for name, picture in found.items()}


def list_exchanges(host: Host, key: Key) -> str:
    """Return the exchanges of a decision as JSON."""
    return json.dumps([asdict(each) for each in host.made.exchanges(key)])


def _show_memories(host: Host, situations: Sequence[Situation]) -> list[Situation]:
    _require_memories(host, [each.memory for each in situations])
    return [replace(each, memory=host.memories[each.memory]) for each in situations]


def _require_memories(host: Host, numbers: Sequence[int]) -> None:
    if any(number not in host.memories for number in numbers):
        raise RuntimeError("the policy's process has ended, and its memory of this episode is lost")


def _pack_plans(plans: Any) -> Any:
    if not isinstance(plans, Sequence) or not all(isinstance(each, Proposal) for own in plans for each in own):
        raise ContractError(f"propose: expected a list of wiw.types.Proposal for each episode, got {plans!r:.200}")
    return [[(_pack_values(each.actions), float(each.prior), each.note, each.text) for each in own] for own in plans]


def _pack_values(array: Any) -> Any:
    return pack_array(np.asarray(array))


def _pack_answer(believed: Answer | TextAnswer | None) -> Any:
    if believed is None:
        return None
    if isinstance(believed, TextAnswer):
        return {"text": believed.text, "confidence": float(believed.confidence), "final": bool(believed.final)}
    raw = None if believed.raw is None else _pack_values(believed.raw)
    return {"choices": list(believed.choices), "probabilities": _pack_values(believed.probabilities), "raw": raw}
