# SPDX-License-Identifier: Apache-2.0
"""A run as its user reads it: summary, table, episodes, decisions, report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from wiw.errors import ArgumentError
from wiw.evaluation.blame import blame
from wiw.evaluation.costs import costs
from wiw.evaluation.fidelity import fidelity
from wiw.evaluation.store import RunStore
from wiw.evaluation.summary import Summary, summarise


class Records(list[dict[str, Any]]):
    """A list of plain dicts that turns into a pandas DataFrame on request."""

    def to_pandas(self) -> Any:
        """The records as a DataFrame, nested metrics as columns.

        Raises:
            ArgumentError: pandas is not installed.
        """
        try:
            import pandas
        except ModuleNotFoundError:
            raise ArgumentError("to_pandas needs pandas, which is not installed: pip install pandas") from None
        return pandas.DataFrame([_flat(record) for record in self])


def _flat(record: dict[str, Any]) -> dict[str, Any]:
    metrics = record.get("metrics", {})
    return {**{name: value for name, value in record.items() if name != "metrics"}, **metrics}


class RunLog:
    """A run on disk, whether finished or not. Made by `wiw.evaluate` and `wiw.load_run`."""

    def __init__(self, store: RunStore) -> None:
        self.store = store

    @property
    def path(self) -> Path:
        """The run's folder."""
        return self.store.path.parent

    @property
    def arms(self) -> list[str]:
        """Names of the arms, in the order of the table."""
        return [arm["name"] for arm in self.store.config["arms"]]

    @property
    def episodes(self) -> Records:
        """Ended episodes of all arms: arm, episode, scene, status, metrics, seconds, error."""
        return Records(self.store.outcomes())

    @property
    def decisions(self) -> Records:
        """Decisions of all ended episodes: proposals, scores, choice, what was executed, truth before and after."""
        return Records(self.store.decisions())

    @property
    def complete(self) -> bool:
        """Whether every arm has ended every episode."""
        return not any(self.store.pending(arm) for arm in self.arms)

    @property
    def valid(self) -> bool:
        """Whether every arm has ended every episode and at most 1 % of them failed for infrastructure."""
        return self.complete and not self.numbers().invalid

    def numbers(self) -> Summary:
        """Means, intervals and paired differences, without printing."""
        config = self.store.config
        policies = [arm["name"] for arm in config["arms"] if arm["agent"].get("model") is None]
        return summarise(self.arms, self.store.outcomes(), len(self.store.episodes()), config["seed"], policies)

    def summary(self) -> Summary:
        """Prints the table of arms and the paired differences, and returns them as numbers."""
        numbers = self.numbers()
        if not in_notebook():
            from wiw.evaluation.tables import print_summary

            print_summary(numbers)
        return numbers

    def table(self) -> Records:
        """The table of arms as plain values: one dict an arm, with `<metric>`, `<metric>_low` and `<metric>_high`.

        "utility" and its ends are there for arms between floor and ceiling, nan where not identifiable.
        """
        numbers = self.numbers()
        utilities = {found.arm: found for found in numbers.utilities}
        lines = []
        for arm in numbers.arms:
            line: dict[str, Any] = {"arm": arm.name, "role": arm.role}
            line |= {"n": arm.done, "asked": arm.asked, "failed": arm.failed}
            for metric, estimate in arm.estimates.items():
                line |= {metric: estimate.value, f"{metric}_low": estimate.low, f"{metric}_high": estimate.high}
            if found := utilities.get(arm.name):
                line |= {"utility": found.value, "utility_low": found.low, "utility_high": found.high}
            lines.append(line)
        return Records(lines)

    def costs(self) -> Records:
        """What each arm cost: one dict an arm, totals and what a success took; see `wiw.evaluation.costs.Costs`."""
        return Records(line.as_dict() for line in costs(self))

    def fidelity(self) -> Records:
        """How true imagination was in each arm that was run with `fidelity=True`: one dict an arm.

        See `wiw.evaluation.fidelity.ArmFidelity`; each decision's own figures are in `decisions`, column "fidelity".
        """
        return Records(line.as_dict() for line in fidelity(self))

    def blame(self) -> Records:
        """Which stage each arm's failures are due to, as far as `wiw.attribute` has run them again: one dict an arm.

        See `wiw.evaluation.blame.ArmBlame`.
        """
        found = blame(self.store)
        return Records(line.as_dict() for line in found.arms) if found is not None else Records()

    def report(self, path: str | Path | None = None) -> Path:
        """Writes a self-contained HTML report and returns its path; default `report.html` in the run's folder."""
        from wiw.evaluation.report import write_report

        return write_report(self, Path(path) if path is not None else self.path / "report.html")

    def view(self, folder: str | Path | None = None) -> Path:
        """Writes pages to walk through all episodes and decisions; returns the one to open, `view/index.html`."""
        from wiw.evaluation.view import write_view

        return write_view(self, Path(folder) if folder is not None else self.path / "view").index

    def export(
        self, csv: str | Path | None = None, parquet: str | Path | None = None, rerun: str | Path | None = None
    ) -> list[Path]:
        """Writes tables into new folders, a recording for the Rerun viewer, or several of these; returns the files."""
        from wiw.evaluation.export import export

        return export(self, *(None if path is None else Path(path) for path in (csv, parquet, rerun)))

    def close(self) -> None:
        """Closes the run's file."""
        self.store.close()

    def __repr__(self) -> str:
        ended = {arm: sum(record["arm"] == arm for record in self.episodes) for arm in self.arms}
        return f"RunLog({str(self.path)!r}, ended: {ended} of {len(self.store.episodes())})"

    def _repr_html_(self) -> str:
        return self.numbers()._repr_html_()


def load_run(path: str | Path) -> RunLog:
    """A run from its folder, also while it is still running.

    Raises:
        StoreError: nothing there, damaged, or of another version.
    """
    return RunLog(RunStore.read(path))


def in_notebook() -> bool:
    """Whether the value of a cell is shown by itself, so that printing it would show it twice."""
    try:
        from IPython import get_ipython
    except ModuleNotFoundError:
        return False
    return type(get_ipython()).__name__ == "ZMQInteractiveShell"
