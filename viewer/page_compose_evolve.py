"""The tab of the compose page that evolves a robot of a grammar: mutants, children, undo."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import viser

from morphgen.errors import CompositionError
from morphgen.grammar.choosers import Choices
from morphgen.viewer import markup
from morphgen.viewer.address import parse_count
from morphgen.viewer.compose_output import ROBOTS, send_robot, write_robot
from morphgen.viewer.evolution import (
    History,
    Individual,
    offspring,
    pack_choices,
    unpack_choices,
)
from morphgen.viewer.evolution_html import history_html, offspring_html
from morphgen.viewer.page_compose_grammar import (
    GrammarTab,
    edited_grammar,
    load_source,
    show_grammar,
)
from morphgen.viewer.scene_offspring import (
    OffspringScene,
    add_offspring,
    hit_robot,
    remove_offspring,
)
from morphgen.viewer.session import Session, set_value

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
    """Forget the parent and remove its offspring: another robot is shown now.

    Args:
        tab: The tab.
        source: Words or URI of the robot.
    """
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
    """Return the robot that evolves.

    Raises:
        CompositionError: If there is none.
    """
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
