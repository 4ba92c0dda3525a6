# SPDX-License-Identifier: Apache-2.0
"""Writes the type stubs of a freshly built `_core`.

usage: write_stubs.py MODULE_FILE OUTPUT_FOLDER
"""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pybind11_stubgen

# What the generator writes, and what the typing rules ask for in its place.
CORRECTIONS = (
    (r"def (__eq__|__ne__)\(self, arg0: [^)]+\)", r"def \1(self, other: object)"),
    (r"(__hash__: typing\.ClassVar\[None\] = None)", r"\1  # type: ignore[assignment]"),
)


def load(file: str) -> None:
    """Loads the module by path under its final name: stubs then speak of `wiw._core`, and no installed wiw is met."""
    sys.modules["wiw"] = ModuleType("wiw")
    spec = importlib.util.spec_from_file_location("wiw._core", file)
    assert spec is not None and spec.loader is not None
    sys.modules["wiw._core"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["wiw._core"])


def correct(text: str) -> str:
    for pattern, replacement in CORRECTIONS:
        text = re.sub(pattern, replacement, text)
    for name in re.findall(r"^class (\w+)\(enum\.", text, re.MULTILINE):
        text = re.sub(rf"^(    \w+): typing\.ClassVar\[{name}\]$", r"\1 = ...", text, flags=re.MULTILINE)
    return text


def main(file: str, folder: str) -> None:
    load(file)
    # A default value that is an object has no literal; the stub says `...` there. Anything else unreadable is an error.
    options = ["--output-dir", folder, "--ignore-invalid-expressions", "<.*>", "--exit-code"]
    pybind11_stubgen.main(["wiw._core", *options])
    for stub in Path(folder).rglob("*.pyi"):
        stub.write_text(correct(stub.read_text()))


if __name__ == "__main__":
    main(*sys.argv[1:])
