# SPDX-License-Identifier: Apache-2.0
"""What a world model's answers depend on beside what it is handed, as one digest: its code, options and weights."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from hashlib import blake2b
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any

import numpy as np

from wiw.errors import ArgumentError
from wiw.scenes.store import build_digest


def fingerprint(model: Any) -> str:
    """Hex digest of a model's class, the files that define it, `describe()`, and all its attributes.

    Arrays and tensors count by content, networks by their `state_dict`, with dtypes and the kind of device; torch's
    precision settings belong to it. Code that those files import does not: clear the cache when it has changed.

    Raises:
        ArgumentError: an attribute is of a kind whose content cannot be told; names it.
    """
    digest = blake2b(code_digest(type(model)).encode(), digest_size=20)
    _add(digest, json.dumps(model.describe(), sort_keys=True, default=str), "describe()")
    for name, value in sorted(vars(model).items()):
        _add(digest, value, f"{type(model).__name__}.{name}")
    _add(digest, _precision(), "torch")
    return digest.hexdigest()


def _precision() -> list[Any]:
    """Torch's precision settings; where nothing has loaded torch, the ones that it would start with."""
    torch = sys.modules.get("torch")
    if torch is None:
        return ["highest", "torch.float32", False]
    matmul = torch.backends.cuda.matmul
    return [torch.get_float32_matmul_precision(), str(torch.get_default_dtype()), bool(matmul.allow_tf32)]


def code_digest(model: type) -> str:
    """Hex digest of a model's class: names and files of it and of what it derives from, below `WorldModel`."""
    digest = blake2b(digest_size=20)
    for cls in model.__mro__:
        if cls is object or cls.__module__ in ("wiw.world_models.base", "abc"):
            continue
        digest.update(f"{cls.__module__}.{cls.__qualname__}".encode())
        digest.update(_source(cls))
    return digest.hexdigest()


def _source(cls: type) -> bytes:
    """The file that defines a class, and the compiled core behind wiw's own; nothing where there is no file."""
    core = build_digest().encode() if cls.__module__.startswith("wiw.") else b""
    try:
        return core + Path(inspect.getfile(cls)).read_bytes()
    except (OSError, TypeError):
        return core


def _add(digest: Any, value: Any, where: str) -> None:
    """Feeds a value into the digest, with its type, so that equal bytes of different things differ."""
    torch = sys.modules.get("torch")
    digest.update(f"\0{type(value).__name__}:".encode())
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | Path | np.dtype | type):
        digest.update(repr(value).encode())
    elif isinstance(value, ModuleType | FunctionType | BuiltinFunctionType):
        digest.update(f"{getattr(value, '__module__', '')}.{value.__name__}".encode())
    elif isinstance(value, np.ndarray | np.generic) and np.asarray(value).dtype != object:
        array = np.ascontiguousarray(value)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.data if array.size else b"")
    elif torch is not None and isinstance(value, torch.Tensor):
        data = value.detach().contiguous().cpu()
        digest.update(f"{data.dtype}{tuple(data.shape)}{value.device.type}".encode())
        digest.update(data.reshape(-1).view(torch.uint8).numpy().data if data.numel() else b"")
    elif torch is not None and isinstance(value, torch.nn.Module):
        digest.update(f"{value}{value.training}".encode())
        _add(digest, dict(value.state_dict()), where)
    elif torch is not None and isinstance(value, torch.dtype | torch.device):
        digest.update(str(value).encode())
    elif isinstance(value, Mapping):
        for name in value:
            _add(digest, str(name), where)
            _add(digest, value[name], f"{where}[{name!r}]")
    elif is_dataclass(value):
        _add(digest, {each.name: getattr(value, each.name) for each in fields(value)}, where)
    elif isinstance(value, list | tuple | set | frozenset):
        for index, item in enumerate(sorted(value, key=repr) if isinstance(value, set | frozenset) else value):
            _add(digest, item, f"{where}[{index}]")
    else:
        raise ArgumentError(
            f"rollouts cannot be cached: nobody can tell what is inside {where}, a {type(value).__name__}. Write "
            "`def fingerprint(self) -> str`, a text that changes with everything the answers depend on, such as the "
            "digest of the weights' file; or leave the cache off"
        )
