# SPDX-License-Identifier: Apache-2.0
"""A scorer in a separate process: any command, in any language, under any licence.

The command is started once, without a shell. Its first line on the standard output says who it is:

    {"scorer": "my-musiq", "version": "1.0", "licence": "CC-BY-4.0", "scores": {"musiq": [0, 100]}}

Then it reads paths of PNG files from the standard input, one per line, to the end, and answers each by a line, in any
order:

    {"path": "/tmp/.../5f3a.png", "scores": {"musiq": 61.5}}

Every line is flushed. All other output belongs on standard error. It ends with exit code 0 once all paths are answered.
Nothing of it is imported here, so its licence is its own.
"""

from __future__ import annotations

import json
import math
import os
import queue
import shlex
import signal
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from wiw.errors import ArgumentError, ScorerError
from wiw.scorers.scorer import Range, ScorerCard

DEADLINE = 300.0
"""Seconds of silence after which a scorer counts as hung: time to load a network, or to score one image."""
LONGEST_LINE = 1 << 20
"""Bytes of an answer."""
SLACK = 0.1
"""Share of its range by which a predictor may overshoot it: these are regressions, and their scales approximate."""
QUOTED = 300
"""Characters of a scorer's output that a message repeats."""
MOST_WAITING = 1024
"""Lines that are read ahead."""
GRACE = 2.0
"""Seconds that a scorer has to exit on its own once it is closed."""


class ProcessScorer:
    """A command that scores images. Starts it and reads who it is.

    Args:
        command: as in a shell, without pipes and the like.
        deadline: seconds that it may be silent.

    Raises:
        ScorerError: it cannot be run, ends, hangs, or does not say who it is.
        ArgumentError: the command cannot be split into words, or a deadline that is not above 0.
    """

    def __init__(self, command: str, deadline: float = DEADLINE) -> None:
        if not 0 < deadline < math.inf:
            raise ArgumentError(f"scorer: expected a deadline above 0 seconds, got {deadline:g}")
        self._command, self._deadline = command, deadline
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        self._process = _start(command, self._errors)
        self._failed = False
        self._writer: threading.Thread | None = None
        self._lines: queue.Queue[bytes] = queue.Queue(MOST_WAITING)
        threading.Thread(target=_read_lines, args=(self._process.stdout, self._lines), daemon=True).start()
        try:
            self.card = self._read_card()
        except BaseException:
            self.close()
            raise

    def score(self, paths: Sequence[Path]) -> Iterator[tuple[Path, dict[str, float]]]:
        """Yield the scores of each PNG file as they come, and wait for the process to end. Can be called once.

        Raises:
            ScorerError: it hangs, ends before all are scored, or answers anything but valid scores of what was asked.
        """
        self._writer = threading.Thread(target=_write_lines, args=(self._process.stdin, paths), daemon=True)
        self._writer.start()
        asked = {str(path): path for path in paths}
        answered: set[str] = set()
        while len(answered) < len(asked):
            path, scores = self._read_scores(asked, answered)
            answered.add(path)
            yield asked[path], scores
        self._wait()

    def close(self) -> None:
        """End the process and all that it has started."""
        if self._writer is None:
            self._close_input()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0 if self._failed else GRACE)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        if self._writer is not None:  # closing the input sooner would wait for a write that nobody reads
            self._writer.join(GRACE)
        self._errors.close()

    def _close_input(self) -> None:
        with suppress(OSError):
            if self._process.stdin is not None:
                self._process.stdin.close()

    def __enter__(self) -> ProcessScorer:
        return self

    def __exit__(self, *exception: object) -> None:
        self._failed |= any(part is not None for part in exception)
        self.close()

    def _read_card(self) -> ScorerCard:
        expected = (
            'expected its first line to be like {"scorer": "NAME", "version": "1", "licence": "MIT", "scores": '
            '{"musiq": [0, 100]}}'
        )
        line = self._read_line(0, 0, expected)
        names = ("scorer", "version", "licence")
        if not all(isinstance(line.get(name), str) and line[name].strip() for name in names):
            self._fail("card", f"{expected}, got {_quote(line)}")
        scores = line.get("scores")
        if not isinstance(scores, dict) or not scores or not all(map(_is_range, scores.values())):
            self._fail("card", f"{expected} with [least, most] or null for each score, got {_quote(line)}")
        spans: dict[str, Range] = {
            str(name): None if span is None else (float(span[0]), float(span[1])) for name, span in scores.items()
        }
        return ScorerCard(line["scorer"], line["version"], line["licence"], spans)

    def _read_scores(self, asked: Mapping[str, Path], answered: set[str]) -> tuple[str, dict[str, float]]:
        expected = 'expected a line like {"path": "...", "scores": {...}}'
        line = self._read_line(len(answered), len(asked), expected)
        path, scores = line.get("path"), line.get("scores")
        if not isinstance(path, str) or not isinstance(scores, dict):
            self._fail("malformed", f"{expected}, got {_quote(line)}")
        if path not in asked:
            self._fail("unknown", f"it scored {_quote(path)}, which was not requested; repeat paths exactly as given")
        if path in answered:
            self._fail("repeated", f"it scored {path} twice; answer each path once")
        if set(scores) != set(self.card.scores):
            self._fail(
                "names",
                f"expected the scores {', '.join(sorted(self.card.scores))} that its first line names, "
                f"got {', '.join(sorted(map(str, scores))) or 'none'} of {path}",
            )
        return path, {name: self._check(name, value, path) for name, value in scores.items()}

    def _check(self, name: str, value: Any, path: str) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            self._fail("number", f"expected a finite number as {name} of {path}, got {_quote(value)}")
        span = self.card.scores[name]
        if span is not None:
            slack = SLACK * (span[1] - span[0])
            if not span[0] - slack <= value <= span[1] + slack:
                self._fail(
                    "range", f"{name} of {path} is {value:g}, but its first line says {span[0]:g} to {span[1]:g}"
                )
        return float(value)

    def _read_line(self, answered: int, asked: int, expected: str) -> dict[str, Any]:
        """Return the next line as an object; a line without an end is none."""
        try:
            raw = self._lines.get(timeout=self._deadline)
        except queue.Empty:
            self._fail(
                "hung",
                f"no line for {self._deadline:g} s, with {answered} of {asked} images answered; flush each line, or "
                "allow more time with deadline= or --deadline",
            )
        if not raw:
            self._explain_end(answered, asked)
        if len(raw) >= LONGEST_LINE:
            self._fail("malformed", f"{expected}, got a line of more than {LONGEST_LINE} bytes")
        try:
            line = json.loads(raw)
        except (ValueError, RecursionError):
            line = None
        if not isinstance(line, dict):
            self._fail(
                "malformed",
                f"{expected}, got {_quote(raw.decode(errors='replace').strip())}; print anything else to standard "
                "error",
            )
        return line

    def _explain_end(self, answered: int, asked: int) -> NoReturn:
        """Say how a process ended whose output did."""
        try:
            code = self._process.wait(self._deadline)
        except subprocess.TimeoutExpired:
            self._fail("hung", f"it closed its output with {answered} of {asked} images answered, but keeps running")
        if code != 0:
            how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
            self._fail("crashed", f"it ended {how} with {answered} of {asked} images answered")
        if asked == 0:
            self._fail("card", "it ended without identifying itself; see `wiw quality --help`")
        self._fail("partial", f"it ended with {answered} of {asked} images answered; expected an answer for each path")

    def _wait(self) -> None:
        """Wait until the process has ended; an answer too many and an exit code are errors."""
        count = "all images answered"
        try:
            extra = self._lines.get(timeout=self._deadline)
            code = self._process.wait(self._deadline)
        except (queue.Empty, subprocess.TimeoutExpired):
            self._fail("hung", f"{count}, but it keeps running after the end of its input")
        if extra:
            self._fail("repeated", f"{count}, but it continues with {_quote(extra.decode(errors='replace').strip())}")
        if code != 0:
            self._fail("crashed", f"{count}, but it ended with exit code {code}")

    def _fail(self, kind: str, problem: str) -> NoReturn:
        self._failed = True
        self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, self._errors.tell() - QUOTED))
        said = self._errors.read().decode(errors="replace").strip()
        after = f". Its standard error ends: {said}" if said else ""
        raise ScorerError(f"scorer '{self._command}': {problem}{after}", kind)


def _start(command: str, errors: Any) -> subprocess.Popen[bytes]:
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ArgumentError(f"scorer: cannot read the command {command!r} ({error}); quote it as in a shell") from None
    try:
        return subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, start_new_session=True
        )
    except OSError as error:
        raise ScorerError(
            f"scorer '{command}': cannot be run ({error.strerror or error}); expected pixels, laion, or a command that "
            "can be found and executed",
            "missing",
        ) from error


def _read_lines(stream: Any, lines: queue.Queue[bytes]) -> None:
    """Hand on lines until the stream ends; b"" stands for its end."""
    with suppress(ValueError, OSError):  # closed meanwhile
        while line := stream.readline(LONGEST_LINE):
            lines.put(line)
    lines.put(b"")


def _write_lines(stream: Any, paths: Sequence[Path]) -> None:
    """Write paths, then close the stream, also where its reader has ended: what that answered says the rest."""
    with suppress(OSError), stream:
        for path in paths:
            stream.write(f"{path}\n".encode())


def _is_range(span: Any) -> bool:
    if span is None:
        return True
    numbers = (
        isinstance(span, list)
        and len(span) == 2
        and all(isinstance(end, int | float) and not isinstance(end, bool) and math.isfinite(end) for end in span)
    )
    return numbers and span[0] < span[1]


def _quote(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return repr(text if len(text) <= QUOTED else f"{text[:QUOTED]}...")
