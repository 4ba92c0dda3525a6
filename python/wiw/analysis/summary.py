# SPDX-License-Identifier: Apache-2.0
"""The numbers of a run: one line per arm, and each arm against the arms without a (real) world model."""

from __future__ import annotations

import math
import sys
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

from wiw.analysis.breakdowns import (
    Breakdown,
    Cuts,
    compare_anytime_curves,
    cut_by_decisions,
    cut_by_primitives,
    find_twins,
    read_anytime_curve,
    score_twins,
    split_by_kind,
)
from wiw.analysis.flip_test import FEWEST_SCENES
from wiw.analysis.marks import BLIND, Marks, answer_blind, read_marks
from wiw.analysis.noise_floor import NoiseFloor, find_repeats, measure_noise
from wiw.analysis.statistics import LEVEL, Difference, Estimate, Units, adjust_p_values, compare, estimate_mean
from wiw.analysis.stopping import describe_bets, find_units
from wiw.analysis.utility import CEILING, FLOOR, Utility, utility
from wiw.errors import RegistryError, read_last_line
from wiw.metrics.metric import ANSWER_SCORE, SPL, SPL_RULE, Metric, name_column
from wiw.registry import METRICS
from wiw.runs.departures import Departure, read_departures
from wiw.runs.judges import JudgeRecord
from wiw.runs.recipes import RESEEDED
from wiw.runs.run import Records, Run
from wiw.scenes import strip_edits
from wiw.types import TableSpec

ROLES = {
    "none": "policy without a world model",
    "copy": "floor, predicts that nothing changes",
    "oracle": "reference, the true future",
}
"""Roles of the reference arms; any other arm is a world model under test, or a policy without one."""
PLACEBOS = {
    "placebo-shuffled": "control: same compute, futures of shuffled actions",
    "placebo-swapped": "control: same compute, futures of another episode",
    "placebo-blind": "control: same compute, the model is not told the plan",
}
"""Arms with the compute of a world model and uninformative imagination; ":" and a model's name may follow."""
REPEATS = {RESEEDED: "noise floor: the same arm with other random numbers"}
"""Arms that repeat another one of the run; ":" and a model's name follow."""
ERROR = "error-"
"""Beginning of the names of arms whose futures have an error of a known dose."""
ERRONEOUS = "control: futures with an error of a known dose"
GAINS = {
    "none": "Gain over the policy without a world model",
    "copy": "Gain over the floor, which predicts that nothing changes",
}
"""Meaning of a difference from each of these arms."""
BLIND_ROLE = "floor, best guess from the question's text alone"
WORLD_MODEL, ANOTHER_POLICY = "world model", "another policy without a world model"

UTILITY_COLUMNS = ("utility", "utility_low", "utility_high")
OWN_COLUMNS = frozenset({"arm", "tier", "role", "n", "asked", "errors", *UTILITY_COLUMNS, "judge", "approximate_marks"})
"""Columns of the exported table of arms that are no metrics."""

MAX_ERROR_SHARE = 0.01
"""Largest share of an arm's ended episodes that may have ended with an infrastructure error in a valid run."""
LONGEST_CAUSE = 200
"""Characters of an error's message that notes show."""


@dataclass(frozen=True)
class ArmSummary:
    """One line of the table."""

    name: str
    role: str
    done: int
    """Episodes that ended without an error; only these are scored."""
    errors: int
    """Episodes that ended with an infrastructure error, excluded from scores."""
    pending: int
    """Episodes not run yet."""
    estimates: Mapping[str, Estimate]
    """Over the scored episodes, by metric: "success" and "spl" in percent, "actions" in primitives."""
    cause: str = ""
    """Most frequent message of the errors, with how many had it, e.g. "2 of 3: OSError: gone"; empty without errors."""

    @property
    def total(self) -> int:
        """Episodes of the run, scored or not."""
        return self.ended_count + self.pending

    @property
    def ended_count(self) -> int:
        """Episodes that have ended, scored or with an error."""
        return self.done + self.errors

    @property
    def scored_of_total(self) -> str:
        """E.g. "20", or "18/20" where only 18 of 20 episodes are scored."""
        return str(self.done) if self.done == self.total else f"{self.done}/{self.total}"


@dataclass(frozen=True)
class Group:
    """One table of differences."""

    title: str
    heading: str
    """Meaning of the differences, for the report."""
    corner: str
    """Label of the corner cell: which minus which."""
    rows: Mapping[str, Mapping[str, Difference]]
    """By label of the row, then by metric."""


TRACKED = {
    "frames": "their pixels",
    "poses": "the requested poses, regardless of what the frames show",
}
"""Words for each thing that a tracker follows."""


@dataclass(frozen=True)
class Summary:
    """The numbers of a run, as `RunLog.summary()` shows them."""

    arms: tuple[ArmSummary, ...]
    differences: tuple[Difference, ...]
    """Each arm minus "none" and minus "copy", on the episodes scored in both."""
    same_episodes: bool
    """Whether all arms are scored on the same episodes, so that their lines can be compared as they stand."""
    utilities: tuple[Utility, ...] = ()
    """Where each arm stands between "copy" and "oracle", if the run has both."""
    breakdowns: tuple[Breakdown, ...] = ()
    """Further tables: by kind of episode, the anytime curve, twins, where the task has these."""
    baselines: tuple[ArmSummary, ...] = ()
    """Lines beside the arms that no agent was run for: answers from the question's text alone."""
    marks: Marks | None = None
    """Whose marks scores rest on, where answers are judged."""

    unbalanced: int = field(default=0, kw_only=True)
    """Episodes whose question is asked in one scene only, so that its text may give the answer away."""
    trackers: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    """Trackers of targets in imagined frames by name, each with "frames" or "poses", whichever it followed."""
    answers: Mapping[str, Mapping[str, int]] = field(default_factory=dict, kw_only=True)
    """Answers of a language model by arm and by the kind of problem for which they could not be used ("": none)."""
    choices: Mapping[str, tuple[int, int]] = field(default_factory=dict, kw_only=True)
    """Choices of a language model by arm: how many are doubtful (`wiw.vlm.messages.Reply.doubtful`), and how many."""
    looks: str = field(default="", kw_only=True)
    """Sentences on the rule by which the run was to stop early, and on whether it did; empty without one."""
    bets: str = field(default="", kw_only=True)
    """The test behind the p values of a run with such a rule, in words; empty without one."""
    noise: tuple[NoiseFloor, ...] = field(default=(), kw_only=True)
    """How much each arm that repeats another differs from that one."""
    part: str = field(default="", kw_only=True)
    """Sentence on the part of a run that a shard is; empty for a whole run."""
    departures: tuple[Departure, ...] = field(default=(), kw_only=True)
    """Where the run departs from the paper's protocol."""
    tiers: Mapping[str, Summary] = field(default_factory=dict, kw_only=True)
    """The same numbers for each tier of episodes separately, where the run has several."""

    @property
    def protocol(self) -> str:
        """Sentence on the departures from the paper's protocol; empty without any."""
        shown = "; ".join(departure.short for departure in self.departures)
        return f"not the paper's protocol: {shown}" if shown else ""

    @property
    def lines(self) -> tuple[ArmSummary, ...]:
        """All lines of the table: arms, then baselines."""
        return (*self.arms, *self.baselines)

    @property
    def kinds(self) -> dict[str, dict[str, Estimate]]:
        """Estimates of the first metric that is shown by kind of episode: by kind, then by arm."""
        return next((each.rows for each in self.breakdowns if each.name == "kinds"), {})

    def groups(self) -> tuple[Group, ...]:
        """Return the differences as tables, one per base."""
        bases = dict.fromkeys(difference.base for difference in self.differences)
        return tuple(
            Group(f"Difference from {base}, paired by episode", GAINS[base], f"Arm minus {base}", self._rows(base))
            for base in bases
        )

    def _rows(self, base: str) -> dict[str, dict[str, Difference]]:
        rows: dict[str, dict[str, Difference]] = {}
        for difference in self.differences:
            if difference.base == base:
                rows.setdefault(difference.arm, {})[difference.metric] = difference
        return rows

    def remarks(self) -> tuple[str, ...]:
        """Return further sentences that a reader of the tables needs."""
        found = [
            f"Tracker {name} located the target in imagined frames by {TRACKED[follows]}."
            for name, follows in self.trackers.items()
            if follows in TRACKED
        ]
        found += [_describe_unusable(arm, kinds) for arm, kinds in self.answers.items() if any(kinds)]
        found += [_describe_doubtful(arm, *counts) for arm, counts in self.choices.items() if counts[0]]
        if self.unbalanced:
            found.append(
                f"Unbalanced questions in {self.unbalanced} of the episodes: each is asked in one scene only, so its "
                "text may give its answer away. Scores cannot be compared with those of balanced questions."
            )
        return tuple(found)

    def utility(self, arm: str) -> Utility:
        """Return an arm's utility: its share of the gain from floor to ceiling."""
        for found in self.utilities:
            if found.arm == arm:
                return found
        raise KeyError(
            f"no utility of '{arm}' in this run: it needs episodes that are scored in the arm, copy and oracle"
        )

    @property
    def invalid(self) -> tuple[str, ...]:
        """Reasons why the run must not be reported, a sentence per arm; empty for a valid run."""
        return tuple(
            f"{line.errors} of {line.ended_count} episodes of {line.name} ended with an infrastructure error "
            f"({100 * line.errors / line.ended_count:.1f} %, more than {100 * MAX_ERROR_SHARE:g} %)."
            for line in self.arms
            if line.errors > MAX_ERROR_SHARE * line.ended_count
        )

    def __getitem__(self, arm: str) -> ArmSummary:
        """Return the line of an arm."""
        for line in self.arms:
            if line.name == arm:
                return line
        raise KeyError(f"no arm '{arm}' in this run; it has {', '.join(line.name for line in self.arms)}")

    def difference(self, arm: str, base: str, metric: str = "success") -> Difference:
        """Return one paired difference."""
        for difference in self.differences:
            if (difference.arm, difference.base, difference.metric) == (arm, base, metric):
                return difference
        raise KeyError(f"no difference of {metric} between '{arm}' and '{base}' in this run")


def summarise(
    arms: Sequence[str],
    outcomes: Sequence[Mapping[str, Any]],
    episodes: int,
    seed: int = 0,
    agents: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    tables: TableSpec = TableSpec(),  # noqa: B008 - frozen
    twins: Sequence[tuple[int, int]] = (),
    judge: JudgeRecord | None = None,
    pairs: Sequence[tuple[str, str]] | None = None,
    units: Units | None = None,
) -> Summary:
    """Return the numbers of a run.

    Args:
        arms: names in the order of the table.
        outcomes: ended episodes with "arm", "episode", "scene", "status", "metrics", and "task" where there are kinds.
        episodes: how many the run has.
        seed: of the bootstrap.
        agents: descriptions of the arms' agents, from which follow their roles; without them, roles are by names.
        tables: what the task has tables show.
        twins: pairs of episodes that are twins.
        judge: whose marks the outcomes have, where answers are judged.
        pairs: arms whose anytime curves are compared, each with its base; None for each arm with "none" and "copy".
        units: of a run that was looked at before it was stopped, so that p must allow for that
            (`wiw.analysis.stopping.find_units`).
    """
    done, errors = split_outcomes(arms, outcomes)
    roles = {arm: role_of(arm, None if agents is None else agents[arm]) for arm in arms}
    lines = tuple(
        replace(
            _summarise_arm(arm, roles[arm], done[arm], errors[arm], episodes, seed), cause=find_cause(arm, outcomes)
        )
        for arm in arms
    )
    differences = tuple(
        difference
        for base in ("none", FLOOR)
        if base in arms
        for difference in _compare_with(base, arms, done, seed, units)
    )
    same = len({frozenset(ended) for ended in done.values()}) == 1
    blind = answer_blind(done, tables.cuts) if BLIND not in done else {}
    baselines = (_summarise_arm(BLIND, BLIND_ROLE, blind, 0, len(blind), seed),) if blind else ()
    marks = read_marks(judge, outcomes, arms, tables)
    beside = {**done, BLIND: blind} if blind else done
    if pairs is None:
        pairs = [(arm, base) for base in ("none", FLOOR) if base in arms for arm in arms if arm not in (base, "none")]
    breakdowns = _break_down(beside, pairs, tables, twins, marks, seed, units)
    return Summary(lines, differences, same, _list_utilities(lines, done), breakdowns, baselines, marks)


def summarise_run(run: Run) -> Summary:
    """Return means, intervals and paired differences of a run."""
    config = run.store.config
    agents = {arm["name"]: arm["agent"] for arm in config["arms"]}
    episodes, outcomes = run.store.episodes(), run.store.outcomes()
    units = find_units(episodes, outcomes, run.arms) if "until" in run.store.info else None
    found = summarise(
        run.arms,
        outcomes,
        len(run.store.own_episodes()),
        config["seed"],
        agents,
        tables=run.tables,
        twins=find_twins(episodes),
        judge=run.store.judge,
        units=units,
    )
    tiers = _summarise_tiers(run, outcomes, agents, units)
    answers, choices = run.store.count_answers(), run.store.count_choices()
    return replace(
        found,
        unbalanced=count_unbalanced(run),
        trackers=_list_trackers(run),
        answers={arm: answers[arm] for arm in run.arms if arm in answers},
        choices={arm: choices[arm] for arm in run.arms if arm in choices},
        departures=read_departures(run.store.info),
        looks=_describe_looks(run),
        bets="" if units is None else describe_bets(episodes, units),
        noise=_measure_noise(run, outcomes),
        tiers=tiers,
        part=_describe_shard(run),
    )


def _describe_shard(run: Run) -> str:
    """Return which part of a run a shard is; empty for a whole run."""
    if run.store.shard is None:
        return ""
    own, whole = len(run.store.own_episodes()), len(run.store.episodes())
    return f"Shard {run.store.shard}: {own} of the run's {whole} episodes; `wiw merge` joins all shards."


def _measure_noise(run: Run, outcomes: Sequence[Mapping[str, Any]]) -> tuple[NoiseFloor, ...]:
    """Return how much arms differ from themselves; few runs have such arms, and only theirs are scored once more."""
    repeats = list(find_repeats({arm["name"]: dict(arm["agent"]) for arm in run.store.config["arms"]}))
    return measure_noise(repeats, split_outcomes(run.arms, outcomes)[0], run.store.config["seed"]) if repeats else ()


def _describe_noise(noise: NoiseFloor) -> str:
    """Return how much an arm differs from itself, in a sentence or two."""
    found, said = noise.difference, f"Noise floor: {noise.change} {noise.difference.base}"
    differing = found.wins + found.losses
    if not differing:
        return f"{said} has the same outcome in all {found.estimate.n} episodes. This makes no difference here."
    return (
        f"{said} differs from itself in {differing} of {found.estimate.n} episodes ({found.wins} won, {found.losses} "
        f"lost), SR by {show_estimate(found.estimate, signed=True)} points. A difference between arms that is no "
        "larger may be due to this alone."
    )


def _describe_unusable(arm: str, kinds: Mapping[str, int]) -> str:
    """Return how many answers of a language model could not be used, and why."""
    problems = {kind: count for kind, count in kinds.items() if kind}
    unusable, asked = sum(problems.values()), sum(kinds.values())
    reasons = ", ".join(f"{kind} {count}" for kind, count in sorted(problems.items(), key=lambda each: -each[1]))
    return (
        f"{arm}: {unusable} of {asked} answers of its language model ({100 * unusable / asked:.0f} %) could not be "
        f"used ({reasons}). Fallbacks, such as a randomly drawn primitive, were used instead and are scored."
    )


def _describe_doubtful(arm: str, doubtful: int, count: int) -> str:
    """Return how many choices rest on less than half of the model's probability."""
    return (
        f"{arm}: in {doubtful} of {count} choices of its language model ({100 * doubtful / count:.0f} %), most of the "
        "probability went to something other than the choices, so these say little about what it prefers."
    )


def describe_stop(run: Run) -> str:
    """Return whether a run with a rule for stopping early has stopped, as a predicate."""
    if "stopped" in (info := run.store.info):
        return f"stopped at {info['stopped']['why']}"
    return "was never stopped, as the rule held at no look" if run.complete else "has not been stopped so far"


def _describe_looks(run: Run) -> str:
    """Return the rule by which a run was to stop early, and whether it did."""
    info = run.store.info
    if "until" not in info:
        return ""
    rule = f"The run was checked every {info['until']['every']} episodes, to stop once {info['until']['rule']}."
    return (
        f"{rule} It {describe_stop(run)}. That interval is from a confidence sequence, and p from a betting test: both "
        "are valid at any time. The intervals in the tables are for a number of episodes that is fixed in advance."
    )


def _summarise_tiers(
    run: Run, outcomes: Sequence[Mapping[str, Any]], agents: Mapping[str, Mapping[str, Any]], units: Units | None
) -> dict[str, Summary]:
    """Return the numbers of each tier of episodes; nothing if there is one tier, or none."""
    episodes = run.store.episodes()
    own = run.store.own_episodes()
    tiers = dict.fromkeys(episodes[index].tier for index in own)
    indices = {tier: {index for index in own if episodes[index].tier == tier} for tier in tiers}
    return {
        tier: summarise(
            run.arms,
            [outcome for outcome in outcomes if outcome["episode"] in indices[tier]],
            len(indices[tier]),
            run.store.config["seed"],
            agents,
            tables=run.tables,
            units=units,
        )
        for tier in (tiers if len(tiers) > 1 else ())
    }


def _list_trackers(run: Run) -> dict[str, str]:
    """Return the trackers of the arms that imagine, and what each follows."""
    built = run.store.info.get("built", {})
    revisers = [built[arm].get("revision") for arm in run.arms if arm in built and built[arm].get("model")]
    trackers = [reviser.get("tracker") for reviser in revisers if isinstance(reviser, Mapping)]
    known = [own for own in trackers if isinstance(own, Mapping) and {"name", "follows"} <= own.keys()]
    return {str(own["name"]): str(own["follows"]) for own in known}


def count_unbalanced(run: Run) -> int:
    """Return the episodes whose question is asked in one scene only."""
    return sum(bool(episode.info.get("unbalanced")) for episode in run.store.episodes())


def arm_table(run: Run) -> Records:
    """Return the table of arms as plain values, a dict per arm; see `list_arm_lines`."""
    return Records(list_arm_lines(summarise_run(run)))


def list_tier_lines(summary: Summary) -> list[dict[str, Any]]:
    """Return the lines of each tier of episodes, with its name as "tier"; none unless there are several."""
    return [{"tier": tier, **line} for tier, own in summary.tiers.items() for line in list_arm_lines(own)]


def list_arm_lines(summary: Summary) -> list[dict[str, Any]]:
    """Return the lines of a summary as plain values, with `<metric>`, `<metric>_low` and `<metric>_high`.

    "utility" and its ends are there for arms between floor and ceiling, nan where undefined.
    """
    utilities = {found.arm: found for found in summary.utilities}
    lines = []
    for arm in summary.lines:
        line: dict[str, Any] = {"arm": arm.name, "role": arm.role}
        line |= {"n": arm.done, "asked": arm.total, "errors": arm.errors}
        for metric, estimate in arm.estimates.items():
            name = name_column(metric, OWN_COLUMNS)
            line |= {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}
        if found := utilities.get(arm.name):
            line |= dict(zip(UTILITY_COLUMNS, (found.value, found.low, found.high), strict=True))
        if summary.marks is not None:
            line |= {
                "judge": summary.marks.judge.full_label,
                "approximate_marks": summary.marks.approximate.get(arm.name, 0),
            }
        lines.append(line)
    return lines


def split_outcomes(
    arms: Sequence[str], outcomes: Sequence[Mapping[str, Any]]
) -> tuple[dict[str, dict[int, Mapping[str, Any]]], dict[str, int]]:
    """Return by arm the scored episodes, by index and with all metrics, and the number of errors.

    What a task has measured as no finite number is NaN, as are then its mean and differences.
    An edited copy of an apartment counts as the same scene: intervals are over apartments.
    """
    known = load_metrics()
    done: dict[str, dict[int, Mapping[str, Any]]] = {arm: {} for arm in arms}
    errors = dict.fromkeys(arms, 0)
    for outcome in outcomes:
        if outcome["status"] == "done":
            metrics: Mapping[str, float] = {
                name: math.nan if value is None else value for name, value in outcome["metrics"].items()
            }
            for metric in known:
                metrics = metric.add_to(metrics)
            scene = strip_edits(outcome["scene"])
            done[outcome["arm"]][outcome["episode"]] = {**outcome, "scene": scene, "metrics": metrics}
        else:
            errors[outcome["arm"]] += 1
    return done, errors


def find_cause(arm: str, outcomes: Sequence[Mapping[str, Any]]) -> str:
    """Return the most frequent last line of an arm's errors, the first of several, and how many errors have it."""
    errors = [row.get("error", "") for row in outcomes if row["arm"] == arm and row["status"] == "error"]
    messages = [read_last_line(error) or "no message" for error in errors]
    if not messages:
        return ""
    message, count = Counter(messages).most_common(1)[0]
    short = message if len(message) <= LONGEST_CAUSE else f"{message[: LONGEST_CAUSE - 1]}…"
    shown = "".join(sign if sign.isprintable() else "�" for sign in short)
    return f"{count} of {len(messages)}: {shown}"


def role_of(arm: str, agent: Mapping[str, Any] | None = None) -> str:
    """Return the role of an arm: by the description of its agent, or by its name where that is not known."""
    if arm in ROLES:
        return ROLES[arm]
    return _read_role(arm) if agent is None else _describe_role(agent)


def _describe_role(agent: Mapping[str, Any]) -> str:
    if "error" in agent:
        return ERRONEOUS
    if "placebo" in agent:
        return PLACEBOS[f"placebo-{agent['placebo']}"]
    if "reseed" in agent:
        return REPEATS[RESEEDED]
    return ANOTHER_POLICY if agent.get("model") is None else WORLD_MODEL


def _read_role(arm: str) -> str:
    kind = arm.rpartition("+")[2].partition(":")[0]
    if kind.startswith(ERROR):
        return ERRONEOUS
    special = {**PLACEBOS, **REPEATS}.get(RESEEDED if kind.startswith(f"{RESEEDED}-") else kind)
    return special or WORLD_MODEL


def _compare_with(
    base: str, arms: Sequence[str], done: Mapping[str, Mapping[int, Mapping[str, Any]]], seed: int, units: Units | None
) -> tuple[Difference, ...]:
    others = [arm for arm in arms if arm not in (base, "none")]
    found = [compare(arm, base, done, metric, seed, units) for arm in others for metric in select_metrics(done)]
    return adjust_p_values([difference for difference in found if difference is not None])


def _list_utilities(
    lines: Sequence[ArmSummary], done: Mapping[str, Mapping[int, Mapping[str, Any]]]
) -> tuple[Utility, ...]:
    if FLOOR not in done or CEILING not in done:
        return ()
    others = [line for line in lines if line.name not in (FLOOR, CEILING)]
    found = [utility(line.name, done, reference=not is_under_test(line.name, line.role)) for line in others]
    return tuple(one for one in found if one is not None)


def _break_down(
    done: Mapping[str, Mapping[int, Mapping[str, Any]]],
    pairs: Sequence[tuple[str, str]],
    tables: TableSpec,
    twins: Sequence[tuple[int, int]],
    marks: Marks | None,
    seed: int,
    units: Units | None,
) -> tuple[Breakdown, ...]:
    known = {metric.name: _label(metric, marks) for metric in load_metrics()}
    return (
        *split_by_kind(done, [known[name] for name in tables.kinds if name in known], tables.kind, seed),
        *_cut_episodes(done, pairs, tables, marks, seed, units),
        *score_twins(done, twins, seed),
    )


def _cut_episodes(
    done: Mapping[str, Mapping[int, Mapping[str, Any]]],
    pairs: Sequence[tuple[str, str]],
    tables: TableSpec,
    marks: Marks | None,
    seed: int,
    units: Units | None,
) -> tuple[Breakdown, ...]:
    """Return the anytime curve, over primitives where the task names cuts, else over decisions, and its differences."""
    if tables.cuts:
        cuts: Cuts | None = cut_by_primitives(tables.cuts, _label(ANSWER_SCORE, marks))
    else:
        done, cuts = cut_by_decisions(done)
    if cuts is None:
        return ()
    return (*read_anytime_curve(done, cuts, seed), *compare_anytime_curves(done, pairs, cuts, seed, units))


def _label(metric: Metric, marks: Marks | None) -> Metric:
    return metric if marks is None else marks.label(metric)


def is_under_test(arm: str, role: str) -> bool:
    """Return whether an arm is a world model under test with this run's policy; `warp` is a reference."""
    return role == WORLD_MODEL and arm != "warp" and "+" not in arm


def load_metrics() -> tuple[Metric, ...]:
    """Return all metrics: built-in ones, then registered ones and those of installed packages that can be loaded."""
    return _load_metrics_on(tuple(sys.path), tuple((name, id(thing)) for name, thing in METRICS.registered.items()))


@cache
def _load_metrics_on(path: tuple[str, ...], registered: tuple[tuple[str, int], ...]) -> tuple[Metric, ...]:
    """Load metrics once per state of `sys.path` and registry: the search for packages takes longer than a summary."""
    found = []
    for name in METRICS.names():
        try:
            found.append(METRICS.make(name))
        except RegistryError as error:  # a broken package must not hide the results of a run
            warnings.warn(str(error), RuntimeWarning, stacklevel=2)
    return tuple(found)


def select_metrics(done: Mapping[str, Mapping[int, Mapping[str, Any]]]) -> list[Metric]:
    """Return the metrics that every scored episode has a value for, or some where a metric is partial."""
    ended = [outcome["metrics"] for arm in done.values() for outcome in arm.values()]
    return [
        metric
        for metric in load_metrics()
        if ended and (any if metric.partial else all)(metric.name in metrics for metrics in ended)
    ]


def _summarise_arm(
    arm: str, role: str, done: Mapping[int, Mapping[str, Any]], errors: int, episodes: int, seed: int
) -> ArmSummary:
    estimates = {}
    for metric in select_metrics({arm: done}):
        own = [outcome for outcome in done.values() if metric.name in outcome["metrics"]]
        values, scenes = [outcome["metrics"][metric.name] for outcome in own], [outcome["scene"] for outcome in own]
        estimates[metric.name] = estimate_mean(values, scenes, metric, seed=seed)
    return ArmSummary(arm, role, len(done), errors, episodes - len(done) - errors, estimates)


def notes(summary: Summary) -> list[str]:
    """Return sentences that a reader of the numbers needs."""
    found = [f"{line.name}: {line.role}." for line in summary.arms if line.name in ROLES and len(summary.arms) > 1]
    found = [" ".join(found)] if found else []
    if summary.invalid:
        found.insert(
            0,
            f"INVALID RUN, do not report: {' '.join(summary.invalid)} Fix the cause, then {_name_remedy(summary)}.",
        )
    found += [_describe_missing(line) for line in summary.arms if line.done < line.total]
    found += [*_explain_intervals(summary), *_explain_differences(summary), *_explain_utility(summary)]
    found += _explain_unknown(summary)
    found += summary.marks.describe() if summary.marks is not None else []
    found += _explain_partial(summary)
    found += [SPL_RULE] if summary.marks is None and SPL.name in {each.name for each in list_columns(summary)} else []
    found += [_explain_paper_name(metric) for metric in list_columns(summary) if metric.paper_name]
    found += [_describe_noise(one) for one in summary.noise]
    found += [text for text in (summary.looks, summary.part) if text]
    found += summary.remarks()
    widest = max(
        (line.estimates["success"] for line in summary.arms if "success" in line.estimates),
        key=lambda estimate: estimate.high - estimate.low,
        default=None,
    )
    shown = any(difference.is_shown for difference in summary.differences)
    if widest is not None and widest.high - widest.low > 30 and not shown:
        found.append(
            f"Too few episodes ({widest.n}) for conclusions: intervals of SR are up to "
            f"{widest.high - widest.low:.0f} points wide."
        )
    return found


def _name_remedy(summary: Summary) -> str:
    """Return the command that mends errors: judging again where marks are all that is missing."""
    errors = sum(line.errors for line in summary.arms)
    only_marks = summary.marks is not None and summary.marks.missing == errors
    return "`wiw judge` with the same judge" if only_marks else "`wiw resume --retry-errors`"


def _describe_missing(line: ArmSummary) -> str:
    """Return the range of the rate over all episodes: every missing one a failure, or every one a success."""
    text = f"{line.name}: {line.done} of {line.total} episodes are scored"
    if line.errors:
        count = "1 infrastructure error is" if line.errors == 1 else f"{line.errors} infrastructure errors are"
        text += f"; {count} excluded from scores"
    text += f"; {line.pending} still to run" if line.pending else ""
    text += f". Most frequent error, {line.cause}" if line.cause else ""
    if "success" not in line.estimates:
        return f"{text}."
    won = line.estimates["success"].value * line.done
    least, most = won / line.total, (won + 100 * (line.total - line.done)) / line.total
    return f"{text}. Over all {line.total}, SR would be between {least:.1f} and {most:.1f} %."


def _explain_intervals(summary: Summary) -> list[str]:
    found = {line.name: next(iter(line.estimates.values())) for line in summary.arms if line.estimates}
    if not found:
        return []
    widest = max(found.values(), key=lambda estimate: (estimate.scenes, estimate.n))
    fewer = [f"{name} over {each.scenes}" for name, each in found.items() if each.scenes != widest.scenes]
    return [*_explain_interval(widest), *([f"So far, intervals of {', '.join(fewer)}."] if fewer else [])]


def _explain_interval(first: Estimate) -> list[str]:
    if first.scenes == 1:
        return [f"95 % intervals over episodes of one scene ({first.method}); they do not generalise to other scenes."]
    if first.scenes == first.n:
        return [f"95 % intervals over {first.n} episodes, each in its own scene."]
    few = ""
    if first.effective_scenes < first.scenes / 2:
        few = (
            f" Their numbers of episodes are so unequal that they count as {first.effective_scenes:.1f}: run the same "
            "number in each (--per-scene)."
        )
    elif first.scenes < FEWEST_SCENES:
        few = " With so few scenes they are wide: add scenes rather than episodes per scene."
    return [f"95 % intervals over {first.scenes} scenes.{few}"]


def _explain_unknown(summary: Summary) -> list[str]:
    """Return why an interval is not known, where that is so."""
    estimates = [estimate for line in summary.arms for estimate in line.estimates.values()]
    estimates += [difference.estimate for difference in summary.differences]
    if any(math.isnan(estimate.value) for estimate in estimates):
        return ["nan [?]: unknown, as the task has measured no number in some episodes."]
    if not any(math.isnan(estimate.low) for estimate in estimates):
        return []
    return ["[?]: unknown, as lengths of one episode, or that are all 0, do not show how far apart lengths may lie."]


def _explain_differences(summary: Summary) -> list[str]:
    first = next((difference.estimate for difference in summary.differences), None)
    if first is None:
        return []
    what = "exact sign-flip test over scenes"
    if summary.bets:
        what = f"{summary.bets}, valid at any time; none for lengths"
    elif first.scenes == 1:
        what = "exact sign-flip test over episodes; it says nothing about other scenes"
    elif first.scenes < FEWEST_SCENES:
        what = "the interval's t test, as there are too few scenes for an exact one"
    return [
        f"p: {what}, Holm-adjusted over the arms in its table. Bold: adjusted p of at most {LEVEL:g} (SR's "
        "p values are adjusted on their own, those of the other columns together). Intervals are not adjusted."
    ]


def _explain_utility(summary: Summary) -> list[str]:
    if not summary.utilities:
        return []
    found = ["U = (SR - copy) / (oracle - copy), on the episodes scored in all three; Fieller's interval."]
    if any(not one.is_defined for one in summary.utilities):
        found.append(f"Utility undefined: {_explain_undefined(summary.utilities)}.")
    return found


def _explain_undefined(utilities: Sequence[Utility]) -> str:
    """Return why utilities are undefined, with the names of arms where not all have the same reason."""
    arms: dict[str, list[str]] = {}
    for one in utilities:
        if not one.is_defined:
            arms.setdefault(one.reason, []).append(one.arm)
    if len(arms) == 1:
        return next(iter(arms))
    return "; ".join(f"{reason} ({', '.join(names)})" for reason, names in arms.items())


def _explain_partial(summary: Summary) -> list[str]:
    """Return for which share of the scored episodes metrics are known that not all have."""
    found = []
    for metric in list_columns(summary):
        counts = [(line.estimates[metric.name].n, line.done) for line in summary.arms if metric.name in line.estimates]
        if any(known < done for known, done in counts):
            known, done = min(counts)
            found.append(f"{metric.label}: over the episodes for which it is known, at least {known} of {done}.")
    return found


def _explain_paper_name(metric: Metric) -> str:
    return f"{metric.label}: {metric.paper_name} in the paper."


def show_estimate(estimate: Estimate, signed: bool = False) -> str:
    """Return e.g. "46.3 [38.9, 54.0]", or "+21.3 [12.8, 29.9]" for a difference."""
    interval = "[?]" if math.isnan(estimate.low) else f"[{estimate.low:.1f}, {estimate.high:.1f}]"
    return f"{estimate.value:{'+.1f' if signed else '.1f'}} {interval}"


def show_utility(found: Utility) -> str:
    """Return e.g. "0.75 [0.58, 0.93]"."""
    return f"{found.value:.2f} [{found.low:.2f}, {found.high:.2f}]" if found.is_defined else "undefined"


def show_p(p_value: float | None) -> str:
    """Return e.g. "0.012", "<.001", or nothing."""
    if p_value is None:
        return ""
    return "<.001" if p_value < 0.001 else f"{p_value:.3f}"


def list_columns(summary: Summary) -> list[Metric]:
    """Return the metrics that the summary has numbers for."""
    present = {metric for line in summary.arms for metric in line.estimates}
    return [_label(metric, summary.marks) for metric in load_metrics() if metric.name in present]


def column_title(metric: Metric) -> str:
    """Return e.g. "SR % ↑"; the arrow points to the better side."""
    arrow = "↑" if metric.higher_is_better else "↓"
    return " ".join(part for part in (metric.label, metric.unit, arrow) if part)
