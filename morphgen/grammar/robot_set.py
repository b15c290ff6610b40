"""A set of robots on disk: drawn in parallel, resumed after any interruption, the same bytes.

    <set>/set.json          grammar, seed, conditions, format
    <set>/grammar.grammar   the grammar with its includes, as one text
    <set>/<name>-000017/    a bundle, or with ``light`` its URDF and derivation only
    <set>/index.jsonl       a line a robot, by number

While a run lasts, what is done stands in ``.journal.jsonl``.
"""

from __future__ import annotations

import json
import math
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from morphgen.errors import FormatError
from morphgen.formats.bundle import URDF, write_bundle
from morphgen.formats.data_files import read_json, read_text
from morphgen.formats.files import locked_folder, partial_path, replacing_folder, write_atomic
from morphgen.formats.resolve import portable_uri
from morphgen.formats.rounding import round_number
from morphgen.formats.urdf_text import urdf_text
from morphgen.grammar.grammar_file import Grammar, grammar_from_text
from morphgen.grammar.library import Library, default_library
from morphgen.grammar.limits import MAX_TEXT
from morphgen.grammar.sampling import Sample, sample_robot
from morphgen.grammar.syntax import parse_condition
from morphgen.model.robot import Robot

INDEX = "index.jsonl"
SETTINGS = "set.json"
GRAMMAR = "grammar.grammar"
DERIVATION = "derivation.txt"
JOURNAL = ".journal.jsonl"

Record = dict[str, Any]
"""A line of the index."""
SetWorker = Callable[["SetConfig", Sequence[int]], Iterator[Record]]
"""Makes the robots of the given numbers, in any order."""


@dataclass(frozen=True)
class SetConfig:
    """Everything that a worker needs to make the robots of a set; plain data."""

    folder: Path
    grammar_name: str
    grammar_text: str
    seed: int
    where: tuple[str, ...]
    light: bool
    picture: bool
    library: tuple[Path, ...]
    """The user's folders of parts."""

    def settings(self) -> Record:
        """What ``set.json`` holds: a set is only continued with the same."""
        return {
            "format": 1,
            "grammar": self.grammar_name,
            "seed": self.seed,
            "where": list(self.where),
            "light": self.light,
        }


@dataclass(frozen=True)
class SetReport:
    """What a run did."""

    made: int
    kept: int
    """Robots that were there already."""
    rejected: dict[str, int]
    """Draws that were thrown away over the whole set, by the reason."""
    duplicates: list[tuple[str, str]]
    """Robots with the same body as an earlier one: (name, name of the earlier)."""


def make_set(
    plan: SetConfig, n: int, work: SetWorker, progress: Callable[[int], None] = lambda done: None
) -> SetReport:
    """Make robots 0 to n - 1 of a set, but for those that are there.

    Args:
        plan: The set.
        n: How many robots it shall hold.
        work: Makes robots, such as ``make_serially``.
        progress: Told how many are done, again and again.

    Raises:
        FormatError: If the folder holds a set made otherwise, or something else, or cannot be
            written.
        SamplingError: If a robot's conditions cannot be met.
    """
    _prepare(plan)
    with locked_folder(plan.folder):
        done = _finished(plan)
        missing = [i for i in range(n) if i not in done]
        progress(n - len(missing))
        with (plan.folder / JOURNAL).open("a", encoding="utf-8") as journal:
            journal.write("\n")  # ends a line that an interruption cut short
            for made, record in enumerate(work(plan, missing), 1):
                journal.write(json.dumps(record) + "\n")
                journal.flush()
                progress(n - len(missing) + made)
        report = _write_index(plan, len(missing), len(done))
        (plan.folder / JOURNAL).unlink()
    return report


def make_serially(plan: SetConfig, indices: Sequence[int]) -> Iterator[Record]:
    """Make robots one after the other in this process."""
    maker = RobotMaker(plan)
    for index in indices:
        yield maker.make(index)


class RobotMaker:
    """Draws and writes robots of a set."""

    def __init__(self, plan: SetConfig) -> None:
        self._plan = plan
        self._library: Library = default_library(plan.library)
        self._grammar: Grammar = grammar_from_text(plan.grammar_text, plan.grammar_name)
        self._where = [parse_condition(text) for text in plan.where]

    def make(self, index: int) -> Record:
        """Draw and write one robot; return its line of the index."""
        plan = self._plan
        drawn = sample_robot(self._grammar, self._library, index, seed=plan.seed, where=self._where)
        folder = plan.folder / drawn.robot.name
        if plan.light:
            _write_light(drawn, folder)
        else:
            write_bundle(drawn.robot, folder, drawn.findings, picture=plan.picture)
        return _record(drawn)

    def make_all(self, indices: Sequence[int]) -> list[Record]:
        """Draw and write several robots."""
        return [self.make(index) for index in indices]


def read_index(folder: Path) -> list[Record]:
    """The index of a set.

    Raises:
        FormatError: If the folder is no finished set, or a line of the index is none.
    """
    path = folder / INDEX
    if not path.is_file():
        raise FormatError(f"{folder} is no finished set: it has no {INDEX}")
    records = []
    with path.open("rb") as lines:
        for i, line in enumerate(lines, 1):
            record = _record_in(line)
            if record is None:
                raise FormatError(f"{path}:{i}: not a line of an index of morphgen sample")
            records.append(record)
    return records


def read_settings(folder: Path) -> Record:
    """What a set was made with: its ``set.json``.

    Raises:
        FormatError: If it is missing or invalid.
    """
    path = folder / SETTINGS
    try:
        settings = read_json(path)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from error
    if not isinstance(settings, dict) or not isinstance(settings.get("grammar"), str):
        raise FormatError(f"{path}: expected the settings of a set, with the name of its grammar")
    return settings


def _record_in(line: bytes) -> Record | None:
    """The record of a line; None if the line is cut short or is no record."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    kinds = {"index": int, "name": str, "hash": str, "rejected": dict, "choices": dict}
    if not isinstance(record, dict) or any(
        not isinstance(record.get(key), kind) for key, kind in kinds.items()
    ):
        return None
    numbers = (*record["rejected"].values(), *record["choices"].values())
    if not all(isinstance(number, int | float) and math.isfinite(number) for number in numbers):
        return None
    leads_out = record["name"] in ("", ".", "..") or set(record["name"]) & {"/", "\0"}
    return None if leads_out else record


def _record(drawn: Sample) -> Record:
    robot = drawn.robot
    return {
        "index": drawn.index,
        "name": robot.name,
        "hash": drawn.derivation.digest,
        "derivation": str(drawn.derivation),
        "dof": robot.dof,
        "links": len(robot.links),
        "movable": len(robot.movable_joints),
        "reach": round_number(drawn.properties.reach),
        "mass": round_number(robot.mass),
        "findings": sorted({finding.code for finding in drawn.findings}),
        "rejected": dict(sorted(drawn.rejected.items())),
        "choices": {key: round_number(value) for key, value in drawn.choices.items()},
    }


def _write_light(drawn: Sample, folder: Path) -> None:
    with replacing_folder(folder) as partial:
        (partial / URDF).write_text(light_urdf(drawn.robot), encoding="utf-8")
        (partial / DERIVATION).write_text(f"{drawn.derivation}\n", encoding="utf-8")


def light_urdf(robot: Robot) -> str:
    """URDF without a bundle: meshes are named where their data package has them."""
    return urdf_text(robot, lambda mesh: portable_uri(mesh.path))


def _prepare(plan: SetConfig) -> None:
    """Make the folder, or see that it holds the same set."""
    path = plan.folder / SETTINGS
    wanted = plan.settings()
    if not path.exists():
        if plan.folder.exists() and not _is_barely_begun(plan):
            raise FormatError(f"{plan.folder} exists and is no set (no {SETTINGS}); name another")
        try:
            plan.folder.mkdir(parents=True, exist_ok=True)
            write_atomic(plan.folder / GRAMMAR, plan.grammar_text)
            write_atomic(path, json.dumps(wanted, indent=2) + "\n")
        except OSError as error:
            raise FormatError(f"cannot write to {plan.folder}: {error.strerror}") from error
        return
    found = read_settings(plan.folder)
    for key, value in wanted.items():
        if found.get(key) != value:
            raise FormatError(
                f"{plan.folder} holds another set: its {key} is {found.get(key)!r}, not {value!r}; "
                "name another folder"
            )
    if read_text(plan.folder / GRAMMAR, MAX_TEXT) != plan.grammar_text:
        raise FormatError(f"{plan.folder} holds a set of another grammar; name another folder")


def _is_barely_begun(plan: SetConfig) -> bool:
    """Whether a folder is empty, or what a run left that was interrupted before it made a set."""
    grammar = plan.folder / GRAMMAR
    own = {partial_path(grammar), partial_path(plan.folder / SETTINGS)}
    if grammar.is_file() and grammar.read_bytes() == plan.grammar_text.encode():
        own.add(grammar)
    return plan.folder.is_dir() and own >= set(plan.folder.iterdir())


def _finished(plan: SetConfig) -> dict[int, tuple[Path, int]]:
    """Where the records of the robots that are there stand: file and offset, by number.

    A line cut short by an interruption counts for nothing. Records themselves stay on disk, so that
    the size of a set is not bounded by memory.
    """
    places = {}
    for path in (plan.folder / INDEX, plan.folder / JOURNAL):
        if not path.is_file():
            continue
        offset = 0
        with path.open("rb") as lines:
            for line in lines:
                record = _record_in(line)
                if record and (plan.folder / record["name"] / URDF).is_file():
                    places[record["index"]] = (path, offset)
                offset += len(line)
    for leftover in plan.folder.glob(".*.*"):
        if leftover.is_dir():
            shutil.rmtree(leftover, ignore_errors=True)
    return places


def _write_index(plan: SetConfig, made: int, kept: int) -> SetReport:
    """Write all records in order of their numbers, and sum them up."""
    rejected: Counter[str] = Counter()
    first: dict[str, str] = {}
    duplicates = []
    partial = partial_path(plan.folder / INDEX)
    places = _finished(plan)
    with ExitStack() as stack:
        sources = {path for path, _ in places.values()}
        files = {path: stack.enter_context(path.open("rb")) for path in sources}
        index = stack.enter_context(partial.open("wb"))
        for number in sorted(places):
            path, offset = places[number]
            files[path].seek(offset)
            line = files[path].readline()
            index.write(line)
            record = json.loads(line)
            rejected.update(record["rejected"])
            earlier = first.setdefault(record["hash"], record["name"])
            if earlier != record["name"]:
                duplicates.append((record["name"], earlier))
    partial.replace(plan.folder / INDEX)
    return SetReport(made, kept, dict(rejected), duplicates)
