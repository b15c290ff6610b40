"""Whether a split, as a file or with all its robots built, is the one that it claims to be."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from morphgen.benchmark.split import Member, Split, compose_member, sided_members, split_id
from morphgen.benchmark.split_file import find_split, read_split_file
from morphgen.benchmark.split_folder import (
    BUILD_FILE,
    ROBOTS_DIR,
    ROBOTS_FILE,
    SPLIT_FILE,
    SUMS_FILE,
    TOKENS_FILE,
    read_records,
    read_settings,
    read_sums,
    read_tokens,
    require_split_folder,
)
from morphgen.benchmark.split_folder_files import (
    RobotData,
    records,
    robot_data,
    robot_paths,
    token_tables,
)
from morphgen.benchmark.split_folder_robots import differences, hashes, same
from morphgen.benchmark.token_layout import GEOMETRY, LAYOUT, SHAPE_POSE, TOLERANCE
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.grammar.library import Library
from morphgen.processes import Progress, no_progress, parallel_map

FITTED_TOLERANCE = 1e-3
"""How far the numbers of a link's primitive may be off: it may have been sought anew, here."""


@dataclass(frozen=True)
class Difference:
    """Something that is not as it should be."""

    where: str
    """The robot's name, or a file."""
    why: str


@dataclass(frozen=True)
class Verified:
    """What was found of a split."""

    split: Split
    id: str
    """As its robots give it."""
    differences: tuple[Difference, ...]


def verify(
    name_or_path: str | Path,
    library: Library,
    *,
    jobs: int = 1,
    progress: Progress = no_progress,
) -> Verified:
    """Compare a split with what its derivations give today.

    Of a file the id and the hash of every body are tested; of a folder that ``build`` wrote, also
    every file, against ``SHA256SUMS`` and against the robot that its derivation gives.

    Args:
        name_or_path: A split's name or file, or a built folder.
        library: Where the parts are.
        jobs: Processes.
        progress: Told how many robots are done, again and again.

    Raises:
        BenchmarkError: If there is no such split, or it cannot be read at all.
    """
    folder = Path(name_or_path)
    is_built = folder.is_dir()
    if is_built:
        require_split_folder(folder)
    path = folder / SPLIT_FILE if is_built else find_split(name_or_path)
    read = read_split_file(path)
    own = split_id(read.split)
    found = []
    if read.id != own:
        found.append(Difference(str(path), f"its id is {read.id}, but that of its robots is {own}"))
    if is_built:
        found += _built_differences(folder, read.split, library, jobs, progress)
    else:
        seen = _seen(
            read.split, _Examination(library.folders, read.split.max_links), jobs, progress
        )
        found += _robot_differences(read.split, seen)
    return Verified(read.split, own, tuple(found))


@dataclass(frozen=True, eq=False)
class _Seen:
    """What a worker finds of a robot."""

    whys: tuple[str, ...]
    body: RobotData | None = None


@dataclass(frozen=True, eq=False)
class _Examination:
    """How a worker composes a robot, and looks at its folder in a built split if there is one."""

    folders: tuple[Path, ...]
    max_links: int
    built: Path | None = None
    light: bool = False
    paths: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def library(self) -> Library:
        return Library(self.folders)

    def __call__(self, member: Member) -> _Seen:
        try:
            robot = compose_member(member, self.library)
            if self.built is None:
                return _Seen(())
            folder = self.built / self.paths[member.robot_hash]
            named_so = folder.name == member.name
            whys = differences(folder, robot, light=self.light) if named_so else []
            return _Seen(tuple(whys), robot_data(robot, self.folders, self.max_links))
        except MorphgenError as error:
            return _Seen((str(error),))


def _seen(
    split: Split, look: _Examination, jobs: int, progress: Progress
) -> dict[tuple[str, str], _Seen]:
    """What is found of the robots, by derivation and hash."""
    members = [member for _, member in reversed(sided_members(split))]
    firsts = {(member.derivation, member.robot_hash): member for member in members}
    found = parallel_map(look, list(firsts.values()), jobs, progress)
    return dict(zip(firsts, found, strict=True))


def _robot_differences(split: Split, seen: Mapping[tuple[str, str], _Seen]) -> Iterator[Difference]:
    for _, member in sided_members(split):
        for why in seen[member.derivation, member.robot_hash].whys:
            yield Difference(member.name, why)


def _built_differences(
    folder: Path, split: Split, library: Library, jobs: int, progress: Progress
) -> Iterator[Difference]:
    id_, light = read_settings(folder / BUILD_FILE)
    if id_ != split_id(split):
        yield Difference(BUILD_FILE, f"it is of split {id_}, not of {SPLIT_FILE}")
    try:
        paths = robot_paths(split)
    except BenchmarkError as error:
        yield Difference(SPLIT_FILE, str(error))
        return
    files = list(_file_differences(folder))
    yield from files
    look = _Examination(library.folders, split.max_links, folder, light, paths)
    seen = _seen(split, look, jobs, progress)
    told = {difference.where for difference in files}
    yield from (each for each in _robot_differences(split, seen) if each.where not in told)
    known = {body: one.body for (_, body), one in seen.items() if one.body is not None}
    if known.keys() >= paths.keys():
        yield from _record_differences(folder / ROBOTS_FILE, split, known)
        yield from _token_differences(folder / TOKENS_FILE, split, known)


def _file_differences(folder: Path) -> Iterator[Difference]:
    """Files that are not as ``SHA256SUMS`` says; those of a robot are told by its name."""
    expected = read_sums(folder / SUMS_FILE)
    found = hashes(folder)
    for name in sorted((expected.keys() | found.keys()) - {SUMS_FILE}):
        if name not in found:
            why = f"is missing, but {SUMS_FILE} names it"
        elif name not in expected:
            why = f"is not named by {SUMS_FILE}"
        elif found[name] != expected[name]:
            why = f"is not what {SUMS_FILE} was written for"
        else:
            continue
        place, _, below = name.partition("/")
        robot, _, file = below.partition("/")
        where, told = (robot, file) if place == ROBOTS_DIR and file else (name, name)
        yield Difference(where, f"file {told} {why}")


def _record_differences(
    path: Path, split: Split, known: Mapping[str, RobotData]
) -> Iterator[Difference]:
    """Lines of ``robots.jsonl`` that are not as the robots are."""
    try:
        found = read_records(path)
    except BenchmarkError as error:
        yield Difference(path.name, str(error))
        return
    expected = records(split, known)
    if len(found) != len(expected):
        yield Difference(path.name, f"it has {len(found)} robots, not {len(expected)}")
        return
    for i, (line, wanted) in enumerate(zip(found, expected, strict=True), 1):
        keys = sorted(line.keys() | wanted.keys())
        wrong = [key for key in keys if not same(line.get(key), wanted.get(key))]
        for key in wrong:
            why = f"{path.name}:{i}: {key} is {line.get(key)!r}, not {wanted.get(key)!r}"
            yield Difference(str(wanted["name"]), why)


def _token_differences(
    path: Path, split: Split, known: Mapping[str, RobotData]
) -> Iterator[Difference]:
    """Rows of ``tokens.npz`` that are not as the robots are."""
    try:
        names, tokens, mask = read_tokens(path)
    except BenchmarkError as error:
        yield Difference(path.name, str(error))
        return
    wanted, wanted_mask = token_tables(split, known)
    expected = [member.name for _, member in sided_members(split)]
    if names != expected or tokens.shape != wanted.shape:
        yield Difference(path.name, f"it is not of the {len(expected)} robots of {SPLIT_FILE}")
        return
    apart = np.abs(tokens - wanted)
    for shape in (GEOMETRY, SHAPE_POSE):
        apart[..., shape.columns] *= TOLERANCE / FITTED_TOLERANCE
    for i, name in enumerate(expected):
        if (mask[i] != wanted_mask[i]).any():
            yield Difference(name, f"{path.name}: its mask is not that of its links")
        lost = ~(apart[i] <= TOLERANCE)
        if lost.any():
            link, column = np.argwhere(lost)[0].tolist()
            what = next(each for each in LAYOUT if column < each.columns.stop)
            yield Difference(name, f"{path.name}: {what.name} of link {link} is not the robot's")
