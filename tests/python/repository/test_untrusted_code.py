# SPDX-License-Identifier: Apache-2.0
"""Nothing that wiw reads can run code, and secrets are compared in constant time. Ruff's rules S102, S301, S307 and
S506 hold `exec`, `pickle`, `eval` and YAML; these hold what it has no rule for.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest
from locations import ROOT

SOURCES = ROOT / "python" / "wiw"
SECRET = ("token", "password", "secret", "authorization")


def find_calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def find_unsafe_loads(tree: ast.AST) -> list[int]:
    """Lines at which a file may bring code: torch.load without weights_only, NumPy with pickle, other unpicklers."""
    lines = []
    for name, call in find_calls(tree):
        given = {each.arg: ast.unparse(each.value) for each in call.keywords}
        unsafe_torch = name == "torch.load" and given.get("weights_only") != "True"
        unsafe_numpy = name in ("np.load", "numpy.load") and given.get("allow_pickle", "False") != "False"
        if unsafe_torch or unsafe_numpy or name in ("joblib.load", "dill.load", "cloudpickle.load", "shelve.open"):
            lines.append(call.lineno)
    return lines


def find_plain_comparisons(tree: ast.AST) -> list[int]:
    """Lines at which something named like a secret is compared with == or !=, which takes longer the more is right."""
    return [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Compare)
        and any(isinstance(operator, ast.Eq | ast.NotEq) for operator in node.ops)
        and any(
            name.lower().strip("_").endswith(SECRET)
            for side in (node.left, *node.comparators)
            for part in ast.walk(side)
            if (name := getattr(part, "id", getattr(part, "attr", "")))
        )
    ]


def test_no_file_brings_code_and_no_secret_is_compared_plainly() -> None:
    files = sorted(SOURCES.rglob("*.py"))
    assert len(files) > 400
    for file in files:
        tree = ast.parse(file.read_text())
        assert find_unsafe_loads(tree) == [], file
        assert file.parent.name == "vlm" or find_plain_comparisons(tree) == [], file  # whose tokens are words


@pytest.mark.parametrize(
    "text", ["torch.load(path)", "torch.load(path, weights_only=False)", "np.load(path, allow_pickle=True)"]
)
def test_unsafe_loads_are_found(text: str) -> None:
    assert find_unsafe_loads(ast.parse(text)) == [1]


@pytest.mark.parametrize("text", ["token == shown", "self.token != b'a'", "headers['a'] == settings.token.encode()"])
def test_plain_comparisons_are_found(text: str) -> None:
    assert find_plain_comparisons(ast.parse(text)) == [1]
