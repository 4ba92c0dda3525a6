# SPDX-License-Identifier: Apache-2.0
"""Pages to browse a run: a list of its episodes and a page per episode, with the pictures in a folder beside them.

The report is one file about the results with a few example episodes; these pages are for finding and opening any
decision, in a run of any size. Both render an episode from the same values and template parts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wiw._core import core
from wiw.files import atomic_folder
from wiw.metrics.metric import is_success
from wiw.report.beliefs import read_verdict
from wiw.report.episodes import make_title, outcomes_by_episode, read_story, read_wording
from wiw.report.plots import arm_colors
from wiw.report.story import Album, Picture, Story, final_answer, name_place, place
from wiw.report.templating import environment
from wiw.runs.run import Run
from wiw.types import Episode, Wording


class PictureFolder(Album):
    """An album whose pictures are files in a folder, each written once, by a pool of threads."""

    panorama_width, frame_height, quality = 1024, 132, 60
    belief_width, belief_quality, belief_count = 760, 75, None
    front_side, end_side, goal_side, map_side, whole = 480, 160, 480, 1100, True

    def __init__(self, folder: Path, pool: Executor) -> None:
        super().__init__()
        self._folder, self._pool = folder, pool
        self._folder.mkdir()
        self._sizes: dict[str, int] = {}
        self._making: list[Future[str]] = []

    @property
    def count(self) -> int:
        """Pictures that were written."""
        return len(self._sizes)

    @property
    def size(self) -> int:
        """Their bytes."""
        return sum(self._sizes.values())

    def put(self, name: str, kind: str, data: bytes) -> str:
        """Return the picture's address, relative to an episode's page. No text of the run is part of a name."""
        file = self._folder / f"{name}.{kind}"
        if file.name not in self._sizes:
            file.write_bytes(data)
            self._sizes[file.name] = len(data)
        return f"../{self._folder.name}/{file.name}"

    def draw(self, name: str, make: Callable[[], bytes]) -> Picture:
        """Return a picture whose file is there after `finish`."""
        self._making.append(self._pool.submit(lambda: self.put(name, "webp", make())))
        return Picture(f"../{self._folder.name}/{name}.webp")

    def finish(self) -> None:
        """Wait for the pictures that are being made; raise the error of one that could not be made."""
        making, self._making = self._making, []
        for picture in making:
            picture.result()


@dataclass(frozen=True)
class Cell:
    """Outcome of an episode in one arm, for the list."""

    arm: str
    state: str
    """"success", "failure", "error" (of the infrastructure) or "open" (not run yet)."""
    text: str
    about: str
    """Explanation of the text."""
    short: bool = False
    """Whether the text is the distance to the goal at the end."""


@dataclass(frozen=True)
class Line:
    """One episode in the list."""

    index: int
    episode: Episode
    place: str
    cells: tuple[Cell, ...]
    pictures: bool

    @property
    def group(self) -> str:
        """Value that the list is filtered by: its kind where its task has several, else its scene."""
        return self.episode.kind or self.episode.scene

    @property
    def instruction(self) -> str:
        """Instruction in words, where the task gives one."""
        return str(self.episode.info.get("instruction", ""))

    @property
    def file(self) -> str:
        """Its page's name."""
        return f"{self.index:04d}.html"

    @property
    def has_page(self) -> bool:
        """Whether there is a page: at least one arm has ended the episode."""
        return any(cell.state != "open" for cell in self.cells)


@dataclass(frozen=True)
class Site:
    """Files that `write_view` wrote."""

    index: Path
    """The page to open."""
    episodes: int
    pictures: int
    size: int
    """Bytes of pictures."""


def write_view(run: Run, folder: Path) -> Site:
    """Write `index.html`, `episodes/` and `images/` into a new folder. All text from the run is escaped.

    Raises:
        FileError: the folder holds something that is not a view, or cannot be written.
    """
    with atomic_folder(folder, replace=is_view) as draft, ThreadPoolExecutor(core.num_threads()) as pool:
        album = PictureFolder(draft / "images", pool)
        pages = draft / "episodes"
        pages.mkdir()
        outcomes = outcomes_by_episode(run.store, run.arms)
        lines = _list_lines(run, outcomes)
        common = _collect_common(run)
        (draft / "index.html").write_text(_index(run, lines, common), encoding="utf-8")
        listed = [line for line in lines if line.has_page]
        for number, line in enumerate(listed):
            scenes: dict[str, Picture] = {}
            story = read_story(run.store, line.index, line.episode, outcomes[line.index], scenes, album)
            common |= {"before": listed[number - 1] if number else None}
            common |= {"after": listed[number + 1] if number + 1 < len(listed) else None}
            (pages / line.file).write_text(_render_episode(story, scenes, common), encoding="utf-8")
            album.finish()
    return Site(folder / "index.html", len(listed), album.count, album.size)


def is_view(folder: Path) -> bool:
    """Return whether a folder holds a view and nothing else, so that a new one may take its place."""
    return (folder / "index.html").is_file() and {path.name for path in folder.iterdir()} <= {
        "index.html",
        "episodes",
        "images",
    }


def _index(run: Run, lines: list[Line], common: Mapping[str, Any]) -> str:
    template = environment().get_template("index.html.j2")
    return template.render(**common, lines=lines, groups=list(dict.fromkeys(line.group for line in lines)))


def _render_episode(story: Story, maps: Mapping[str, Picture], values: Mapping[str, Any]) -> str:
    template = environment().get_template("episode_page.html.j2")
    return template.render(**values, story=story, maps=maps)


def _collect_common(run: Run) -> dict[str, Any]:
    task = run.store.config["task"]
    return {
        "title": make_title(run),
        "arms": run.arms,
        "colors": arm_colors(run.arms),
        "radius": task.get("radius"),
        "place": place,
        "whole": PictureFolder.whole,
        "words": read_wording(run.store),
        "choices": task.get("categories", ()),
        "judge": run.store.judge,
        "judged": "judge" in task,
    }


def _list_lines(run: Run, outcomes: Mapping[int, Mapping[str, Any]]) -> list[Line]:
    pictures = set(run.store.info["pictures"])
    words, choices = read_wording(run.store), run.store.config["task"].get("categories", ())
    return [
        Line(
            index,
            episode,
            name_place(episode),
            tuple(_make_cell(arm, outcomes.get(index, {}).get(arm), words, choices) for arm in run.arms),
            index in pictures,
        )
        for index, episode in enumerate(run.store.episodes())
    ]


def _make_cell(arm: str, outcome: Mapping[str, Any] | None, words: Wording, choices: Sequence[str]) -> Cell:
    if outcome is None:
        return Cell(arm, "open", "to run", "not run yet")
    if outcome["status"] == "error":
        return Cell(arm, "error", "error", "infrastructure error, excluded from scores")
    verdict = read_verdict(outcome["details"])
    if verdict is not None:
        state = "success" if is_success(outcome["metrics"]) else "failure"
        return Cell(arm, state, verdict.answer or "no answer", f"{verdict.text}; its answer")
    return _make_number_cell(arm, outcome["metrics"], words, choices)


def _make_number_cell(arm: str, metrics: Mapping[str, Any], words: Wording, choices: Sequence[str]) -> Cell:
    count = f"{metrics['decisions']:.0f}" if "decisions" in metrics else ""
    if is_success(metrics):
        return Cell(arm, "success", count, f"{words.won}; number of decisions")
    if choices:
        return Cell(arm, "failure", final_answer(metrics, choices) or "no answer", f"{words.lost}; its answer")
    if "distance_to_goal" in metrics:
        return Cell(arm, "failure", f"{metrics['distance_to_goal']:.1f} m", f"{words.lost}; distance to the goal", True)
    return Cell(arm, "failure", count, f"{words.lost}; number of decisions")
