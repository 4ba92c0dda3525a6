# SPDX-License-Identifier: Apache-2.0
"""A run from a researcher's view: summary, table, costs, fidelity, blame, report."""

from __future__ import annotations

from pathlib import Path

from wiw.analysis.blame import read_blame
from wiw.analysis.costs import costs
from wiw.analysis.fidelity import fidelity
from wiw.analysis.summary import arm_table, summarise_run
from wiw.errors import Error
from wiw.report.tables import SummaryTable, print_summary
from wiw.runs.progress import in_notebook
from wiw.runs.run import Records, Run
from wiw.runs.store import RunStore


class RunLog(Run):
    """A run on disk, finished or not, as returned by `wiw.evaluate` and `wiw.load_run`."""

    @property
    def valid(self) -> bool:
        """Whether every arm has finished every episode, with at most 1 % infrastructure errors."""
        return self.complete and not self.numbers().invalid

    def numbers(self) -> SummaryTable:
        """Return means, intervals and paired differences, without printing."""
        return SummaryTable.of(summarise_run(self))

    def summary(self) -> SummaryTable:
        """Print the table of arms and the paired differences, and return them as numbers."""
        numbers = self.numbers()
        if not in_notebook():
            print_summary(numbers)
        return numbers

    def table(self) -> Records:
        """Return the table of arms as plain values; see `wiw.analysis.summary.arm_table`."""
        return arm_table(self)

    def costs(self) -> Records:
        """Return what each arm cost: one dict per arm, totals and per success; see `wiw.analysis.costs.Costs`."""
        return Records(line.as_dict() for line in costs(self))

    def breakdown(self, name: str) -> Records:
        """Return another table as plain values: one dict per estimate, with value, low, high and n.

        Args:
            name: "kinds" (by kind of episode), "anytime" (scores within N primitives or decisions),
                "anytime_differences" (paired), or "twins"; the result is empty if the task has no such table.
        """
        return Records(line for each in self.numbers().breakdowns if each.name == name for line in each.list_cells())

    def fidelity(self) -> Records:
        """Return how faithful imagination was in each arm run with `fidelity=True`: one dict per arm.

        See `wiw.analysis.fidelity.ArmFidelity`; each decision's own figures are in `decisions`, column "fidelity".
        """
        return Records(line.as_dict() for line in fidelity(self))

    def blame(self) -> Records:
        """Return the stages to blame for each arm's rerun failures: one dict per arm.

        See `wiw.analysis.blame.ArmBlame`.
        """
        found = read_blame(self.store)
        return Records(line.as_dict() for line in found.arms) if found is not None else Records()

    def report(
        self,
        path: str | Path | None = None,
        *,
        episodes: int | None = None,
        max_mb: float | None = None,
        remark: str = "",
    ) -> Path:
        """Write a self-contained HTML report and return its path.

        Args:
            path: file to write; by default `report.html` in the run's folder.
            episodes: number of episodes to show with images; by default all that kept them.
            max_mb: maximum file size in megabytes; images are shrunk, then episodes dropped, until it fits.
            remark: sentence that the page shows below the result.

        Raises:
            ArgumentError: a number out of range, or less than the tables and plots take.
            FileError: the file cannot be written; an older version is kept.
        """
        from wiw.report.page import write_report

        file = Path(path) if path is not None else self.path / "report.html"
        return write_report(self, file, episodes=episodes, max_mb=max_mb, remark=remark)

    def view(self, folder: str | Path | None = None) -> Path:
        """Write pages for browsing all episodes and decisions; return the one to open, `view/index.html`."""
        from wiw.report.site import write_view

        return write_view(self, Path(folder) if folder is not None else self.path / "view").index

    def export(
        self, csv: str | Path | None = None, parquet: str | Path | None = None, rerun: str | Path | None = None
    ) -> list[Path]:
        """Write tables into new folders, a recording for the Rerun viewer, or both; return the files."""
        from wiw.report.export import export

        return export(self, *(None if path is None else Path(path) for path in (csv, parquet, rerun)))

    def _repr_html_(self) -> str:
        return self.numbers()._repr_html_()


def load_run(path: str | Path, judge: str | None = None) -> RunLog:
    """Open a run by its folder, also while it is still running.

    Args:
        path: the run's folder.
        judge: name or digest of the judge whose marks are read (see `wiw.judge`); None for the run's own.

    Raises:
        StoreError: there is no run, or it is damaged or of another version.
        ArgumentError: no judge, or several judges, of that name.
    """
    store = RunStore.read(path)
    try:
        store.use_judge(judge)
    except Error:
        store.close()
        raise
    return RunLog(store)
