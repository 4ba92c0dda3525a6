# SPDX-License-Identifier: Apache-2.0
"""The examples of docs/conventions.md hold."""

import re

from locations import ROOT

PAGE = ROOT / "docs" / "conventions.md"


def test_the_examples_of_the_page_run():
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert len(blocks) >= 5
    names: dict = {}
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)
