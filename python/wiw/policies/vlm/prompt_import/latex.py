# SPDX-License-Identifier: Apache-2.0
r"""Prompts in LaTeX as plain text with Markdown's marks: the few commands that prompts are set with.

`\textbf{x}` becomes **x**, `\texttt{x}` `x`, items become numbers or dashes, indented by their depth. Lines that LaTeX
would fill are one line. A command that is not known is an error: dropping it could change what a model reads.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

from wiw.errors import PromptError

MARKS = {"textbf": "**", "texttt": "`", "textit": "*", "emph": "*", "text": "", "mbox": "", "underline": ""}
"""Commands of one argument: what stands before and after it."""
SYMBOLS = {
    "quad": "  ",
    "qquad": "    ",
    "ldots": "...",
    "dots": "...",
    "textbackslash": "\\",
    "textless": "<",
    "textgreater": ">",
    "textasciitilde": "~",
    "textendash": "–",
    "textemdash": "—",
    "leq": "≤",
    "le": "≤",
    "geq": "≥",
    "ge": "≥",
    "times": "×",
    "rightarrow": "→",
    "degree": "°",
}
IGNORED = ("noindent", "small", "footnotesize", "normalsize", "ttfamily", "bfseries", "itshape", "centering", "sloppy")
BREAKS = ("par", "smallskip", "medskip", "bigskip")
LISTS = ("itemize", "enumerate")
PLAIN = ("ttfamily", "center", "flushleft", "quote", "small")
"""Environments whose content is text like any other."""
INDENT = "   "
ESCAPED = {**{mark: mark for mark in "$&%#_{}"}, **dict.fromkeys(" \n\t,;:", " "), **dict.fromkeys("!/-@", "")}
"""Text for a backslash and one of these: the character, a space of any width, or nothing that is seen."""
_LIGATURES = {"---": "—", "--": "–", "``": '"', "''": '"', "~": " "}
_TOKEN = re.compile(
    r"(?P<comment>%[^\n]*(?:\n[ \t]*)?)"
    r"|\\(?P<edge>begin|end)\s*\{(?P<environment>[A-Za-z*]+)\}(?:\[[^\]]*\])?"
    r"|(?P<newline>\\\\\*?(?:\[[^\]]*\])?|\\newline\b)"
    r"|\\(?P<skip>[vh]space)\*?\s*\{[^{}]*\}"
    r"|\\(?P<item>item)(?![A-Za-z])\s*(?:\[(?P<label>[^\]]*)\])?"
    r"|\\(?P<command>[A-Za-z]+)\*?[ \t]*\n?[ \t]*"
    r"|\\(?P<escaped>[^A-Za-z])"
    r"|(?P<open>\{)|(?P<close>\})|(?P<math>\$)"
    r"|(?P<paragraph>[ \t]*\n(?:[ \t]*\n)+[ \t]*)|(?P<space>[ \t\n]+)"
    r"|(?P<ligature>---|--|``|''|~)"
    r"|(?P<words>[^\\{}%$~`'\s-]+|.)",
    re.DOTALL,
)


def convert_latex(text: str, place: Callable[[int], str]) -> str:
    """Return the text of a prompt.

    Args:
        text: what stands between the beginning and the end of its box.
        place: gives file and line of an offset, for messages.

    Raises:
        PromptError: a command or environment that is not known, or one that does not end.
    """
    writer = _Writer()
    for match in _TOKEN.finditer(text):
        try:
            writer.write(str(match.lastgroup), match)
        except _UnknownLatexError as error:
            raise PromptError(f"{place(match.start())}: {error}") from None
    if writer.closers or writer.lists:
        raise PromptError(f"{place(len(text))}: a brace or a list is not closed")
    return writer.text()


class _UnknownLatexError(Exception):
    """Something that this converter cannot express."""


@dataclass
class _Writer:
    """The text written so far."""

    lines: list[str] = field(default_factory=lambda: [""])
    closers: list[str] = field(default_factory=list)
    """Text to write where each open brace ends."""
    lists: list[int | None] = field(default_factory=list)
    """For each list that is open: its latest number, or None if it has dashes."""
    pending: str | None = None
    """Mark of a command that waits for its argument."""

    def write(self, kind: str, match: re.Match[str]) -> None:
        found = match.group()
        if self.pending is not None and kind != "open":
            raise _UnknownLatexError(f"expected an argument in braces, found {found!r}")
        if kind in ("environment", "label"):
            kind = "item" if match["item"] else "environment"
        if kind == "environment":
            self._enter(match["environment"]) if match["edge"] == "begin" else self._leave(match["environment"])
        elif kind == "item":
            self._begin_item(match["label"])
        elif kind == "command":
            self._expand(match["command"])
        elif kind == "open":
            self.lines[-1] += self.pending or ""
            self.closers.append(self.pending or "")
            self.pending = None
        elif kind == "close":
            self._close()
        elif kind == "paragraph":
            self._break(empty=True)
        elif kind == "newline":
            self._break()
        elif kind in ("space", "comment"):
            self._space(kind == "space")
        elif kind == "escaped":
            self._write_escaped(match["escaped"])
        elif kind not in ("skip", "math"):
            self.lines[-1] += _LIGATURES.get(found, found)

    def text(self) -> str:
        """Return all lines; never two empty ones in a row."""
        return re.sub(r"\n{3,}", "\n\n", "\n".join(line.rstrip() for line in self.lines)).strip("\n")

    def _enter(self, environment: str) -> None:
        if environment in LISTS:
            self.lists.append(0 if environment == "enumerate" else None)
        elif environment not in PLAIN:
            raise _UnknownLatexError(f"unknown environment '{environment}'; expected {', '.join((*LISTS, *PLAIN))}")

    def _leave(self, environment: str) -> None:
        if environment in LISTS:
            if not self.lists:
                raise _UnknownLatexError(f"\\end{{{environment}}} without its beginning")
            self.lists.pop()
            self._break()

    def _begin_item(self, label: str | None) -> None:
        if not self.lists:
            raise _UnknownLatexError("\\item outside a list")
        if self.lines[-1].strip():
            self._break()
        number = self.lists[-1]
        if number is not None:
            self.lists[-1] = number = number + 1
        self.lines[-1] = INDENT * (len(self.lists) - 1) + (label or ("-" if number is None else f"{number}.")) + " "

    def _expand(self, command: str) -> None:
        if command in MARKS:
            self.pending = MARKS[command]
        elif command in SYMBOLS:
            self.lines[-1] += SYMBOLS[command]
        elif command in BREAKS:
            self._break(empty=True)
        elif command not in IGNORED:
            raise _UnknownLatexError(f"unknown command \\{command}; replace it by its meaning in your copy")

    def _write_escaped(self, mark: str) -> None:
        if mark not in ESCAPED:
            raise _UnknownLatexError(f"unknown command \\{mark}; replace it by its meaning in your copy")
        self.lines[-1] += ESCAPED[mark]

    def _close(self) -> None:
        if not self.closers:
            raise _UnknownLatexError("a closing brace has no opening brace")
        self.lines[-1] += self.closers.pop()

    def _break(self, empty: bool = False) -> None:
        if self.lines[-1].strip():
            self.lines.append("")
        if empty and self.lines[-2:] != ["", ""]:
            self.lines.append("")
        self.lines[-1] = INDENT * len(self.lists)

    def _space(self, written: bool) -> None:
        if written and self.lines[-1].strip() and not self.lines[-1].endswith(" "):
            self.lines[-1] += " "
