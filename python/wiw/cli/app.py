# SPDX-License-Identifier: Apache-2.0
"""Dispatch the command line to a command, and turn errors into one clean message and an exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NoReturn

import tyro

import wiw
from wiw import benchmark
from wiw.cli.bench import bench_gpu
from wiw.cli.blame import blame
from wiw.cli.check_model import check_model
from wiw.cli.collect_decisions import collect_decisions
from wiw.cli.collect_manipulation import collect_manipulation
from wiw.cli.collect_navigation import collect_navigation
from wiw.cli.compare import compare
from wiw.cli.data import export_data, import_data, show_data, stats_data, verify_data
from wiw.cli.demo import demo
from wiw.cli.doctor import doctor
from wiw.cli.episodes import episodes
from wiw.cli.export import export
from wiw.cli.flag_help import hide_defaults, join_lines, read_flags
from wiw.cli.judge import judge
from wiw.cli.merge import merge
from wiw.cli.names import list_names
from wiw.cli.numbers import make_registry
from wiw.cli.power import power
from wiw.cli.prompts import import_prompts
from wiw.cli.quality import quality
from wiw.cli.report import report
from wiw.cli.run import resume, run
from wiw.cli.scale import scale
from wiw.cli.scenes import draw_scenes, verify_scans
from wiw.cli.serve import serve
from wiw.cli.serve_vlm import serve_vlm
from wiw.cli.status import status
from wiw.cli.stop import EXIT_RESUME, Terminated, end_process, raise_on_stop_signals
from wiw.cli.study import STUDIES
from wiw.cli.study_file import run_study
from wiw.cli.submit import cancel, submit
from wiw.cli.terminal import printable
from wiw.cli.train.commands import TRAININGS
from wiw.cli.verify import verify
from wiw.cli.view import view
from wiw.errors import ArgumentError, Error
from wiw.suggestions import did_you_mean

DESCRIPTION = """Does a world model help an agent succeed, and by how much?

An agent uses a world model to imagine the outcome of each candidate plan, picks one plan and acts. `wiw run` does this
on a task, for one world model or several on the same episodes, and measures how much each raises task success.

  $ wiw demo                                              four tasks, two to five world models each, in minutes
  $ wiw list                                              world models, policies, tasks, metrics, presets
  $ wiw run imagenav --world-model warp --episodes 50     one world model
  $ wiw check-model my_model.py:MyModel                   does your own model work?
  $ wiw run imagenav --world-model my_model.py:MyModel --arms none,copy,oracle
                                                          your own, next to floor and ceiling
  $ wiw report runs/NAME                                  table and HTML report of a run
  $ wiw compare runs/NAME runs/OTHER                      is the difference more than chance?

`wiw COMMAND --help` explains each command with examples. `--debug` shows the full traceback of an error.

Exit codes: 0 success, 1 the run is invalid (verify: something differs; judge: marks are missing), 2 error, 130 stopped
by Ctrl-C, 75 stopped by SIGTERM or SIGUSR2 (within 6 seconds; with --scratch within 60). A stopped run keeps everything
recorded so far; `wiw resume` continues it."""

COMMANDS: tuple[tuple[Callable[..., int], str, str], ...] = (
    (demo, "demo", "See it work: several world models on a few episodes of each task, with tables and reports."),
    (list_names, "list", "List world models, policies, trackers, tasks, presets and metrics."),
    (run, "run", "Run an agent on a task, with one world model or several."),
    (resume, "resume", "Resume a run that was stopped."),
    (status, "status", "Show the progress of runs, finished or not."),
    (submit, "submit", "Run an agent in shards, as an array of SLURM jobs."),
    (cancel, "cancel", "Cancel the jobs of a run."),
    (merge, "merge", "Merge the shards of a run from several machines into one run."),
    (blame, "blame", "Find the stage that causes a run's failures."),
    (judge, "judge", "Judge the stored answers of a run again, with rules or a language model."),
    (compare, "compare", "Compare two runs on the same episodes."),
    (power, "power", "Compute how many episodes are needed to show a difference."),
    (quality, "quality", "Compare success with the visual quality and controllability of imagined frames."),
    (scale, "scale", "Measure success against the number of imagined futures."),
    (report, "report", "Print the tables of a run and write its HTML report."),
    (export, "export", "Export a run as CSV or Parquet tables, or as a Rerun recording."),
    (verify, "verify", "Rerun some episodes of a run and compare them with the record."),
    (view, "view", "Write HTML pages to browse a run, decision by decision."),
    (check_model, "check-model", "Check a world model against its contract."),
    (serve, "serve", "Serve a world model to other processes or machines."),
    (doctor, "doctor", "Check this machine, and say how to fix what is missing."),
    (serve_vlm, "serve-vlm", "Serve a small vision-language model on this machine, for tests."),
    (episodes, "episodes", "Write episodes to a file that anyone can run."),
)


@dataclass(frozen=True)
class Group:
    """Commands of two words."""

    line: str
    """The summary shown in the list of commands."""
    description: str
    commands: tuple[tuple[Callable[..., int], str, str], ...]
    default: str | None = None
    """The second word if none is given."""
    default_takes_words: bool = False
    """Whether a second word that is not a command is taken as an argument of the default command."""
    needs_words: bool = False
    """Whether the default command needs arguments, so that without any the help is shown."""


GROUPS: Mapping[str, Group] = {
    "scenes": Group(
        "Draw scenes and print their sizes, or check the scans in a dataset.",
        """Draw scenes and print their sizes, or check the scans in a dataset.

  $ wiw scenes apartments:val:4
  $ wiw scenes house.glb --out house.png
  $ wiw scenes verify hm3d:scene_datasets/hm3d:val""",
        (
            (draw_scenes, "draw", "Print the sizes of scenes and draw a contact sheet; `wiw scenes SPEC` for short."),
            (verify_scans, "verify", "Open every scan in a dataset and print what is wrong."),
        ),
        default="draw",
        default_takes_words=True,
    ),
    "collect": Group(
        "Collect data: navigation through scenes, demonstrations of manipulation tasks, or decisions.",
        """Collect training data, and decisions for validation. To resume an interrupted command, repeat it.

  $ wiw collect navigation --scenes apartments:train:80 --out data --workers 4
  $ wiw collect manipulation --out demos --workers 4
  $ wiw collect decisions --scenes apartments:val:20 --out decisions.parquet

`wiw collect NAME --help` explains each with examples.""",
        (
            (collect_navigation, "navigation", "Panoramas with depth, poses and actions along paths through scenes."),
            (collect_manipulation, "manipulation", "Demonstrations of the manipulation tasks by scripted experts."),
            (collect_decisions, "decisions", "Decisions between plans, with the true outcome of each plan."),
        ),
        default="manipulation",
    ),
    "train": Group(
        "Train a network: recogniser, navigator, warpnet, pocket, perception, armnet, diffuser or a video model.",
        """Train a network: recogniser, navigator, warpnet, pocket, perception, armnet, diffuser or a video model.
All but video models train on a CPU, in minutes to hours. Repeat an interrupted command to resume it.

  $ wiw train warpnet --out warpnet.safetensors
  $ wiw train recogniser --scenes house.glb --val other.glb --out house.safetensors
  $ wiw train pocket --data data --out pocket.safetensors
  $ wiw train ltx-action --data data --out runs/ltx

`wiw train NAME --help` explains each with examples.""",
        TRAININGS,
    ),
    "data": Group(
        "Check, summarise or draw a navigation dataset; convert collected data to and from LeRobot's format.",
        """Check, summarise or draw a dataset of `wiw collect navigation`; convert data to and from LeRobot's format.

  $ wiw data verify data
  $ wiw data stats data
  $ wiw data show data --out data.png
  $ wiw data export data --format lerobot --out data-lerobot""",
        (
            (verify_data, "verify", "Check every file, frame and split."),
            (stats_data, "stats", "Print frames, actions, lengths, coverage and sizes."),
            (show_data, "show", "Draw maps of coverage and a contact sheet of clips."),
            (export_data, "export", "Convert navigation or manipulation data to a LeRobot dataset, format v3.0."),
            (import_data, "import", "Convert an exported LeRobot dataset back to the collection it came from."),
        ),
    ),
    "bench": Group(
        "Measure this machine's GPU: rendering, small networks, memory.",
        """Measure how fast this machine runs wiw.

  $ wiw bench gpu --out gpu.json""",
        ((bench_gpu, "gpu", "Batched rendering, rollouts and training steps of the small networks, memory."),),
        default="gpu",
    ),
    "prompts": Group(
        "Import the prompts from your own copy of the paper.",
        """Import prompts from your own copy of the paper for policy vlm; `wiw list prompts` lists the built-in sets.

  $ wiw prompts import paper/main.tex --out prompts/paper""",
        ((import_prompts, "import", "Write a folder of prompts from the LaTeX source or the published code."),),
    ),
    "study": Group(
        "Answer a research question with many runs or trainings; write a page with figures and tables.",
        """Answer a research question with many runs or trainings, and write a page with figures and tables. To resume
an interrupted study, repeat the command. `wiw list studies` lists the built-in ones; a YAML file defines your own:

  $ wiw study front-vs-panorama --small
  $ wiw study vlm --set server=http://localhost:8000/v1 --set model=qwen2.5-vl-72b-awq
  $ wiw study models --set arms=none,copy,warp,mine=my_model.py:MyModel,oracle
  $ wiw study errors --small --workers 2
  $ wiw study data-scaling --small --workers 2
  $ wiw study my.yaml --set episodes=100

A complete my.yaml:

  title: Does a longer horizon help?
  about: one line, shown in the list of studies
  variables: {model: warp, episodes: 60}       # --set model=oracle
  small: {episodes: 4}                         # --small
  runs:
    far:                                       # one run: arms on the same episodes of one task
      task: imagenav
      task_options: {scenes: "apartments:val:12", tier: far}
      settings: {episodes: "{episodes}"}       # as in `wiw run`: seed, keep_images, fidelity, ...
      agent: {policy: matcher, model: "{model}"}   # shared by all arms
      arms:                                    # or a string, as in `wiw run --arms`
        none: {model: none}
        short: {horizon: 5}
        long: {horizon: 10}
      compare: [[long, short]]                 # paired differences, in addition to those from none and copy
      plots: [success, rollouts]               # also quality, with the options of `wiw quality` under `quality:`

An arm accepts the fields of `wiw.runs.recipes.AgentRecipe`: policy, model, reviser, model_options, policy_options,
tracker, candidates, horizon, depth, placebo and so on. `wiw study NAME --help` explains each command.""",
        (
            (run_study, "run", "Run a study by name or from a YAML file; `wiw study NAME` for short."),
            *STUDIES,
        ),
        default="run",
        default_takes_words=True,
        needs_words=True,
    ),
}

CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.HelptextFromCommentsOff)

EXIT_CRASH, EXIT_ERROR, EXIT_INTERRUPTED = 1, 2, 130


def run_process() -> NoReturn:
    """Run the command that the process was started with, and end the process with its exit code."""
    try:
        code: Any = main()
    except SystemExit as stop:
        code = 0 if stop.code is None else stop.code
        if not isinstance(code, int):
            print(code, file=sys.stderr)
            code = EXIT_CRASH
    except KeyboardInterrupt:  # while the command was being closed
        code = EXIT_INTERRUPTED
    except Terminated:
        code = EXIT_RESUME
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = EXIT_CRASH
    end_process(code)


RENAMED_OPTIONS = {"--retry-failed": "--retry-errors"}
"""Old names of options, which still work but are not shown."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, 1 (the run is invalid), 2 (error), 75 or 130 (stopped)."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    given = [RENAMED_OPTIONS.get(argument, argument) for argument in given if argument != "--debug"]
    if given == ["--version"]:
        print(f"wiw {wiw.__version__}, benchmark {benchmark.VERSION}")
        return 0
    try:
        with raise_on_stop_signals():
            return _dispatch(given) or 0
    except Error as error:
        if debug:
            raise
        notes = map(printable, getattr(error, "__notes__", ()))
        with suppress(BrokenPipeError):  # whoever read it has gone, which is no other error
            print(f"wiw: {printable(error)}", *notes, sep="\n", file=sys.stderr, flush=True)
        return EXIT_ERROR
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except Terminated:
        return EXIT_RESUME
    except (BrokenPipeError, SystemExit) as error:  # e.g. `wiw list | head -1`, or Ctrl-C in `wiw run | tee log`
        if not any(isinstance(each, BrokenPipeError) for each in _list_contexts(error)):
            raise
        return _find_stop_code(error)
    finally:
        _leave_broken_streams()


def _find_stop_code(error: BaseException) -> int:
    """Return the exit code of the stop or error that was being told when a pipe broke; 0 if there was none."""
    codes = ((Terminated, EXIT_RESUME), (KeyboardInterrupt, EXIT_INTERRUPTED), (Error, EXIT_ERROR))
    return next((code for each in _list_contexts(error) for kind, code in codes if isinstance(each, kind)), 0)


def _list_contexts(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error, and those in whose handling it was raised."""
    while error is not None:
        yield error
        error = error.__context__


def _leave_broken_streams() -> None:
    """Let output go nowhere whose reader has gone: Python would complain about what is left at its shutdown."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        except ValueError:  # closed
            pass


def _dispatch(arguments: Sequence[str]) -> Any:
    name, *rest = arguments or ["--help"]
    if name in GROUPS:
        return _dispatch_group(name, rest)
    groups = [(_name_group, known, group.line) for known, group in GROUPS.items()]
    return _run_app([*COMMANDS, *groups], "wiw", DESCRIPTION, [name, *rest])


def _dispatch_group(name: str, arguments: Sequence[str]) -> Any:
    group = GROUPS[name]
    known = [each for _, each, _ in group.commands]
    given = list(arguments) or ([] if group.default_takes_words and not group.needs_words else ["--help"])
    first = next(iter(given), "")
    is_own = group.default_takes_words or first.startswith("-")
    if group.default and is_own and first not in (*known, "-h", "--help"):
        given = [group.default, *given]
    return _run_app(group.commands, f"wiw {name}", group.description, given)


def _name_group() -> int:
    """Stand for a group in the list of commands."""
    raise AssertionError("commands of two words are dispatched before")


def _run_app(
    commands: Sequence[tuple[Callable[..., int], str, str]], prog: str, description: str, arguments: Sequence[str]
) -> Any:
    """Run a command on its own, so that an error names the flags and the help of no other; or list all of them.

    Raises:
        ArgumentError: there is no such command.
    """
    name, *rest = arguments
    functions = {known: function for function, known, _ in commands}
    if name in functions:
        command = hide_defaults(join_lines(functions[name]))
        with _make_rules():
            return tyro.cli(command, prog=f"{prog} {name}", args=rest, config=CONFIG)
    if not name.startswith("-"):
        choices = ", ".join(functions)
        raise ArgumentError(f"no command '{prog} {name}'; expected one of {choices}.{did_you_mean(name, functions)}")
    app = tyro.extras.SubcommandApp()
    for function, known, line in commands:
        app.command(name=known, help=line)(join_lines(function))
    with _make_rules():
        return app.cli(prog=prog, description=description, args=arguments, config=CONFIG)


def _make_rules() -> tyro.constructors.ConstructorRegistry:
    registry = make_registry()
    registry.struct_rule(read_flags)
    return registry
