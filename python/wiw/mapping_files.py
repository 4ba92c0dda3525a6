# SPDX-License-Identifier: Apache-2.0
"""Read files of one mapping: YAML that people write, and JSON that programs do."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any

from wiw.errors import FileError
from wiw.json_text import parse_json

TOO_DEEP = "expected less deeply nested lists and mappings"
MERGE = "tag:yaml.org,2002:merge"
"""Tag of the key `<<`, which takes in the keys of other mappings."""
MOST_BRACKETS = 100
"""Open at once in a YAML file; PyYAML looks at all of them for each word, which takes seconds from a thousand on."""


def read_yaml_mapping(path: Path, expected: str) -> dict[str, Any]:
    """Return the mapping in a YAML file.

    Args:
        path: of the file.
        expected: words for what it should hold.

    Raises:
        FileError: it cannot be read, is no YAML, has a key twice, or is no mapping.
    """
    import yaml

    try:
        content = parse_yaml(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileError(f"{path} does not exist; expected {expected}") from error
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise FileError(f"{path}: expected {expected}, got {error}") from error
    if not isinstance(content, dict):
        raise FileError(f"{path}: expected {expected}, got {type(content).__name__}")
    return content


def parse_yaml(text: str) -> Any:
    """Return the value of a YAML text.

    Raises:
        ValueError: its lists and mappings are nested too deeply, a mapping has a key twice, or a value is none, such as
            the date 2026-13-40.
        yaml.YAMLError: it is no YAML.
    """
    try:
        return deepcopy(_parse_yaml_once(text))
    except RecursionError:
        raise ValueError(TOO_DEEP) from None
    except OverflowError as error:  # PyYAML makes characters of any number
        raise ValueError(f"expected characters of Unicode, got another: {error}") from None


@lru_cache(maxsize=64)  # every task reads its presets anew, and parsing takes longer than all else that makes a task
def _parse_yaml_once(text: str) -> Any:
    import yaml

    class CarefulLoader(yaml.SafeLoader):
        def fetch_flow_collection_start(self, TokenClass: type) -> None:
            if self.flow_level == MOST_BRACKETS:
                raise ValueError(TOO_DEEP)
            super().fetch_flow_collection_start(TokenClass)

        def compose_mapping_node(self, anchor: Any) -> Any:
            node = super().compose_mapping_node(anchor)  # before `<<` adds keys, which its own may override
            words = [key for key, _ in node.value if isinstance(key, yaml.ScalarNode) and key.tag != MERGE]
            _refuse_twice((self.construct_object(key), key.start_mark.line + 1) for key in words)
            return node

    loader = CarefulLoader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def _refuse_twice(keys: Iterable[tuple[Any, int]]) -> None:
    """Refuse a mapping that has a key twice, of which PyYAML would keep the last.

    Args:
        keys: each with its line.

    Raises:
        ValueError: it does; names the key and its lines.
    """
    lines: dict[Any, int] = {}
    for key, line in keys:
        if key in lines:
            raise ValueError(f"key '{key}' twice in one mapping, in lines {lines[key]} and {line}; leave one out")
        lines[key] = line


def read_json_object(path: Path, expected: str) -> dict[str, Any]:
    """Return the object in a JSON file.

    Args:
        path: of the file.
        expected: words for what it should hold.

    Raises:
        FileError: it is missing, cannot be read, is no JSON, or no object.
    """
    try:
        found = parse_json(path.read_text(encoding="utf-8"))
        if not isinstance(found, dict):
            raise ValueError("no object")
        return found
    except FileNotFoundError as error:
        raise FileError(f"{path} does not exist; expected {expected}") from error
    except (OSError, ValueError) as error:
        raise FileError(f"{path}: expected {expected}, got something else ({error})") from error
