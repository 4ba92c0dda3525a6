# SPDX-License-Identifier: Apache-2.0
"""World models of one's own, each in a separate process.

`find_isolated_model` returns a class that stands for the one behind a name: it describes itself in the same way, and an
instance of it passes each rollout on to the instance in its process. Nothing of the model's code is imported here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, ConstructionError, RegistryError
from wiw.isolation.child import Host
from wiw.isolation.failures import EndedError, ExitError, LateError, RaisedError
from wiw.isolation.source import Isolated, Source, build_signature, describe_class, read_file_version
from wiw.json_text import parse_json
from wiw.registry import WORLD_MODELS
from wiw.types import Conditioning, Control
from wiw.world_models.base import (
    Accepts,
    Requirements,
    WorldModel,
    answer_deadline,
    find_accepts,
    require_frames,
    seconds_left,
)
from wiw.world_models.remote.declaration import declaration, parse_declaration

DOOR = {"isolate": (True, "bool"), "memory_gb": (None, "float | None")}
"""Options of every model of one's own, which its constructor does not see."""
IDENTIFYING = 600.0
"""Least seconds in which a model has to say what it is: a fingerprint may read all of its weights."""
RESTARTS = 2
"""Calls in a row that raise, after which the process is started anew."""


_PATIENCE: ContextVar[float] = ContextVar("wiw_patience", default=math.inf)


@contextmanager
def construction_deadline(seconds: float) -> Iterator[None]:
    """Set the seconds that constructors of isolated models may take inside the block, and whenever they start anew."""
    token = _PATIENCE.set(seconds)
    try:
        yield
    finally:
        _PATIENCE.reset(token)


def find_isolated_model(name: str) -> type[IsolatedModel]:
    """Return the class that stands for the world model of a name, such as "model.py:MyModel".

    Raises:
        RegistryError: it cannot be imported, which is tried in a separate process.
    """
    return _make_class(name, read_file_version(name))


@lru_cache(64)
def _make_class(name: str, version: tuple[str, str] | None) -> type[IsolatedModel]:
    """Return the class of a name; an edited file, or one of its own that it imports, has another one."""
    source = Source("world model", name, load_model)
    described = source.description
    attributes: dict[str, Any] = {
        "source": source,
        "version": described["version"],
        "requires": Requirements(
            packages=tuple(described["packages"]), extra=described["extra"], weights=described["weights"]
        ),
        "__signature__": build_signature(described["parameters"], DOOR),
        "__module__": described["module"],
        "__doc__": described["doc"],
    }
    if described["accepts"]:
        attributes["accepts"] = _Declared(parse_declaration(described["accepts"]))
    return type(described["name"], (IsolatedModel,), attributes)


class IsolatedModel(Isolated, WorldModel):
    """Stands for a world model in a separate process.

    Args:
        isolate: False makes the model in this process instead, and returns it itself.
        memory_gb: most gigabytes of memory that its process may take, without those that it starts; three quarters of
            the machine's if not given.
        options: what the model is made with.

    Raises:
        ConstructionError: the constructor raised, did not return in time, or ended its process; and errors of wiw that
            it raised.
        ArgumentError: the model requires the simulator.
    """

    def __new__(cls, isolate: bool = True, memory_gb: float | None = None, **options: Any) -> Any:
        """Return an instance of this class, or the model itself where it is not isolated."""
        return super().__new__(cls) if isolate else WORLD_MODELS.make_here(cls.source.name, **options)

    def __init__(self, isolate: bool = True, memory_gb: float | None = None, **options: Any) -> None:
        super().__init__(memory_gb)
        self._options = options
        self._patience, self._failures = _PATIENCE.get(), 0
        self._accepts = parse_declaration(self._begin())
        if "simulator" in self._accepts.needs:
            raise ArgumentError(
                f"world model '{self.source.name}' needs the simulator, which only the oracle is given; to study your "
                "own privileged model, give it isolate=false"
            )

    def __reduce__(self) -> Any:
        return _make_again, (self.source.name, {"memory_gb": self._memory_gb, **self._options})

    @property
    def accepts(self) -> Accepts:  # type: ignore[override]
        """The model's declaration."""
        return self._accepts

    def describe(self) -> dict[str, Any]:
        """Return what the model says of itself."""
        described: dict[str, Any] = parse_json(self._ask_for_identity(describe_model))
        return described

    def fingerprint(self) -> str:
        """Return the model's own."""
        return self._ask_for_identity(fingerprint_model)

    def ask(self, function: Callable[..., Any], *arguments: Any, seconds: float = math.inf) -> Any:
        """Call a function on the model in its process; see `ChildProcess.call`."""
        return self._find_process().call(function, *arguments, seconds=seconds)[0]

    def _ask_for_identity(self, function: Callable[[Host], str]) -> str:
        """Return what the model says of itself.

        Raises:
            ConstructionError: it did not answer in time, or ended its process.
        """
        try:
            return str(self.ask(function, seconds=max(self._patience, IDENTIFYING)))
        except (LateError, EndedError, ExitError) as error:
            text = f"world model '{self.source.name}' cannot say what it is: {error}"
            raise ConstructionError(text, error.kind) from None

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return the model's frames; those that nobody reads (shared ones, padding) are left unwritten.

        Raises:
            LateError: there is no answer by the caller's deadline; the process is killed.
            EndedError: the process has ended. As with other failures, the next call finds a new one.
            ContractError: the answer breaks the contract.
            RaisedError: the model raised an exception.
        """
        seconds = seconds_left()
        shape = (len(controls), len(controls[0].actions) + 1, *observations.image.shape[1:])
        process = self._find_process()
        try:
            spent, answer = process.call(
                roll_out,
                *(observations, list(controls), np.asarray(seeds), seconds),
                seconds=seconds,
                answer=math.prod(shape),
            )
        except (RaisedError, ExitError):
            self._failures += 1
            if self._failures % RESTARTS == 0:  # what it has leaked or broken goes with its process
                process.kill()
            raise
        self._failures = 0
        self._count_spent(spent)
        return answer.reshape(shape)

    def _begin(self) -> str:
        """Make the model in a process that has none; return its declaration."""
        seconds = self._patience if math.isfinite(self._patience) else seconds_left()
        return str(self._make(make_model, self._options, seconds, seconds=seconds))


class _Declared:
    """A declaration that class and instances tell: the instances their own."""

    def __init__(self, declared: Accepts) -> None:
        self._declared = declared

    def __get__(self, model: IsolatedModel | None, kind: type) -> Accepts:
        return self._declared if model is None else model._accepts


def _make_again(name: str, options: Mapping[str, Any]) -> Any:
    return find_isolated_model(name)(**options)


# -- in the model's process --------------------------------------------------------------------------------------------


def load_model(host: Host, name: str) -> dict[str, Any]:
    """Import the class or factory behind a name; return its description, which is available before any call."""
    host.thing = thing = WORLD_MODELS.find_here(name)
    host.make = partial(WORLD_MODELS.make_here, name)
    declared, requires = find_accepts(thing), getattr(thing, "requires", Requirements())
    return {
        **describe_class(thing),
        "version": str(getattr(thing, "version", "")),
        "accepts": declaration(declared) if declared else "",
        "packages": list(requires.packages),
        "extra": requires.extra,
        "weights": requires.weights,
    }


def make_model(host: Host, options: Mapping[str, Any], seconds: float) -> str:
    """Make the model; return its declaration."""
    with answer_deadline(seconds):
        host.made = host.make(**options)
    if not isinstance(host.made, WorldModel):
        raise RegistryError(f"expected a world model, got {host.made!r}; 'none' stands for no world model")
    return declaration(host.made.accepts)


def describe_model(host: Host) -> str:
    """Return what the model says of itself, as JSON."""
    return json.dumps(host.made.describe())


def fingerprint_model(host: Host) -> str:
    """Return the model's fingerprint."""
    return str(host.made.fingerprint())


def roll_out(
    host: Host, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64], seconds: float
) -> dict[str, float]:
    """Write the model's frames into the memory of the answer; return what it has consumed so far."""
    with answer_deadline(seconds):
        frames = host.made.rollout(observations, controls, seeds)
    require_frames(host.made, frames, observations, controls)
    answer = host.answer.reshape(frames.shape)
    for own, row, control in zip(answer, frames, controls, strict=True):
        own[0] = row[0]
        own[1 + control.shared : 1 + control.length] = row[1 + control.shared : 1 + control.length]
    return {name: float(value) for name, value in host.made.spent.items()}
