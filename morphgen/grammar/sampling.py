"""Draw robots from a grammar; the same seed gives the same robots.

A set of robots is a folder:

    <set>/set.json          grammar, seed, conditions, format
    <set>/grammar.grammar   the grammar with its includes, as one text
    <set>/<name>-000017/    a bundle, or in a ``light`` set only its URDF and derivation
    <set>/index.jsonl       one line per robot, in order

A set has the same bytes however often it was interrupted and however many processes made it. During
a run, the records of finished robots are in ``.journal.jsonl``.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from morphgen.checks import check
from morphgen.errors import FormatError, MorphgenError
from morphgen.files import write_atomic
from morphgen.formats.bundle import URDF, write_bundle
from morphgen.formats.data_files import read_json, read_text
from morphgen.formats.files import begin_folder, locked_folder, naming, replacing_folder
from morphgen.formats.fits import with_stored_fits
from morphgen.formats.records import FiniteNumber
from morphgen.formats.resolve import portable_uri
from morphgen.formats.rounding import round_number
from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar.compose import MAX_HOME_OVERLAP, join, survey_contacts
from morphgen.grammar.derive import Choices, RandomChooser, TooManyPartsError, derive
from morphgen.grammar.grammar_file import Grammar, grammar_from_text
from morphgen.grammar.library import Library, default_library
from morphgen.grammar.syntax import MAX_PARTS, MAX_TEXT, Derivation, Expression, parse_condition
from morphgen.grammar.values import RobotProperties, clauses, holds
from morphgen.model.findings import Finding
from morphgen.model.robot import Robot
from morphgen.processes import parallel_map
from morphgen.progress import own_progress

MAX_ATTEMPTS = 500  # draws for one robot before its conditions are considered unsatisfiable
TOO_LARGE = f"more than {MAX_PARTS} parts"
"""Reason for rejecting a draw whose recursion exceeds the part limit."""


class SamplingError(MorphgenError):
    """No valid robot was found within ``MAX_ATTEMPTS`` draws."""


@dataclass(frozen=True)
class Sample:
    """A robot drawn from a grammar."""

    index: int
    robot: Robot
    properties: RobotProperties
    findings: tuple[Finding, ...]  # findings of `morphgen.checks.check`; only of severity `info`
    derivation: Derivation
    choices: Choices  # every random choice by its key, such as `robot/1.plane.size`
    rejected: Mapping[str, int]  # number of rejected draws before this robot, by reason


def sample_robots(
    grammar: Grammar, library: Library, n: int, *, seed: int = 0, where: Sequence[Expression] = ()
) -> Iterator[Sample]:
    """Draw robots; generator i is child i of ``SeedSequence(seed)``, whatever n."""
    for index in range(n):
        yield sample_robot(grammar, library, index, seed=seed, where=where)


def sample_robot(
    grammar: Grammar,
    library: Library,
    index: int,
    *,
    seed: int = 0,
    where: Sequence[Expression] = (),
    name: str | None = None,
) -> Sample:
    """Draw robot number ``index`` of a seed; see ``sample_robots``."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
    conditions = [
        clause for condition in (*grammar.wheres, *where) for clause in clauses(condition)
    ]
    name = name or f"{grammar.name}-{index:06d}"
    rejected: Counter[str] = Counter()
    for _ in range(MAX_ATTEMPTS):
        chooser = RandomChooser(rng)
        try:
            derivation = derive(grammar, library, chooser)
        except TooManyPartsError:
            rejected[TOO_LARGE] += 1
            continue
        result = _build_if_valid(derivation, library, conditions, name, chooser.choices)
        if not isinstance(result, str):
            return Sample(index, *result, derivation, chooser.choices, dict(rejected))
        rejected[result] += 1
    reason, times = rejected.most_common(1)[0]
    raise SamplingError(
        f"robot {index} of {grammar.name!r}: 0 of {MAX_ATTEMPTS} draws were accepted; "
        f"{times} failed at: {reason}"
    )


def _build_if_valid(
    derivation: Derivation,
    library: Library,
    conditions: Sequence[Expression],
    name: str,
    choices: Choices,
) -> tuple[Robot, RobotProperties, tuple[Finding, ...]] | str:
    """Compose a robot; return the reason as text if it breaks a condition or fails a check."""
    robot = join(derivation, library, name)
    provenance = {**robot.provenance, "choices": {k: round_number(v) for k, v in choices.items()}}
    robot = replace(robot, provenance=provenance)
    properties = RobotProperties(robot)
    # Cheap tests first: conditions, then overlaps at home, then all checks.
    for condition in conditions:
        if not holds(condition, properties):
            return f"where {condition}"
    contacts = survey_contacts(robot, derivation, library)
    if any(depth > MAX_HOME_OVERLAP for depth in contacts.home_penetrations.values()):
        return "links overlap at home"
    robot = with_stored_fits(replace(robot, ignore_pairs=contacts.ignore_pairs), library.folders)
    findings = check(robot, home_tested=True)
    for finding in findings:
        if finding.severity != "info":
            return f"check {finding.code}, {finding.where}"
    return robot, properties, findings


INDEX = "index.jsonl"
SETTINGS = "set.json"
GRAMMAR = "grammar.grammar"
DERIVATION = "derivation.txt"
JOURNAL = ".journal.jsonl"

Record = dict[str, Any]  # a line of the index


@dataclass(frozen=True)
class SetConfig:
    """Everything that a worker needs to make the robots of a set; plain data."""

    folder: Path
    grammar_name: str
    grammar_text: str
    seed: int
    where: tuple[str, ...]  # conditions in addition to the grammar's own
    light: bool  # whether to write only the URDF and the derivation of a robot
    picture: bool  # whether to render `preview.png`
    library: tuple[Path, ...]  # folders of a user's own parts

    def settings(self) -> Record:
        """Return the content of ``set.json``; a set is only continued with equal settings."""
        return {
            "format": 1,
            "grammar": self.grammar_name,
            "seed": self.seed,
            "where": list(self.where),
            "light": self.light,
        }


@dataclass(frozen=True)
class SetReport:
    """Result of ``make_set``."""

    made: int  # robots made by this run
    kept: int  # robots that existed before
    distinct: int  # different robots of the whole set
    rejected: dict[str, int]  # number of rejected draws of the whole set, by reason


def make_set(config: SetConfig, n: int, jobs: int = 1) -> SetReport:
    """Make the robots 0 to n - 1 of a set, except those that exist, in ``jobs`` processes.

    A set that fails before its first robot is deleted: its folder may hold the set of a corrected
    grammar.
    """
    folders = (config.folder, *config.folder.parents)
    new_folders = [folder for folder in folders if not folder.exists()]
    first = {GRAMMAR: config.grammar_text}
    begin_folder(config.folder / SETTINGS, config.settings(), "set", first=first)
    _require_same_grammar(config)
    try:
        return _make_robots(config, n, jobs)
    except MorphgenError:
        for folder in new_folders:
            with suppress(OSError):  # it has robots
                folder.rmdir()
        raise


def _make_robots(config: SetConfig, n: int, jobs: int) -> SetReport:
    with locked_folder(config.folder), own_progress() as show:
        finished = _finished(config)
        missing = [i for i in range(n) if i not in finished]
        show(n - len(missing), n)
        path = config.folder / JOURNAL
        try:
            with naming(path), path.open("a", encoding="utf-8") as journal:
                journal.write("\n")  # ends a line that an interruption cut short
                records = parallel_map(RobotMaker(config).make, missing, jobs)
                for made, record in enumerate(records, 1):
                    journal.write(json.dumps(record) + "\n")
                    journal.flush()  # a killed run keeps what it has made
                    show(n - len(missing) + made, n)
        except MorphgenError:
            if not _finished(config):
                for name in (JOURNAL, INDEX, SETTINGS, GRAMMAR):
                    (config.folder / name).unlink(missing_ok=True)
            raise
        report = _write_index(config, len(missing), len(finished))
        path.unlink()
    return report


class RobotMaker:
    """Draws and writes robots of a set; every process that it is sent to loads the parts once."""

    def __init__(self, config: SetConfig) -> None:
        self._config = config

    @cached_property
    def _inputs(self) -> tuple[Grammar, Library, list[Expression]]:
        config = self._config
        grammar = grammar_from_text(config.grammar_text, config.grammar_name)
        return grammar, default_library(config.library), list(map(parse_condition, config.where))

    def make(self, index: int) -> Record:
        """Draw and write one robot; return its line of the index."""
        config, (grammar, library, where) = self._config, self._inputs
        sample = sample_robot(grammar, library, index, seed=config.seed, where=where)
        folder = config.folder / sample.robot.name
        if config.light:
            write_light(sample.robot, folder)
        else:
            write_bundle(sample.robot, folder, sample.findings, picture=config.picture)
        return _record(sample)


def read_index(folder: Path) -> list[Record]:
    """Return the index of a set."""
    path = folder / INDEX
    if not path.is_file():
        raise FormatError(f"{folder} is not a finished set: it has no {INDEX}")
    records = []
    with path.open("rb") as lines:
        for i, line in enumerate(lines, 1):
            record = _parse_record(line)
            if record is None:
                raise FormatError(f"{path}:{i}: not a line of an index of morphgen sample")
            records.append(record)
    return records


def read_settings(folder: Path) -> Record:
    """Return the settings of a set, the content of its ``set.json``."""
    path = folder / SETTINGS
    settings = read_json(path)
    if not isinstance(settings, dict) or not isinstance(settings.get("grammar"), str):
        raise FormatError(f"{path}: expected the settings of a set, with the name of its grammar")
    where = settings.get("where")
    if not isinstance(where, list) or not all(isinstance(text, str) for text in where):
        raise FormatError(f"{path}: where: expected a list of conditions, not {where!r}")
    return settings


def _parse_record(line: bytes) -> Record | None:
    """Return the record of a line; None if the line is cut short or invalid."""
    try:
        checked = msgspec.json.decode(line, type=_IndexLine)
    except (msgspec.MsgspecError, RecursionError):
        return None
    # The name is a folder in the set's folder; it must not lead out of it.
    if checked.name in ("", ".", "..") or set(checked.name) & {"/", "\0"}:
        return None
    record: Record = json.loads(line)
    return record


class _IndexLine(msgspec.Struct):
    """The keys of a line that are read; there are more."""

    index: int
    name: str
    hash: str
    rejected: dict[str, FiniteNumber]
    choices: dict[str, FiniteNumber]


def _record(sample: Sample) -> Record:
    robot = sample.robot
    return {
        "index": sample.index,
        "name": robot.name,
        "hash": sample.derivation.digest,
        "derivation": str(sample.derivation),
        "dof": robot.dof,
        "links": len(robot.links),
        "movable": len(robot.movable_joints),
        "reach": round_number(sample.properties.reach),
        "mass": round_number(robot.mass),
        "findings": sorted({finding.code for finding in sample.findings}),
        "rejected": dict(sorted(sample.rejected.items())),
        "choices": {key: round_number(value) for key, value in sample.choices.items()},
    }


def write_light(robot: Robot, folder: Path) -> None:
    """Write a robot's URDF, whose meshes are those of their data packages, and its derivation."""
    with replacing_folder(folder) as partial:
        urdf = urdf_text(robot, lambda mesh: portable_uri(mesh.path))
        (partial / URDF).write_text(urdf, encoding="utf-8")
        text = f"{robot.provenance['derivation']}\n"
        (partial / DERIVATION).write_text(text, encoding="utf-8")


def _require_same_grammar(config: SetConfig) -> None:
    """Require the text of the grammar that the set was begun with."""
    if read_text(config.folder / GRAMMAR, MAX_TEXT) != config.grammar_text:
        raise FormatError(
            f"{config.folder} holds a set of another grammar {config.grammar_name!r}, that of its "
            f"{GRAMMAR}; name another folder, or delete this one"
        )


def _finished(config: SetConfig) -> dict[int, bytes]:
    """Return the records' lines of finished robots by index; delete folders that are partial."""
    finished = {}
    for path in (config.folder / INDEX, config.folder / JOURNAL):
        if path.is_file():
            with path.open("rb") as lines:
                for line in lines:
                    record = _parse_record(line)
                    if record and (config.folder / record["name"] / URDF).is_file():
                        finished[record["index"]] = line
    for leftover in config.folder.glob(".*.*"):
        if leftover.is_dir():
            shutil.rmtree(leftover, ignore_errors=True)
    return finished


def _write_index(config: SetConfig, made: int, kept: int) -> SetReport:
    """Write all records in order of their indices, and summarize them."""
    rejected: Counter[str] = Counter()
    lines = [line for _, line in sorted(_finished(config).items())]
    write_atomic(config.folder / INDEX, b"".join(lines))
    hashes = set()
    for line in lines:
        record = json.loads(line)
        rejected.update(record["rejected"])
        hashes.add(record["hash"])
    return SetReport(made, kept, len(hashes), dict(rejected))
