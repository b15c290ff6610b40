"""The tab of the compose page that evolves a robot of a grammar: mutants, children, undo."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import numpy as np
import viser

from morphgen.checks import check
from morphgen.errors import CompositionError
from morphgen.formats.bundle import bundle_folder, split_colours, write_bundle
from morphgen.grammar.derive import Choices
from morphgen.grammar.robot_set import INDEX
from morphgen.model.inertia import box_corners
from morphgen.model.kinematics import arm_reach
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import markup
from morphgen.viewer.app.address import parse_count
from morphgen.viewer.app.session import Session, set_value
from morphgen.viewer.pages.compose_grammar import (
    GrammarTab,
    History,
    Individual,
    change_lines,
    edited_grammar,
    load_source,
    offspring,
    pack_choices,
    show_grammar,
    unpack_choices,
)
from morphgen.viewer.population_pick import camera_view, project_points
from morphgen.viewer.robot_files import new_bundle_files, zip_files
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.scene.robot import (
    OffspringScene,
    RobotView,
    add_offspring,
    add_robot,
    hit_robot,
    remove_offspring,
    robot_bounds,
)
from morphgen.viewer.scene.stage import CAMERA_DIRECTION, add_ground, look_at

ROBOTS = "robots"
"""Folder in which bundles are written."""


def write_robot(session: Session, robot: Robot, name: str, set_name: str = "") -> None:
    """Write a robot's bundle with findings and picture below ``robots/``."""
    parent = session.files.roots[0] / ROBOTS
    if set_name:
        parent = bundle_folder(parent, set_name)
        if (parent / INDEX).exists():
            raise CompositionError(
                f"{ROBOTS}/{set_name} is a set of morphgen sample, which draws its robots itself; "
                "expected another name"
            )
    folder = bundle_folder(parent, name)
    target = str(folder.relative_to(session.files.roots[0]))
    session.set_status(f"writing {target}")
    session.run_in_worker(_write_checked, robot, folder)
    session.set_status("")
    session.notify("Written", target)


def send_robot(session: Session, robot: Robot, name: str) -> None:
    """Send a zip of a robot's bundle to the browser."""
    name = bundle_folder(Path(), name).name  # validates the name
    session.set_status("packing the bundle")
    files = session.run_in_worker(new_bundle_files, robot)
    session.client.send_file_download(f"{name}.zip", zip_files(name, files), save_immediately=True)
    session.set_status("")


def _write_checked(robot: Robot, folder: Path) -> None:
    """Write a bundle with findings and picture. Runs in a worker, which may use OpenGL."""
    write_bundle(robot, folder, check(robot))


GHOST_OPACITY = 0.16
"""Opacity of the previous robot."""
GESTURE_TIME = 1.0
"""Changes that follow each other faster, as those of a moved slider, count as one [s]."""
_EDGE = 0.02
"""Share of the picture at its edges into which a robot may not reach."""


@dataclass(frozen=True)
class Facts:
    """Numbers of a robot that the page compares."""

    dof: int
    mass: float
    """Mass [kg]."""
    reach: float | None
    """Reach [m]; None for a robot without a tool or without joints."""


@dataclass(eq=False)
class ComposeView:
    """Robots in the scene of one browser."""

    session: Session
    shown: RobotView | None = None
    ghost: RobotView | None = None
    before: Facts | None = None
    """Facts of the ghost."""
    changed_at: float = -np.inf
    """Time of the last change by ``time.monotonic`` [s]."""
    count: int = 0
    """Number of robots shown so far; names the nodes of the scene."""


def robot_facts(robot: Robot) -> Facts:
    """Return the facts of a robot."""
    return Facts(robot.dof, robot.mass, arm_reach(robot) if has_tool(robot) and robot.dof else None)


def show(view: ComposeView, robot: Robot) -> str:
    """Show a robot; the one before it becomes the ghost, unless both belong to one gesture.

    The camera stays, unless the robot leaves the picture.

    Returns:
        What changed from the ghost to the robot; empty if there is no ghost.
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


_MAX_CHANGES = 4
"""Lines of changes on a card."""


def history_html(history: History) -> str:
    """Return a tag for each individual; a click recalls it, the current one is coloured."""
    chips = []
    for i, individual in enumerate(history.individuals):
        name = escape(individual.robot.name.rpartition("-")[2][:6])
        style = "info" if i == history.position else ""
        chips.append(f'<a data-do="recall" data-value="{i}">{markup.tag(name, style)}</a>')
    return " ".join(chips)


def offspring_html(
    parent: Individual, generation: Sequence[Individual], picked: Collection[int]
) -> str:
    """Return cards of the offspring with what differs from the parent; empty without offspring."""
    cards = []
    for i, individual in enumerate(generation):
        lines = change_lines(parent.derivation, individual.derivation)
        changes = "<br>".join(map(escape, lines[:_MAX_CHANGES]))
        changes += "<br>..." if lines[_MAX_CHANGES:] else ""
        facts = change_text(robot_facts(parent.robot), robot_facts(individual.robot))
        checked = " checked" if i in picked else ""
        cards.append(
            f'<div><b>{i + 1}</b> <a data-do="adopt" data-value="{i}">adopt</a> '
            f'<label><input type="checkbox" data-do="pick" data-value="{i}"{checked}> cross</label>'
            f"{markup.dim(f'{escape(facts)}<br>{changes}' if facts else changes)}</div>"
        )
    return f'<div class="offspring">{"".join(cards)}</div>' if cards else ""


NO_GRAMMAR = (
    "This robot has no grammar whose choices could be drawn again. <i>Evolve this robot</i> makes "
    "one: parameters vary about their values, and arms and end-effectors may be replaced by "
    "others. You can edit it on the tab <i>Grammar</i>."
)
NO_ROBOT = "No robot is shown: choose parts that fit, or draw a robot on the tab <i>Grammar</i>."
HINT = (
    "Click a robot, or <i>adopt</i> here, to go on with it. Tick two to cross them. Ctrl+Z and "
    "Ctrl+Y undo and redo."
)


@dataclass(eq=False)
class EvolveTab:
    """Controls of the tab in one browser."""

    session: Session
    grammar: GrammarTab
    """The tab whose robot evolves."""
    make: viser.GuiButtonHandle
    """Makes a grammar around a robot that none has given."""
    seed: viser.GuiNumberHandle[int]
    grid: viser.GuiHtmlHandle
    strip: viser.GuiHtmlHandle
    """The history."""
    set_name: viser.GuiTextHandle
    parent: Individual | None = None
    """The robot that is shown, if the grammar gave it."""
    source: str = ""
    """Words or URI of the robot that is shown, if no grammar gave it."""
    partner: Choices | None = None
    """Choices of the other parent, if the generation was crossed."""
    generation: list[Individual] = field(default_factory=list)
    scene: OffspringScene | None = None
    picked: list[int] = field(default_factory=list)
    """Indices of the offspring that are to be crossed."""
    history: History = field(default_factory=History)
    text: str = ""
    """Text of the grammar that the history is about."""


def add_evolve_tab(
    session: Session, tabs: viser.GuiTabGroupHandle, grammar: GrammarTab
) -> EvolveTab:
    """Add the tab; it shows the offspring that the address asks for with the first robot."""
    gui, state = session.client.gui, session.address.state
    with tabs.add_tab("Evolve", viser.Icon.DNA):
        make = gui.add_button("Evolve this robot", icon=viser.Icon.DNA, visible=False)
        seed = gui.add_number("generation", parse_count(state.get("evolve", ""), 0), min=0, step=1)
        buttons = gui.add_button_group("show", ("mutants", "cross", "none"))
        steps = gui.add_button_group("history", ("undo", "redo"))
        strip, grid = gui.add_html(""), gui.add_html("")
        with gui.add_folder("Keep the robot"):
            set_name = gui.add_text("set", "", hint=f"folder below {ROBOTS}/")
            keep = gui.add_button("Add to set", icon=viser.Icon.DEVICE_FLOPPY)
            export = gui.add_button("Export bundle (.zip)", icon=viser.Icon.DOWNLOAD)
    tab = EvolveTab(session, grammar, make, seed, grid, strip, set_name)
    if "with" in state:
        tab.partner = unpack_choices(state["with"])
    is_asked = "evolve" in state
    actions: dict[str, Callable[[], object]] = {
        "mutants": lambda: _next_generation(tab),
        "cross": lambda: _cross(tab),
        "none": lambda: _hide(tab),
        "undo": lambda: _step(tab, -1),
        "redo": lambda: _step(tab, 1),
    }
    session.on_change(make, lambda: _next_generation(tab))
    session.on_change(buttons, lambda: actions[buttons.value]())
    session.on_change(steps, lambda: actions[steps.value]())
    session.on_change(seed, lambda: _breed(tab), "generation")
    session.on_change(keep, lambda: session.run_in_background(lambda: _add_to_set(tab)))
    session.on_change(export, lambda: session.run_in_background(lambda: _export(tab)))
    session.actions |= {
        "adopt": lambda value: _adopt(tab, parse_count(value, 0)),
        "pick": lambda value: _pick(tab, parse_count(value, 0)),
        "recall": lambda value: _step(tab, parse_count(value, 0) - tab.history.position),
    }
    for label, key, step in (("Undo", "Z", -1), ("Redo", "Y", 1)):
        command = gui.add_command(label, hotkey=key, modifier="cmd/ctrl")  # type: ignore[arg-type]
        session.on_command(command, functools.partial(_step, tab, step))
    scene = session.client.scene
    scene.on_click()(lambda event: session.enqueue(lambda: _click(tab, event, adopt=True)))
    scene.on_click(modifier="shift")(
        lambda event: session.enqueue(lambda: _click(tab, event, adopt=False))
    )
    grammar.on_shown = lambda individual: set_parent(tab, individual)
    show_parent(tab)
    if is_asked:
        grammar.on_shown = lambda individual: _start(tab, individual)
    return tab


def show_parent(tab: EvolveTab) -> None:
    """Show the history and the generation, or what to do so that the robot can evolve."""
    tab.make.visible = tab.parent is None and bool(tab.source)
    if tab.parent is None:
        tab.strip.content = ""
        tab.grid.content = markup.framed(markup.dim(NO_GRAMMAR if tab.source else NO_ROBOT))
        return
    tab.strip.content = markup.framed(history_html(tab.history))
    tab.grid.content = markup.framed(
        markup.dim(HINT), offspring_html(tab.parent, tab.generation, tab.picked)
    )


def leave_parent(tab: EvolveTab, source: str) -> None:
    """Forget the parent and remove its offspring: another robot is shown now."""
    tab.parent, tab.source = None, source
    _clear_generation(tab)
    show_parent(tab)


def set_parent(tab: EvolveTab, individual: Individual) -> None:
    """Take the robot that the grammar gave as the parent, and remember it in the history."""
    if tab.text != tab.grammar.text.value:
        tab.text, tab.history = tab.grammar.text.value, History()
    tab.parent = individual
    history = tab.history
    current = history.individuals[history.position] if history.individuals else None
    if current is None or current.derivation != individual.derivation:
        history.add(individual)
    if not tab.set_name.value:
        set_value(tab.set_name, f"{tab.grammar.name}-evolved")
    show_parent(tab)


def _start(tab: EvolveTab, individual: Individual) -> None:
    """Show the first robot of the page with the generation that the address asks for."""
    tab.grammar.on_shown = lambda later: set_parent(tab, later)
    set_parent(tab, individual)
    _breed(tab)


def _next_generation(tab: EvolveTab, partner: Choices | None = None) -> None:
    """Show other mutants of the parent, or children of it and a partner.

    A robot that no grammar gave gets a grammar first.
    """
    if tab.parent is None and tab.source:
        load_source(tab.grammar, tab.source)
    tab.partner = partner
    set_value(tab.seed, tab.seed.value + 1)
    _breed(tab)


def _breed(tab: EvolveTab) -> None:
    """Make the offspring in a worker process, and show it."""
    parent = _require_parent(tab)
    session, seed = tab.session, tab.seed.value
    parents = [parent.choices, *([tab.partner] if tab.partner else [])]
    grammar = edited_grammar(tab.grammar)

    def make() -> None:
        session.set_status("mutating" if len(parents) == 1 else "crossing")
        folders = session.files.library_folders
        generation = session.run_in_worker(offspring, grammar, folders, parents, seed)
        session.set_status("")
        session.enqueue(lambda: _show_generation(tab, parent, generation))

    session.run_in_background(make, "breed")


def _show_generation(tab: EvolveTab, parent: Individual, generation: list[Individual]) -> None:
    """Draw the offspring beside the parent, unless another parent has replaced it."""
    if parent is not tab.parent:
        return
    _clear_generation(tab)
    tab.generation = generation
    robots = [individual.robot for individual in generation]
    tab.scene = add_offspring(tab.session.client, parent.robot, robots)
    _show_in_address(tab)
    show_parent(tab)


def _show_in_address(tab: EvolveTab) -> None:
    is_shown = bool(tab.generation) and tab.parent is not None
    choices = pack_choices(tab.parent.choices) if is_shown and tab.parent else ""
    if is_shown:
        tab.session.address = tab.session.address.with_state(choices=choices, seed="", number="")
    tab.session.update_address(
        tab.session.title,
        evolve=str(tab.seed.value) if is_shown else "",
        **{"with": pack_choices(tab.partner) if is_shown and tab.partner else ""},
    )


def _clear_generation(tab: EvolveTab) -> None:
    if tab.scene is not None:
        remove_offspring(tab.scene)
    tab.scene, tab.generation, tab.picked = None, [], []


def _hide(tab: EvolveTab) -> None:
    _clear_generation(tab)
    tab.partner = None
    _show_in_address(tab)
    show_parent(tab)


def _adopt(tab: EvolveTab, i: int) -> None:
    """Show one of the offspring as the parent, with mutants of its own."""
    if i < len(tab.generation):
        _show_individual(tab, tab.generation[i])
        _next_generation(tab)


def _show_individual(tab: EvolveTab, individual: Individual) -> None:
    tab.partner = None
    tab.grammar.choices = individual.choices
    show_grammar(tab.grammar, "chosen")


def _pick(tab: EvolveTab, i: int) -> None:
    """Pick one of the offspring for crossing, or put it back; of three, the first is put back."""
    if i in tab.picked:
        tab.picked.remove(i)
    elif i < len(tab.generation):
        tab.picked = [*tab.picked[-1:], i]
    if tab.scene is not None:
        for k, label in enumerate(tab.scene.labels):
            label.text = f"{k + 1} · cross" if k in tab.picked else str(k + 1)
    show_parent(tab)


def _cross(tab: EvolveTab) -> None:
    """Show the first picked robot as the parent, with children of both."""
    if len(tab.picked) != 2:
        raise CompositionError(f"{len(tab.picked)} robots are picked to cross; expected 2")
    first, second = (tab.generation[i] for i in tab.picked)
    _show_individual(tab, first)
    _next_generation(tab, second.choices)


def _step(tab: EvolveTab, step: int) -> None:
    """Go back or forth in the history."""
    if step and (individual := tab.history.go_to(tab.history.position + step)) is not None:
        _show_individual(tab, individual)


def _click(tab: EvolveTab, event: viser.SceneClickEvent, *, adopt: bool) -> None:
    """Adopt or pick the robot under the pointer."""
    if tab.scene is None:
        return
    origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
    if (i := hit_robot(tab.scene.boxes, origin, direction)) is not None:
        (_adopt if adopt else _pick)(tab, i)


def _require_parent(tab: EvolveTab) -> Individual:
    """Return the robot that evolves."""
    if tab.parent is None:
        raise CompositionError(
            "the robot has no grammar: press 'Evolve this robot', or draw one on the tab Grammar"
        )
    return tab.parent


def _add_to_set(tab: EvolveTab) -> None:
    robot = _require_parent(tab).robot
    write_robot(tab.session, robot, robot.name, tab.set_name.value)


def _export(tab: EvolveTab) -> None:
    robot = _require_parent(tab).robot
    send_robot(tab.session, robot, robot.name)
