# SPDX-License-Identifier: Apache-2.0
"""A user's code, imported in separate processes: the description of its class, and processes to build it in."""

from __future__ import annotations

import inspect
import math
import sys
import weakref
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from wiw.errors import ConstructionError, InfrastructureError, RegistryError
from wiw.isolation.child import Host
from wiw.isolation.failures import EndedError, ExitError, LateError
from wiw.isolation.process import STARTING, ChildProcess
from wiw.registry import SOURCES
from wiw.source_files import digest_imports

_SOURCES: weakref.WeakSet[Source] = weakref.WeakSet()


def end_idle_processes() -> None:
    """End the processes that have only described their code, where other processes will run it."""
    for source in list(_SOURCES):
        source.end_idle()


class Source:
    """The code behind a name, imported in a process in which nothing has been made of it so far.

    Args:
        kind: as in messages: "world model".
        name: of the part.
        load: imports it in the child, and returns what it tells of itself.
    """

    def __init__(self, kind: str, name: str, load: Callable[[Host, str], dict[str, Any]]) -> None:
        self.kind, self.name, self._load = kind, name, load
        self._idle: ChildProcess | None = None
        self.description = self._import(process := ChildProcess(), math.inf)
        self._idle = process
        _SOURCES.add(self)

    def end_idle(self) -> None:
        """End the process in which nothing has been made; another one begins when it is asked again."""
        if self._idle is not None:
            self._idle.kill()

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function on the imported class; see `ChildProcess.call`."""
        if self._idle is None or not self._idle.alive:
            self._idle = ChildProcess()
            self._load_again(self._idle, math.inf)
        return self._idle.call(function, *arguments)[0]

    def take_process(self, memory_gb: float | None, seconds: float = math.inf) -> ChildProcess:
        """Return a process that has imported the code, within so many seconds and no fewer than `STARTING`.

        Nobody else has it.

        Raises:
            RegistryError: it cannot be imported, or not in time.
            InfrastructureError: it has changed since it was first imported.
        """
        if memory_gb is None and self._idle is not None and self._idle.alive:
            process, self._idle = self._idle, None
            return process
        process = ChildProcess(memory_gb)
        self._load_again(process, max(seconds, STARTING))
        return process

    def _load_again(self, process: ChildProcess, seconds: float) -> None:
        """Import the code in another process.

        Raises:
            RegistryError: it cannot be imported.
            InfrastructureError: it has changed since it was first imported.
        """
        found = self._import(process, seconds)
        version = "sources" if found["sources"] else "module"  # the latter also changes with the time of a file
        if any(found[each] != self.description[each] for each in ("name", version)):
            raise InfrastructureError(f"{self.kind} '{self.name}' has changed since it was loaded; start a new run")

    def _import(self, process: ChildProcess, seconds: float) -> dict[str, Any]:
        """Import the code in a process; return what it says of itself."""
        try:
            description: dict[str, Any] = process.call(self._load, self.name, seconds=seconds)[0]
        except (EndedError, ExitError, LateError) as error:
            raise RegistryError(f"{self.kind} '{self.name}' cannot be loaded: {error}") from None
        return description


class Isolated:
    """Base of what stands for a part in a separate process; if that has ended, another one is started.

    Args:
        memory_gb: most gigabytes of memory that a process may take, without those that it starts; three quarters of
            the machine's if None.
    """

    source: ClassVar[Source]

    def __init__(self, memory_gb: float | None) -> None:
        self._memory_gb = memory_gb
        self._process: ChildProcess | None = None
        self._spent, self._spent_before = Counter[str](), Counter[str]()

    @classmethod
    def require(cls, task: Mapping[str, Any]) -> None:
        """Ask the class whether it is made for a task.

        Raises:
            ArgumentError: it is not.
        """
        cls.source.ask(_require_task, dict(task))

    @property
    def spent(self) -> Mapping[str, float]:
        """Resources that the part has used up so far, in all of its processes."""
        return self._spent_before + self._spent

    def close(self) -> None:
        """End the process; the next call starts another one."""
        if self._process is not None:
            self._process.kill()

    def _find_process(self) -> ChildProcess:
        """Return the process in which the part is, made anew where that has ended."""
        if self._process is None or not self._process.alive:
            self._begin()
        assert self._process is not None
        return self._process

    def _begin(self) -> Any:
        """Make the part in a process, by `_make`."""
        raise NotImplementedError

    def _make(self, function: Callable[..., Any], *arguments: Any, seconds: float) -> Any:
        """Call a function that makes the part in a process that has none; return what it tells of it.

        Raises:
            ConstructionError: the constructor raised, did not return in time, or ended its process.
        """
        self._spent_before += self._spent
        self._spent = Counter()
        process = self.source.take_process(self._memory_gb, seconds)
        cannot = f"{self.source.kind} '{self.source.name}' cannot be built"
        try:
            answer = process.call(function, *arguments, seconds=seconds)[0]
        except LateError as error:
            raise ConstructionError(
                f"{cannot}: its constructor did not return within {seconds:g} s (deadline). Is it waiting for a "
                "download, a lock, a server or a prompt? If it is just slow, give a longer deadline",
                "deadline",
            ) from error
        except (EndedError, ExitError) as error:
            raise ConstructionError(f"{cannot}: {error}", error.kind) from None
        self._process = process
        return answer

    def _count_spent(self, spent: Mapping[str, Any]) -> None:
        """Note what the part has used up in its present process."""
        self._spent = Counter({str(name): float(amount) for name, amount in spent.items()})


def read_file_version(name: str) -> tuple[str, str] | None:
    """Return the path of the file in "path.py:Class", and a digest of it and the user's files that it imports.

    None for a name without a file.
    """
    path = Path(name.rpartition(":")[0]).expanduser()
    if path.suffix != ".py" or not path.is_file():
        return None
    return str(path.resolve()), digest_imports(path.resolve())


def describe_class(thing: Any) -> dict[str, Any]:
    """Return the description of a class or factory, which is available before it is called."""
    makes = inspect.isclass(thing) or inspect.isroutine(thing) or isinstance(thing, partial)
    parameters = inspect.signature(thing).parameters.values() if makes else ()
    return {
        "name": str(getattr(thing, "__name__", type(thing).__name__)),
        "module": str(getattr(thing, "__module__", "")),
        "sources": str(getattr(sys.modules.get(str(getattr(thing, "__module__", ""))), SOURCES, "")),
        "doc": inspect.getdoc(thing) or "",
        "parameters": [_describe_parameter(each) for each in parameters],
    }


def _describe_parameter(parameter: inspect.Parameter) -> dict[str, Any]:
    empty = inspect.Parameter.empty
    annotation = "" if parameter.annotation is empty else inspect.formatannotation(parameter.annotation).strip("'")
    value = parameter.default
    plain = value is None or type(value) in (bool, int, float, str)
    default = None if value is empty else {"value": value} if plain else {"repr": repr(value)}
    return {"name": parameter.name, "kind": int(parameter.kind), "annotation": annotation, "default": default}


def build_signature(parameters: Sequence[Mapping[str, Any]], own: Mapping[str, tuple[Any, str]]) -> inspect.Signature:
    """Return the signature of a constructor as its process has told it, with options of our own (default, type)."""
    built = [
        inspect.Parameter(
            each["name"],
            inspect._ParameterKind(each["kind"]),
            default=_read_default(each["default"]),
            annotation=each["annotation"] or inspect.Parameter.empty,
        )
        for each in parameters
    ]
    taken = {parameter.name for parameter in built}
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        for name, (default, annotation) in own.items()
        if name not in taken
    ]
    last = [parameter for parameter in built if parameter.kind is inspect.Parameter.VAR_KEYWORD]
    return inspect.Signature([*(parameter for parameter in built if parameter not in last), *added, *last])


def _read_default(packed: Any) -> Any:
    if packed is None:
        return inspect.Parameter.empty
    return _HiddenDefault(packed["repr"]) if "repr" in packed else packed["value"]


class _HiddenDefault:
    """A default value that the class keeps to itself."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text


def _require_task(host: Host, task: Mapping[str, Any]) -> None:
    """Ask the class whether it is made for a task, in its process; a factory takes any."""
    thing: Any = host.thing
    if isinstance(thing, type) and hasattr(thing, "require"):
        thing.require(task)
