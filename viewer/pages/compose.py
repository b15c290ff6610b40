"""The page that composes robots, from chosen parts, of parameters, or from a grammar."""

from __future__ import annotations

import functools
import re
import shlex
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np
import viser

from morphgen.checks import check
from morphgen.errors import CompositionError, MorphgenError
from morphgen.formats.bundle import bundle_folder, split_colours, write_bundle
from morphgen.formats.rounding import format_number
from morphgen.grammar.compose import compose
from morphgen.grammar.derive import Chooser, derive
from morphgen.grammar.grammar_file import SUFFIX, grammar_from_text, grammar_names, grammar_text
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import Parameter, PartKind, parse_value
from morphgen.grammar.request import MAIN_PORTS, SLOTS, default_name, known_grammars, parse_request
from morphgen.grammar.sampling import GRAMMAR, sample_robot
from morphgen.grammar.syntax import Derivation, parse_derivation
from morphgen.model.inertia import box_corners
from morphgen.model.kinematics import reach
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address, AddressError, pack_text, parse_count, unpack_text
from morphgen.viewer.app.frame import call
from morphgen.viewer.app.session import Session, set_value
from morphgen.viewer.pages.robot import PANEL_WIDTH
from morphgen.viewer.robot_files import new_bundle_files, zip_files
from morphgen.viewer.robot_uri import (
    DEFAULT_WORDS,
    DERIVATION,
    MEMBER,
    UPLOAD,
    WORDS,
    FileAccess,
    UriError,
    parent_folder,
    read_robot_uri,
    resolve_derivation,
    resolve_grammar,
    resolve_words,
    shorten,
)
from morphgen.viewer.scene.robot import RobotView, add_robot, robot_bounds
from morphgen.viewer.scene.stage import (
    CAMERA_DIRECTION,
    add_ground,
    look_at,
    project_points,
)

NO_PART = "(none)"  # option of a dropdown that leaves a slot empty


@dataclass(frozen=True, eq=False)
class Shown:
    """A robot that the page shows."""

    robot: Robot
    derivation: Derivation
    command: str  # command that makes the robot, or a comment with its derivation
    uri: str  # URI of the robot
    subject: str  # subject of the page's address that shows the robot again


ShowRobot = Callable[[Shown], None]
Words = Mapping[str, str]
"""Words of ``morphgen compose`` by their keys: a part for each slot, and values of parameters."""


def split_words(text: str) -> Words:
    """Return the words of a text by their keys; ``parse_request`` says which are invalid."""
    parts = (word.partition("=") for word in text.split())
    return {"base": "fixed"} | {key: value for key, _, value in parts}


def kind_of(slot: str) -> PartKind:
    """Return the kind of part that a slot takes, such as ``arm`` for ``left.arm``."""
    last = slot.rpartition(".")[2]
    return next(kind for kind in SLOTS if kind == last)


def slots_of(words: Words, library: Library) -> list[str]:
    """Return the slots that the chosen parts offer, except the base's own slot.

    Beside a main arm, an end-effector on another port of the base needs an arm there.
    """
    base = library.manifest(words["base"], "base")
    arm = words.get("arm")
    ports = list(library.manifest(arm, "arm").ports) if arm else [MAIN_PORTS["arm"]]
    slots = ["arm", *("ee" if port == MAIN_PORTS["arm"] else f"{port}.ee" for port in ports)]
    for port in base.ports:
        if port != MAIN_PORTS["base"]:
            slots.append(f"{port}.arm")
            if not arm or words.get(f"{port}.arm"):
                slots.append(f"{port}.ee")
    return list(dict.fromkeys(slots))


def parameters_of(slot: str, part: str, library: Library) -> Mapping[str, Parameter]:
    """Return the parameters of a part in a slot: its own, and the rotation of its mount."""
    manifest = library.manifest(part, kind_of(slot))
    return manifest.parameters if slot == "base" else manifest.attached_parameters


def words_of(derivation: Derivation, library: Library) -> Words | None:
    """Return the words that give a derivation; None if words cannot describe it."""
    words = {}
    for node in derivation.walk():
        limb, _, kind = node.label.rpartition("_")
        if kind not in SLOTS:
            return None
        slot = f"{limb}.{kind}" if limb else kind
        if node.part == "none":
            continue
        words[slot] = node.part
        for name, value in node.parameters:
            default = parameters_of(slot, node.part, library)[name].default
            if (text := format_number(value)) != format_number(default):
                words[f"{slot}.{name}"] = text
    try:
        return words if parse_request(_texts(words), library) == derivation else None
    except MorphgenError:
        return None  # labels that only look like slots


def with_word(words: Words, key: str, value: str, library: Library) -> Words:
    """Return words with another value of a key, or without the key if the value is empty.

    Parameters of a slot's previous part go, as do slots that parts no longer have.
    """
    words = {other: text for other, text in {**words, key: value}.items() if text}
    slots = {"base", *slots_of(words, library)}

    def is_kept(other: str) -> bool:
        slot, _, name = other.rpartition(".")
        if other in slots or slot not in slots or slot not in words or slot == key:
            return other in slots
        return name in parameters_of(slot, words[slot], library)

    return {other: text for other, text in words.items() if is_kept(other)}


def _texts(words: Words) -> list[str]:
    return [f"{key}={value}" for key, value in words.items()]


class ComposingTab(ABC):
    """A tab whose controls compose a robot."""

    _fault: viser.GuiHtmlHandle  # reason why no robot can be composed, or empty

    def __init__(self, session: Session, show_robot: ShowRobot) -> None:
        """Prepare the tab; ``show_robot`` shows a composed robot."""
        self._session, self._library, self._show_robot = session, session.files.library, show_robot

    @abstractmethod
    def _compose(self) -> Shown:
        """Return the robot that the controls describe."""

    def show(self) -> None:
        """Show the robot, or why it cannot be composed; then the last robot stays."""
        try:
            shown = self._compose()
        except (MorphgenError, RecursionError) as error:
            self._show_fault(self._session.files.redact(error))
            return
        self._show_robot(shown)
        self._show_fault("")

    def _show_fault(self, text: str) -> None:
        self._fault.content = markup.error(text) if text else ""

    def _add_slider(
        self,
        name: str,
        parameter: Parameter,
        value: float,
        key: str,
        change: Callable[[float], None],
    ) -> None:
        low, high = parameter.minimum, parameter.maximum
        slider = self._session.client.gui.add_slider(
            name.replace("_", " ") + (f" ({parameter.unit})" if parameter.unit else ""),
            low,
            high,
            1.0 if parameter.integer else markup.slider_step(low, high),
            min(max(value, low), high),
            marks=tuple((end, f"{end:.3g}") for end in (low, high)),
            hint=parameter.summary or name,
        )
        self._session.on_change(slider, lambda: change(slider.value), key)


class PartsTab(ComposingTab):
    """The tab with a dropdown of parts for the base and its slots, and sliders of parameters."""

    def __init__(
        self, session: Session, tabs: viser.GuiTabGroupHandle, words: Words, show_robot: ShowRobot
    ) -> None:
        """Add the tab; ``show`` shows the robot of the words."""
        super().__init__(session, show_robot)
        gui, self._words = session.client.gui, words
        self._slots: list[viser.GuiFolderHandle] = []  # folders with the controls of each slot
        self._library.manifest(words["base"], "base")  # require that there is such a base
        with tabs.add_tab("Parts", viser.Icon.PUZZLE):
            self._fault = gui.add_html("")
            bases = tuple(self._library.names("base"))
            base = gui.add_dropdown("base", bases, initial_value=self._words["base"])
            self._folder = gui.add_folder(None)
        session.on_change(base, lambda: self._choose("base", base.value))
        self._add_slots()

    def _compose(self) -> Shown:
        words = _texts(self._words)
        text = " ".join(words)
        derivation, name = resolve_words(text, self._session.files)
        robot = compose(derivation, self._library, name)
        command = shlex.join(["morphgen", "compose", *words])
        return Shown(robot, derivation, command, WORDS + text, text)

    def _add_slots(self) -> None:
        """Add for each slot a dropdown of parts, and sliders of the chosen part's parameters."""
        for folder in self._slots:
            folder.remove()
        self._slots = []
        for slot in ("base", *slots_of(self._words, self._library)):
            with self._folder:
                self._slots.append(folder := self._session.client.gui.add_folder(slot))
            with folder:
                if slot != "base":
                    self._add_part_dropdown(slot)
                if part := self._words.get(slot):
                    for name, parameter in parameters_of(slot, part, self._library).items():
                        key = f"{slot}.{name}"
                        text, default = self._words.get(key), parameter.default
                        value = parse_value(text, parameter, key) if text else default
                        change = functools.partial(self._change, key, default)
                        self._add_slider(name, parameter, value, key, change)

    def _add_part_dropdown(self, slot: str) -> None:
        kind, chosen = kind_of(slot), self._words.get(slot)
        names = (NO_PART, *(name for name in self._library.names(kind) if name != "none"))
        dropdown = self._session.client.gui.add_dropdown(
            kind, names, initial_value=chosen if chosen in names else NO_PART
        )
        self._session.on_change(dropdown, lambda: self._choose(slot, dropdown.value))

    def _choose(self, slot: str, part: str) -> None:
        """Put a part into a slot, and show its controls and the robot."""
        part = "" if part == NO_PART else part
        self._words = with_word(self._words, slot, part, self._library)
        self._add_slots()
        self.show()

    def _change(self, key: str, default: float, value: float) -> None:
        text = format_number(value) if abs(value - default) > 1e-9 else ""
        self._words = with_word(self._words, key, text, self._library)
        self.show()


class ParametersTab(ComposingTab):
    """The tab with sliders for every part of a derivation that words cannot describe."""

    def __init__(
        self,
        session: Session,
        tabs: viser.GuiTabGroupHandle,
        derivation: Derivation,
        show_robot: ShowRobot,
    ) -> None:
        """Add the tab; ``show`` shows the robot."""
        super().__init__(session, show_robot)
        gui, self._derivation = session.client.gui, derivation
        with tabs.add_tab("Parameters", viser.Icon.ADJUSTMENTS):
            self._fault = gui.add_html("")
            for node in derivation.walk():
                manifest, values = self._library.manifest(node.part), dict(node.parameters)
                is_root = node is derivation
                parameters = manifest.parameters if is_root else manifest.attached_parameters
                if names := [name for name in parameters if name in values]:
                    with gui.add_folder(markup.part_title(node.label, node.part)):
                        for name in names:
                            change = functools.partial(self._change, node.label, name)
                            key = f"{node.label}.{name}"
                            self._add_slider(name, parameters[name], values[name], key, change)

    def _compose(self) -> Shown:
        derivation = self._derivation
        uri = f"{DERIVATION}{derivation}"
        robot = compose(derivation, self._library, default_name(derivation, self._library))
        return Shown(robot, derivation, f"# {derivation}", uri, uri)

    def _change(self, label: str, name: str, value: float) -> None:
        self._derivation = with_parameter(self._derivation, label, name, value)
        self.show()


def with_parameter(derivation: Derivation, label: str, name: str, value: float) -> Derivation:
    """Return a derivation with another value of a parameter of the part with a label."""
    parameters = derivation.parameters
    if derivation.label == label:
        values = {**dict(parameters), name: value}
        parameters = tuple(values.items())
    children = tuple(
        (port, with_parameter(child, label, name, value)) for port, child in derivation.children
    )
    return replace(derivation, parameters=parameters, children=children)


_LOCATION = re.compile(r"(?P<origin>[^\s:]+):(?P<line>\d+):(?P<column>\d+): ")
"""Beginning of an error that names a place in a grammar."""


class GrammarTab(ComposingTab):
    """The tab of a grammar's text, from which robots are drawn."""

    def __init__(
        self, session: Session, tabs: viser.GuiTabGroupHandle, source: str, show_robot: ShowRobot
    ) -> None:
        """Add the tab with the text of a grammar, given by its name or file."""
        super().__init__(session, show_robot)
        gui = session.client.gui
        self._source, self._name, self._original = source, "", ""
        self._is_drawn = False  # whether the robot is drawn by seed and number, or the typical one
        with tabs.add_tab("Grammar", viser.Icon.BINARY_TREE):
            # A grammar may also be one of a file.
            start = gui.add_dropdown("start from", tuple(dict.fromkeys((source, *grammar_names()))))
            self._text = gui.add_text("grammar", "", multiline=True)
            save = gui.add_button("Save the grammar", icon=viser.Icon.DOWNLOAD)
            self._fault = gui.add_html("")
            self._too_long = gui.add_html("")
            self._seed = gui.add_number("seed", 0, min=0, step=1)
            self._number = gui.add_number("robot number", 0, min=0, step=1)
            buttons = gui.add_button_group("robot", ("typical", "this", "next"))
        self._load(source)
        session.on_change(start, lambda: self._start_from(start.value))
        session.on_change(self._text, self.show, "grammar")
        session.on_change(buttons, lambda: self._draw(buttons.value))
        session.on_change(
            save, lambda: session.send_file(f"{self._name}{SUFFIX}", self._text.value.encode())
        )
        session.keep(
            "text", self._write_text, lambda text: set_value(self._text, unpack_text(text))
        )
        for key, field in (("seed", self._seed), ("number", self._number)):
            session.on_change(field, lambda: self._draw("this"), "number")
            session.keep(
                key,
                functools.partial(self._write_number, field),
                functools.partial(self._apply_number, field),
            )

    def _load(self, source: str) -> None:
        self._source = source
        self._name = Path(source).stem if source.endswith(SUFFIX) else source
        self._original = grammar_text(resolve_grammar(source, self._session.files))
        set_value(self._text, self._original)

    def _write_number(self, field: viser.GuiNumberHandle[int]) -> str:
        # Without a text that is too long for it, the address would name another robot.
        is_named = self._is_shown and self._is_drawn and not self._too_long.content
        return str(field.value) if is_named else ""

    def _apply_number(self, field: viser.GuiNumberHandle[int], text: str) -> None:
        self._is_drawn = True
        set_value(field, parse_count(text, 0))

    def _write_text(self) -> str:
        self._too_long.content = ""
        if self._is_shown and self._text.value != self._original:
            try:
                return pack_text(self._text.value)
            except AddressError as error:
                self._too_long.content = markup.framed(markup.dim(str(error)))
        return ""

    @property
    def _is_shown(self) -> bool:
        """Whether the robot of the page is one of this tab."""
        return self._session.address.subject == self._source

    def _compose(self) -> Shown:
        session, library = self._session, self._library
        grammar = grammar_from_text(self._text.value, self._name)
        derivation = derive(grammar, library, Chooser())
        robot = compose(derivation, library, self._name)  # also checks the grammar
        is_edited = self._text.value != self._original
        name = shlex.quote(f"{self._name}{SUFFIX}" if is_edited else self._source)
        command = f"morphgen compose {name}"
        if self._is_drawn:
            seed, number = self._seed.value, self._number.value
            with session.activity(f"drawing robot {number} of seed {seed}"):
                sample = sample_robot(grammar, library, number, seed=seed)
            robot, derivation = sample.robot, sample.derivation
            command = f"morphgen sample {name} -n {number + 1} --seed {seed}"
        if is_edited:
            command = f"# with the text of the tab Grammar in {name}\n{command}"
        return Shown(robot, derivation, command, f"{DERIVATION}{derivation}", self._source)

    def _show_fault(self, text: str) -> None:
        """Show what is wrong with the grammar, below the text and at its place in the text."""
        super()._show_fault(text)
        if text:  # the address has the text that is wrong
            self._session.address = replace(self._session.address, subjects=(self._source,))
            self._session.show_state()
        place = _LOCATION.match(text)
        is_here = place is not None and place["origin"] == self._name
        line, column = (int(place["line"]), int(place["column"])) if place and is_here else (0, 0)
        self._session.run_script(call("mark", line, column))

    def _start_from(self, source: str) -> None:
        self._load(source)
        self._draw("typical")

    def _draw(self, action: str) -> None:
        if action == "next":
            set_value(self._number, self._number.value + 1)
        self._is_drawn = action != "typical"
        self.show()


ROBOTS = "robots"  # folder in which bundles are written
DEFAULT_GRAMMAR = "arm3"


def show(session: Session) -> None:
    """Build the page."""
    files, subject = session.files, session.address.subject.strip() or DEFAULT_WORDS
    derivation, name = subject_derivation(subject, files), subject.split()[0]
    is_grammar = derivation is None and "=" not in name  # the subject is a grammar's name
    text = DEFAULT_WORDS if is_grammar else subject
    words = words_of(derivation, files.library) if derivation else split_words(text)
    session.open_panel(PANEL_WIDTH + 30, markup.breadcrumbs(("compose", None)))
    page = ComposePage(session)
    tabs = session.client.gui.add_tab_group()
    source = name if is_grammar else set_grammar(subject, files) if derivation else DEFAULT_GRAMMAR
    add_grammar = functools.partial(GrammarTab, session, tabs, source, page.show)
    add_parts: Callable[[], ComposingTab]
    if derivation and words is None:
        add_parts = functools.partial(ParametersTab, session, tabs, derivation, page.show)
    else:
        add_parts = functools.partial(PartsTab, session, tabs, words or {}, page.show)
    # The tab that the address asks for comes first.
    order = (add_grammar, add_parts) if is_grammar else (add_parts, add_grammar)
    first, _ = [add_tab() for add_tab in order]
    page.add_tabs(tabs)
    session.apply_state()
    first.show()


def set_grammar(subject: str, files: FileAccess) -> str:
    """Return the file of the grammar that gave a robot of a set, or else the default grammar."""
    folder = parent_folder(subject)
    is_in_set = bool(folder) and (files.path(folder) / GRAMMAR).is_file()
    return f"{folder}/{GRAMMAR}" if is_in_set else DEFAULT_GRAMMAR


def subject_derivation(subject: str, files: FileAccess) -> Derivation | None:
    """Return the derivation of the robot that an address names by its URI; None for words."""
    if subject.startswith((DERIVATION, MEMBER)):
        return resolve_derivation(subject, files)
    first = subject.split()[0]
    is_path = subject.startswith(UPLOAD) or ("=" not in first and not first.endswith(SUFFIX))
    if not is_path or first in known_grammars(files.library):
        return None
    if not subject.startswith(UPLOAD) and "/" not in subject and not _exists(subject, files):
        return None  # the name of a grammar that does not exist
    text = read_robot_uri(subject, files).provenance.get("derivation")
    if not text:
        raise UriError(f"{shorten(subject)} was imported: only composed robots can be edited")
    return parse_derivation(str(text))


def _exists(subject: str, files: FileAccess) -> bool:
    try:
        files.path(subject)
    except UriError:
        return False
    return True


class ComposePage:
    """The composed robot in one browser, and the texts about it."""

    def __init__(self, session: Session) -> None:
        """Prepare the scene and the text above the tabs."""
        self.shown: Shown | None = None
        self._session, self._view = session, ComposeView(session)
        self._summary = session.client.gui.add_html("")
        self._findings: viser.GuiHtmlHandle
        self._command: viser.GuiHtmlHandle

    def add_tabs(self, tabs: viser.GuiTabGroupHandle) -> None:
        """Add the tabs of all robots: findings, and files to write or download."""
        gui, session = self._session.client.gui, self._session
        with tabs.add_tab("Check", viser.Icon.STETHOSCOPE):
            self._findings = gui.add_html("")
        with tabs.add_tab("Get", viser.Icon.DOWNLOAD):
            name = gui.add_text("name", "", hint="by default from its parts")
            write = gui.add_button(f"Write to {ROBOTS}/", icon=viser.Icon.DEVICE_FLOPPY)
            download = gui.add_button("Bundle (.zip)", icon=viser.Icon.DOWNLOAD)
            self._command = gui.add_html("")
        session.on_press(write, lambda: self._write_bundle(name.value))
        session.on_press(download, lambda: self._send_bundle(name.value))

    def show(self, shown: Shown) -> None:
        """Show a robot in place of the previous one, and check it in the background."""
        session, self.shown = self._session, shown
        change = self._view.replace_robot(shown.robot)
        self._summary.content = markup.summary(
            shown.robot,
            f" · {markup.link(Address('robot', (shown.uri,)), 'open its page')} · "
            + markup.choose_box(shown.uri, "choose")
            + (f"<br>changed: {escape(change)}" if change else ""),
        )
        self._command.content = markup.framed(
            markup.command(shown.command), "<h3>Derivation</h3>", markup.code(str(shown.derivation))
        )
        session.address = replace(session.address, subjects=(shown.subject,))
        session.title = f"compose {shown.robot.name}"
        session.show_state()
        session.run_in_background(self._check, "check")

    def _check(self) -> None:
        """Check the current robot, and show the findings unless another robot has replaced it."""
        if (shown := self.shown) is not None:
            findings = check(shown.robot, tool_required=shown.robot.tool is not None)
            if shown is self.shown:
                table = markup.findings_table(findings, self._session.files.redact)
                self._findings.content = markup.framed(table)

    def _named_robot(self, name: str) -> Robot:
        """Return the robot that the page shows under a name, by default its own."""
        if self.shown is None:
            raise CompositionError("no robot is shown: choose parts that fit, or draw one")
        robot = self.shown.robot
        return replace(robot, name=name or robot.name or "robot")

    def _write_bundle(self, name: str) -> None:
        """Write the robot's bundle with findings and picture below ``robots/``."""
        session, robot = self._session, self._named_robot(name)
        folder = bundle_folder(session.files.roots[0] / ROBOTS, robot.name)
        target = str(folder.relative_to(session.files.roots[0]))
        with session.activity(f"writing {target}"):
            session.workers.call(_write_checked, robot, folder)
        session.notify("Written", target)

    def _send_bundle(self, name: str) -> None:
        session, robot = self._session, self._named_robot(name)
        folder = bundle_folder(Path(), robot.name).name  # validates the name
        with session.activity("packing the bundle"):
            files = session.workers.call(new_bundle_files, robot)
            session.send_file(f"{folder}.zip", zip_files(folder, files))


def _write_checked(robot: Robot, folder: Path) -> None:
    """Write a bundle with findings and picture. Runs in a worker, which may use OpenGL."""
    write_bundle(robot, folder, check(robot))


GHOST_OPACITY = 0.16  # opacity of the previous robot
GESTURE_TIME = 1.0  # changes that follow each other faster, as of a slider, count as one [s]
_EDGE = 0.02  # share of the picture at its edges into which a robot may not reach


class ComposeView:
    """The robot in the scene of one browser, and the ghost of the one before."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._shown: RobotView | None = None
        self._ghost: RobotView | None = None
        self._changed_at = -np.inf  # time of the last change by `time.monotonic` [s]
        self._count = 0  # number of robots shown so far; names the nodes of the scene

    def replace_robot(self, robot: Robot) -> str:
        """Show a robot, and the one before as ghost; return what changed, or an empty text."""
        client, previous, robot = self._session.client, self._shown, split_colours(robot)
        is_gesture = time.monotonic() - self._changed_at < GESTURE_TIME
        with client.atomic():
            self._count += 1
            self._shown = add_robot(client.scene, robot, f"/robot{self._count}")
            if previous is not None and is_gesture and self._ghost is not None:
                previous.base.remove()
            elif previous is not None:
                if self._ghost is not None:
                    self._ghost.base.remove()
                self._ghost = previous
                previous.set_opacity(GHOST_OPACITY)
                previous.cast_no_shadow()
        low, high = robot_bounds(robot)
        add_ground(client.scene, float(np.linalg.norm(high - low)))
        if previous is None:
            look_at(client, low, high)
        elif not self._is_in_picture(low, high):
            x, y, z = (client.camera.position - client.camera.look_at).tolist()
            look_at(client, low, high, (x, y, z) if np.hypot(x, y) > 1e-6 else CAMERA_DIRECTION)
        self._changed_at = time.monotonic()
        return change_text(self._ghost.robot, robot) if self._ghost else ""

    def _is_in_picture(self, low: Array, high: Array) -> bool:
        camera = self._session.client.camera
        shares, depths = project_points(camera, box_corners(low, high))
        return bool((depths > 0).all() and (abs(shares - 0.5) <= 0.5 - _EDGE).all())


def change_text(before: Robot, after: Robot) -> str:
    """Return what differs between two robots, such as ``reach 1.08 to 1.68 m, mass +0.24 kg``."""
    parts = []
    if before.dof != after.dof:
        parts.append(f"{before.dof} to {after.dof} DoF")
    if all(robot.tool and robot.dof for robot in (before, after)):
        old, new = (f"{reach(robot):.2f}" for robot in (before, after))
        if old != new:
            parts.append(f"reach {old} to {new} m")
    if abs(difference := after.mass - before.mass) >= 0.005:
        parts.append(f"mass {difference:+.2f} kg")
    return ", ".join(parts)
