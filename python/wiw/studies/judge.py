# SPDX-License-Identifier: Apache-2.0
"""Judge the stored answers of a run again: nothing is rerun, and the run's own marks are kept.

Marks are stored in the run under the digest of everything that they depend on. An answer that could not be judged is an
error of its episode; the next call requests only what is missing.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wiw.errors import Error, InfrastructureError, StoreError, VlmError
from wiw.judging import Judge, Judgement, Reference, make_judge
from wiw.registry import TASKS, task_class
from wiw.runs.judges import JUDGE_ERROR, JudgedRow, JudgeRecord, can_be_judged
from wiw.runs.progress import AnswerProgress, make_board
from wiw.runs.rows import to_json
from wiw.runs.run import find_folder
from wiw.runs.store import RunStore
from wiw.studies.run_log import RunLog, load_run
from wiw.tasks.answer_record import AnswerRecord, read_judgements

SERVER_ERRORS = 5
"""Consecutive answers for which the language model could not be reached, after which no more are requested."""
Key = tuple[str, int]
"""Arm and index of an episode."""
Item = tuple[int, str]
"""Episode and answer: equal answers by several arms to one question are judged once."""


@dataclass(frozen=True)
class MissingMarks:
    """An arm's episode that a judge has not marked."""

    arm: str
    episode: int
    error: str
    """The reason, in one line."""
    kind: str


@dataclass(frozen=True)
class JudgedRun:
    """The result of judging a run."""

    log: RunLog
    """The run, read with the judge's marks."""
    judge: JudgeRecord
    asked: int
    """Answers that were judged now."""
    known: int
    """Answers that the judge had marked before."""
    missing: tuple[MissingMarks, ...]
    """Episodes without marks; the next call requests these."""
    stopped: str = ""
    """Why some answers were not judged; empty if all were."""

    @property
    def complete(self) -> bool:
        """Whether every finished episode has marks."""
        return not self.missing


def judge(
    run: str | Path | RunLog, judge: str | Judge = "rules", *, progress: bool = True, **options: Any
) -> JudgedRun:
    """Judge the stored answers of a run, and recompute all metrics that depend on marks.

        found = wiw.judge("runs/first", "rules+llm:http://localhost:8000/v1#gpt-4o-mini", temperature=0.0)
        found.log.summary()                                      # with the marks of that judge
        wiw.load_run("runs/first", judge="rules+llm").summary()  # later, the same

    Args:
        run: a run, or its folder.
        judge: see `wiw.judging.make_judge`.
        progress: whether to show a bar.
        options: options of a language model as judge, such as temperature, seed, prompts, timeout; see
            `LanguageModelJudge`.

    Raises:
        ArgumentError: an unknown judge, or options without a language model.
        StoreError: the run cannot be read, is being written, or its task has no answers in words.
        VlmError: the model's name was not given, and its server cannot be asked for it.
    """
    folder = find_folder(run)
    made = make_judge(judge, **options)
    with RunStore.annotate(folder) as store:
        marking = _JudgingPass(store, made)
        marking.mark_missing(progress)
        missing = tuple(marking.list_missing())
    log = load_run(folder, judge=marking.judge.digest)
    return JudgedRun(log, marking.judge, marking.asked, marking.known_before, missing, marking.stopped)


class _JudgingPass:
    """One pass of a judge over the answers of a run."""

    def __init__(self, store: RunStore, made: Judge) -> None:
        self._store, self._made = store, made
        self.asked, self.stopped = 0, ""
        self._records = read_answers(store)
        own = store.judges[0] if store.judges else None
        description = json.loads(to_json(made.describe()))
        self.judge = own if own is not None and own.description == description else JudgeRecord(description)
        judged = store.judged_outcomes(self.judge.digest)
        marked = {key for key, row in judged.items() if row["status"] == "done"}
        if self.judge.own:
            marked |= {key for key, (row, _) in self._records.items() if row["status"] == "done"}
        self._left = [key for key in self._records if key not in marked]  # what this pass is to mark
        self._found: dict[Item, Judgement | Exception] = dict(self._read_known(judged))
        self.known_before = len(self._found)

    def _read_known(self, judged: Mapping[Key, Mapping[str, Any]]) -> Iterator[tuple[Item, Judgement]]:
        """Yield the judge's stored marks, including those of episodes with another answer missing."""
        rows = [(episode, row["details"]) for (_, episode), row in judged.items()]
        if self.judge.own:
            rows += [(episode, row["details"]) for (_, episode), (row, _) in self._records.items()]
        for episode, details in rows:
            for answer, judgement in read_judgements(details).items():
                yield (episode, answer), judgement

    def mark_missing(self, progress: bool) -> None:
        """Judge what is missing, and write each outcome as soon as its answers are judged."""
        wanted = {(key[1], answer): None for key in self._left for answer in self._records[key][1].answers}
        items = [item for item in wanted if item not in self._found]
        if self._left or not self.judge.own:  # its marks can be read as soon as it is known, also while there are none
            self._store.add_judge(self.judge)
        state = AnswerProgress(self.known_before + len(items), self.known_before)
        board = make_board(progress and bool(items))
        try:
            board.show(self.judge.name, state)
            left = _group_by_episode(self._write_ready(self._left))
            for item, outcome in self._ask(items):
                self._found[item] = outcome
                self.asked += 1
                state.ended, state.errors = state.ended + 1, state.errors + isinstance(outcome, Exception)
                left[item[0]] = self._write_ready(left[item[0]])
                board.show(self.judge.name, state)
        finally:
            board.close()

    def _ask(self, items: Sequence[Item]) -> Iterator[tuple[Item, Judgement | Exception]]:
        """Yield the outcome of each item as it arrives, until the language model can no longer be reached."""
        references = {key[1]: record.reference for key, (_, record) in self._records.items()}
        width, waiting, in_a_row = self._made.concurrency, deque(items), 0
        pool = ThreadPoolExecutor(width, thread_name_prefix="wiw judge")
        running: dict[Future[Judgement | Exception], Item] = {}
        try:
            while running or waiting:
                while waiting and len(running) < width and not self.stopped:
                    item = waiting.popleft()
                    running[pool.submit(judge_answer, self._made, references[item[0]], item[1])] = item
                if not running:
                    return
                for done in wait(running, return_when=FIRST_COMPLETED).done:
                    outcome = done.result()
                    in_a_row = in_a_row + 1 if isinstance(outcome, VlmError) else 0
                    if in_a_row >= max(SERVER_ERRORS, width) and waiting:
                        self.stopped = f"{len(waiting)} answers were not judged, as the last {in_a_row} ended "
                        self.stopped += f"with an error of the language model: {outcome}"
                    yield running.pop(done), outcome
        finally:
            pool.shutdown(wait=False, cancel_futures=True)

    def _write_ready(self, keys: Sequence[Key]) -> list[Key]:
        """Write the outcomes whose answers have all been judged, or could not be; return the others."""
        left = []
        for key in keys:
            record = self._records[key][1]
            if all((key[1], answer) in self._found for answer in record.answers):
                self._store.write_judged(self._make_row(key, record))
            else:
                left.append(key)
        return left

    def _make_row(self, key: Key, record: AnswerRecord) -> JudgedRow:
        found = {answer: self._found[key[1], answer] for answer in record.answers}
        judgements = {answer: each for answer, each in found.items() if isinstance(each, Judgement)}
        errors = [each for each in found.values() if isinstance(each, Exception)]
        details = record.describe(judgements)
        if not errors:
            return JudgedRow(self.judge.digest, *key, record.compute_metrics(judgements), details)
        kind = JUDGE_ERROR + (str(getattr(errors[0], "kind", "")) or "raised")
        return JudgedRow(self.judge.digest, *key, {}, details, f"{type(errors[0]).__name__}: {errors[0]}", kind)

    def list_missing(self) -> Iterator[MissingMarks]:
        """Yield the episodes without marks."""
        judged = self._store.judged_outcomes(self.judge.digest)
        for (arm, episode), (row, _) in self._records.items():
            if self.judge.own and row["status"] == "done":
                continue
            found = judged.get((arm, episode))
            if found is None:
                yield MissingMarks(arm, episode, "not requested yet", "judge/missing")
            elif found["status"] == "error":
                yield MissingMarks(arm, episode, found["error"], found["kind"])


def _group_by_episode(keys: Sequence[Key]) -> dict[int, list[Key]]:
    found: dict[int, list[Key]] = {}
    for key in keys:
        found.setdefault(key[1], []).append(key)
    return found


def read_answers(store: RunStore) -> dict[Key, tuple[dict[str, Any], AnswerRecord]]:
    """Return the outcomes of a run that can be judged, each with its answers, by arm and episode.

    Raises:
        StoreError: the run's task has no answers in words, or is unknown here.
    """
    task, episodes = _find_task(store), store.episodes()
    found = {}
    for row in store.recorded_outcomes():
        if can_be_judged(row):
            answers = task.read_answers(store.config["task"], episodes[row["episode"]], row)
            if answers is not None:
                found[row["arm"], row["episode"]] = row, answers
    return found


def judge_answer(judge: Judge, reference: Reference, answer: str) -> Judgement | Exception:
    """Return the judgement of an answer, or why there is none.

    Raises:
        Error: judging cannot work at all, for example without a required package.
    """
    try:
        outcome: Judgement | Exception = judge.judge_each([reference], [answer])[0]
    except InfrastructureError as error:
        return error
    except Error:
        raise
    except Exception as error:  # of a judge of the user's own
        return error
    return outcome


def _find_task(store: RunStore) -> Any:
    """Return the class of a run's task.

    Raises:
        StoreError: it has no answers in words, or is unknown here.
    """
    task, recipe = store.config["task"].get("task"), store.info["task"]
    if not store.judges:
        raise StoreError(
            f"{store.path.parent} is a run of task '{task}', whose outcomes do not depend on a judge; expected a task "
            "with answers in words, such as aeqa"
        )
    if not recipe and task not in TASKS.names():
        raise StoreError(
            f"{store.path.parent} was started with a task in memory, '{task}', that is not registered; register it "
            "under the entry points 'wiw.tasks' (docs/write-your-own-task.md)"
        )
    return task_class(recipe["name"] if recipe else task)
