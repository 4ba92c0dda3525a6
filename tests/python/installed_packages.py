# SPDX-License-Identifier: Apache-2.0
"""The packages that wiw needs, with all its extras, as they are installed here.

Run by hand it prints the lock of CI: installed_packages.py > requirements.lock
"""

from __future__ import annotations

from importlib import metadata

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def find_packages(name: str = "wiw") -> dict[str, metadata.Distribution]:
    """Return, by canonical name, a package and all that it needs, as far as installed."""
    found: dict[str, metadata.Distribution] = {}
    extras = set(metadata.metadata(name).get_all("Provides-Extra", []))
    left, seen = [(name, frozenset(extras))], set()
    while left:
        name, wanted = left.pop()
        if (name, wanted) in seen:
            continue
        seen.add((name, wanted))
        try:
            found[name] = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue
        for needed in map(Requirement, found[name].requires or []):
            if needed.marker is None or any(needed.marker.evaluate({"extra": extra}) for extra in (*wanted, "")):
                left.append((canonicalize_name(needed.name), frozenset(needed.extras)))
    return found


if __name__ == "__main__":
    for name, package in sorted(find_packages().items()):
        if name != "wiw":
            print(f"{name}=={package.version.partition('+')[0]}")
