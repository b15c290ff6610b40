"""New splits of chosen robots, and the survey of a split that its page shows."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import viser

from morphgen.benchmark.audit import Audit, audit_survey
from morphgen.benchmark.survey import (
    Fault,
    SurveyedRobot,
    compare_members,
    different_members,
    summarize_survey,
    survey_robot,
)
from morphgen.encoding.robot_hash import robot_hash
from morphgen.encoding.similarity import MEASURES
from morphgen.errors import BenchmarkError
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.library import Library
from morphgen.splits.split import (
    COMPOSED,
    HOLD_OUT,
    REGIMES,
    Member,
    Regime,
    Side,
    Split,
    sided_members,
)
from morphgen.splits.split_file import require_split_name, write_split
from morphgen.tasks.registry import TASKS
from morphgen.typing import Array
from morphgen.viewer import markup
from morphgen.viewer.app.session import Session
from morphgen.viewer.app.workers import Workers
from morphgen.viewer.robot_rows import Row
from morphgen.viewer.robot_uri import (
    MEMBER,
    FileAccess,
    read_robot_uri,
    resolve_derivation,
    resolve_member,
    shorten,
)

_REGIMES = tuple(regime for regime in REGIMES if regime != HOLD_OUT)
"""Regimes of splits that the viewer saves; it has no controls for what a hold-out split says."""
SPLITS = "splits"  # folder in which new splits are written
MAX_NAME = 200  # longest name of a split [characters]
MAX_ROBOTS = 60  # robots of which every pair is compared; a map of more could not be read


@dataclass(frozen=True, eq=False)
class SplitStudy:
    """Survey of a split's robots."""

    audit: Audit
    statistics: Mapping[str, object]  # statistics by side; empty if a robot cannot be composed
    members: tuple[tuple[Side, Member], ...]  # members that can be composed, train robots first
    matrices: Mapping[str, Array]  # similarity of their pairs by measure, shape (n, n)


def make_member(task: str, obstacles: bool, files: FileAccess, row: Row) -> Member:
    """Return the robot of a row as a member of a split. Runs in a worker."""
    uri = row.uri
    if uri.startswith(MEMBER):
        return replace(resolve_member(uri, files), task=task, obstacles=obstacles)
    robot = read_robot_uri(uri, files)
    derivation = str(resolve_derivation(uri, files) or robot.provenance.get("derivation", ""))
    if not derivation:
        raise BenchmarkError(f"{uri} was imported: a split names robots by their derivations")
    composed = compose(parse_derivation(derivation), files.library, robot.name)
    hash_ = robot_hash(composed)
    return Member(robot.name, row.category or COMPOSED, derivation, task, obstacles, hash_)


def save_split(
    name: str, regime: Regime, train: Sequence[Member], test: Sequence[Member], files: FileAccess
) -> Path:
    """Write a split's file into ``splits/`` of the folder where the viewer was started."""
    require_split_name(name)
    if not train or not test:
        raise BenchmarkError(
            f"{len(train)} train and {len(test)} test robots: at least one of each is needed"
        )
    if len(name) > MAX_NAME:
        raise BenchmarkError(f"name {shorten(name)!r}: at most {MAX_NAME} characters")
    path = files.roots[0] / SPLITS / f"{name}.yaml"
    if path.exists():
        raise BenchmarkError(f"{path} exists; choose another name")
    summary = f"{len(train)} robots to train on, {len(test)} to test on, chosen in the viewer"
    write_split(Split(name, regime, summary, tuple(train), tuple(test)), path)
    return path


def study_split(split: Split, folders: tuple[Path, ...], workers: Workers) -> SplitStudy:
    """Measure and compare a split's robots in worker processes."""
    members = [*split.train, *split.test]
    if len(members) > MAX_ROBOTS:
        raise BenchmarkError(
            f"{len(members)} robots are too many to compare all pairs (at most {MAX_ROBOTS}); "
            "use morphgen split audit and morphgen split stats"
        )
    measure = partial(survey_robot, Library(folders), split.max_links)
    robots = list(workers.map(measure, different_members(split)))
    return workers.call(conclude_study, split, robots, folders)


def conclude_study(
    split: Split, robots: Sequence[SurveyedRobot | Fault], folders: tuple[Path, ...]
) -> SplitStudy:
    """Compare measured robots, audit the split and compute its statistics. Runs in a worker."""
    survey = compare_members(split, robots, all_pairs=True)
    sound = [i for i, each in enumerate(survey.robots) if isinstance(each, SurveyedRobot)]
    members = sided_members(split)
    return SplitStudy(
        audit_survey(survey, Library(folders)),
        summarize_survey(survey) if len(sound) == len(members) else {},
        tuple(members[i] for i in sound),
        {
            name: survey.similarity[np.ix_(sound, sound, [k])][..., 0]
            for k, name in enumerate(MEASURES)
        },
    )


def add_split_form(
    session: Session, choose_sides: Callable[[], tuple[list[Row], list[Row]]]
) -> None:
    """Add controls that save a new split for a task, and show the command that audits it.

    The function returns the robots to train on and those to test on.
    """
    gui = session.client.gui
    with gui.add_folder("New split"):
        name = gui.add_text("split name", "")
        regime = gui.add_dropdown("regime", _REGIMES)
        task = gui.add_dropdown("task", tuple(TASKS))
        obstacles = gui.add_checkbox("obstacles", False)
        text = gui.add_html("")
        button = gui.add_button("Save", icon=viser.Icon.DEVICE_FLOPPY)

    def save() -> None:
        make = partial(make_member, task.value, obstacles.value, session.files)
        with session.activity("composing {} robots"):
            train, test = (list(session.workers.map(make, rows)) for rows in choose_sides())
        path = save_split(name.value, regime.value, train, test, session.files)
        shown = str(path.relative_to(session.files.roots[0]))
        text.content = markup.framed(markup.code(f"morphgen split audit {shlex.quote(shown)}"))
        session.notify("Saved", shown)

    session.on_press(button, save)
