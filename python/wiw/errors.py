# SPDX-License-Identifier: Apache-2.0
"""Every error that `wiw` raises on purpose. Messages say what was expected, what was received, and what to do."""

import sysconfig
import traceback
from pathlib import Path

from wiw._core import ArgumentError, BackendError, Error, FileError, NavigationError

__all__ = [
    "ArgumentError",
    "BackendError",
    "ConstructionError",
    "ContractError",
    "DependencyError",
    "DeviceMemoryError",
    "EpisodesError",
    "Error",
    "FileError",
    "InfrastructureError",
    "JudgeError",
    "NavigationError",
    "PromptError",
    "RegistryError",
    "RemoteError",
    "RolloutError",
    "ScorerError",
    "StoreError",
    "TrainingError",
    "VlmError",
    "WeightsError",
    "describe_exception",
    "find_error_class",
    "find_raising_line",
    "is_stop_request",
    "read_text",
]

OWN = str(Path(__file__).parent)
"""Folder of wiw's code."""
LIBRARIES = tuple(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib"))
"""Folders of installed code."""


for _error in (ArgumentError, BackendError, Error, FileError, NavigationError):
    _error.__module__ = __name__  # tracebacks name the module that users import them from


def is_stop_request(error: BaseException) -> bool:
    """Return whether an exception stops the process itself: Ctrl-C, or one of wiw's own for a signal.

    Any other is an error of the code that raised it, also `SystemExit`: a plugged-in model ends no run.
    """
    own = type(error).__module__.partition(".")[0] == "wiw" and not isinstance(error, Exception)
    return own or isinstance(error, KeyboardInterrupt)


def find_error_class(name: str) -> type[Error] | None:
    """Return the class of wiw's errors of that name, as another process reports it; None if there is none."""
    found = globals().get(name) if name in __all__ else None
    return found if isinstance(found, type) and issubclass(found, Error) else None


def find_raising_line(error: BaseException) -> traceback.FrameSummary | None:
    """Return the line of a user's code at which an exception was raised, or that led to it.

    It is the last line outside wiw and installed packages, or else outside wiw; None if no other line was reached.
    """
    frames = traceback.extract_tb(error.__traceback__)
    foreign = [frame for frame in frames if not frame.filename.startswith((OWN, "<"))]
    users = [frame for frame in foreign if not frame.filename.startswith(LIBRARIES)]
    return next(reversed(users or foreign), None)


def read_text(error: BaseException) -> str:
    """Return an exception's text in one line; that of somebody else's may fail to be made, which the line then says."""
    try:
        return " ".join(str(error).split())
    except Exception as fault:
        return f"its text cannot be had ({type(fault).__name__})"


def describe_exception(error: BaseException, show_line: bool = False) -> str:
    """Return, e.g., "ValueError: no (model.py, line 3)": also the place, and the line itself if `show_line`."""
    said = f"{type(error).__name__}: {read_text(error)}"
    place = find_raising_line(error)
    if place is None:
        return said
    line = f": {place.line}" if show_line else ""
    return f"{said} ({Path(place.filename).name}, line {place.lineno}{line})"


def read_last_line(report: str) -> str:
    """Return the last line of a traceback, which names the exception; empty for an empty one."""
    lines = report.strip().splitlines()
    return lines[-1].strip() if lines else ""


class EpisodesError(ArgumentError):
    """A scene has no episode that satisfies the rules asked for; `rule` is the one that the best attempts broke."""

    def __init__(self, message: str, rule: str) -> None:
        super().__init__(message)
        self.rule = rule

    def __reduce__(self) -> tuple[type, tuple[str, str]]:
        return type(self), (str(self), self.rule)


class RegistryError(Error, LookupError):
    """A name is not registered. The message lists what is, nearest first."""


class ConstructionError(Error):
    """A world model, a policy or another part cannot be built: its constructor failed.

    `kind` is "raised", "deadline" where it did not return in time, or "ended" where it ended its process.
    """

    def __init__(self, message: str = "", kind: str = "raised") -> None:
        super().__init__(message)
        self.kind = kind


class ContractError(Error, TypeError):
    """A plugged-in model, policy or metric broke its contract (wrong shape, dtype, count, or NaN).

    `kind` names a breach of a world model: "type", "dtype", "nan", "shape", "frames" (another number of them),
    "frame 0" (not the observation), "channels" (BGR), "scale" (0 to 1 cast to uint8) or "memory".
    """

    def __init__(self, message: str = "", kind: str = "contract") -> None:
        super().__init__(message)
        self.kind = kind


class InfrastructureError(Error):
    """Something around the task failed (a server, a file, memory): the episode is recorded as such and not scored."""


class DependencyError(Error, ImportError):
    """An optional package is not installed. The message names it and the extra of wiw that brings it."""


class WeightsError(Error):
    """A model's weights cannot be had or used.

    `kind` is "missing" (no such folder, repository or file), "revision", "gated" (accept its terms and log in),
    "network", or "unfit" (another kind of model, or damaged files).
    """

    def __init__(self, message: str = "", kind: str = "missing") -> None:
        super().__init__(message)
        self.kind = kind


class DeviceMemoryError(InfrastructureError):
    """The memory of the device, accelerator or CPU, is full. The message names the options that need less of it."""


class RolloutError(InfrastructureError):
    """A world model gave no valid rollout after all retries.

    `kind` is "raised", "deadline", "ended" (its own process has), or the kind of the `ContractError` that its answer
    was.
    """

    def __init__(self, message: str = "", kind: str = "raised") -> None:
        super().__init__(message)
        self.kind = kind


class RemoteError(RolloutError):
    """A served model gave no answer, or a message violates the protocol.

    `kind` is "connection" (nobody is there), "deadline", "token", "version", "model" (the server has come back with
    another one), "message" (malformed, or too large), "row" (not what the model accepts), or "raised".
    """


class PromptError(Error):
    """A prompt template cannot be used. The message names the file, and the slot if it is one."""


class VlmError(InfrastructureError):
    """A vision-language model could not be queried after all retries.

    `kind` is "unreachable", "timeout", "status" (the server failed or was busy), "refused" (it never will), "protocol"
    (a reply that is not a completion) or "missing" (an answer that was not recorded).
    """

    def __init__(self, message: str = "", kind: str = "unreachable") -> None:
        super().__init__(message)
        self.kind = kind


class JudgeError(InfrastructureError):
    """An answer could not be judged; it has no mark, which is not the same as a low one.

    `kind` names what the language model replied: "empty", "refusal", "truncated", "huge", "malformed" (no mark is all
    that it says) or "range" (a mark that is not from 1 to 5); or "no_rule", where no judge knows the answer's type.
    """

    def __init__(self, message: str = "", kind: str = "malformed") -> None:
        super().__init__(message)
        self.kind = kind


class ScorerError(InfrastructureError):
    """A scorer of images gave no valid scores.

    `kind` is "missing" (the command cannot be run), "card" (it does not say who it is), "hung", "crashed", "partial"
    (it ended before all was answered), "malformed" (no answer), "unknown" (a path that was not asked about),
    "repeated", "names" (other scores than announced), "number" (none, or NaN) or "range" (beyond the announced one).
    """

    def __init__(self, message: str = "", kind: str = "malformed") -> None:
        super().__init__(message)
        self.kind = kind


class StoreError(Error):
    """A run store is damaged, of another version, or does not fit what is asked of it."""


class TrainingError(Error):
    """A training cannot continue: its loss or its gradient is not finite. The message names the batch."""
