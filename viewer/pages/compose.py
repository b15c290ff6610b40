"""The page that composes robots, from chosen parts or from a grammar, and evolves them."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path

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
    add_grammar_tab,
    change_lines,
    edited_grammar,
    is_robot,
    load_source,
    mutants,
    pack_choices,
    show_grammar,
)
from morphgen.viewer.pages.compose_parts import (
    add_parameters_tab,
    add_parts_tab,
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
from morphgen.viewer.scene.robot import (
    OffspringScene,
    RobotView,
    add_offspring,
    add_robot,
    hit_robot,
    remove_offspring,
    robot_bounds,
)
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


@dataclass(eq=False)
class ComposePage:
    """The composed robot in one browser, and the texts about it."""

    session: Session
    view: ComposeView
    summary: viser.GuiHtmlHandle
    findings: viser.GuiHtmlHandle | None = None
    command: viser.GuiHtmlHandle | None = None
    robot: Robot | None = None
    evolve: EvolveTab | None = None


def show(session: Session) -> None:
    """Build the page."""
    files, subject = session.files, session.address.subject.strip() or DEFAULT_WORDS
    derivation = subject_derivation(subject, files)
    words = DEFAULT_WORDS if derivation else subject
    grammar_name = DEFAULT_GRAMMAR
    # A robot with choices is one of the grammar around it.
    is_around = is_robot(subject) and not session.address.state.keys().isdisjoint(_OF_GRAMMARS)
    if is_around:
        grammar_name, is_grammar = subject, True
    elif is_grammar := not derivation and "=" not in subject.split()[0]:
        grammar_name, words = subject.split()[0], DEFAULT_WORDS
    drawn = drawn_in_set(subject, files) if derivation else None
    if drawn is not None:
        grammar_name = drawn[0]
    choice = choice_of(derivation, files.library) if derivation else None
    is_tree = derivation is not None and choice is None
    choice = choice or parse_choice(words.split(), files.library)
    session.open_panel(PANEL_WIDTH + 30, markup.breadcrumbs(("compose", None)))
    gui = session.client.gui
    page = ComposePage(session, ComposeView(session), gui.add_html(""))
    tabs = gui.add_tab_group()
    show_in_page = functools.partial(show_robot, page)
    start: Callable[[], None]
    # The tab that the address asks for comes first.
    if is_grammar:
        grammar_tab = add_grammar_tab(session, tabs, grammar_name, show_in_page)
        add_parts_tab(session, tabs, choice, show_in_page)
        start = functools.partial(show_grammar, grammar_tab, grammar_tab.mode)
    else:
        if derivation and is_tree:
            start = add_parameters_tab(session, tabs, derivation, show_in_page)
        else:
            start = add_parts_tab(session, tabs, choice, show_in_page)
        grammar_tab = add_grammar_tab(session, tabs, grammar_name, show_in_page)
    page.evolve = add_evolve_tab(session, tabs, grammar_tab)
    with tabs.add_tab("Check", viser.Icon.STETHOSCOPE):
        page.findings = gui.add_html("")
    with tabs.add_tab("Get", viser.Icon.DOWNLOAD):
        _add_downloads_tab(page)
    start()
    if derivation and drawn is not None and page.robot is not None:
        grammar_tab.choices, grammar_tab.mode = drawn[1], "chosen"
        set_parent(page.evolve, Individual(page.robot, derivation, drawn[1]))


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


def show_robot(
    page: ComposePage, robot: Robot, derivation: Derivation, command: str, uri: str
) -> None:
    """Show a robot in place of the previous one, and check it in the background."""
    change = replace_robot(page.view, robot)
    page.robot = robot
    page.summary.content = summary(
        robot,
        f" · {markup.link(Address('robot', (uri,)), 'open its page')} · "
        + markup.choose_box(uri, "choose")
        + (f"<br>changed: {escape(change)}" if change else ""),
    )
    if page.command is not None:
        page.command.content = markup.framed(
            markup.command(command), "<h3>Derivation</h3>", markup.code(str(derivation))
        )
    if page.evolve is not None:
        set_parent(page.evolve, None, uri.removeprefix(WORDS))
    page.session.run_in_background(lambda: _check(page), "check")


def _check(page: ComposePage) -> None:
    """Check the current robot, and show the findings unless another robot has replaced it."""
    robot = page.robot
    if robot is None or page.findings is None:
        return
    findings = check(robot, tool_required=has_tool(robot))
    if robot is page.robot:
        table = markup.findings_table(findings, page.session.files.redact)
        page.findings.content = markup.framed(table)


def _add_downloads_tab(page: ComposePage) -> None:
    """Add buttons that write or download the bundle, and the command."""
    gui, session = page.session.client.gui, page.session
    name = gui.add_text("name", "", hint="by default from its parts")
    write = gui.add_button(f"Write to {ROBOTS}/", icon=viser.Icon.DEVICE_FLOPPY)
    download = gui.add_button("Bundle (.zip)", icon=viser.Icon.DOWNLOAD)
    page.command = gui.add_html("")
    session.on_press(write, lambda: _write_bundle(page, name.value))
    session.on_press(download, lambda: _send_bundle(page, name.value))


def _named_robot(page: ComposePage, name: str) -> Robot:
    """Return the robot that the page shows under a name, by default its own."""
    if page.robot is None:
        raise CompositionError("no robot is shown: choose parts that fit, or draw one")
    return replace(page.robot, name=name or page.robot.name or "robot")


def _write_bundle(page: ComposePage, name: str) -> None:
    """Write the robot's bundle with findings and picture below ``robots/``."""
    session, robot = page.session, _named_robot(page, name)
    folder = bundle_folder(session.files.roots[0] / ROBOTS, robot.name)
    target = str(folder.relative_to(session.files.roots[0]))
    with session.activity(f"writing {target}"):
        session.run_in_worker(_write_checked, robot, folder)
    session.notify("Written", target)


def _write_checked(robot: Robot, folder: Path) -> None:
    """Write a bundle with findings and picture. Runs in a worker, which may use OpenGL."""
    write_bundle(robot, folder, check(robot))


def _send_bundle(page: ComposePage, name: str) -> None:
    """Send a zip of the robot's bundle to the browser."""
    session, robot = page.session, _named_robot(page, name)
    folder = bundle_folder(Path(), robot.name).name  # validates the name
    with session.activity("packing the bundle"):
        files = session.run_in_worker(new_bundle_files, robot)
        session.send_file(f"{folder}.zip", zip_files(folder, files))


GHOST_OPACITY = 0.16  # opacity of the previous robot
GESTURE_TIME = 1.0  # changes that follow each other faster, as of a slider, count as one [s]
_EDGE = 0.02  # share of the picture at its edges into which a robot may not reach


@dataclass(frozen=True)
class Facts:
    """Numbers of a robot that the page compares."""

    dof: int
    mass: float  # mass [kg]
    reach: float | None  # reach [m]; None for a robot without a tool or without joints


@dataclass(eq=False)
class ComposeView:
    """Robots in the scene of one browser."""

    session: Session
    shown: RobotView | None = None
    ghost: RobotView | None = None
    before: Facts | None = None  # facts of the ghost
    changed_at: float = -np.inf  # time of the last change by `time.monotonic` [s]
    count: int = 0  # number of robots shown so far; names the nodes of the scene


def robot_facts(robot: Robot) -> Facts:
    """Return the facts of a robot."""
    return Facts(robot.dof, robot.mass, arm_reach(robot) if has_tool(robot) and robot.dof else None)


def replace_robot(view: ComposeView, robot: Robot) -> str:
    """Show a robot; the one before it becomes the ghost, unless both belong to one gesture.

    Return what changed from the ghost to the robot; an empty text if there is no ghost.
    """
    client = view.session.client
    robot = split_colours(robot)
    is_gesture = time.monotonic() - view.changed_at < GESTURE_TIME
    previous = view.shown
    with client.atomic():
        view.count += 1
        view.shown = add_robot(client.scene, robot, f"/robot{view.count}")
        if previous is not None and (is_gesture and view.ghost is not None):
            previous.base.remove()
        elif previous is not None:
            if view.ghost is not None:
                view.ghost.base.remove()
            view.ghost, view.before = previous, robot_facts(previous.robot)
            _fade(previous)
    low, high = robot_bounds(robot)
    add_ground(client.scene, float(np.linalg.norm(high - low)))
    if previous is None:
        look_at(client, low, high)
    elif not _is_in_picture(view, low, high):
        look_at(client, low, high, _camera_direction(view))
    view.changed_at = time.monotonic()
    return change_text(view.before, robot_facts(robot)) if view.before else ""


def _fade(view: RobotView) -> None:
    """Make a robot the ghost."""
    view.set_opacity(GHOST_OPACITY)
    for shapes in view.layers["visual"]:
        for shape in shapes:
            shape.handle.cast_shadow = False


def change_text(before: Facts, after: Facts) -> str:
    """Return what differs between two robots, such as ``reach 1.08 to 1.68 m, mass +0.24 kg``."""
    parts = []
    if before.dof != after.dof:
        parts.append(f"{before.dof} to {after.dof} DoF")
    old, new = before.reach, after.reach
    if old is not None and new is not None and f"{old:.2f}" != f"{new:.2f}":
        parts.append(f"reach {old:.2f} to {new:.2f} m")
    if abs(difference := after.mass - before.mass) >= 0.005:
        parts.append(f"mass {difference:+.2f} kg")
    return ", ".join(parts)


def _is_in_picture(view: ComposeView, low: Array, high: Array) -> bool:
    """Return whether the camera sees all corners of a box."""
    picture = camera_view(view.session.client)
    points, depths = project_points(picture, box_corners(low, high))
    shares = points / (picture.aspect, 1.0)
    return bool((depths > 0).all() and (abs(shares - 0.5) <= 0.5 - _EDGE).all())


def _camera_direction(view: ComposeView) -> tuple[float, float, float]:
    camera = view.session.client.camera
    x, y, z = (float(value) for value in camera.position - camera.look_at)
    return (x, y, z) if np.linalg.norm((x, y)) > 1e-6 else CAMERA_DIRECTION


_MAX_CHANGES = 4  # lines of changes on a card
NO_GRAMMAR = (
    "This robot has no grammar whose choices could be drawn again. <i>mutants</i> makes one: "
    "parameters vary about their values, and arms and end-effectors may be replaced by others. "
    "You can edit it on the tab <i>Grammar</i>."
)
NO_ROBOT = "No robot is shown: choose parts that fit, or draw a robot on the tab <i>Grammar</i>."
HINT = "Click a robot, or <i>adopt</i> here, to go on with it."


@dataclass(eq=False)
class EvolveTab:
    """Controls of the tab in one browser."""

    session: Session
    grammar: GrammarTab  # the tab whose robot evolves
    seed: viser.GuiNumberHandle[int]
    grid: viser.GuiHtmlHandle
    parent: Individual | None = None  # the robot that is shown, if the grammar gave it
    source: str = ""  # words or URI of the robot that is shown, if no grammar gave it
    generation: list[Individual] = field(default_factory=list)
    scene: OffspringScene | None = None


def add_evolve_tab(
    session: Session, tabs: viser.GuiTabGroupHandle, grammar: GrammarTab
) -> EvolveTab:
    """Add the tab; it shows the mutants that the address asks for with the first robot."""
    gui, state = session.client.gui, session.address.state
    with tabs.add_tab("Evolve", viser.Icon.DNA):
        seed = gui.add_number("generation", parse_count(state.get("evolve", ""), 0), min=0, step=1)
        buttons = gui.add_button_group("show", ("mutants", "none"))
        tab = EvolveTab(session, grammar, seed, gui.add_html(""))

    def press() -> None:
        if buttons.value == "mutants":
            _next_generation(tab)
            return
        _clear_generation(tab)
        _show_in_address(tab)
        _show_generation(tab)

    def click(event: viser.SceneClickEvent) -> None:
        if tab.scene is not None:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            if (i := hit_robot(tab.scene.boxes, origin, direction)) is not None:
                _adopt(tab, i)

    def start(individual: Individual) -> None:
        """Show the first robot of the page with its mutants."""
        grammar.on_shown = functools.partial(set_parent, tab)
        set_parent(tab, individual)
        _breed(tab)

    session.on_change(buttons, press)
    session.on_change(seed, lambda: _breed(tab), "generation")
    session.actions["adopt"] = lambda value: _adopt(tab, parse_count(value, 0))
    session.client.scene.on_click()(lambda event: session.enqueue(lambda: click(event)))
    grammar.on_shown = start if "evolve" in state else functools.partial(set_parent, tab)
    _show_generation(tab)
    return tab


def offspring_html(parent: Individual, generation: Sequence[Individual]) -> str:
    """Return cards of the mutants with what differs from the parent; empty without mutants."""
    cards = []
    for i, individual in enumerate(generation):
        lines = change_lines(parent.derivation, individual.derivation)
        changes = "<br>".join(map(escape, lines[:_MAX_CHANGES]))
        changes += "<br>..." if lines[_MAX_CHANGES:] else ""
        facts = change_text(robot_facts(parent.robot), robot_facts(individual.robot))
        cards.append(
            f'<div><b>{i + 1}</b> <a data-do="adopt" data-value="{i}">adopt</a>'
            f"{markup.dim(f'{escape(facts)}<br>{changes}' if facts else changes)}</div>"
        )
    return f'<div class="offspring">{"".join(cards)}</div>' if cards else ""


def set_parent(tab: EvolveTab, individual: Individual | None, source: str = "") -> None:
    """Take the robot that is shown as the parent: one of the grammar, or else words or a URI."""
    tab.parent, tab.source = individual, source
    if individual is None:
        _clear_generation(tab)
    _show_generation(tab)


def _next_generation(tab: EvolveTab) -> None:
    """Show other mutants of the parent; a robot that no grammar gave gets a grammar first."""
    if tab.parent is None and tab.source:
        load_source(tab.grammar, tab.source)
    set_value(tab.seed, tab.seed.value + 1)
    _breed(tab)


def _breed(tab: EvolveTab) -> None:
    """Make the mutants in a worker process, and show them unless the parent has changed."""
    session, parent, seed = tab.session, tab.parent, tab.seed.value
    if parent is None:
        raise CompositionError("the robot has no grammar: press 'mutants', which makes one")
    grammar, folders = edited_grammar(tab.grammar), session.files.library_folders

    def show(generation: list[Individual]) -> None:
        if parent is tab.parent:
            _clear_generation(tab)
            tab.generation = generation
            robots = [individual.robot for individual in generation]
            tab.scene = add_offspring(session.client, parent.robot, robots)
            _show_in_address(tab)
            _show_generation(tab)

    def make() -> None:
        with session.activity("mutating"):
            generation = session.run_in_worker(mutants, grammar, folders, parent.choices, seed)
        session.enqueue(lambda: show(generation))

    session.run_in_background(make, "breed")


def _show_generation(tab: EvolveTab) -> None:
    """Show the cards of the mutants, or what to do so that the robot can evolve."""
    if tab.parent is None:
        content = markup.dim(NO_GRAMMAR if tab.source else NO_ROBOT)
    else:
        content = markup.dim(HINT) + offspring_html(tab.parent, tab.generation)
    tab.grid.content = markup.framed(content)


def _show_in_address(tab: EvolveTab) -> None:
    """Show in the address which mutants there are, and the choices that gave their parent."""
    state: dict[str, str] = {}
    if tab.generation and tab.parent is not None:
        state = {"choices": pack_choices(tab.parent.choices), "seed": "", "number": ""}
    evolve = str(tab.seed.value) if tab.generation else ""
    tab.session.address = tab.session.address.with_state(**state, evolve=evolve)
    tab.session.show_address(tab.session.title)


def _clear_generation(tab: EvolveTab) -> None:
    if tab.scene is not None:
        remove_offspring(tab.scene)
    tab.scene, tab.generation = None, []


def _adopt(tab: EvolveTab, i: int) -> None:
    """Show one of the mutants as the parent, with mutants of its own."""
    if i < len(tab.generation):
        tab.grammar.choices = tab.generation[i].choices
        show_grammar(tab.grammar, "chosen")
        _next_generation(tab)
