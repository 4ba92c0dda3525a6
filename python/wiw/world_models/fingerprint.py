# SPDX-License-Identifier: Apache-2.0
"""What a world model's answers depend on beside what it is handed, as one digest: its code, options and weights.

A class in a file counts by the file. One of a notebook, or typed at a prompt, has none: it counts by its code in memory
and all that this code reads, such as globals, closures, helper functions and other classes of the notebook.
"""

from __future__ import annotations

import dis
import inspect
import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cached_property, partial
from hashlib import blake2b
from pathlib import Path
from types import BuiltinFunctionType, CodeType, EllipsisType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from wiw.errors import ArgumentError
from wiw.scenes.store import build_digest
from wiw.world_models.base import WorldModel

PLAIN = (bool, int, float, complex, str, bytes, Path, np.dtype, slice, EllipsisType)
"""Kinds whose `repr` tells all."""
NOT_FED = ("builtins", "abc", "typing", "enum", WorldModel.__module__)
"""Modules whose classes are every model's."""


def fingerprint(model: Any) -> str:
    """Hex digest of a model's class, the files that define it, `describe()`, and all its attributes.

    Arrays and tensors count by content, networks by their classes, attributes, parameters and buffers, with dtypes and
    the kind of device; torch's precision settings belong to it. Code that is imported does not (of wiw's own models,
    that of other folders): clear the cache when it has changed.

    Raises:
        ArgumentError: an attribute, or what code without a file reads, is of a kind whose content cannot be told; names
            it.
    """
    content = _Content(model)
    content.add_class(type(model))
    content.add(json.dumps(model.describe(), sort_keys=True, default=str), "describe()")
    for name, value in sorted(vars(model).items()):
        content.add(value, f"{type(model).__name__}.{name}")
    content.add(_precision(), "torch")
    return content.digest.hexdigest()


def _precision() -> list[Any]:
    """Torch's precision settings; where nothing has loaded torch, the ones that it would start with."""
    torch = sys.modules.get("torch")
    if torch is None:
        return ["highest", "torch.float32", False]
    matmul = torch.backends.cuda.matmul
    return [torch.get_float32_matmul_precision(), str(torch.get_default_dtype()), bool(matmul.allow_tf32)]


def code_digest(model: type) -> str:
    """Hex digest of a class: names, files and code of it and of what it derives from, below `WorldModel` or torch's."""
    content = _Content(model)
    content.add_class(model)
    return content.digest.hexdigest()


class _Content:
    """A digest in the making. Every value is fed with its type, so that equal bytes of different things differ."""

    def __init__(self, subject: Any) -> None:
        self.digest = blake2b(digest_size=20)
        self._met = {} if isinstance(subject, type) else {id(subject): 0}
        """Numbers of functions, classes, networks and models, which may lead back to themselves."""

    def add(self, value: Any, where: str) -> None:
        """Feeds a value; `where` names it in errors."""
        torch = sys.modules.get("torch")
        self._feed(f"\0{type(value).__name__}:")
        if value is None or isinstance(value, PLAIN):
            self._feed(repr(value))
        elif isinstance(value, type):
            self._feed(repr(value))
            if _lives_in_memory(value):
                self.add_class(value)
        elif isinstance(value, FunctionType) and not _is_importable(value):
            self._add_function(value)
        elif isinstance(value, ModuleType | BuiltinFunctionType) or _is_importable(value):
            self._feed(f"{getattr(value, '__module__', '')}.{value.__name__}")
        elif isinstance(value, np.ndarray | np.generic) and np.asarray(value).dtype != object:
            array = np.ascontiguousarray(value)
            self._feed(f"{array.dtype}{array.shape}", array.data if array.size else b"")
        elif torch is not None and isinstance(value, torch.Tensor):
            data = value.detach().contiguous().cpu()
            self._feed(f"{data.dtype}{tuple(data.shape)}{value.device.type}")
            self._feed(data.reshape(-1).view(torch.uint8).numpy().data if data.numel() else b"")
        elif torch is not None and isinstance(value, torch.nn.Module):
            self._add_network(value, where)
        elif torch is not None and isinstance(value, torch.dtype | torch.device):
            self._feed(str(value))
        elif isinstance(value, WorldModel):
            self._feed(value.fingerprint() if self._is_new(value) else "")
        else:
            self._add_parts(value, where)

    def _add_parts(self, value: Any, where: str) -> None:
        """Feeds what is made of other values."""
        if isinstance(value, Mapping):
            for name in value:
                self.add(str(name), where)
                self.add(value[name], f"{where}[{name!r}]")
        elif is_dataclass(value):
            self.add(type(value), where)
            self.add({each.name: getattr(value, each.name) for each in fields(value)}, where)
        elif isinstance(value, list | tuple | set | frozenset):
            for index, item in enumerate(sorted(value, key=repr) if isinstance(value, set | frozenset) else value):
                self.add(item, f"{where}[{index}]")
        elif isinstance(value, partial):
            self.add([value.func, value.args, value.keywords], where)
        elif isinstance(value, MethodType):
            self.add([value.__func__, value.__self__], where)
        elif isinstance(value, Enum):
            self.add([type(value).__qualname__, value.name, value.value], where)
        elif hasattr(value, "__wrapped__"):
            self.add(value.__wrapped__, where)
        else:
            raise ArgumentError(
                f"rollouts cannot be cached: nobody can tell what is inside {where}, a {type(value).__name__}. Write "
                "`def fingerprint(self) -> str`, a text that changes with everything the answers depend on, such as "
                "the digest of the weights' file; or leave the cache off"
            )

    def add_class(self, cls: type) -> None:
        """Feeds a class and what it derives from, as far as it is neither Python's, torch's nor `WorldModel`."""
        for each in cls.__mro__ if self._is_new(cls) else ():
            home, alive = each.__module__, _lives_in_memory(each)
            if not alive and (home in NOT_FED or home.partition(".")[0] == "torch"):
                continue
            self._feed(f"{home}.{each.__qualname__}", _source(each))
            for name, member in sorted(vars(each).items()):
                if name.startswith("__annotat"):
                    continue
                functions = list(_functions(member))
                for function in functions:
                    self._add_code(function.__code__)
                    if alive and not _is_generated(each, function):
                        self._add_surroundings(function)
                if alive and not functions and not name.startswith("__") and name != "_abc_impl":
                    self._add_member(member, f"{each.__name__}.{name}")

    def _add_member(self, member: Any, where: str) -> None:
        if inspect.isdatadescriptor(member):  # such as a slot: it holds nothing
            self._feed(type(member).__name__)
        else:
            self.add(member, where)

    def _add_function(self, function: FunctionType) -> None:
        if self._is_new(function):
            self._feed(f"{function.__module__}.{function.__qualname__}")
            self._add_code(function.__code__)
            self._add_surroundings(function)

    def _add_code(self, code: CodeType) -> None:
        """Feeds what code does, wherever it stands."""
        self._feed(f"\0{code.co_name}", code.co_code, getattr(code, "co_exceptiontable", b""))
        names = [code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars]
        self.add([*names, code.co_flags, code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount], "code")
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                self._add_code(constant)
            else:
                self.add(constant, "code")

    def _add_surroundings(self, function: FunctionType) -> None:
        """Feeds all that a function reads beside its arguments; of one that was imported, less its globals."""
        name = function.__qualname__
        self.add([function.__defaults__, function.__kwdefaults__], f"the defaults of {name}")
        if _is_in_memory(function):
            with suppress(OSError):
                self._feed(inspect.getsource(function))  # has its decorators, with what they were given
            space = function.__globals__
            for read in sorted(set(_globals(function.__code__)) & set(space)):
                self.add(space[read], f"{read}, which {name} reads")
        wrapped = getattr(function, "__wrapped__", None)
        if wrapped is not None and not _is_in_memory(function):  # else its closure has it
            self.add(wrapped, name)
            return
        for read, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
            with suppress(ValueError):  # nothing is in it yet
                self.add(cell.cell_contents, f"{read}, which {name} reads")

    def _add_network(self, network: Any, where: str) -> None:
        torch = sys.modules["torch"]
        if not self._is_new(network):
            return
        self._feed(f"{network}{[module.training for module in network.modules()]}")
        self.add({**network.state_dict(), **dict(network.named_buffers())}, where)
        common = vars(torch.nn.Module())
        for path, module in network.named_modules():
            if type(module).__module__.partition(".")[0] == "torch":
                continue
            self.add_class(type(module))
            for name, value in sorted(vars(module).items()):
                if name not in common:
                    self._add_attribute(type(module), value, ".".join(filter(None, (where, path, name))))

    def _add_attribute(self, cls: type, value: Any, where: str) -> None:
        """Feeds a network's attribute; those of libraries' networks as far as their content can be told."""
        try:
            self.add(value, where)
        except ArgumentError:
            if _lives_in_memory(cls):
                raise

    def _is_new(self, thing: Any) -> bool:
        known = len(self._met)
        number = self._met.setdefault(id(thing), known)
        self._feed(f"#{number}")
        return number == known

    def _feed(self, *data: Any) -> None:
        for each in data:
            self.digest.update(each.encode() if isinstance(each, str) else each)


def _source(cls: type) -> bytes:
    """The file that defines a class, if any; of wiw's own models all files of the folder, and the compiled core."""
    core = build_digest().encode() if cls.__module__.startswith("wiw.") else b""
    try:
        file = Path(inspect.getfile(cls))
        files = sorted(file.parent.glob("*.py")) if cls.__module__.startswith("wiw.world_models.") else [file]
        return core + b"".join(each.read_bytes() for each in files)
    except (OSError, TypeError):
        return core


def _lives_in_memory(cls: type) -> bool:
    """Whether a class, or one of its methods, was written in no file."""
    functions = [inspect.unwrap(function) for member in vars(cls).values() for function in _functions(member)]
    return any(map(_is_in_memory, functions)) or (not functions and cls.__module__ == "__main__")


def _is_in_memory(function: FunctionType) -> bool:
    """Whether a function was written in no file: in a notebook, at a prompt, or by `exec`."""
    space = function.__globals__
    module = sys.modules.get(space.get("__name__", ""))
    if module is None or vars(module) is not space:
        return True
    return module.__spec__ is None and function.__code__.co_filename != getattr(module, "__file__", None)


def _is_importable(value: Any) -> bool:
    """Whether a function is found by its name in a module that was imported, and so is a part of that module's code."""
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None)
    found: Any = sys.modules.get(getattr(value, "__module__", None) or "")
    if not callable(value) or not isinstance(name, str) or getattr(found, "__spec__", None) is None:
        return False
    for part in name.split("."):
        found = getattr(found, part, None)
    return found is value


def _functions(member: Any) -> Iterator[FunctionType]:
    """Those behind a class's member: itself, or what a property, a static method and the like call."""
    if isinstance(member, FunctionType):
        yield member
    elif isinstance(member, staticmethod | classmethod):
        yield from _functions(member.__func__)
    elif isinstance(member, cached_property):
        yield from _functions(member.func)
    elif isinstance(member, property):
        for each in (member.fget, member.fset, member.fdel):
            yield from _functions(each)


def _is_generated(cls: type, function: FunctionType) -> bool:
    """Whether `dataclass` has written a method: what it reads is the fields' defaults."""
    return "__dataclass_fields__" in vars(cls) and function.__code__.co_filename == "<string>"


def _globals(code: CodeType) -> Iterator[str]:
    """Names that code looks up outside itself."""
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            yield instruction.argval
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _globals(constant)
