"""Build, read and compare split folders: a split with the files of all its robots.

split.yaml         the split
robots.jsonl       one line per robot, train robots first
tokens.npz         tokens (n, max_links, 48), mask (n, max_links), names (n,), in the same order
robots/<name>/     a bundle: robot.urdf, robot.xml, meshes/, card.json; members with the same robot
                   share one
README.md          description of the files
build.json         settings of the build
SHA256SUMS         hashes of all these files, written last, for ``sha256sum -c``
"""

from __future__ import annotations

import io
import json
import math
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from string import Template
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark import read_text as package_text
from morphgen.benchmark.survey import SurveyedRobot, measure_robot
from morphgen.checks import check
from morphgen.encoding import tokens as encoding
from morphgen.errors import BenchmarkError, FormatError, MorphgenError
from morphgen.files import file_sha256, write_atomic
from morphgen.formats import bundle, records
from morphgen.formats.data_files import parse_json, read_json, read_text
from morphgen.formats.files import begin_folder, folder_hashes, locked_folder
from morphgen.formats.urdf.write import urdf_text
from morphgen.formats.zip_files import read_npz
from morphgen.grammar.library import Library
from morphgen.model.robot import Robot
from morphgen.processes import parallel_map
from morphgen.splits.split import (
    SIDES,
    Member,
    Split,
    compose_member,
    read_split,
    sided_members,
    split_id,
    split_text,
)
from morphgen.typing import Array

SPLIT_FILE = "split.yaml"
ROBOTS_FILE = "robots.jsonl"
TOKENS_FILE = "tokens.npz"
ROBOTS_DIR = "robots"
README_FILE = "README.md"
BUILD_FILE = "build.json"
SUMS_FILE = "SHA256SUMS"
ARCHIVE_SUFFIX = ".zip"  # suffix of the archive of a release, see `morphgen.benchmark.release`

_SUM = re.compile(r"([0-9a-f]{64})  (.+)")

Record = dict[str, Any]  # a line of `robots.jsonl`


def require_split_folder(folder: Path) -> None:
    """Check that a folder is a finished split folder."""
    if not folder.is_dir():
        raise BenchmarkError(f"{folder}: no such folder")
    if not (folder / BUILD_FILE).is_file():
        # A build is at most three folders deep; a search of all would take long in a large folder.
        depths = ("*", "*/*", "*/*/*")
        inside = sorted(path.parent for n in depths for path in folder.glob(f"{n}/{BUILD_FILE}"))
        hint = f"; did you mean {inside[0]}?" if inside else "; morphgen split build makes one"
        raise BenchmarkError(f"{folder} is no built split: it has no {BUILD_FILE}{hint}")
    if not (folder / SUMS_FILE).is_file():
        raise BenchmarkError(f"{folder} is not finished: it has no {SUMS_FILE}; build it again")


def read_records(path: Path) -> list[Record]:
    """Read the lines of ``robots.jsonl``."""
    records = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        record = parse_json(line, f"{path}:{number}")
        if not isinstance(record, dict) or "name" not in record or record.get("side") not in SIDES:
            raise BenchmarkError(f"{path}:{number}: expected an object with a name and a side")
        records.append(record)
    return records


def read_tokens(path: Path) -> tuple[list[str], NDArray[np.float64], NDArray[np.bool_]]:
    """Read names, tokens and mask of ``tokens.npz``."""
    try:
        names, tokens, mask = read_npz(path, ("names", "tokens", "mask")).values()
    except FileNotFoundError as error:
        raise BenchmarkError(f"{path}: no such file") from error
    except ValueError as error:
        raise BenchmarkError(f"{path}: cannot be read: {error}") from error
    types = ", ".join(array.dtype.name for array in (names, tokens, mask))
    if names.dtype.kind != "U" or tokens.dtype != np.float64 or mask.dtype != np.bool_:
        raise BenchmarkError(
            f"{path}: names, tokens and mask are of types {types}; expected str, float64 and bool"
        )
    if (
        names.ndim != 1
        or mask.shape != (len(names), *mask.shape[1:2])
        or tokens.shape != (*mask.shape, encoding.TOKEN_SIZE)
    ):
        shapes = ", ".join(str(array.shape) for array in (names, tokens, mask))
        raise BenchmarkError(f"{path}: names, tokens and mask are of shapes {shapes}")
    return names.tolist(), tokens, mask


def read_sums(path: Path) -> dict[str, str]:
    """Read SHA-256 hashes by path, as ``sha256sum`` writes them."""
    sums = {}
    for number, line in enumerate(read_text(path).splitlines(), 1):
        match = _SUM.fullmatch(line)
        if not match:
            raise BenchmarkError(f"{path}:{number}: expected a hash, two spaces and a path")
        sums[match[2]] = match[1]
    return sums


class _Settings(records.Record, frozen=True):
    """The content of ``build.json``; a build is continued only with the same."""

    format: Literal[1]
    split: str  # id of the split
    light: Literal[False] = False  # versions until 0.3 had builds without bundles
    picture: bool = False  # and those with pictures


def read_settings(path: Path) -> _Settings:
    """Read ``build.json``."""
    return records.read_record(read_json(path), _Settings, str(path), BenchmarkError)


def unique_robots(split: Split) -> list[Member]:
    """Return the first member of each robot, train first; its name is that of the folder."""
    firsts: dict[str, Member] = {}
    hash_by_name: dict[str, str] = {}
    for _, member in sided_members(split):
        firsts.setdefault(member.robot_hash, member)
        if hash_by_name.setdefault(member.name, member.robot_hash) != member.robot_hash:
            raise BenchmarkError(
                f"split {split.name!r}: a train and a test robot of different bodies are both "
                f"named {member.name!r}; rename one"
            )
    return list(firsts.values())


def robot_paths(split: Split) -> dict[str, str]:
    """Return the path of each robot's folder in the split folder, by the robot's hash."""
    return {member.robot_hash: f"{ROBOTS_DIR}/{member.name}" for member in unique_robots(split)}


def robot_records(split: Split, known: Mapping[str, SurveyedRobot]) -> list[Record]:
    """Return the lines of ``robots.jsonl``, given the robots by their hashes."""
    paths = robot_paths(split)
    return [
        {
            "name": member.name,
            "side": side,
            "task": member.task,
            "obstacles": member.obstacles,
            "category": member.category,
            "derivation": member.derivation,
            "hash": member.robot_hash,
            **vars(known[member.robot_hash].stats),
            "path": paths[member.robot_hash],
        }
        for side, member in sided_members(split)
    ]


def token_tables(
    split: Split, known: Mapping[str, SurveyedRobot]
) -> tuple[Array, NDArray[np.bool_]]:
    """Return tokens (n, max_links, 48) and mask (n, max_links) of all members."""
    tables = [known[member.robot_hash].tokens for _, member in sided_members(split)]
    padded = [encoding.pad_tokens(table, split.max_links) for table in tables]
    return np.array([table for table, _ in padded]), np.array([mask for _, mask in padded])


def tokens_npz(split: Split, known: Mapping[str, SurveyedRobot]) -> bytes:
    """Return the bytes of ``tokens.npz``."""
    tables, mask = token_tables(split, known)
    content = io.BytesIO()
    np.savez(
        content,
        tokens=tables,
        mask=mask,
        names=np.array([member.name for _, member in sided_members(split)]),
        **encoding.LAYOUT_ARRAYS,
    )
    return content.getvalue()


def readme_text(split: Split) -> str:
    """Return the text of ``README.md``."""
    return Template(package_text("split_readme.md")).substitute(
        name=split.name,
        summary=split.summary or "(no summary)",
        regime=split.regime,
        train=len(split.train),
        test=len(split.test),
        id=split_id(split),
        sums=SUMS_FILE,
    )


def sums_text(sums: Mapping[str, str]) -> str:
    """Return the text of ``SHA256SUMS`` for hexadecimal hashes by path."""
    return "".join(f"{sums[name]}  {name}\n" for name in sorted(sums))


_MESH = re.compile(r'(<mesh filename=")[^"]*"')
_IGNORED_KEYS = {"findings", "versions"}  # keys of a card that are not compared
_REL_TOL, _ABS_TOL = 1e-6, 1e-9
"""Tolerances of the numbers of two cards, which may be rounded on different machines."""


def differences(folder: Path, robot: Robot) -> list[str]:
    """Return the differences between a robot's folder and the robot, one line each.

    The URDF (without the names of meshes) and the card (without findings and versions) are compared
    with the robot, all other files with the hashes on the card.
    """
    if not folder.is_dir():
        return ["its folder is missing"]
    return list(_differences(folder, robot))


def _differences(folder: Path, robot: Robot) -> Iterator[str]:
    try:
        findings = bundle.file_findings(folder)
    except FormatError as error:
        yield str(error)
        return
    yield from (f"{finding.where}: {finding.why}" for finding in findings)
    card = read_json(folder / bundle.CARD)
    if (folder / bundle.URDF).is_file():
        stored_urdf = (folder / bundle.URDF).read_text("utf-8", "replace")
        # Compared without the names of meshes, which depend on where the meshes are stored.
        if _MESH.sub(r'\1"', stored_urdf) != urdf_text(
            bundle.split_colours(robot), lambda mesh: ""
        ):
            yield f"file {bundle.URDF} is not the robot's"
    expected = json.loads(bundle.card_text(bundle.robot_card(robot, (), card["hashes"], {})))
    for key in sorted(expected.keys() - _IGNORED_KEYS):
        if not same(card.get(key), expected[key]):
            yield f"file {bundle.CARD}: its {key!r} is not the robot's"
    yield from _extra(folder, (*card["hashes"], bundle.CARD, bundle.PICTURE))


def _extra(folder: Path, known: Iterable[str]) -> Iterator[str]:
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    yield from (f"file {name} does not belong to it" for name in sorted(names - set(known)))


def same(a: object, b: object) -> bool:
    """Test if two values read from JSON are equal up to rounding."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=_REL_TOL, abs_tol=_ABS_TOL)
    return a == b


@dataclass(frozen=True)
class BuildReport:
    """Result of a build."""

    folder: Path
    num_written: int  # number of robots that were written
    num_kept: int  # number of robots that an earlier build had written


def build_split(
    split: Split,
    folder: Path,
    library: Library,
    *,
    jobs: int = 1,
) -> BuildReport:
    """Write a split and all its robots to ``folder / split.name``, always the same bytes.

    Robots that an interrupted build has written are kept if they are correct.
    """
    split_folder = split_folder_path(split, folder)
    members = unique_robots(split)
    with writing_split(split_folder), _removed_if_empty(split_folder):
        build = _Settings(1, split_id(split))
        path = split_folder / BUILD_FILE
        begin_folder(path, msgspec.to_builtins(build), "built split", BenchmarkError)
        write_atomic(split_folder / SPLIT_FILE, split_text(split))
        with locked_folder(split_folder):
            (split_folder / SUMS_FILE).unlink(missing_ok=True)  # marks the folder as unfinished
            for leftover in (split_folder / ROBOTS_DIR).glob(".*"):  # of an interrupted build
                shutil.rmtree(leftover, ignore_errors=True)
            write = partial(_write_member, library, split_folder, split.max_links)
            results = parallel_map(write, members, jobs)
            robots = {member.robot_hash: r for member, r in zip(members, results, strict=True)}
            _finish(split_folder, split, robots)
    num_written = sum(is_new for is_new, _, _ in robots.values())
    return BuildReport(split_folder, num_written, len(robots) - num_written)


def split_folder_path(split: Split, folder: Path) -> Path:
    """Return the folder of a split in a parent folder."""
    for name in split.name.split("/"):
        folder = bundle.bundle_folder(folder, name)
    return folder


_WrittenRobot = tuple[bool, SurveyedRobot, dict[str, str]]
"""Whether a robot's folder was written, the robot, and the hashes of its files by name."""


def _write_member(
    library: Library, split_folder: Path, max_links: int, member: Member
) -> _WrittenRobot:
    """Write the folder of a member, unless an earlier build has; runs in worker processes."""
    robot = compose_member(member, library)
    encoding.require_max_links(len(robot.links), f"robot {member.name!r}", max_links)
    folder = bundle.bundle_folder(split_folder / ROBOTS_DIR, member.name)
    is_kept = not differences(folder, robot)
    if is_kept:  # and written in the same way by this version
        versions = read_json(folder / bundle.CARD)["versions"]
        has_picture = (folder / bundle.PICTURE).is_file()
        is_kept = versions == {"morphgen": version("morphgen")} and not has_picture
    if not is_kept:
        bundle.write_bundle(robot, folder, check(robot), picture=False, edits_kept=False)
    measured = measure_robot(robot, library, max_links, with_features=False)
    return not is_kept, measured, folder_hashes(folder)


def _finish(split_folder: Path, split: Split, robots: Mapping[str, _WrittenRobot]) -> None:
    """Write the files of the whole split, the hashes last."""
    known = {robot_hash: measured for robot_hash, (_, measured, _) in robots.items()}
    lines = (json.dumps(record, ensure_ascii=False) for record in robot_records(split, known))
    write_atomic(split_folder / ROBOTS_FILE, "".join(f"{line}\n" for line in lines))
    write_atomic(split_folder / TOKENS_FILE, tokens_npz(split, known))
    write_atomic(split_folder / README_FILE, readme_text(split))
    single = (README_FILE, ROBOTS_FILE, BUILD_FILE, SPLIT_FILE, TOKENS_FILE)
    sums = {name: file_sha256(split_folder / name) for name in single}
    paths = robot_paths(split)
    for robot_hash, (_, _, hashes) in robots.items():
        sums |= {f"{paths[robot_hash]}/{name}": value for name, value in hashes.items()}
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
def writing_split(split_folder: Path) -> Iterator[None]:
    """Turn an ``OSError`` into an error that names the file in the folder, if it is known."""
    try:
        yield
    except OSError as error:
        path = error.filename or split_folder
        raise BenchmarkError(f"cannot write {path}: {error.strerror}") from error


def is_archive(path: Path) -> bool:
    """Return whether a path is named as an archive and is not a folder."""
    return path.suffix == ARCHIVE_SUFFIX and not path.is_dir()


def read_split_or_folder(name: str | PathLike[str]) -> tuple[Split, Path | None]:
    """Return a split by its name, its file or its built folder; and that folder."""
    folder = Path(name)
    if is_archive(folder):
        raise BenchmarkError(f"{folder}: the archive of a release; unpack it, and name the folder")
    if not folder.is_dir():
        return read_split(str(name)), None
    require_split_folder(folder)
    return read_split(folder / SPLIT_FILE), folder


FITTED_TOLERANCE = 1e-3
"""Tolerance of what depends on primitives that may be fitted on this machine: the token numbers of
a link's primitive, the reach [m] and similarities."""


@dataclass(frozen=True)
class Difference:
    """One difference between a split and its robots."""

    where: str  # name of the robot, or of a file
    why: str


def require_unchanged(folder: Path, name: str) -> None:
    """Require that the files of a split folder are those that ``SHA256SUMS`` lists."""
    changed = list(_file_differences(folder))
    if changed:
        more = f" (and {len(changed) - 1} more)" if len(changed) > 1 else ""
        first = f"{changed[0].where}: {changed[0].why}"
        raise BenchmarkError(f"{name}: {first}{more}; get it again, or see morphgen split verify")


def compare_robots(split: Split, library: Library, *, jobs: int = 1) -> tuple[Difference, ...]:
    """Compose every robot of a split and compare its hash; see ``verify``."""
    return tuple(_robot_differences(split, _inspect(split, library, None, jobs)))


_Inspection = tuple[list[str], SurveyedRobot | None]
"""The differences of a robot and, in a split folder, the robot."""


def _inspect_member(
    library: Library, max_links: int, folders: Mapping[str, Path] | None, member: Member
) -> _Inspection:
    """Compose a member, and compare it with its folder; runs in worker processes."""
    try:
        robot = compose_member(member, library)
        if folders is None:
            return [], None
        folder = folders[member.robot_hash]
        # Members with the same robot share the folder of the first one, which is compared.
        is_first = folder.name == member.name
        lines = differences(folder, robot) if is_first else []
        return lines, measure_robot(robot, library, max_links, with_features=False)
    except MorphgenError as error:
        return [str(error)], None


def _inspect(
    split: Split, library: Library, folders: Mapping[str, Path] | None, jobs: int
) -> dict[tuple[str, str], _Inspection]:
    """Inspect each different robot once; return the results by derivation and hash.

    ``folders`` are those of the robots in a split folder, by hash.
    """
    members = [member for _, member in reversed(sided_members(split))]  # the first one stays last
    firsts = {(member.derivation, member.robot_hash): member for member in members}
    inspect = partial(_inspect_member, library, split.max_links, folders)
    return dict(zip(firsts, parallel_map(inspect, list(firsts.values()), jobs), strict=True))


def _robot_differences(
    split: Split, inspected: Mapping[tuple[str, str], _Inspection]
) -> Iterator[Difference]:
    for _, member in sided_members(split):
        for why in inspected[member.derivation, member.robot_hash][0]:
            yield Difference(member.name, why)


def compare_folder(folder: Path, split: Split, library: Library, *, jobs: int) -> list[Difference]:
    """Compare a split folder with ``SHA256SUMS`` and its robots."""
    build, found = read_settings(folder / BUILD_FILE), list[Difference]()
    if build.split != split_id(split):
        why = f"it is of split {build.split}, not of {SPLIT_FILE}"
        found.append(Difference(BUILD_FILE, why))
    try:
        paths = robot_paths(split)
    except BenchmarkError as error:
        return [*found, Difference(SPLIT_FILE, str(error))]
    files = list(_file_differences(folder))
    folders = {robot_hash: folder / path for robot_hash, path in paths.items()}
    inspected = _inspect(split, library, folders, jobs)
    # A changed file explains the differences of its robot.
    explained = {difference.where for difference in files}
    robots = _robot_differences(split, inspected)
    found += [*files, *(each for each in robots if each.where not in explained)]
    known = {
        robot_hash: robot for (_, robot_hash), (_, robot) in inspected.items() if robot is not None
    }
    if not known.keys() >= paths.keys():
        return found
    for name, compare in ((ROBOTS_FILE, _record_differences), (TOKENS_FILE, _token_differences)):
        try:
            found += compare(folder / name, split, known)
        except MorphgenError as error:
            found.append(Difference(name, str(error)))
    return found


def _file_differences(folder: Path) -> Iterator[Difference]:
    """Yield files that differ from ``SHA256SUMS``; a file of a robot is listed under its name."""
    expected = read_sums(folder / SUMS_FILE)
    actual = folder_hashes(folder)
    for name in sorted((expected.keys() | actual.keys()) - {SUMS_FILE}):
        if name not in actual:
            why = f"is missing, but {SUMS_FILE} names it"
        elif name not in expected:
            why = f"is not named by {SUMS_FILE}"
        elif actual[name] != expected[name]:
            why = f"is not what {SUMS_FILE} was written for"
        else:
            continue
        parent, _, rest = name.partition("/")
        robot, _, file = rest.partition("/")
        where, path = (robot, file) if parent == ROBOTS_DIR and file else (name, name)
        yield Difference(where, f"file {path} {why}")


def _record_differences(
    path: Path, split: Split, known: Mapping[str, SurveyedRobot]
) -> Iterator[Difference]:
    """Yield entries of ``robots.jsonl`` that differ from the robots."""
    stored, expected = read_records(path), robot_records(split, known)
    if len(stored) != len(expected):
        yield Difference(path.name, f"it has {len(stored)} robots, not {len(expected)}")
        return
    for i, (line, computed) in enumerate(zip(stored, expected, strict=True), 1):
        keys = sorted(line.keys() | computed.keys())
        wrong = [key for key in keys if not same(line.get(key), computed.get(key))]
        for key in wrong:
            why = f"{path.name}:{i}: {key} is {line.get(key)!r}, not {computed.get(key)!r}"
            yield Difference(str(computed["name"]), why)


def _token_differences(
    path: Path, split: Split, known: Mapping[str, SurveyedRobot]
) -> Iterator[Difference]:
    """Yield robots whose rows of ``tokens.npz`` differ from their tokens."""
    names, tokens, mask = read_tokens(path)
    computed, computed_mask = token_tables(split, known)
    expected = [member.name for _, member in sided_members(split)]
    if names != expected or tokens.shape != computed.shape:
        yield Difference(path.name, f"it is not of the {len(expected)} robots of {SPLIT_FILE}")
        return
    # Primitives of meshes are fitted here, in the last bits otherwise than where it was built.
    errors = np.abs(tokens - computed)
    for shape in (encoding.GEOMETRY, encoding.SHAPE_POSE):
        errors[..., shape.columns] *= encoding.TOLERANCE / FITTED_TOLERANCE
    for i, name in enumerate(expected):
        if (mask[i] != computed_mask[i]).any():
            yield Difference(name, f"{path.name}: its mask is not that of its links")
        wrong = ~(errors[i] <= encoding.TOLERANCE)  # NaN is wrong, too
        if wrong.any():
            link, column = np.argwhere(wrong)[0].tolist()
            token_field = next(entry for entry in encoding.LAYOUT if column < entry.columns.stop)
            yield Difference(
                name, f"{path.name}: {token_field.name} of link {link} is not the robot's"
            )
