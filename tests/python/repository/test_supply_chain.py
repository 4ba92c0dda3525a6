# SPDX-License-Identifier: Apache-2.0
"""Whatever wiw needs has a licence that it may be used under, and a version that CI can pin."""

from __future__ import annotations

import re
from importlib.metadata import Distribution

import pytest
from installed_packages import find_packages
from locations import ROOT
from packaging.requirements import Requirement

PERMISSIVE = {
    "0BSD", "3-Clause BSD License", "Apache 2.0", "Apache 2.0 License", "Apache License 2.0", "Apache Software License",
    "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD License", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0",
    "CNRI-Python", "DFSG approved", "ISC", "ISC License (ISCL)", "MIT", "MIT License", "MIT-CMU", "PSF-2.0",
    "Python Software Foundation License", "Unlicense", "Zlib",
}  # fmt: skip
WEAK_COPYLEFT = {"MPL-2.0", "Mozilla Public License 2.0 (MPL 2.0)"}
"""Asks for the source of its own files alone, which wiw neither changes nor ships."""
KNOWN = {
    "embreex": "Copyright (c) 2015, Anthony Scopatz",  # BSD-2-Clause
    "atheris": "",  # Apache-2.0, in a file alone
}
"""Packages whose metadata quotes a licence in place of its name, by its first line, or do not name any."""


def read_licences(package: Distribution) -> set[str]:
    """Return the names in a package's licence expression, else in its classifiers, else in its free text."""
    about = package.metadata
    names = [each.rpartition(" :: ")[2] for each in about.get_all("Classifier", []) if each.startswith("License ::")]
    free = (about.get("License") or "").partition("\n")[0]
    text = about.get("License-Expression") or " AND ".join(names) or free
    return set(re.split(r" AND | OR ", text))


def test_every_dependency_has_a_licence_of_the_list() -> None:
    packages = find_packages()
    assert len(packages) > 20
    unknown = {
        name: licences
        for name, package in packages.items()
        if (licences := read_licences(package) - PERMISSIVE - WEAK_COPYLEFT) and licences != {KNOWN.get(name)}
    }
    assert not unknown, f"read these licences, and add them to the list or drop the package: {unknown}"


def test_the_lock_has_a_version_of_every_direct_dependency_that_it_may_have() -> None:
    pins = dict(line.split("==") for line in (ROOT / "requirements.lock").read_text().splitlines())
    unpinned = {"wiw", "bitsandbytes", "datasets", "pre-commit", "ray", "tensorboard"}  # CI installs none
    needed = [Requirement(text) for text in find_packages()["wiw"].requires or []]
    for each in needed:
        if each.name in unpinned and each.name not in pins:
            continue
        assert each.name.lower().replace("_", "-") in pins, f"{each.name}: run tests/python/installed_packages.py again"
        assert each.specifier.contains(pins[each.name.lower().replace("_", "-")], prereleases=True), each


@pytest.mark.parametrize("text", ["GPL-3.0-only", "MIT AND AGPL-3.0-only", ""])
def test_other_licences_are_found(text: str) -> None:
    class Package:
        metadata = type("Metadata", (dict,), {"get_all": lambda self, name, default: default})(
            {"License-Expression": text}
        )

    assert read_licences(Package()) - PERMISSIVE - WEAK_COPYLEFT  # type: ignore[arg-type]
