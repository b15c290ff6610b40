"""The page of a population: many robots on one ground, arranged, moved and selected together."""

from __future__ import annotations

from html import escape
from typing import Any

import viser

from morphgen.viewer import markup, population_layout, scene_population
from morphgen.viewer.address import Address, parse_count
from morphgen.viewer.comparison import parse_moves
from morphgen.viewer.page_index import show_index
from morphgen.viewer.page_population_actions import add_actions
from morphgen.viewer.page_population_show import (
    ARRANGEMENTS,
    MIDDLE,
    POSES,
    PopulationPage,
    arrange_robots,
    connect_pointer,
    go_to,
    read_sliders,
    show_selection,
)
from morphgen.viewer.population import Population
from morphgen.viewer.population_hover import install_script
from morphgen.viewer.population_source import (
    NUM_POSES,
    NUM_SAMPLED,
    Source,
    find_source,
    load_population,
)
from morphgen.viewer.population_state import card, parse_selection
from morphgen.viewer.session import Session
from morphgen.viewer.viser_internals import run_javascript

PANEL_WIDTH = 340.0
"""Width of the panel [pixels]."""


def show(session: Session) -> None:
    """Build the page.

    Raises:
        MorphgenError: If the address names no robots.
    """
    if not session.address.subject:
        show_index(session)
        return
    subject, state = session.address.subject, session.address.state
    seed, number = (
        parse_count(state.get(key, ""), value)
        for key, value in (("seed", 0), ("number", NUM_SAMPLED))
    )
    source = find_source(subject, session.files, seed, number)
    crumbs = markup.breadcrumbs((subject, _gallery_address(subject, source)), ("population", None))
    session.open_panel(PANEL_WIDTH, crumbs, f"reading {len(source.rows)} robots")
    session.run_in_background(lambda: _load(session, source))


def _gallery_address(subject: str, source: Source) -> Address:
    if source.grammar:
        return Address("compose", (source.grammar,))
    split = subject.rpartition("@")[0] or subject
    return Address("split" if source.rows[0].role else "gallery", (split,))


def _load(session: Session, source: Source) -> None:
    """Read the robots, once for all browsers, and show them."""

    def progress(done: int, total: int) -> None:
        session.set_status(f"reading {total} robots", done / total)

    population, faults = session.cached(
        f"population {source.key}",
        lambda: load_population(source, session.files, session.workers, progress),
    )
    if not session.closed.is_set():
        session.enqueue(lambda: _show_population(session, source, population, faults))


def _show_population(
    session: Session, source: Source, population: Population, faults: list[tuple[str, str]]
) -> None:
    """Draw the robots in a grid at home, add the controls, and apply the address."""
    client, state, n = session.client, session.address.state, len(population)
    session.set_status("sending the shapes to the browser")
    layout = population_layout.grid(population.home_bounds)
    scene = scene_population.add_population(client, population, layout.positions, population.home)
    client.gui.add_html(markup.framed(_summary(source, population, faults)))
    arrange, axes = _add_arrangement(session)
    pose_buttons, sliders = _add_sliders(session, population)
    page = PopulationPage(
        session,
        source,
        population,
        scene,
        arrange,
        axes,
        sliders,
        parse_selection(state.get("select", ""), n),
        parse_moves(state, population.roles, 0.0),
        min(parse_count(state.get("pose", ""), 0), NUM_POSES),
    )
    add_actions(page)
    for control in (arrange, *axes):
        session.on_change(control, lambda: arrange_robots(page), "arrange")
    session.on_change(pose_buttons, lambda: go_to(page, pose_buttons.value))
    for slider in sliders.values():
        session.on_change(slider, lambda: read_sliders(page), "move")
    connect_pointer(page)
    run_javascript(client, install_script([card(row) for row in population.rows]))
    session.set_status("")
    arrange_robots(page)
    show_selection(page)


def _summary(source: Source, population: Population, faults: list[tuple[str, str]]) -> str:
    """Return the number of robots, what is missing, and how to use the pointer."""
    text = f"<h3>{len(population)} robots</h3>"
    if source.total > len(source.rows):
        text += markup.dim(f"the first {len(source.rows)} of {source.total}")
    if faults:
        lines = "<br>".join(f"{escape(name)}: {escape(error)}" for name, error in faults[:5])
        text += f"{markup.tag(f'{len(faults)} cannot be read', 'error')}{markup.dim(lines)}"
    if len(population) > scene_population.MAX_SHADOWS:
        text += markup.dim(f"without shadows: more than {scene_population.MAX_SHADOWS} robots")
    return text + markup.dim(
        "Point at a robot for its facts, click to open it. Shift and drag selects a rectangle, "
        "shift and click one robot."
    )


def _add_arrangement(
    session: Session,
) -> tuple[
    viser.GuiDropdownHandle[str],
    tuple[viser.GuiDropdownHandle[str], viser.GuiDropdownHandle[str]],
]:
    """Add the controls of the arrangement, in the state of the address."""
    gui, state = session.client.gui, session.address.state
    facts = tuple(population_layout.UNITS)
    label = ARRANGEMENTS.get(state.get("arrange", ""), ARRANGEMENTS["grid"])
    arrange = gui.add_dropdown("Arrange", tuple(ARRANGEMENTS.values()), initial_value=label)
    x, y = (
        gui.add_dropdown(axis, facts, initial_value=fact if fact in facts else default)
        for axis, fact, default in (
            ("to the right", state.get("x", ""), "reach"),
            ("away", state.get("y", ""), "mass"),
        )
    )
    return arrange, (x, y)


def _add_sliders(
    session: Session, population: Population
) -> tuple[Any, dict[str, viser.GuiSliderHandle[float]]]:
    """Add the buttons of poses and a slider for each role of joints."""
    gui = session.client.gui
    buttons = gui.add_button_group("Pose", POSES)
    sliders = {}
    shares = parse_moves(session.address.state, population.roles, 0.0)
    folders = [
        ("Joints from the base to the tool", [r for r in population.roles if r[0] == "j"]),
        ("Fingers and other joints", [r for r in population.roles if r[0] != "j"]),
    ]
    for title, roles in folders:
        if not roles:
            continue
        with gui.add_folder(title, expand_by_default=roles[0][0] == "j"):
            for role in roles:
                number = int((population.role == population.roles.index(role)).any(axis=1).sum())
                hint = f"share of its range, of {number} robots"
                sliders[role] = gui.add_slider(
                    role, 0.0, 1.0, 0.01, shares.get(role, MIDDLE), hint=hint
                )
    return buttons, sliders
