"""The page that composes robots, from chosen parts or from a grammar, and evolves them."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import viser

from morphgen.checks import check
from morphgen.errors import CompositionError
from morphgen.formats.bundle import bundle_folder, split_colours, write_bundle
from morphgen.grammar.derivation import Derivation, parse_derivation
from morphgen.grammar.derive import Choices
from morphgen.grammar.grammar_file import SUFFIX, grammar_names, grammar_text
from morphgen.grammar.request import known_grammars
from morphgen.grammar.robot_set import GRAMMAR, INDEX, read_index, read_settings
from morphgen.model.inertia import box_corners
from morphgen.model.kinematics import arm_reach
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address, parse_count
from morphgen.viewer.app.session import Session, set_value
from morphgen.viewer.pages.compose_grammar import (
    GrammarTab,
    Individual,
    change_lines,
    is_robot,
    mutants,
    pack_choices,
)
from morphgen.viewer.pages.compose_parts import (
    ParametersTab,
    PartsTab,
    Shown,
    choice_of,
    parse_choice,
)
from morphgen.viewer.pages.robot import PANEL_WIDTH, summary
from morphgen.viewer.robot_files import new_bundle_files, zip_files
from morphgen.viewer.robot_tables import has_tool
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
    shorten,
    uri_name,
)
from morphgen.viewer.scene.robot import RobotView, add_offspring, add_robot, robot_bounds
from morphgen.viewer.scene.stage import (
    CAMERA_DIRECTION,
    add_ground,
    camera_view,
    look_at,
    project_points,
)

ROBOTS = "robots"  # folder in which bundles are written
DEFAULT_GRAMMAR = "arm3"
_OF_GRAMMARS = ("choices", "evolve", "number", "text")
"""Keys of the address that only robots of grammars have."""


def show(session: Session) -> None:
    """Build the page."""
    files, subject = session.files, session.address.subject.strip() or DEFAULT_WORDS
    state, library = session.address.state, files.library
    derivation = subject_derivation(subject, files)
    drawn = drawn_in_set(subject, files) if derivation else None
    # A robot with choices is one of the grammar around it.
    is_around = is_robot(subject) and not state.keys().isdisjoint(_OF_GRAMMARS)
    is_name = derivation is None and not is_robot(subject)  # the subject is a grammar's name
    grammar_name = drawn[0] if drawn else DEFAULT_GRAMMAR
    if is_around or is_name:
        grammar_name = subject if is_around else subject.split()[0]
    words = DEFAULT_WORDS if derivation or is_name else subject
    known = choice_of(derivation, library) if derivation else None
    choice = known or parse_choice(words.split(), library)
    session.open_panel(PANEL_WIDTH + 30, markup.breadcrumbs(("compose", None)))
    page = ComposePage(session)
    tabs = session.client.gui.add_tab_group()
    # The tab that the address asks for comes first.
    first: GrammarTab | PartsTab | ParametersTab
    if is_around or is_name:
        first = grammar = GrammarTab(session, tabs, grammar_name, page.show)
        PartsTab(session, tabs, choice, page.show)
    else:
        if derivation and known is None:
            first = ParametersTab(session, tabs, derivation, page.show)
        else:
            first = PartsTab(session, tabs, choice, page.show)
        grammar = GrammarTab(session, tabs, grammar_name, page.show)
    page.add_tabs(tabs, grammar)
    first.show()
    if drawn is not None and page.shown is not None:
        grammar.choices, grammar.mode = drawn[1], "chosen"
        page.shown = replace(page.shown, choices=drawn[1])
        page.evolve.set_parent(page.shown)
    if "evolve" in state and page.shown is not None and page.shown.choices is not None:
        page.evolve.breed()


def drawn_in_set(subject: str, files: FileAccess) -> tuple[str, Choices] | None:
    """Return the grammar and the choices that gave a robot of a set; None for other robots."""
    folder = parent_folder(subject)
    if not folder or not (path := files.path(folder)).joinpath(INDEX).is_file():
        return None
    records = {record["name"]: record["choices"] for record in read_index(path)}
    choices = records.get(uri_name(subject))
    if choices is None or not (path / GRAMMAR).is_file():
        return None
    name = str(read_settings(path)["grammar"])
    text = (path / GRAMMAR).read_text(encoding="utf-8")
    if name in grammar_names() and grammar_text(resolve_grammar(name, files)) == text:
        return name, choices
    return f"{folder}/{GRAMMAR}", choices


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
        self.evolve: EvolveTab
        self._session, self._view = session, ComposeView(session)
        self._summary = session.client.gui.add_html("")
        self._findings: viser.GuiHtmlHandle
        self._command: viser.GuiHtmlHandle

    def add_tabs(self, tabs: viser.GuiTabGroupHandle, grammar: GrammarTab) -> None:
        """Add the tabs of all robots: mutants, findings, and files to write or download."""
        gui, session = self._session.client.gui, self._session
        self.evolve = EvolveTab(session, tabs, grammar)
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
        self._summary.content = summary(
            shown.robot,
            f" · {markup.link(Address('robot', (shown.uri,)), 'open its page')} · "
            + markup.choose_box(shown.uri, "choose")
            + (f"<br>changed: {escape(change)}" if change else ""),
        )
        self._command.content = markup.framed(
            markup.command(shown.command),
            "<h3>Derivation</h3>",
            markup.code(str(shown.derivation)),
        )
        self.evolve.set_parent(shown)
        session.address = Address("compose", (shown.subject,), shown.state)
        session.show_address(f"compose {shown.robot.name}")
        session.run_in_background(self._check, "check")

    def _check(self) -> None:
        """Check the current robot, and show the findings unless another robot has replaced it."""
        if (shown := self.shown) is not None:
            findings = check(shown.robot, tool_required=has_tool(shown.robot))
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
            session.run_in_worker(_write_checked, robot, folder)
        session.notify("Written", target)

    def _send_bundle(self, name: str) -> None:
        """Send a zip of the robot's bundle to the browser."""
        session, robot = self._session, self._named_robot(name)
        folder = bundle_folder(Path(), robot.name).name  # validates the name
        with session.activity("packing the bundle"):
            files = session.run_in_worker(new_bundle_files, robot)
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
        """Show a robot; the one before becomes the ghost, unless both belong to one gesture.

        Return what changed from the ghost to the robot; an empty text if there is no ghost.
        """
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
        """Return whether the camera sees all corners of a box."""
        picture = camera_view(self._session.client)
        points, depths = project_points(picture, box_corners(low, high))
        shares = points / (picture.aspect, 1.0)
        return bool((depths > 0).all() and (abs(shares - 0.5) <= 0.5 - _EDGE).all())


def change_text(before: Robot, after: Robot) -> str:
    """Return what differs between two robots, such as ``reach 1.08 to 1.68 m, mass +0.24 kg``."""
    parts = []
    if before.dof != after.dof:
        parts.append(f"{before.dof} to {after.dof} DoF")
    if all(has_tool(robot) and robot.dof for robot in (before, after)):
        old, new = (f"{arm_reach(robot):.2f}" for robot in (before, after))
        if old != new:
            parts.append(f"reach {old} to {new} m")
    if abs(difference := after.mass - before.mass) >= 0.005:
        parts.append(f"mass {difference:+.2f} kg")
    return ", ".join(parts)


_MAX_CHANGES = 4  # lines of changes on a card
NO_GRAMMAR = (
    "This robot has no grammar whose choices could be drawn again. <i>mutants</i> makes one: "
    "parameters vary about their values, and arms and end-effectors may be replaced by others. "
    "You can edit it on the tab <i>Grammar</i>."
)
NO_ROBOT = "No robot is shown: choose parts that fit, or draw a robot on the tab <i>Grammar</i>."
HINT = "Click a robot, or <i>adopt</i> here, to go on with it."


class EvolveTab:
    """The tab that shows mutants of the robot, of which one is adopted."""

    def __init__(
        self, session: Session, tabs: viser.GuiTabGroupHandle, grammar: GrammarTab
    ) -> None:
        """Add the tab; the robots evolve by the grammar of another tab."""
        gui, number = session.client.gui, parse_count(session.address.state.get("evolve", ""), 0)
        self._session, self._grammar = session, grammar
        self._parent: Shown | None = None
        self._generation: list[Individual] = []
        self._views: list[RobotView] = []
        with tabs.add_tab("Evolve", viser.Icon.DNA):
            self._seed = gui.add_number("generation", number, min=0, step=1)
            buttons = gui.add_button_group("show", ("mutants", "none"))
            self._cards = gui.add_html("")
        session.on_change(
            buttons, lambda: self._mutate() if buttons.value == "mutants" else self._show([])
        )
        session.on_change(self._seed, self.breed, "generation")
        session.actions["adopt"] = lambda value: self._adopt(parse_count(value, 0))
        self._show_cards()

    def set_parent(self, shown: Shown) -> None:
        """Take the robot that is shown as the parent."""
        self._parent = shown
        if shown.choices is None:
            self._draw([])
        self._show_cards()

    def breed(self) -> None:
        """Make the mutants in a worker process, and show them unless the parent has changed."""
        session, parent, seed = self._session, self._parent, self._seed.value
        if parent is None or parent.choices is None:
            raise CompositionError("the robot has no grammar: press 'mutants', which makes one")
        grammar, folders = self._grammar.grammar, session.files.library_folders

        def make() -> None:
            with session.activity("mutating"):
                generation = session.run_in_worker(mutants, grammar, folders, parent.choices, seed)
            session.enqueue(lambda: self._show(generation) if parent is self._parent else None)

        session.run_in_background(make, "breed")

    def _mutate(self) -> None:
        """Show other mutants of the parent; a robot that no grammar gave gets a grammar first."""
        if self._parent is not None and self._parent.choices is None:
            self._grammar.load(self._parent.uri.removeprefix(WORDS))
        set_value(self._seed, self._seed.value + 1)
        self.breed()

    def _adopt(self, i: int) -> None:
        """Show one of the mutants as the parent, with mutants of its own."""
        if i < len(self._generation):
            self._grammar.choices = self._generation[i].choices
            self._grammar.show("chosen")
            self._mutate()

    def _show(self, generation: list[Individual]) -> None:
        """Show mutants in the scene, the tab and the address, with the choices of their parent."""
        self._draw(generation)
        session, state = self._session, {"evolve": ""}
        if generation and self._parent is not None and self._parent.choices is not None:
            choices = pack_choices(self._parent.choices)
            state = {"choices": choices, "seed": "", "number": "", "evolve": f"{self._seed.value}"}
        session.address = session.address.with_state(**state)
        session.show_address(session.title)
        self._show_cards()

    def _draw(self, generation: list[Individual]) -> None:
        for view in self._views:
            view.base.remove()
        self._generation, self._views = generation, []
        if generation and self._parent is not None:
            robots = [individual.robot for individual in generation]
            self._views = add_offspring(self._session.client, self._parent.robot, robots)
        for i, view in enumerate(self._views):
            view.base.on_click(functools.partial(self._clicked, i))

    async def _clicked(self, i: int, event: viser.SceneNodePointerEvent[Any]) -> None:
        del event
        self._session.enqueue(lambda: self._adopt(i))

    def _show_cards(self) -> None:
        """Show the cards of the mutants, or what to do so that the robot can evolve."""
        parent = self._parent
        if parent is None or parent.choices is None:
            content = markup.dim(NO_GRAMMAR if parent else NO_ROBOT)
        else:
            content = markup.dim(HINT) + offspring_html(parent, self._generation)
        self._cards.content = markup.framed(content)


def offspring_html(parent: Shown, generation: Sequence[Individual]) -> str:
    """Return cards of the mutants with what differs from the parent; empty without mutants."""
    cards = []
    for i, individual in enumerate(generation):
        lines = change_lines(parent.derivation, individual.derivation)
        changes = "<br>".join(map(escape, lines[:_MAX_CHANGES]))
        changes += "<br>..." if lines[_MAX_CHANGES:] else ""
        facts = change_text(parent.robot, individual.robot)
        cards.append(
            f'<div><b>{i + 1}</b> <a data-do="adopt" data-value="{i}">adopt</a>'
            f"{markup.dim(f'{escape(facts)}<br>{changes}' if facts else changes)}</div>"
        )
    return f'<div class="offspring">{"".join(cards)}</div>' if cards else ""
