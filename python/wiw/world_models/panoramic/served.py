# SPDX-License-Identifier: Apache-2.0
"""World models whose official code runs elsewhere, behind `server/shim.py`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from wiw.errors import RemoteError
from wiw.world_models.base import Accepts
from wiw.world_models.remote.model import Remote

ADDRESS = "ws://127.0.0.1:8765"
"""Where `shim.py` listens by default."""
SHIM = Path(__file__).parent / "server/shim.py"


class Served(Remote):
    """Ask a model that `shim.py` serves. Subclasses set `accepts`, and `requires` with its name there.

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
            hint = f". {self._explain_start()}" if error.kind == "connection" else ""
            raise RemoteError(f"{error}{hint}", error.kind) from None
        served = json.loads(self._welcome.model).get("name")
        if served != self.requires.served or _list_inputs(self._accepts) != _list_inputs(type(self).accepts):
            self.close()
            raise RemoteError(
                f"{address} serves {served}, not {self.requires.served} as known to this version of wiw. "
                f"{self._explain_start()}, or give another address",
                "model",
            )
        self.accepts = self._accepts

    def describe(self) -> dict[str, Any]:
        """Return what is served, wherever that is."""
        return {**super().describe(), "name": type(self).__name__}

    def _explain_start(self) -> str:
        name = self.requires.served.lower()
        return (
            f"Start it in the environment of the official code:  python {SHIM} {name} --code FOLDER --weights FOLDER  "
            f"({SHIM.parents[1]}/README.md)"
        )


def _list_inputs(accepts: Accepts) -> tuple[Any, ...]:
    return accepts.control, accepts.view, accepts.size, accepts.needs
