"""Controls that several pages have: values in the address, joints of a role, a robot to pick."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import viser

from morphgen.grammar.robot_source import is_set_folder
from morphgen.model.kinematics import driving_joints
from morphgen.model.robot import TOOL, Robot
from morphgen.splits.split_file import split_names
from morphgen.viewer.app.address import AddressError, parse_count
from morphgen.viewer.app.session import Session, set_value
from morphgen.viewer.robot_rows import folder_rows, robot_folders, split_rows
from morphgen.viewer.robot_uri import WORDS, FileAccess, member_split, parent_folder, resolve_split


def bind(session: Session, key: str, control: Any, keys: Sequence[str] = ()) -> None:  # noqa: ANN401
    """Keep the value of a control in the page's address; its present value is the default.

    A value of the address that it cannot have is left out with a note. ``keys`` are the texts of a
    dropdown's options, by default these, or that of a check box that is on.
    """
    default, keys = control.value, tuple(keys)

    def write() -> str:
        value = control.value
        if value == default:
            return ""
        if isinstance(control, viser.GuiDropdownHandle):
            return keys[control.options.index(value)] if keys else str(value)
        if isinstance(control, viser.GuiCheckboxHandle):
            return keys[0]
        return f"{value:g}" if isinstance(value, float) else str(value)

    def apply(text: str) -> None:
        if (value := parse_value(control, text, keys)) is None:
            valid = "a number"
            if isinstance(control, viser.GuiDropdownHandle):
                valid = ", ".join(keys or control.options)
            raise AddressError(f"{key}={text[:40]} was left out; expected {valid[:200]}")
        set_value(control, value)

    session.keep(key, write, apply)


def parse_value(control: Any, text: str, keys: Sequence[str] = ()) -> Any:  # noqa: ANN401
    """Return the value of a control that a text of an address stands for; None for none."""
    match control:
        case viser.GuiDropdownHandle():
            keys = keys or control.options
            return control.options[keys.index(text)] if text in keys else None
        case viser.GuiCheckboxHandle():
            return text in keys
        case viser.GuiNumberHandle():
            count = parse_count(text, -1)
            return None if count < 0 else count
        case viser.GuiSliderHandle():
            try:
                number = float(text)
            except ValueError:
                return None
            low, high = control.min, control.max
            return None if math.isnan(number) else type(low)(min(max(number, low), high))
    return text


def joint_roles(robot: Robot) -> list[str]:
    """Return the role of every independent joint: ``joint 1`` is the first that moves the tool.

    Others, such as ``finger 1``, do not.
    """
    on_path: tuple[int, ...] = ()
    if robot.tool:
        on_path = driving_joints(robot, robot.joint_chain(robot.frame(TOOL).link))
    off_path = [i for i in range(robot.dof) if i not in on_path]
    roles = {i: f"joint {n}" for n, i in enumerate(on_path, 1)}
    roles |= {i: f"finger {n}" for n, i in enumerate(off_path, 1)}
    return [roles[i] for i in range(robot.dof)]


def all_roles(robots: Sequence[Robot]) -> list[str]:
    """Return every role of any of the robots, joints before fingers, by number."""
    roles = {role for robot in robots for role in joint_roles(robot)}
    return sorted(roles, key=lambda role: (role[0] != "j", int(role.split()[1])))


MIDDLE = 0.5  # position of a slider whose joints are at home


class RoleSliders:
    """Sliders that move the joints of a role in all robots of a page; other joints stay at home."""

    def __init__(self, session: Session, move: Callable[[], object]) -> None:
        """Prepare for sliders; ``move`` is called after the user moved one."""
        self.moved: dict[str, float] = {}  # shares of their ranges, of the roles that were moved
        self._session, self._move = session, move
        self._sliders: dict[str, viser.GuiSliderHandle[float]] = {}

    def add(self, role: str, hint: str) -> None:
        """Add the slider of a role, which is in the middle while nobody has moved it."""
        session, moved = self._session, self.moved
        slider = session.client.gui.add_slider(role, 0.0, 1.0, 0.01, MIDDLE, hint=hint)
        self._sliders[role] = slider

        def apply(text: str) -> None:
            """Take over a position of an address, unless it is invalid; the robots move later."""
            if (position := parse_value(slider, text)) is not None:
                moved[role] = position
                set_value(slider, position)

        def read() -> None:
            moved[role] = slider.value
            self._move()

        def write() -> str:
            return f"{moved[role]:g}" if role in moved else ""

        session.on_change(slider, read, f"move {role}")
        session.keep(role.replace(" ", ""), write, apply)

    def go_home(self) -> None:
        """Move all roles home."""
        self.moved.clear()
        for slider in self._sliders.values():
            set_value(slider, MIDDLE)
        self._move()


ARMS = "arms with a plate"
MAX_CHOICES = 500  # robots that a dropdown offers; others can be named by words

Robots = list[tuple[str, str]]  # names and URIs
RobotLists = Mapping[str, Callable[[], Robots]]  # functions that list robots, by source


class RobotPicker:
    """Controls that pick a robot: from a list to search, or by words of the command."""

    def __init__(self, session: Session, lists: RobotLists, current: Callable[[], str]) -> None:
        """Add the controls; ``current`` returns the URI of the robot that is shown first."""
        gui, self._lists, self._current = session.client.gui, lists, current
        self._source = gui.add_dropdown("from", tuple(lists))
        self.robot = gui.add_dropdown("robot", ("",), hint="type to search")
        hint = "such as arm=ur5 ee=plane, or the folder of a bundle"
        self._words = gui.add_text("or words", "", hint=hint)
        self._uris: dict[str, str] = {}  # URIs of the robots in the dropdown, by label
        session.on_change(self._source, self._list_robots)
        self._list_robots()

    def _list_robots(self) -> None:
        """Fill the dropdown of robots from the chosen source, each with a label of its own."""
        current, robots = self._current(), self._lists[self._source.value]()[:MAX_CHOICES]
        if current and current not in (uri for _, uri in robots):
            robots = [(current, current), *robots]
        self._uris = {}
        for name, uri in robots:
            while name in self._uris:
                name += "'"
            self._uris[name] = uri
        self.robot.options = tuple(self._uris)
        if current:
            set_value(self.robot, next(name for name, uri in self._uris.items() if uri == current))

    def picked_uri(self) -> str:
        """Return the URI of the robot that the user named or picked, and clear the words."""
        text = self._words.value.strip()
        if not text:
            return self._uris[self.robot.value]
        set_value(self._words, "")
        return WORDS + text if "=" in text and ":" not in text else text


def robot_lists(uri: str, files: FileAccess, first: RobotLists) -> RobotLists:
    """Return lists of robots to pick from, those beside a robot and ``first`` before others."""

    def folder_robots(folder: str) -> Robots:
        return [(row.name, row.uri) for row in folder_rows(folder, files)]

    def split_robots(split: str) -> Robots:
        rows = split_rows(split, resolve_split(split, files))
        return [(f"{row.role}: {row.name}", row.uri) for row in rows]

    def arms() -> Robots:
        names = files.library.names("arm")
        plates = [(arm, f"{WORDS}arm={arm} ee=plane") for arm in names]
        return [*plates, ("planar-cube", f"{WORDS}base=planar ee=cube")]

    lists = dict(first)
    if split := member_split(uri):
        lists[split] = functools.partial(split_robots, split)
    folder = parent_folder(uri)
    if folder and is_set_folder(files.path(folder)):
        lists[folder] = functools.partial(folder_robots, folder)
    lists[ARMS] = arms
    for name in robot_folders(files.roots[0]):
        lists.setdefault(name, functools.partial(folder_robots, name))
    for split in split_names():
        lists.setdefault(split, functools.partial(split_robots, split))
    return lists
