"""Load splits of train and test robots, and choose the robots of new ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from numbers import Integral
from os import PathLike
from typing import TYPE_CHECKING, Any, TypedDict, overload

from morphgen.api.loaded_split import LoadedSplit
from morphgen.arguments import checked_signature, path_argument, truth, whole_number
from morphgen.benchmark.generate import SplitRequest
from morphgen.benchmark.new_split import RobotChoice, choose_robots, default_name
from morphgen.benchmark.split import HOLD_OUT, Regime
from morphgen.benchmark.split_file import require_split_name
from morphgen.benchmark.split_source import read_split_or_folder
from morphgen.benchmark.statistics import statistics
from morphgen.benchmark.token_layout import MAX_LINKS
from morphgen.errors import BenchmarkError, nearest
from morphgen.extras import explain_missing_extras
from morphgen.grammar.library import LibraryFolders, default_library
from morphgen.tasks.registry import TASKS

if TYPE_CHECKING:
    from typing_extensions import Unpack

Names = str | Sequence[str]
"""One name, or several."""
DEFAULT_TRAIN = 10
"""Number of train robots; a split of compositions has all that may be trained on."""


class NewSplit(TypedDict, total=False):
    """Keyword arguments that choose the robots of a new split; see ``split``."""

    hold_out: Names
    regime: Regime
    robots: Names
    grammar: Names
    train_category: Names
    test_category: Names
    hull: str
    similarity: str
    test: int
    task: Names
    obstacles: bool
    seed: int
    max_links: int
    statistics: bool
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
@checked_signature
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
        train: Number of train robots, by default 10; for compositions all that may be trained on.
            Several numbers that grow give a split each, with the same test robots, the smaller
            within the larger.
        library: Folders of your own parts and grammars.
        **choice: Arguments of a new split. A name or rule may also be a list of several.

            - ``hold_out``: parts (``arm=kinova*``), a manufacturer (``manufacturer=Kinova``), a
              range of a parameter (``arm3.length=0.3..0.4``) or a combination
              (``arm=ur5+ee=plane``)
            - ``regime``: ``interpolation`` with ``grammar`` and ``hull`` (``inside``, ``outside``
              or ``any``); ``composition`` with ``robots``; ``extrapolation`` with
              ``train_category``, ``test_category`` (grammars) and ``similarity`` (``<0.6``)
            - ``robots``: words of ``compose`` with choices in braces and wildcards, by default
              ``arm=* ee=*``; ``grammar``: grammars to draw from
            - ``test``: number of test robots, by default 1; ``task``: by default ``reach``;
              ``obstacles``; ``seed``; ``max_links``, by default 23
            - ``statistics``: whether the file has the statistics; ``jobs``: number of processes

    Returns:
        The split, or for several sizes a tuple of splits. Its ``train`` and ``test`` robots are
        composed when first used. ``statistics()`` and ``audit()`` measure and compare all of them,
        ``licences()`` lists their parts with licences and restrictions, ``write()`` writes its
        file, ``build()`` all robots, and ``verify()`` compares them.

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
    jobs, with_statistics = choice.pop("jobs", 1), choice.pop("statistics", False)
    rules, request = _parse(str(name), train, **choice)
    require_split_name(request.name)
    splits = choose_robots(rules, request, parts, jobs=jobs)
    if with_statistics:
        splits = tuple(
            replace(each, statistics=statistics(each, parts, jobs=jobs)) for each in splits
        )
    loaded = tuple(LoadedSplit(each, parts) for each in splits)
    return loaded[0] if train is None or isinstance(train, Integral) else loaded


def _parse(
    name: str,
    train: int | Sequence[int] | None,
    *,
    regime: Regime = HOLD_OUT,
    hull: str = "",
    similarity: str = "",
    test: int = 1,
    task: Names = "reach",
    obstacles: bool = False,
    seed: int = 0,
    max_links: int = MAX_LINKS,
    **names: Names,
) -> tuple[RobotChoice, SplitRequest]:
    """Return the rules and the request that the arguments of ``split`` describe."""
    several = {key: _several(key, value) for key, value in names.items()}
    rules = RobotChoice(regime, hull=hull, similarity=similarity, **several)
    tasks = _several("task", task)
    for each in tasks:
        if each not in TASKS:
            raise BenchmarkError(f"unknown task {each!r}{nearest(each, TASKS)}")
    if len(set(tasks)) < len(tasks) or not tasks:
        raise BenchmarkError(f"task {list(tasks)}: expected one or more, all different")
    if train is None:
        train = () if regime == "composition" else DEFAULT_TRAIN
    sizes = tuple(train) if isinstance(train, Iterable) else (train,)
    sizes = tuple(whole_number("split: train", size, BenchmarkError) for size in sizes)
    test, seed, max_links = (
        whole_number(f"split: {what}", value, BenchmarkError)
        for what, value in (("test", test), ("seed", seed), ("max_links", max_links))
    )
    obstacles = truth("split: obstacles", obstacles, BenchmarkError)
    name = name or default_name(rules, tasks, obstacles, seed)
    return rules, SplitRequest(name, sizes, test, tasks, obstacles, seed, max_links)


def _several(key: str, names: Names) -> tuple[str, ...]:
    """Return the names of an argument.

    Raises:
        BenchmarkError: If it is neither a text nor several.
    """
    several = (names,) if isinstance(names, str) or not isinstance(names, Iterable) else names
    texts = tuple(several)
    if not all(isinstance(text, str) for text in texts):
        raise BenchmarkError(f"split: {key} {names!r}: expected a text, or several")
    return texts
