"""Build a split folder: write a split and all its robots; see ``split_folder`` for the layout."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from morphgen.benchmark.split import Member, Split, compose_member
from morphgen.benchmark.split_file import split_text
from morphgen.benchmark.split_folder import (
    BUILD_FILE,
    BUNDLED,
    README_FILE,
    ROBOTS_DIR,
    ROBOTS_FILE,
    SPLIT_FILE,
    SUMS_FILE,
    TOKENS_FILE,
    BuildSettings,
    RobotData,
    differences,
    is_current,
    readme_text,
    records_text,
    robot_data,
    robot_paths,
    settings_text,
    sums_text,
    tokens_npz,
    unique_robots,
    write_robot,
)
from morphgen.benchmark.tokens import require_max_links
from morphgen.errors import BenchmarkError
from morphgen.formats.bundle import bundle_folder
from morphgen.formats.data_files import read_json
from morphgen.formats.files import (
    file_sha256,
    folder_hashes,
    locked_folder,
    partial_path,
    write_atomic,
)
from morphgen.grammar.library import Library
from morphgen.processes import parallel_map


@dataclass(frozen=True)
class BuildReport:
    """Result of a build."""

    folder: Path
    num_written: int
    """Number of robots that were written."""
    num_kept: int
    """Number of robots that an earlier build had written."""


def build_split(
    split: Split,
    folder: Path,
    library: Library,
    *,
    jobs: int = 1,
    settings: BuildSettings = BUNDLED,
) -> BuildReport:
    """Write a split and all its robots to ``folder / split.name``.

    Robots that an interrupted build has written are kept if they are correct. The same split gives
    the same bytes.
    """
    split_folder = split_folder_path(split, folder)
    members = unique_robots(split)
    with _writing(split_folder), _removed_if_empty(split_folder):
        _prepare(split_folder, split, settings)
        with locked_folder(split_folder):
            (split_folder / SUMS_FILE).unlink(missing_ok=True)
            for leftover in (split_folder / ROBOTS_DIR).glob(".*"):  # of an interrupted build
                shutil.rmtree(leftover, ignore_errors=True)
            writer = _RobotWriter(library.folders, split_folder, settings, split.max_links)
            results = parallel_map(writer, members, jobs)
            robots = {member.robot_hash: r for member, r in zip(members, results, strict=True)}
            _finish(split_folder, split, settings, robots)
    num_written = sum(robot.is_new for robot in robots.values())
    return BuildReport(split_folder, num_written, len(robots) - num_written)


def split_folder_path(split: Split, folder: Path) -> Path:
    """Return the folder of a split in a parent folder."""
    for name in split.name.split("/"):
        folder = bundle_folder(folder, name)
    return folder


@dataclass(frozen=True, eq=False)
class _WrittenRobot:
    """A robot that was written or kept."""

    is_new: bool
    data: RobotData
    hashes: dict[str, str]


@dataclass(frozen=True, eq=False)
class _RobotWriter:
    """Write the folder of a member; sent to worker processes."""

    folders: tuple[Path, ...]
    split_folder: Path
    settings: BuildSettings
    max_links: int

    @cached_property
    def library(self) -> Library:
        return Library(self.folders)

    def __call__(self, member: Member) -> _WrittenRobot:
        robot = compose_member(member, self.library)
        require_max_links(len(robot.links), f"robot {member.name!r}", self.max_links)
        folder = bundle_folder(self.split_folder / ROBOTS_DIR, member.name)
        light, picture = self.settings.light, self.settings.picture
        is_kept = not differences(folder, robot, light=light) and is_current(
            folder, light=light, picture=picture
        )
        if not is_kept:
            write_robot(robot, folder, light=light, picture=picture)
        return _WrittenRobot(
            not is_kept, robot_data(robot, self.folders, self.max_links), folder_hashes(folder)
        )


def _prepare(split_folder: Path, split: Split, settings: BuildSettings) -> None:
    """Create the folder, or check that it has the same split with the same settings."""
    texts = {BUILD_FILE: settings_text(split, settings), SPLIT_FILE: split_text(split)}
    if not (split_folder / BUILD_FILE).is_file():
        leftover = {partial_path(split_folder / BUILD_FILE)}
        if split_folder.exists() and not (
            split_folder.is_dir() and leftover >= set(split_folder.iterdir())
        ):
            raise BenchmarkError(
                f"{split_folder} exists and is no built split (no {BUILD_FILE}); name another "
                "folder"
            )
        split_folder.mkdir(parents=True, exist_ok=True)
        write_atomic(split_folder / BUILD_FILE, texts[BUILD_FILE])
    existing = read_json(split_folder / BUILD_FILE)
    if not isinstance(existing, dict):
        raise BenchmarkError(
            f"{split_folder / BUILD_FILE}: expected an object, not {type(existing).__name__}"
        )
    for key, value in json.loads(texts[BUILD_FILE]).items():
        if existing.get(key) != value:
            raise BenchmarkError(
                f"{split_folder} holds another build: its {key} is {existing.get(key)!r}, not "
                f"{value!r}; name another folder"
            )
    write_atomic(split_folder / SPLIT_FILE, texts[SPLIT_FILE])


def _finish(
    split_folder: Path, split: Split, settings: BuildSettings, robots: Mapping[str, _WrittenRobot]
) -> None:
    """Write the files of the whole split, the hashes last."""
    known = {robot_hash: robot.data for robot_hash, robot in robots.items()}
    write_atomic(split_folder / ROBOTS_FILE, records_text(split, known))
    write_atomic(split_folder / TOKENS_FILE, tokens_npz(split, known))
    write_atomic(split_folder / README_FILE, readme_text(split, settings))
    single = (README_FILE, ROBOTS_FILE, BUILD_FILE, SPLIT_FILE, TOKENS_FILE)
    sums = {name: file_sha256(split_folder / name) for name in single}
    paths = robot_paths(split)
    for robot_hash, robot in robots.items():
        sums |= {f"{paths[robot_hash]}/{name}": value for name, value in robot.hashes.items()}
    write_atomic(split_folder / SUMS_FILE, sums_text(sums))


@contextmanager
def _removed_if_empty(split_folder: Path) -> Iterator[None]:
    """If a new folder gets no robot, delete it: it would block a build of the corrected split."""
    is_new = not split_folder.exists()
    try:
        yield
    except BaseException:
        robots = split_folder / ROBOTS_DIR
        if is_new and not any(path.name[0] != "." for path in robots.glob("*")):
            shutil.rmtree(split_folder, ignore_errors=True)
        raise


@contextmanager
def _writing(split_folder: Path) -> Iterator[None]:
    """Convert an ``OSError`` to an error of one line."""
    try:
        yield
    except OSError as error:
        path = error.filename or split_folder
        raise BenchmarkError(f"cannot write {path}: {error.strerror}") from error
