"""The population of a page in one browser: its arrangement, pose and selection, and the pointer."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import viser
from numpy.typing import NDArray

from morphgen.typing import Array
from morphgen.viewer import markup, population_layout, scene_population
from morphgen.viewer.address import Address
from morphgen.viewer.comparison import format_moves
from morphgen.viewer.population import Population, move_roles, robot_bounds, shape_poses
from morphgen.viewer.population_hover import update_script
from morphgen.viewer.population_pick import camera_view, project, robot_at, robots_in
from morphgen.viewer.population_source import (
    NUM_POSES,
    Source,
    load_free_configurations,
    load_map,
)
from morphgen.viewer.population_state import format_selection, selection_text
from morphgen.viewer.robot_rows import Row
from morphgen.viewer.scene_stage import add_ground, add_scale_bar, background_colour, look_at
from morphgen.viewer.session import Session, set_value
from morphgen.viewer.viser_internals import run_javascript

ARRANGEMENTS = {
    "grid": "grid",
    "reach": "rows by reach",
    "mass": "rows by mass",
    "dof": "rows by DoF",
    "scatter": "scatter of two facts",
    "map": "map of similarity",
}
"""Labels of the arrangements by their key in the address."""
POSES = ("home", "random free")
MIDDLE = 0.5
"""Position of a slider whose joints are at the pose."""
ADDRESS_DELAY = 0.5
"""Delay of URL updates after a move [s]."""
HOVER_DELAY = 0.15
"""Time after a move of the camera or the robots at which the browser's hover table is sent [s]."""
CAMERA_DIRECTION = (0.08, -0.8, 0.6)
"""Direction to the camera: rows run from left to right, and their order is the reader's."""


@dataclass(eq=False)
class PopulationPage:
    """A population in one browser."""

    session: Session
    source: Source
    population: Population
    scene: scene_population.PopulationScene
    arrange: viser.GuiDropdownHandle[str]
    axes: tuple[viser.GuiDropdownHandle[str], viser.GuiDropdownHandle[str]]
    """Facts along x and y of a scatter."""
    sliders: dict[str, viser.GuiSliderHandle[float]]
    """Sliders by role of the joints."""
    selected: NDArray[np.bool_]
    """Mask of the selected robots, shape (n,)."""
    moved: dict[str, float] = field(default_factory=dict)
    """Share of its range by each role that the user moved; other joints are at the pose."""
    pose: int = 0
    """Number of the free configuration, from 1; 0 for home."""
    texts: dict[str, viser.GuiHtmlHandle] = field(default_factory=dict)


def _current_q(page: PopulationPage) -> Array:
    """Return the configurations of all robots, shape (n, J)."""
    population = page.population
    q = population.home
    if page.pose:
        q = _free_configurations(page)[0][page.pose - 1]
    return move_roles(population, q, page.moved)


def _free_configurations(page: PopulationPage) -> tuple[Array, NDArray[np.bool_]]:
    """Return ``load_free_configurations``, once for all browsers."""
    session, population = page.session, page.population

    def progress(done: int, total: int) -> None:
        session.set_status(f"testing {total} robots for collisions", done / total)

    return session.cached(
        f"free {page.source.key}",
        lambda: load_free_configurations(population, session.workers, progress),
    )


def _positions(page: PopulationPage) -> population_layout.Layout:
    """Return where the robots stand by the chosen arrangement."""
    rows, session = page.population.rows, page.session
    cell = population_layout.cell_size(page.population.home_bounds)
    key = _arrangement(page)
    if key == "grid":
        return population_layout.grid(page.population.home_bounds)
    if key == "scatter":
        return population_layout.scatter(rows, page.axes[0].value, page.axes[1].value, cell)
    if key != "map":
        return population_layout.sorted_grid(rows, key, page.population.home_bounds)

    def progress(done: int, total: int) -> None:
        session.set_status(f"comparing {total} robots", done / total)

    points = session.cached(
        f"map {page.source.key}",
        lambda: load_map(page.population, session.files, session.workers, progress),
    )
    return population_layout.similarity_map(points, cell)


def _arrangement(page: PopulationPage) -> str:
    """Return the key of the chosen arrangement."""
    return next(key for key, label in ARRANGEMENTS.items() if label == page.arrange.value)


def arrange_robots(page: PopulationPage) -> None:
    """Move the robots to their places, with labels and the camera in front of them."""
    scene, client = page.scene, page.session.client
    is_scatter = _arrangement(page) == "scatter"
    for axis in page.axes:
        axis.visible = is_scatter
    layout = _positions(page)
    q = _current_q(page)
    bounds = robot_bounds(page.population, shape_poses(page.population, q))
    roots = np.pad(layout.positions, ((0, 0), (0, 1)))
    labels = np.array([(*position, 0.0) for _, position in layout.labels]).reshape(-1, 3)
    low = np.concatenate([bounds[:, 0] + roots, labels]).min(axis=0)
    high = np.concatenate([bounds[:, 1] + roots, labels]).max(axis=0)
    with client.atomic():
        for handle in scene.labels:
            handle.remove()
        scene_population.move(scene, layout.positions, q)
        scene.labels = [
            client.scene.add_label(f"/labels/{i}", text, position=(*position, 0.0))
            for i, (text, position) in enumerate(layout.labels)
        ]
        add_ground(client.scene, float(np.linalg.norm(high - low)))
        add_scale_bar(client.scene, low, high, CAMERA_DIRECTION)
        look_at(client, low, high, CAMERA_DIRECTION)
    _show_in_address(page)
    _update_hover_later(page)


def go_to(page: PopulationPage, target: str) -> None:
    """Move all robots home, or to the next of their configurations without collision."""
    page.moved = {}
    if target == POSES[0]:
        page.pose = 0
    else:
        page.pose = page.pose % NUM_POSES + 1
        found = _free_configurations(page)[1]
        if not found.all():
            text = f"no free configuration of {int((~found).sum())} robots was found"
            page.session.notify("Some stay at home", text)
    for slider in page.sliders.values():
        set_value(slider, MIDDLE)
    _move(page)


def read_sliders(page: PopulationPage) -> None:
    """Move the joints whose slider the user has moved."""
    for role, slider in page.sliders.items():
        if role in page.moved or slider.value != MIDDLE:
            page.moved[role] = slider.value
    _move(page)


def _move(page: PopulationPage) -> None:
    scene_population.move(page.scene, page.scene.positions, _current_q(page))
    page.session.call_later(ADDRESS_DELAY, lambda: _show_in_address(page), "address")
    _update_hover_later(page)


def selected_rows(page: PopulationPage) -> list[Row]:
    """Return the rows of the selected robots."""
    return [page.population.rows[i] for i in np.flatnonzero(page.selected)]


def show_selection(page: PopulationPage) -> None:
    """Show which robots are selected, in the scene, the panel and the address."""
    background = background_colour(dark=page.session.dark)
    scene_population.fade(page.scene, page.selected, background)
    page.texts["selection"].content = markup.framed(selection_text(selected_rows(page)))
    _show_in_address(page)


def _show_in_address(page: PopulationPage) -> None:
    key = _arrangement(page)
    page.session.update_address(
        page.session.address.subject,
        arrange="" if key == "grid" else key,
        x=page.axes[0].value if key == "scatter" else "",
        y=page.axes[1].value if key == "scatter" else "",
        pose=str(page.pose) if page.pose else "",
        select=format_selection(page.selected),
        **format_moves(page.moved, tuple(page.sliders)),
    )


def connect_pointer(page: PopulationPage) -> None:
    """Let clicks open robots and rectangles select them."""
    session, scene = page.session, page.session.client.scene
    scene.on_click()(lambda event: session.enqueue(lambda: _open_robot(page, event)))
    scene.on_click(modifier="shift")(
        lambda event: session.enqueue(lambda: _toggle_robot(page, event))
    )
    scene.on_rect_select(modifier="shift")(
        lambda event: session.enqueue(lambda: _select_rectangle(page, event))
    )
    session.client.camera.on_update(lambda camera: _update_hover_later(page))


def _clicked_robot(page: PopulationPage, event: viser.SceneClickEvent) -> int | None:
    view = camera_view(page.session.client)
    capsules = project(view, page.population, page.scene.T_world_shape)
    return robot_at(capsules, np.array(event.screen_pos) * (view.aspect, 1.0))


def _open_robot(page: PopulationPage, event: viser.SceneClickEvent) -> None:
    if (robot := _clicked_robot(page, event)) is not None:
        page.session.open_address(Address("robot", (page.population.rows[robot].uri,)))


def _toggle_robot(page: PopulationPage, event: viser.SceneClickEvent) -> None:
    if (robot := _clicked_robot(page, event)) is not None:
        page.selected[robot] ^= True
        show_selection(page)


def _select_rectangle(page: PopulationPage, event: viser.SceneRectSelectEvent) -> None:
    """Select the robots inside a rectangle instead of the previous selection."""
    view = camera_view(page.session.client)
    corners = np.array([event.screen_min, event.screen_max]) * (view.aspect, 1.0)
    centres = page.population.home_bounds.mean(axis=1)
    centres[:, :2] += page.scene.positions
    page.selected = robots_in(view, centres, corners.min(axis=0), corners.max(axis=0))
    show_selection(page)


def _update_hover_later(page: PopulationPage) -> None:
    """Send the browser's hover table, once what moves has stopped."""

    def update() -> None:
        capsules = project(
            camera_view(page.session.client), page.population, page.scene.T_world_shape
        )
        run_javascript(page.session.client, update_script(capsules))

    page.session.call_later(HOVER_DELAY, update, "hover")
