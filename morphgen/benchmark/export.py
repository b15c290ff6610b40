"""Write every robot of a split into a folder that anyone can use; ``built`` says what is in it."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from morphgen.benchmark.built import (
    BUNDLES,
    README,
    ROBOTS,
    SETTINGS,
    SPLIT,
    SUMS,
    TOKENS,
    load_built,
)
from morphgen.benchmark.contents import (
    BUNDLED,
    Body,
    Settings,
    bodies,
    body_of,
    body_paths,
    readme_text,
    records_text,
    settings_text,
    sums_text,
    tokens_npz,
)
from morphgen.benchmark.robot_folder import differences, hashes, is_current, write_robot
from morphgen.benchmark.split import Member, Split, member_robot
from morphgen.benchmark.split_file import split_text
from morphgen.benchmark.token_layout import require_max_links
from morphgen.errors import BenchmarkError
from morphgen.formats.bundle import bundle_folder
from morphgen.formats.data_files import read_json
from morphgen.formats.files import LOCK, alone, partial_of, write_atomic
from morphgen.grammar.library import Library
from morphgen.processes import Progress, mapped, unseen

__all__ = ["LOCK", "BuildReport", "build", "home_of", "load_built"]


@dataclass(frozen=True)
class BuildReport:
    """What a build did."""

    folder: Path
    made: int
    """Bodies that were written."""
    kept: int
    """Bodies that were there."""


def build(
    split: Split,
    folder: Path,
    library: Library,
    *,
    jobs: int = 1,
    settings: Settings = BUNDLED,
    progress: Progress = unseen,
) -> BuildReport:
    """Write a split with all its robots below ``folder``, in folders of the split's name.

    What an interrupted run has left is kept where it is as it should be. The same split gives the
    same bytes.

    Args:
        split: The split.
        folder: Such as ``data``.
        library: Where the parts are.
        jobs: Processes.
        settings: How robots are written.
        progress: Told how many bodies are done, again and again.

    Raises:
        BenchmarkError: If a robot is not the one that the split names, or the folder holds
            something else or cannot be written.
        MorphgenError: If a robot cannot be composed.
    """
    home = home_of(split, folder)
    firsts = bodies(split)
    with _writing(home):
        _prepare(home, split, settings)
        with alone(home):
            (home / SUMS).unlink(missing_ok=True)
            _sweep(home / BUNDLES)
            maker = _Maker(library.folders, home, settings, split.max_links)
            results = mapped(maker, firsts, jobs, progress)
            made = {member.body: one for member, one in zip(firsts, results, strict=True)}
            _finish(home, split, settings, made)
    written = sum(one.is_new for one in made.values())
    return BuildReport(home, written, len(made) - written)


def home_of(split: Split, folder: Path) -> Path:
    """Where a split is built below a folder.

    Raises:
        FormatError: If the split's name makes no folders.
    """
    for name in split.name.split("/"):
        folder = bundle_folder(folder, name)
    return folder


@dataclass(frozen=True, eq=False)
class _Made:
    """A robot that was written or kept."""

    is_new: bool
    body: Body
    hashes: dict[str, str]


@dataclass(frozen=True, eq=False)
class _Maker:
    """How a worker writes a robot."""

    folders: tuple[Path, ...]
    home: Path
    settings: Settings
    max_links: int

    @cached_property
    def library(self) -> Library:
        return Library(self.folders)

    def __call__(self, member: Member) -> _Made:
        robot = member_robot(member, self.library)
        require_max_links(len(robot.links), f"robot {member.name!r}", self.max_links)
        folder = bundle_folder(self.home / BUNDLES, member.name)
        light, picture = self.settings.light, self.settings.picture
        is_kept = not differences(folder, robot, light=light) and is_current(
            folder, light=light, picture=picture
        )
        if not is_kept:
            write_robot(robot, folder, light=light, picture=picture)
        return _Made(not is_kept, body_of(robot, self.folders, self.max_links), hashes(folder))


def _prepare(home: Path, split: Split, settings: Settings) -> None:
    """Make the folder, or see that it holds the same split, built in the same way."""
    wanted = {SETTINGS: settings_text(split, settings), SPLIT: split_text(split)}
    if not (home / SETTINGS).is_file():
        leftover = {partial_of(home / SETTINGS)}
        if home.exists() and not (home.is_dir() and leftover >= set(home.iterdir())):
            raise BenchmarkError(
                f"{home} exists and is no built split (no {SETTINGS}); name another folder"
            )
        home.mkdir(parents=True, exist_ok=True)
        write_atomic(home / SETTINGS, wanted[SETTINGS])
    found = read_json(home / SETTINGS)
    if not isinstance(found, dict):
        raise BenchmarkError(f"{home / SETTINGS}: expected an object, not {type(found).__name__}")
    for key, value in json.loads(wanted[SETTINGS]).items():
        if found.get(key) != value:
            raise BenchmarkError(
                f"{home} holds another build: its {key} is {found.get(key)!r}, not {value!r}; "
                "name another folder"
            )
    write_atomic(home / SPLIT, wanted[SPLIT])


def _sweep(folder: Path) -> None:
    """Remove what an interruption left half-written."""
    for leftover in folder.glob(".*"):
        shutil.rmtree(leftover, ignore_errors=True)


def _finish(home: Path, split: Split, settings: Settings, made: Mapping[str, _Made]) -> None:
    """Write what is there once, the sums last."""
    known = {body: one.body for body, one in made.items()}
    write_atomic(home / ROBOTS, records_text(split, known))
    write_atomic(home / TOKENS, tokens_npz(split, known))
    write_atomic(home / README, readme_text(split, settings))
    single = (README, ROBOTS, SETTINGS, SPLIT, TOKENS)
    sums = {name: hashlib.sha256((home / name).read_bytes()).hexdigest() for name in single}
    paths = body_paths(split)
    for body, one in made.items():
        sums |= {f"{paths[body]}/{name}": value for name, value in one.hashes.items()}
    write_atomic(home / SUMS, sums_text(sums))


@contextmanager
def _writing(home: Path) -> Iterator[None]:
    """Say in one line that a folder cannot be written."""
    try:
        yield
    except OSError as error:
        place = error.filename or home
        raise BenchmarkError(f"cannot write {place}: {error.strerror}") from error
