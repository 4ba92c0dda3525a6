# SPDX-License-Identifier: Apache-2.0
"""World models whose official code runs elsewhere, behind `shim.py`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from wiw.errors import RemoteError
from wiw.world_models.base import Accepts
from wiw.world_models.remote import Remote

ADDRESS = "ws://127.0.0.1:8765"
"""Where `shim.py` listens unless it is told otherwise."""
SHIM = Path(__file__).with_name("shim.py")


class Served(Remote):
    """A model that `shim.py` serves. Subclasses set `accepts`, and `requires` with the name that it is served under.

    Args:
        address: of the shim.
        token: its token; None means that of the environment variable WIW_TOKEN.
        patience: seconds that the first connection may take.

    Raises:
        ArgumentError: no such address.
        RemoteError: nobody answers there, or something else than this model is served.
    """

    accepts: Accepts

    def __init__(self, address: str = ADDRESS, token: str | None = None, patience: float = 15.0) -> None:
        try:
            super().__init__(address, token, patience)
        except RemoteError as error:
            hint = f". {self._start()}" if error.kind == "connection" else ""
            raise RemoteError(f"{error}{hint}", error.kind) from None
        served = json.loads(self._welcome.model).get("name")
        if served != self.requires.served or _taken(self._accepts) != _taken(type(self).accepts):
            self.close()
            raise RemoteError(
                f"{address} serves {served}, not {self.requires.served} as this version of wiw knows it. "
                f"{self._start()}, or give another address",
                "model",
            )
        self.accepts = self._accepts

    def describe(self) -> dict[str, Any]:
        """What is served, wherever that is."""
        return {**super().describe(), "name": type(self).__name__}

    def _start(self) -> str:
        name = self.requires.served.lower()
        return (
            f"Start it in the environment of the official code:  python {SHIM} {name} --code FOLDER --weights FOLDER  "
            f"({SHIM.parent.with_name(name)}/README.md)"
        )


def _taken(accepts: Accepts) -> tuple[Any, ...]:
    return accepts.control, accepts.view, accepts.size, accepts.needs
