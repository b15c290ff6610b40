"""Load splits of train and test robots, choose the robots of new ones, and sample goal sets."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, overload

from morphgen.benchmark.composition import composition
from morphgen.benchmark.hold_out import hold_out
from morphgen.benchmark.regimes import (
    SplitRequest,
    extrapolation,
    interpolation,
)
from morphgen.benchmark.release import build_with_goals, verify
from morphgen.benchmark.split_folder import (
    Difference,
    compare_robots,
    read_split_or_folder,
)
from morphgen.benchmark.survey import Audit, audit, statistics
from morphgen.encoding.tokens import MAX_LINKS
from morphgen.errors import (
    BenchmarkError,
    explain_missing_extras,
    nearest,
    path_argument,
    text_argument,
    truth,
    whole_number,
)
from morphgen.grammar.analysis import load_sound_grammar
from morphgen.grammar.library import Library, LibraryFolders, default_library
from morphgen.model.robot import Robot
from morphgen.progress import part_of
from morphgen.splits.split import (
    HOLD_OUT,
    Regime,
    Split,
    compose_side,
    require_split_name,
    split_names,
    split_paths,
    write_new_splits,
)
from morphgen.tables import table
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig, load_robot
from morphgen.tasks.split_goals import (
    GoalResult,
    goal_record,
    sample_robot_goals,
    sample_split_goals,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack


@dataclass(frozen=True)
class LoadedSplit:
    """A split, and the library that its robots are composed from."""

    definition: Split
    """Content of the split's file: for each robot its derivation, task and hash."""
    library: Library
    """Library of the parts."""
    folder: Path | None = None
    """Folder where the split is built, if it was loaded from there."""

    @property
    def name(self) -> str:
        """Name of the split, such as ``interpolation/arm3/reach``."""
        return self.definition.name

    @cached_property
    def train(self) -> tuple[Robot, ...]:
        """The train robots, composed at the first access.

        Raises:
            MorphgenError: As ``compose_member``.
        """
        return tuple(compose_side(self.definition, "train", self.library))

    @cached_property
    def test(self) -> tuple[Robot, ...]:
        """The test robots, composed at the first access.

        Raises:
            MorphgenError: As ``compose_member``.
        """
        return tuple(compose_side(self.definition, "test", self.library))

    @explain_missing_extras()
    def statistics(self, *, jobs: int = 1) -> dict[str, Any]:
        """Compute sizes of the robots, and the similarity of test and train robots.

        Args:
            jobs: Number of processes.

        Returns:
            Plain data; see ``morphgen.benchmark.survey.statistics``.

        Raises:
            BenchmarkError: If a robot cannot be composed, or train or test is empty.
            MissingDependencyError: If a part's primitives must be fitted, and ``fit`` is missing.
        """
        return statistics(self.definition, self.library, jobs=jobs)

    @explain_missing_extras()
    def audit(self, *, jobs: int = 1) -> Audit:
        """Find leaks between train and test robots; see ``morphgen.benchmark.survey.audit``.

        Args:
            jobs: Number of processes.

        Raises:
            BenchmarkError: If the provenance of the split is malformed.
            MissingDependencyError: If a part's primitives must be fitted, and ``fit`` is missing.
        """
        return audit(self.definition, self.library, jobs=jobs)

    def write(self, path: str | PathLike[str] = ".") -> Path:
        """Write the split's file.

        Examples:
            >>> scenario = morphgen.split("interpolation/arm3/reach")
            >>> print(scenario.write("mine"))
            mine/interpolation/arm3/reach.yaml

        Args:
            path: A file that ends in ``.yaml``, or a folder for ``<name>.yaml``.

        Returns:
            The file. One that has the same content is kept.

        Raises:
            BenchmarkError: If it exists with another content, or cannot be written.
        """
        paths = split_paths(Path(path), [self.definition])
        write_new_splits([self.definition], paths)
        return paths[0]

    @explain_missing_extras()
    def build(
        self,
        folder: str | PathLike[str] = "data",
        *,
        goals: bool = False,
        goal_seed: int = 0,
        jobs: int = 1,
    ) -> Path:
        """Write every robot and its tokens into a folder; continue an interrupted build.

        Examples:
            >>> scenario = morphgen.split("interpolation/arm3/reach")
            >>> folder = scenario.build("data", goals=True)
            >>> print(folder)
            data/interpolation/arm3/reach
            >>> morphgen.split(folder).verify()
            ()

        Args:
            folder: Folder in which the split's folder is created.
            goals: Whether to ship the goal set of every robot.
            goal_seed: Seed of the goal sets.
            jobs: Number of processes; the files do not depend on it.

        Returns:
            The split's folder.

        Raises:
            BenchmarkError: If a robot is not the one that the split names or has no goal set, or
                the folder has another content or cannot be written.
            MissingDependencyError: If the extra ``fit`` is needed and missing.
            MorphgenError: If a robot cannot be composed.
        """
        config = GoalConfig(goal_seed)
        sets = sample_split_goals(self.definition, self.library, config, jobs=jobs) if goals else ()
        report = build_with_goals(
            self.definition, Path(folder), self.library, sets, config, jobs=jobs
        )
        return report.folder

    @explain_missing_extras()
    def verify(self, *, jobs: int = 1) -> tuple[Difference, ...]:
        """Compose every robot and compare it: with its hash, and with all files of a built split.

        Examples:
            >>> morphgen.split("interpolation/arm3/reach").verify()
            ()

        Args:
            jobs: Number of processes.

        Returns:
            Differences; none if all robots are the same here, and goals are certified.
        """
        if self.folder is None:
            return compare_robots(self.definition, self.library, jobs=jobs)
        return verify(self.folder, self.library, jobs=jobs).differences


Names = str | Sequence[str]  # one name, or several
DEFAULT_TRAIN = 10  # number of train robots


class NewSplit(TypedDict, total=False):
    """Keyword arguments that choose the robots of a new split; see ``split``."""

    hold_out: Names
    regime: Regime
    robots: Names
    grammar: Names
    train_category: Names
    test_category: Names
    hull: str
    test: int
    task: Names
    obstacles: bool
    seed: int
    max_links: int
    jobs: int


@overload
def split(
    name: str | PathLike[str] = ...,
    *,
    train: int | None = None,
    library: LibraryFolders = ...,
    **choice: Unpack[NewSplit],
) -> LoadedSplit: ...
@overload
def split(
    name: str = ...,
    *,
    train: Sequence[int],
    library: LibraryFolders = ...,
    **choice: Unpack[NewSplit],
) -> tuple[LoadedSplit, ...]: ...
@explain_missing_extras()
def split(
    name: str | PathLike[str] = "",
    *,
    train: int | Sequence[int] | None = None,
    library: LibraryFolders = (),
    **choice: Any,
) -> LoadedSplit | tuple[LoadedSplit, ...]:
    """Load a split of train and test robots, or choose the robots of a new one.

    Without further arguments the split is loaded. With ``hold_out``, its robots are chosen: test
    robots have what is held out, train robots do not. With ``regime``, they are chosen by the rules
    of a regime.

    Examples:
        >>> scenario = morphgen.split("interpolation/arm3/reach")
        >>> len(scenario.train), len(scenario.test)
        (10, 1)
        >>> scenario.audit().passed()
        True
        >>> arms = "arm={lwr,ur5,z1} ee=stick"
        >>> mine = morphgen.split("my/no-lwr", hold_out="arm=lwr", robots=arms, train=2)
        >>> [robot.name for robot in mine.test]
        ['lwr+stick']
        >>> print(mine.write("splits"))
        splits/my/no-lwr.yaml
        >>> small, large = morphgen.split(regime="interpolation", grammar="arm3", train=[2, 4])
        >>> [robot.name for robot in small.test] == [robot.name for robot in large.test]
        True

    Args:
        name: Name of a split that comes with morphgen, such as ``interpolation/arm3/reach``; a
            split's file; or the folder where a split was built. The name of a new split is by
            default made from the other arguments.
        train: Number of train robots, by default 10. Several numbers that grow give a split each,
            with the same test robots, the smaller within the larger.
        library: Folders of your own parts and grammars.
        **choice: Arguments of a new split. A name or rule may also be a list of several.

            - ``hold_out``: parts (``arm=kinova*``), a manufacturer (``manufacturer=Kinova``) or
              a combination (``arm=ur5+ee=plane``)
            - ``regime``: ``interpolation`` with ``grammar`` and ``hull`` (``inside``, ``outside``
              or ``any``); ``composition`` with ``robots``; ``extrapolation`` with
              ``train_category`` and ``test_category`` (grammars)
            - ``robots``: words of ``compose`` with choices in braces and wildcards, by default
              ``arm=* ee=*``
            - ``test``: number of test robots, by default 1; ``task``: by default ``reach``;
              ``obstacles``; ``seed``; ``max_links``, by default 23
            - ``jobs``: number of processes

    Returns:
        The split, or for several sizes a tuple of splits. Its ``train`` and ``test`` robots are
        composed when first used. ``statistics()`` and ``audit()`` measure and compare all of them,
        ``write()`` writes its file, ``build()`` all robots, and ``verify()`` compares them.

    Raises:
        BenchmarkError: If the split does not exist or is malformed; or if an argument is unknown or
            invalid, or too few robots meet it.
        MorphgenError: If a part or a grammar is unknown, or parts do not fit.
    """
    name = str(path_argument("name", name, BenchmarkError)) if name != "" else ""
    parts = default_library(library)
    if not choice and train is None:
        if not str(name):
            raise BenchmarkError("no split is named; expected a name, or hold_out or regime")
        definition, folder = read_split_or_folder(name)
        return LoadedSplit(definition, parts, folder)
    for key in choice:
        if key not in NewSplit.__optional_keys__:
            valid = NewSplit.__optional_keys__ | {"train", "library"}
            raise BenchmarkError(f"split: unknown argument {key!r}{nearest(key, valid)}")
    jobs = choice.pop("jobs", 1)
    regime, rules, request = _parse(str(name), train, **choice)
    require_split_name(request.name)
    splits = _choose(regime, rules, request, parts, jobs)
    loaded = tuple(LoadedSplit(each, parts) for each in splits)
    return loaded[0] if train is None or isinstance(train, Integral) else loaded


_RULES: Mapping[Regime, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "interpolation": (("grammar",), ("hull",)),
    "composition": (("robots",), ()),
    "extrapolation": (("train_category", "test_category"), ()),
    "hold-out": (("hold_out",), ("robots",)),
}
"""Arguments that a regime needs, and further ones that have an effect."""
MAX_WORD = 60  # largest number of characters of what is held out in the name of a split
Rules = Mapping[str, tuple[str, ...]]
"""Arguments of ``split`` by which robots are chosen, without those that are not given."""


def _parse(
    name: str,
    train: int | Sequence[int] | None,
    *,
    regime: Regime = HOLD_OUT,
    test: int = 1,
    task: Names = "reach",
    obstacles: bool = False,
    seed: int = 0,
    max_links: int = MAX_LINKS,
    **names: Names,
) -> tuple[Regime, Rules, SplitRequest]:
    """Return regime, rules and request that the arguments of ``split`` describe."""
    several = {key: _several(key, value) for key, value in names.items()}
    rules = {key: texts for key, texts in several.items() if any(texts)}
    _require_rules(regime, rules)
    tasks = _several("task", task)
    for each in tasks:
        if each not in TASKS:
            raise BenchmarkError(f"unknown task {each!r}{nearest(each, TASKS)}")
    if len(set(tasks)) < len(tasks) or not tasks:
        raise BenchmarkError(f"task {list(tasks)}: expected one or more, all different")
    if train is None:
        train = DEFAULT_TRAIN
    sizes = tuple(train) if isinstance(train, Iterable) else (train,)
    sizes = tuple(whole_number("split: train", size, BenchmarkError) for size in sizes)
    test, seed, max_links = (
        whole_number(f"split: {what}", value, BenchmarkError)
        for what, value in (("test", test), ("seed", seed), ("max_links", max_links))
    )
    obstacles = truth("split: obstacles", obstacles, BenchmarkError)
    if not name:
        boxes = ["obstacles"] if obstacles else []
        name = "-".join([regime, _word(regime, rules), *tasks, *boxes, f"seed{seed}"])
    return regime, rules, SplitRequest(name, sizes, test, tasks, obstacles, seed, max_links)


def _require_rules(regime: Regime, rules: Rules) -> None:
    """Require the rules that a regime needs, and no others."""
    if regime not in _RULES:
        raise BenchmarkError(f"unknown regime {regime!r}{nearest(regime, _RULES)}")
    required, optional = _RULES[regime]
    listed = ", ".join([*required, *optional])
    for key in required:
        if key not in rules:
            raise BenchmarkError(f"{regime}: {key} is missing; valid: {listed}")
    for key in rules:
        if key not in (*required, *optional):
            raise BenchmarkError(f"{regime}: no effect of {key}; valid: {listed}")
    if regime == "interpolation" and len(rules["grammar"]) > 1:
        raise BenchmarkError(f"interpolation: {len(rules['grammar'])} grammars; expected one")


def _word(regime: Regime, rules: Rules) -> str:
    """Return a word for the robots in the default name of a split."""
    if regime == HOLD_OUT:
        words = re.findall(r"[A-Za-z0-9_.]+", ",".join(rules["hold_out"]))
        return "-".join(words)[:MAX_WORD].strip("-.")
    if regime == "composition":
        words = " ".join(rules["robots"]).split()
        keys = dict.fromkeys(word.partition("=")[0] for word in words if "={" in word)
        return "-".join(keys) or "robots"
    grammars = [Path(name).stem for name in rules.get("test_category") or rules["grammar"]]
    return "-".join([*grammars, *(hull for hull in rules.get("hull", ()) if hull != "any")])


def _choose(
    regime: Regime, rules: Rules, request: SplitRequest, library: Library, jobs: int
) -> tuple[Split, ...]:
    grammars, train, test = (
        [load_sound_grammar(name, library) for name in rules.get(key, ())]
        for key in ("grammar", "train_category", "test_category")
    )
    patterns = rules.get("robots", ())
    with part_of(request.train[-1] + request.test):
        if regime == "interpolation":
            hull = ",".join(rules.get("hull", ("any",)))
            return interpolation(request, grammars[0], library, hull=hull, jobs=jobs)
        if regime == "composition":
            return composition(request, patterns, library, jobs=jobs)
        if regime == "extrapolation":
            return extrapolation(request, train, test, library, jobs=jobs)
        return hold_out(request, rules["hold_out"], library, patterns=patterns, jobs=jobs)


def _several(key: str, names: Names) -> tuple[str, ...]:
    """Return the names of an argument, which is one text or several."""
    several = (names,) if isinstance(names, str) or not isinstance(names, Iterable) else names
    texts = tuple(several)
    if not all(isinstance(text, str) for text in texts):
        raise BenchmarkError(f"split: {key} {names!r}: expected a text, or several")
    return texts


_HEADERS = ("robot", "side", "task", "goals", "acceptance", "obstacles", "certified")


@dataclass(frozen=True, eq=False)
class GoalSets:
    """Goal sets of robots; the text is a table with the failures."""

    seed: int
    """Seed of the goals."""
    results: tuple[GoalResult, ...]
    """For each robot its ``goals``, or the ``error`` why there are none."""

    @property
    def passed(self) -> bool:
        """Whether every robot has its goals, and none failed its certification."""
        return all(each.goals is not None and not each.certificate_errors for each in self.results)

    def as_dict(self) -> dict[str, object]:
        """Return records of the sets, and the failures, as JSON values."""
        failures = [
            {"robot": each.robot, "side": each.side, "task": each.task, "why": each.error}
            for each in self.results
            if each.goals is None
        ]
        sets = [_record(each) for each in self.results if each.goals]
        return {"seed": self.seed, "sets": sets, "failures": failures, "passed": self.passed}

    def __str__(self) -> str:
        """Return a table with a row per robot, then a line per failure."""
        lines = [table([_row(each) for each in self.results], _HEADERS)]
        for result in self.results:
            robot = f"{result.side} robot" if result.side else "robot"
            if result.goals is None:
                lines.append(f"{robot} {result.robot}: {result.error}")
            elif result.certificate_errors:
                first, *others = result.certificate_errors
                more = f" (and {len(others)} more)" if others else ""
                lines.append(f"{robot} {result.robot}: {first}{more}")
        complete = sum(each.goals is not None for each in self.results)
        count = f"{complete} of {len(self.results)}"
        return "\n".join([*lines, f"{count} goal sets are complete, seed {self.seed}"])


def _record(result: GoalResult) -> Mapping[str, Any]:
    errors = result.certificate_errors
    certified = None if errors is None else not errors
    return {**goal_record(result), "certified": certified, "unproven": list(errors or ())}


def _row(result: GoalResult) -> tuple[str, ...]:
    goals, errors = result.goals, result.certificate_errors
    certified = "not tested" if errors is None else "NO" if errors else "yes"
    rate = "" if result.acceptance is None else f"{result.acceptance:.3g}"
    count = "none" if goals is None else str(len(goals.q))
    boxes = str(len(goals.obstacles)) if goals else "yes" if result.obstacles else "0"
    return (result.robot, result.side or "", result.task, count, rate, boxes, certified)


def goals(
    robots: str | PathLike[str] | Robot,
    *,
    task: str | None = None,
    obstacles: bool = False,
    seed: int = 0,
    certify: bool = False,
    jobs: int = 1,
    library: LibraryFolders = (),
) -> GoalSets:
    """Sample the goal sets of robots, and certify that each goal can be reached.

    Goals of reach and starts of push are kept in the cache. The goals of reach are full poses.

    Examples:
        >>> sets = morphgen.goals("prims", task="reach", certify=True)
        >>> sets.passed, len(sets.results[0].goals.q)
        (True, 100)

    Args:
        robots: Name of a split, its file or built folder; or with ``task`` a robot, its bundle's
            folder, a description, or words of ``compose``.
        task: Task of one robot, such as ``reach`` or ``push``.
        obstacles: Whether one robot is among obstacles.
        seed: Seed of the goals.
        certify: Whether to verify every goal with the configuration that it was sampled from.
        jobs: Number of processes.
        library: Folders of your own parts.

    Returns:
        The goal sets and failures, which print as a table.

    Raises:
        MorphgenError: If the split or the robot cannot be read, or the task is unknown.
    """
    config = GoalConfig(seed)
    if task is not None:
        TASKS[text_argument("task", task, BenchmarkError)]  # raises if the task is unknown
        if str(robots) in split_names():
            raise BenchmarkError(f"--task {task}: is for a robot; {robots} is a split")
        robot = load_robot(robots, library=library)
        result = sample_robot_goals(robot, task, config, obstacles=obstacles, certified=certify)
        return GoalSets(seed, (result,))
    if isinstance(robots, Robot):
        raise BenchmarkError(f"{robots!r}: name its task")
    path = path_argument("robots", robots, BenchmarkError)
    if len(str(path).split()) > 1 and not path.exists():
        raise BenchmarkError(f"{path}: name one split, or say --task for a robot")
    if obstacles:
        raise BenchmarkError("obstacles: only with task")
    split, _ = read_split_or_folder(path)
    results = sample_split_goals(
        split, default_library(library), config, jobs=jobs, certified=certify
    )
    return GoalSets(seed, tuple(results))
