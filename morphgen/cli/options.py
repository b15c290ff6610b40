"""Options that several commands share, and functions that evaluate them."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from morphgen.cli.command import Option, flag, number, option, repeated
from morphgen.cli.progress import note, track
from morphgen.errors import BenchmarkError, FormatError, MorphgenError, TaskError, one_line
from morphgen.tasks.reach import GOAL_KINDS
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS

if TYPE_CHECKING:
    from morphgen.grammar.grammar_file import Grammar
    from morphgen.grammar.library import Library
    from morphgen.grammar.robot_source import RobotSource
    from morphgen.model.robot import Robot
    from morphgen.tasks.task import TaskConfig

T = TypeVar("T")

ROBOT_HELP = (
    "a bundle's folder, a URDF, xacro or MJCF, parts such as ur5-plane, or words of morphgen "
    "compose such as arm=ur5 ee=plane"
)
ROBOTS_HELP = f"{ROBOT_HELP}; a set of morphgen sample or a folder of bundles names all its robots"
ROBOT = option("words ROBOT", ROBOT_HELP, nargs="+")
ROBOTS = option("words ROBOT", ROBOTS_HELP, nargs="+")
JSON = flag("--json", "print JSON")
LIBRARY = repeated("--library DIR", "a folder of your own parts (also: MORPHGEN_LIBRARY)", Path)
ROOT = option(
    "--root DIR",
    "a folder that meshes, includes and YAML may come from, besides the description's own "
    "folder and package",
    Path,
)
MAX_LINKS = number(
    "--max-links",
    "number of links that tokens and observations are padded to (default: 23, or that of the "
    "largest robot)",
    least=2,
)
JOBS = number("--jobs", "number of processes", default=1)
SEED = number("--seed", "random seed", default=0, least=0)
OBSTACLES = flag("--obstacles", "one robot: among obstacles")
NO_PICTURE = flag("--no-picture", "do not draw preview.png")
LIBRARY_JSON = (LIBRARY, JSON)
JOBS_LIBRARY_JSON = (JOBS, *LIBRARY_JSON)
ROOT_LIBRARY_JSON = (ROOT, *LIBRARY_JSON)
BUNDLE_OUT = (
    option("--out DIR", "output folder", Path, default=Path("robots")),
    option("--name", "name of the robot and of its folder (default: from its parts or file)"),
    NO_PICTURE,
)
WORKERS = number("--workers", "number of processes of PyBullet, or of threads of MuJoCo", default=1)
DEVICE = option("--device", "device of the networks: cpu or cuda", default="cpu")
RAY = option(
    "--ray ADDRESS",
    "run on the Ray cluster at this address (without an address: on a local Ray)",
    nargs="?",
    const="",
)
TASK_NAMES = f"{', '.join(TASKS.builtin)}, or a task of an installed package"
TASK = option("task TASK", TASK_NAMES, choices=TASKS)


def sim_option(default: str = DEFAULT_SIMULATOR) -> Option:
    """Return the option ``--sim``; its value is None if it is not given."""
    names = f"{', '.join(SIMULATORS.builtin)}, or a simulator of an installed package"
    return option("--sim SIM", f"{names} (default: {default})", choices=SIMULATORS)


def goal_option(default: str = GOAL_KINDS[0]) -> Option:
    """Return the option ``--goal``, which ``with_goal`` evaluates; None if it is not given."""
    return option(
        "--goal",
        "reach: the goal's position, within 3 cm, or its pose, within 3 cm and 10 degrees "
        f"(default: {default})",
        choices=GOAL_KINDS,
    )


def with_goal(
    configs: Iterable[TaskConfig], goal: str | None, tasks: Iterable[str]
) -> tuple[TaskConfig, ...]:
    """Return configs of tasks with the goal of reach that ``--goal`` names; None keeps it."""
    from morphgen.tasks.reach.config import ReachConfig

    if goal is None:
        return tuple(configs)
    if ReachConfig.task not in (names := tuple(dict.fromkeys(tasks))):
        raise TaskError(
            f"--goal {goal} is for task {ReachConfig.task}; the tasks of the robots: "
            f"{' and '.join(names)}"
        )
    return tuple(
        replace(config, goal=goal) if isinstance(config, ReachConfig) else config
        for config in configs
    )


def print_result(args: argparse.Namespace, data: object, text: Callable[[], str]) -> None:
    """Print data as JSON if ``--json`` is given, else text unless it is empty."""
    if shown := json.dumps(data, default=str) if args.json else text():
        print(shown)


def table(
    rows: Iterable[Any],
    headers: Sequence[str] | str = (),
    *,
    floatfmt: str | Sequence[str] = "g",
    tablefmt: str = "simple",
    disable_numparse: bool = False,
) -> str:
    """Return rows as a table of tabulate, whose import ``morphgen --help`` does not wait for."""
    from tabulate import tabulate

    return tabulate(rows, headers, tablefmt, floatfmt=floatfmt, disable_numparse=disable_numparse)


def given(args: argparse.Namespace, names: Iterable[str]) -> dict[str, Any]:
    """Return the values of options by name, without those that are empty or off."""
    values = {name: getattr(args, name, None) for name in names}
    empty: tuple[object, ...] = (None, (), [], "")
    # 0 equals False, and is a value.
    return {name: x for name, x in values.items() if x not in empty and x is not False}


def library_of(args: argparse.Namespace) -> Library:
    """Return the library with the folders of ``--library``."""
    from morphgen.grammar.library import default_library

    return default_library(args.library)


def sources_of(
    args: argparse.Namespace, refuse: Callable[[str, FormatError], object] | None = None
) -> list[RobotSource]:
    """Return the sources of the robots that the arguments name, one or several."""
    from morphgen.grammar.robot_source import find_robots

    sources = find_robots(args.words, library_of(args), refuse)
    if args.root is not None and (composed := [s for s in sources if s.path is None]):
        raise FormatError(
            f"--root {args.root}: {composed[0].label} is composed; expected a bundle, a URDF, a "
            "xacro or an MJCF"
        )
    return sources


def read_robots(args: argparse.Namespace) -> list[tuple[RobotSource, Robot]]:
    """Return the robots that the arguments name, one or several, with their sources."""
    from morphgen.grammar.robot_source import read_source

    library, sources = library_of(args), sources_of(args)
    return [
        (source, read_source(source, library, args.root))
        for source in track(sources, args, "reading", "robot", len(sources))
    ]


def for_each_robot(
    args: argparse.Namespace, verb: str, work: Callable[[RobotSource, Library], T]
) -> tuple[dict[str, T], dict[str, dict[str, str]]]:
    """Do something with every robot that the arguments name; a refused one does not stop others.

    Returns:
        The results by the label of the source, and the class and message of the errors by the
        label of those that failed, which are printed. With any of these, the exit code is 2.
    """
    results: dict[str, T] = {}
    refused: dict[str, dict[str, str]] = {}

    def refuse(word: str, error: FormatError) -> None:
        if len(args.words) == 1:
            raise error
        refused[word] = refusal(error, word, word)

    library, sources = library_of(args), sources_of(args, refuse)
    for source in track(sources, args, verb, "robot", len(sources)):
        try:
            results[source.label] = work(source, library)
        except MorphgenError as error:
            if len(sources) == 1 and not refused:
                raise
            refused[source.label] = refusal(error, source.label, source.label)
    return results, refused


def refusal(error: MorphgenError, label: str, name: str) -> dict[str, str]:
    """Print why one of several robots is refused; return it for ``--json``."""
    reason = one_line(str(error))
    if name not in reason:
        reason = f"{label}: {reason}"
    note(f"morphgen: {reason}")
    return {"error": type(error).__name__, "message": reason}


def max_links_for(args: argparse.Namespace, robots: Sequence[Robot]) -> int:
    """Return the number of links that tokens are padded to.

    It is the value of ``--max-links``, else the benchmark's or that of the largest robot if it has
    more, such as a robot with two arms. All robots of a command share it.
    """
    from morphgen.encoding.tokens import default_max_links, require_max_links

    if args.max_links is None:
        return default_max_links(len(robot.links) for robot in robots)
    for robot in robots:
        require_max_links(len(robot.links), f"robot {robot.name!r}", args.max_links)
    return int(args.max_links)


def load_grammar_named(name: str, library: Library, *, sound: bool = False) -> Grammar:
    """Return a grammar by its name or file."""
    from morphgen.grammar.analysis import load_sound_grammar
    from morphgen.grammar.grammar_file import find_grammar, load_grammar

    if sound:
        return load_sound_grammar(name, library)
    return load_grammar(find_grammar(name, library.folders), library.folders)


def require_other_name(words: dict[str, str], split: str, word: str) -> None:
    """Require that no other argument names a split of this name; keep the argument."""
    if split in words:
        raise BenchmarkError(
            f"{word}: split {split!r} is also in {words[split]}; expected splits of different names"
        )
    words[split] = word
