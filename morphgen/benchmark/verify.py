"""Whether a split, as a file or with all its robots built, is the one that it claims to be."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from morphgen.benchmark.built import (
    BUNDLES,
    ROBOTS,
    SETTINGS,
    SPLIT,
    SUMS,
    TOKENS,
    read_records,
    read_settings,
    read_sums,
    read_tokens,
    require_built,
)
from morphgen.benchmark.contents import (
    Body,
    body_of,
    body_paths,
    records,
    sided,
    token_tables,
)
from morphgen.benchmark.robot_folder import differences, hashes, same
from morphgen.benchmark.split import Member, Split, member_robot, split_id
from morphgen.benchmark.split_file import find_split, read_split_file
from morphgen.benchmark.token_layout import GEOMETRY, LAYOUT, SHAPE_POSE, TOLERANCE
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.grammar.library import Library
from morphgen.processes import Progress, mapped, unseen

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
    progress: Progress = unseen,
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
        require_built(folder)
    path = folder / SPLIT if is_built else find_split(name_or_path)
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
    body: Body | None = None


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
            robot = member_robot(member, self.library)
            if self.built is None:
                return _Seen(())
            folder = self.built / self.paths[member.body]
            named_so = folder.name == member.name
            whys = differences(folder, robot, light=self.light) if named_so else []
            return _Seen(tuple(whys), body_of(robot, self.folders, self.max_links))
        except MorphgenError as error:
            return _Seen((str(error),))


def _seen(
    split: Split, look: _Examination, jobs: int, progress: Progress
) -> dict[tuple[str, str], _Seen]:
    """What is found of the robots, by derivation and hash."""
    members = [member for _, member in reversed(sided(split))]
    firsts = {(member.derivation, member.body): member for member in members}
    found = mapped(look, list(firsts.values()), jobs, progress)
    return dict(zip(firsts, found, strict=True))


def _robot_differences(split: Split, seen: Mapping[tuple[str, str], _Seen]) -> Iterator[Difference]:
    for _, member in sided(split):
        for why in seen[member.derivation, member.body].whys:
            yield Difference(member.name, why)


def _built_differences(
    folder: Path, split: Split, library: Library, jobs: int, progress: Progress
) -> Iterator[Difference]:
    id_, light = read_settings(folder / SETTINGS)
    if id_ != split_id(split):
        yield Difference(SETTINGS, f"it is of split {id_}, not of {SPLIT}")
    try:
        paths = body_paths(split)
    except BenchmarkError as error:
        yield Difference(SPLIT, str(error))
        return
    files = list(_file_differences(folder))
    yield from files
    look = _Examination(library.folders, split.max_links, folder, light, paths)
    seen = _seen(split, look, jobs, progress)
    told = {difference.where for difference in files}
    yield from (each for each in _robot_differences(split, seen) if each.where not in told)
    known = {body: one.body for (_, body), one in seen.items() if one.body is not None}
    if known.keys() >= paths.keys():
        yield from _record_differences(folder / ROBOTS, split, known)
        yield from _token_differences(folder / TOKENS, split, known)


def _file_differences(folder: Path) -> Iterator[Difference]:
    """Files that are not as ``SHA256SUMS`` says; those of a robot are told by its name."""
    expected = read_sums(folder / SUMS)
    found = hashes(folder)
    for name in sorted((expected.keys() | found.keys()) - {SUMS}):
        if name not in found:
            why = f"is missing, but {SUMS} names it"
        elif name not in expected:
            why = f"is not named by {SUMS}"
        elif found[name] != expected[name]:
            why = f"is not what {SUMS} was written for"
        else:
            continue
        place, _, below = name.partition("/")
        robot, _, file = below.partition("/")
        where, told = (robot, file) if place == BUNDLES and file else (name, name)
        yield Difference(where, f"file {told} {why}")


def _record_differences(
    path: Path, split: Split, known: Mapping[str, Body]
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


def _token_differences(path: Path, split: Split, known: Mapping[str, Body]) -> Iterator[Difference]:
    """Rows of ``tokens.npz`` that are not as the robots are."""
    try:
        names, tokens, mask = read_tokens(path)
    except BenchmarkError as error:
        yield Difference(path.name, str(error))
        return
    wanted, wanted_mask = token_tables(split, known)
    expected = [member.name for _, member in sided(split)]
    if names != expected or tokens.shape != wanted.shape:
        yield Difference(path.name, f"it is not of the {len(expected)} robots of {SPLIT}")
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
