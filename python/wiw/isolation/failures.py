# SPDX-License-Identifier: Apache-2.0
"""How a call of a user's code can fail, besides the exceptions that it raises."""

from __future__ import annotations


class LateError(Exception):
    """The deadline has passed."""

    kind = "deadline"


class ExitError(Exception):
    """The code has raised what is meant to end the process, such as `SystemExit`."""

    kind = "raised"


class EndedError(Exception):
    """The process of the code has ended, or closed its connection, in the middle of a call."""

    kind = "ended"


class RaisedError(Exception):
    """The code has raised an exception in a separate process; the message has its type, text and place."""

    kind = "raised"
