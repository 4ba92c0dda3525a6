# SPDX-License-Identifier: Apache-2.0
"""`wiw judge`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from wiw.cli.options import Options
from wiw.cli.stop import announce_resume
from wiw.cli.terminal import printable
from wiw.errors import ArgumentError

if TYPE_CHECKING:
    from wiw.studies.judge import MissingMarks

MOST_LISTED = 10
"""Maximum number of episodes without marks that are listed for each error."""


def judge(
    run: Positional[Annotated[Path, arg(metavar="RUN")]],
    /,
    *,
    judge: Annotated[str | None, arg(metavar="JUDGE")] = None,
    llm: Annotated[str | None, arg(metavar="URL")] = None,
    model: Annotated[str | None, arg(metavar="NAME")] = None,
    judge_option: Options = (),
) -> int:
    """Judge the stored answers of a run again, with rules or a language model, without rerunning any episode.

    $ wiw judge runs/first
    $ wiw judge runs/first --llm http://localhost:8000/v1 --model gpt-4o-mini
    $ wiw judge runs/first --judge llm:http://localhost:8000/v1#gpt-4o-mini --judge-option temperature=0
    $ wiw report runs/first --judge rules+llm
    $ wiw compare runs/first runs/second --judge rules+llm

    A judge gives each answer a mark from 1 (wrong) to 5 (right); scores, SPL and the anytime curve are computed from
    marks. The new marks are stored in the run next to its own, which are kept, under a digest of everything that marks
    depend on: versions, model, prompt, seed, temperature. `wiw report`, `view`, `export` and `compare` accept --judge
    with a judge's name or digest. Runs with marks from different judges are never compared.

    An answer that cannot be judged (the server is down, or its reply is not a mark) counts as an error of its episode,
    never as a low mark. Exit code 1 if any are left; repeating the command then requests only the missing marks.

    Args:
        run: The run's folder.
        judge: rules (typed rules, word overlap for free text), rules+llm:URL#MODEL (a language model for free text),
            llm:URL#MODEL (a language model for everything) or approximate (word overlap). Default: rules.
        llm: Short for --judge rules+llm:URL#MODEL: any OpenAI-compatible server.
        model: The language model's name on the server; not needed if the server offers only one.
        judge_option: An option of the language model as judge: temperature, seed, max_tokens, prompts, cache, timeout,
            attempts, concurrency, ...; may be repeated.
    """
    from wiw.judging import LanguageModelJudge
    from wiw.runs.part_options import parse_options
    from wiw.studies.judge import judge as judge_run

    options = parse_options(judge_option, LanguageModelJudge, "--judge-option")
    spec = make_spec(judge, llm, model)
    with announce_resume():
        found = judge_run(run, spec, **options)
    found.log.summary()
    print(f"\njudge   {found.judge.full_label}\nanswers {found.asked} judged now, {found.known} judged before")
    for line in list_missing(found.missing):
        print(printable(line), file=sys.stderr)
    if found.missing:
        more = f"; {printable(found.stopped)}" if found.stopped else ""
        print(
            f"{len(found.missing)} episodes have no marks by this judge{more}. Once the cause is fixed, repeat the "
            "command to request the missing marks",
            file=sys.stderr,
        )
    return 0 if found.complete else 1


def list_missing(missing: Sequence[MissingMarks]) -> list[str]:
    """Return one line per error, with the episodes that it left without marks."""
    by_error: dict[str, list[str]] = {}
    for each in missing:
        by_error.setdefault(each.error, []).append(f"{each.arm} {each.episode}")
    return [
        f"no marks: {', '.join(places[:MOST_LISTED])}"
        + (f" and {len(places) - MOST_LISTED} more" if len(places) > MOST_LISTED else "")
        + f": {error}"
        for error, places in by_error.items()
    ]


def make_spec(judge: str | None, llm: str | None, model: str | None) -> str:
    """Return the judge that the three flags specify.

    Raises:
        ArgumentError: flags that exclude each other.
    """
    if llm is not None and judge is not None:
        raise ArgumentError(
            f"--llm is short for --judge rules+llm:URL; give only one of --judge {judge} and --llm {llm}"
        )
    spec = f"rules+llm:{llm}" if llm is not None else (judge or "rules")
    if model is None:
        return spec
    if "llm:" not in spec or "#" in spec:
        raise ArgumentError(
            f"--model {model}: expected a language model given without a name, as --llm URL or --judge llm:URL, got "
            f"the judge '{spec}'"
        )
    return f"{spec}#{model}"
