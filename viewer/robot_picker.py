"""Controls that pick a robot: a list of robots to search, or words of ``morphgen compose``."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import viser

from morphgen.grammar.robot_source import is_set_folder
from morphgen.splits.split_file import split_names
from morphgen.viewer.app.session import Session, set_value
from morphgen.viewer.robot_rows import folder_rows, robot_folders, split_rows
from morphgen.viewer.robot_uri import (
    WORDS,
    FileAccess,
    member_split,
    parent_folder,
    resolve_split,
)

ARMS = "arms with a plate"
MAX_CHOICES = 500  # robots that a dropdown offers; others can be named by words

Robots = list[tuple[str, str]]  # names and URIs
RobotLists = Mapping[str, Callable[[], Robots]]  # functions that list robots, by source


@dataclass(eq=False)
class RobotPicker:
    """Controls that pick a robot in one browser."""

    session: Session
    lists: RobotLists
    current: Callable[[], str]  # returns the URI of the robot that the dropdown shows first
    source: viser.GuiDropdownHandle[str]
    robot: viser.GuiDropdownHandle[str]  # robots of the source; typing searches them
    words: viser.GuiTextHandle
    labels: dict[str, str]  # URIs of the robots in the dropdown, by label


def add_picker(session: Session, lists: RobotLists, current: Callable[[], str]) -> RobotPicker:
    """Add the controls."""
    gui = session.client.gui
    source = gui.add_dropdown("from", tuple(lists))
    robot = gui.add_dropdown("robot", ("",), hint="type to search")
    words = gui.add_text("or words", "", hint="such as arm=ur5 ee=plane, or the folder of a bundle")
    picker = RobotPicker(session, lists, current, source, robot, words, {})
    session.on_change(source, lambda: list_robots(picker))
    list_robots(picker)
    return picker


def list_robots(picker: RobotPicker) -> None:
    """Fill the dropdown of robots from the chosen source."""
    current = picker.current()
    robots = picker.lists[picker.source.value]()[:MAX_CHOICES]
    picker.labels = label_robots(robots, (current,) if current else ())
    picker.robot.options = tuple(picker.labels)
    if current:
        label = next(label for label, uri in picker.labels.items() if uri == current)
        set_value(picker.robot, label)


def picked_uri(picker: RobotPicker) -> str:
    """Return the URI of the robot that the user named or picked, and clear the words."""
    text = picker.words.value.strip()
    if not text:
        return picker.labels[picker.robot.value]
    set_value(picker.words, "")
    return WORDS + text if "=" in text and ":" not in text else text


def label_robots(robots: Robots, current: Sequence[str]) -> dict[str, str]:
    """Return URIs by distinct labels, in the order of the robots."""
    listed_uris = {uri for _, uri in robots}
    labels: dict[str, str] = {}
    for name, uri in [*((uri, uri) for uri in current if uri not in listed_uris), *robots]:
        label = name
        while label in labels:
            label += "'"
        labels[label] = uri
    return labels


def robot_lists(uri: str, files: FileAccess, first: RobotLists) -> RobotLists:
    """Return lists of robots to pick from."""
    lists = dict(first)
    if split := member_split(uri):
        lists[split] = functools.partial(_split_robots, split, files)
    folder = parent_folder(uri)
    if folder and is_set_folder(files.path(folder)):
        lists[folder] = functools.partial(_folder_robots, folder, files)
    lists[ARMS] = lambda: [
        *((arm, f"{WORDS}arm={arm} ee=plane") for arm in files.library.names("arm")),
        ("planar-cube", f"{WORDS}base=planar ee=cube"),
    ]
    for name in robot_folders(files.roots[0]):
        lists.setdefault(name, functools.partial(_folder_robots, name, files))
    for split in split_names():
        lists.setdefault(split, functools.partial(_split_robots, split, files))
    return lists


def _folder_robots(folder: str, files: FileAccess) -> Robots:
    return [(row.name, row.uri) for row in folder_rows(folder, files)]


def _split_robots(split: str, files: FileAccess) -> Robots:
    rows = split_rows(split, resolve_split(split, files))
    return [(f"{row.role}: {row.name}", row.uri) for row in rows]
