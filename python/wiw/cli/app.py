# SPDX-License-Identifier: Apache-2.0
"""Dispatch the command line to a command, and turn errors into one clean message and an exit code."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
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
from wiw.cli.flag_help import join_lines, read_flags
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
from wiw.errors import Error

DESCRIPTION = """Does a world model help an agent succeed, and by how much?

An agent uses a world model to imagine the outcome of each candidate plan, picks one plan and acts. `wiw run` does this
on a task, for one world model or several on the same episodes, and measures how much each raises task success.

  $ wiw demo                                              five world models side by side, in some minutes
  $ wiw list                                              world models, policies, tasks, metrics, presets
  $ wiw run imagenav --world-model warp --episodes 50     one world model
  $ wiw check-model my_model.py:MyModel                   is your own model ready to run?
  $ wiw run imagenav --world-model my_model.py:MyModel --arms none,copy,oracle
                                                          your own, beside floor and ceiling
  $ wiw report runs/NAME                                  table and HTML report of a run
  $ wiw compare runs/NAME runs/OTHER                      is the difference more than chance?

`wiw COMMAND --help` explains each command with examples. `--debug` shows the whole traceback of an error.

Exit codes: 0 done, 1 the run is invalid (verify: something differs; judge: marks are missing), 2 error, 130 stopped by
Ctrl-C, 75 stopped by SIGTERM or SIGUSR2, within 6 seconds. A stopped run keeps everything recorded; `wiw resume`
continues it."""

COMMANDS: tuple[tuple[Callable[..., int], str, str], ...] = (
    (demo, "demo", "Watch it work: a few arms on a handful of episodes, a table and a report."),
    (list_names, "list", "List world models, policies, trackers, tasks, presets and metrics."),
    (run, "run", "Run an agent on a task, with one world model or several."),
    (resume, "resume", "Resume a run that was stopped."),
    (status, "status", "Show how far runs are, while they are being run or after."),
    (submit, "submit", "Run an agent in shards, as an array of SLURM jobs."),
    (cancel, "cancel", "Cancel the jobs of a run."),
    (merge, "merge", "Merge the shards of a run, run on several machines, into one run."),
    (blame, "blame", "Find the stage that causes a run's failures."),
    (judge, "judge", "Judge the stored answers of a run again, by rules or a language model."),
    (compare, "compare", "Compare two runs on the same episodes."),
    (power, "power", "Compute how many episodes a run needs to show a difference."),
    (quality, "quality", "Visual quality and controllability of imagined frames, against success."),
    (scale, "scale", "Success against the number of imagined futures."),
    (report, "report", "Print the tables of a run and write its HTML report."),
    (export, "export", "Export a run as CSV or Parquet tables, or as a Rerun recording."),
    (verify, "verify", "Rerun some episodes of a run and compare them with the record."),
    (view, "view", "Write HTML pages to browse a run, decision by decision."),
    (check_model, "check-model", "Check a world model against its contract."),
    (serve, "serve", "Serve a world model to other processes or machines."),
    (doctor, "doctor", "Check this machine, with a remedy for what is missing."),
    (serve_vlm, "serve-vlm", "Serve a small vision-language model on this machine, for tests."),
    (episodes, "episodes", "Write episodes to a file, so that anyone can run them."),
)


@dataclass(frozen=True)
class Group:
    """Commands of two words."""

    line: str
    """Summary shown in the list of commands."""
    description: str
    commands: tuple[tuple[Callable[..., int], str, str], ...]
    default: str | None = None
    """The second word where none is given."""
    default_takes_words: bool = False
    """Whether that is also where the second word is no command, but a word of the default command."""
    needs_words: bool = False
    """Whether the default command cannot be run without words, so that none at all asks for help."""


GROUPS: Mapping[str, Group] = {
    "scenes": Group(
        "Draw scenes and print their sizes, or check the scans of a dataset.",
        """Draw scenes and print their sizes, or check the scans of a dataset.

  $ wiw scenes apartments:val:4
  $ wiw scenes house.glb --out house.png
  $ wiw scenes verify hm3d:scene_datasets/hm3d:val""",
        (
            (draw_scenes, "draw", "Print sizes of scenes and draw a contact sheet; what `wiw scenes SPEC` does."),
            (verify_scans, "verify", "Open every scan of a dataset, and print what is wrong."),
        ),
        default="draw",
        default_takes_words=True,
    ),
    "collect": Group(
        "Collect data: navigation in scenes, demonstrations of manipulation tasks, or decisions.",
        """Collect data for training, and decisions to validate on. Repeat an interrupted command to resume it.

  $ wiw collect navigation --scenes apartments:train:80 --out data --workers 4
  $ wiw collect manipulation --out demos --workers 4
  $ wiw collect decisions --scenes apartments:val:20 --out decisions.parquet

`wiw collect WHAT --help` explains each with examples.""",
        (
            (collect_navigation, "navigation", "Panoramas with depth, poses and actions along paths through scenes."),
            (collect_manipulation, "manipulation", "Demonstrations of manipulation tasks by scripted experts."),
            (collect_decisions, "decisions", "Decisions between plans, with what each would truly lead to."),
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
        "Check, summarise or draw a navigation dataset; convert collected data to LeRobot's format and back.",
        """Check, summarise or draw a dataset of `wiw collect navigation`; convert what `wiw collect` has collected.

  $ wiw data verify data
  $ wiw data stats data
  $ wiw data show data --out data.png
  $ wiw data export data --format lerobot --out data-lerobot""",
        (
            (verify_data, "verify", "Check every file, frame and split."),
            (stats_data, "stats", "Print frames, actions, lengths, coverage and sizes."),
            (show_data, "show", "Draw maps of what is covered, and a contact sheet of clips."),
            (export_data, "export", "Write navigation or manipulation data as a LeRobot dataset, format v3.0."),
            (import_data, "import", "Write the collection that a LeRobot dataset was exported from."),
        ),
    ),
    "bench": Group(
        "Measure this machine's GPU: rendering, small networks, memory.",
        """Measure what this machine does for wiw.

  $ wiw bench gpu --out gpu.json""",
        ((bench_gpu, "gpu", "Rendering in batches, rollout and training step of each small network, memory."),),
        default="gpu",
    ),
    "prompts": Group(
        "Import the prompts of your own copy of the paper.",
        """Import the prompts of your own copy of the paper for policy vlm. `wiw list prompts` lists the shipped sets.

  $ wiw prompts import paper/main.tex --out prompts/paper""",
        ((import_prompts, "import", "Write a folder of prompts from LaTeX source or published code."),),
    ),
    "study": Group(
        "Run many arms, or train many small models, to answer a question: a page with figures and tables.",
        """Answer a question by many runs or trainings, with figures and tables on one page. Repeat an interrupted
command to resume it. `wiw list studies` names the shipped ones, and a YAML file is a study of your own:

  $ wiw study front-vs-panorama --small
  $ wiw study vlm --set server=http://localhost:8000/v1 --set model=qwen2.5-vl-72b-awq
  $ wiw study models --set arms=none,copy,warp,mine=my_model.py:MyModel,oracle
  $ wiw study errors --small --workers 2
  $ wiw study data-scaling --small --workers 2
  $ wiw study my.yaml --set episodes=100

my.yaml, in full:

  title: Does a longer horizon help?
  about: one line for the list of studies
  variables: {model: warp, episodes: 60}       # --set model=oracle
  small: {episodes: 4}                         # --small
  runs:
    far:                                       # a run: arms on the same episodes of one task
      task: imagenav
      task_options: {scenes: "apartments:val:12", tier: far}
      settings: {episodes: "{episodes}"}       # as of `wiw run`: seed, keep_images, fidelity, ...
      agent: {policy: matcher, model: "{model}"}   # what the arms share
      arms:                                    # or text as for `wiw run --arms`
        none: {model: none}
        short: {horizon: 5}
        long: {horizon: 10}
      compare: [[long, short]]                 # paired differences, besides those from none and copy
      plots: [success, rollouts]               # and quality, with options of `wiw quality` under `quality:`

Arms take policy, model, reviser, model_options, policy_options, tracker, candidates, horizon, depth, placebo and so
on, as `wiw.runs.recipes.AgentRecipe` has them. `wiw study WHAT --help` explains each command.""",
        (
            (run_study, "run", "A study by name or from a YAML file; `wiw study NAME` is short for it."),
            *STUDIES,
        ),
        default="run",
        default_takes_words=True,
        needs_words=True,
    ),
}

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
        print(f"wiw: {printable(error)}", *map(printable, getattr(error, "__notes__", ())), sep="\n", file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except Terminated:
        return EXIT_RESUME
    except BrokenPipeError:  # e.g. `wiw list | head -1`
        sys.stderr.close()
        return 0


def _dispatch(arguments: Sequence[str]) -> Any:
    name, *rest = arguments or ["--help"]
    if name in GROUPS:
        return _dispatch_group(name, rest)
    app = tyro.extras.SubcommandApp()
    named = any(name == known for _, known, _ in COMMANDS)
    for function, known, line in COMMANDS:
        app.command(name=known, help=None if named else line)(
            join_lines(function)
        )  # None: the function's own docstring
    for known, group in GROUPS.items():
        app.command(name=known, help=group.line)(_name_group)
    return _run_app(app, "wiw", DESCRIPTION, [name, *rest])


def _dispatch_group(name: str, arguments: Sequence[str]) -> Any:
    group = GROUPS[name]
    known = [each for _, each, _ in group.commands]
    given = list(arguments) or ([] if group.default_takes_words and not group.needs_words else ["--help"])
    first = next(iter(given), "")
    is_own = group.default_takes_words or first.startswith("-")
    if group.default and is_own and first not in (*known, "-h", "--help"):
        given = [group.default, *given]
    app = tyro.extras.SubcommandApp()
    for function, each, line in group.commands:
        app.command(name=each, help=None if given[0] in known else line)(join_lines(function))
    return _run_app(app, f"wiw {name}", group.description, given)


def _name_group() -> int:
    """Stand for a group in the list of commands."""
    raise AssertionError("commands of two words are dispatched before")


def _run_app(app: tyro.extras.SubcommandApp, prog: str, description: str, arguments: Sequence[str]) -> Any:
    config = (tyro.conf.OmitArgPrefixes, tyro.conf.HelptextFromCommentsOff)
    registry = make_registry()
    registry.struct_rule(read_flags)
    with registry:
        return app.cli(prog=prog, description=description, args=arguments, config=config)
