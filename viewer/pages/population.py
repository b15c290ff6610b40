"""The page of a population: many robots on one ground, arranged, moved and selected together."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from morphgen.benchmark.split import SIDES
from morphgen.errors import BenchmarkError
from morphgen.grammar.robot_set import remove_robots
from morphgen.typing import Array
from morphgen.viewer import markup, population_layout
from morphgen.viewer.app.address import MAX_COMPARED, Address, parse_count
from morphgen.viewer.app.session import Session, set_value
from morphgen.viewer.app.viser_internals import run_javascript
from morphgen.viewer.comparison import format_moves, parse_moves
from morphgen.viewer.pages.index import show_index
from morphgen.viewer.population import (
    NUM_POSES,
    NUM_SAMPLED,
    Population,
    Source,
    find_source,
    load_free_configurations,
    load_map,
    load_population,
    move_roles,
    robot_bounds,
    shape_poses,
)
from morphgen.viewer.population_layout import UNITS
from morphgen.viewer.population_pick import (
    TOLERANCE,
    Capsules,
    camera_view,
    project,
    robot_at,
    robots_in,
)
from morphgen.viewer.robot_files import send_bundles
from morphgen.viewer.robot_rows import Row, facts_line
from morphgen.viewer.robot_uri import UriError, owned_set
from morphgen.viewer.scene import population as scene_population
from morphgen.viewer.scene.stage import add_ground, add_scale_bar, background_colour, look_at
from morphgen.viewer.splits import ChooseSides, add_split_form


def card(row: Row) -> str:
    """Return the card that a browser shows of the robot under the pointer."""
    findings = "no findings" if row.findings == () else ", ".join(row.findings or ["not checked"])
    side = f" · {row.role}" if row.role else ""
    return (
        f"<b>{escape(row.name)}</b>{escape(side)}<br>{escape(facts_line(row))}<br>"
        f'<span style="color:#868e96">{escape(findings)}</span>'
    )


def format_selection(selected: NDArray[np.bool_]) -> str:
    """Return the indices of selected robots as ranges, such as ``0-4,9``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], selected, [False]]).astype(int)))
    pairs = edges.reshape(-1, 2).tolist()
    return ",".join(f"{a}" if b == a + 1 else f"{a}-{b - 1}" for a, b in pairs)


def parse_selection(text: str, n: int) -> NDArray[np.bool_]:
    """Return the mask of robots that ranges select, shape (n,); what is invalid selects nothing."""
    selected = np.zeros(n, dtype=np.bool_)
    for part in text.split(","):
        first, dash, last = part.partition("-")
        start = parse_count(first, n)
        selected[start : (parse_count(last, -1) if dash else start) + 1] = True
    return selected


def selection_text(rows: Sequence[Row]) -> str:
    """Return the number of selected robots and the ranges of their facts as HTML."""
    if not rows:
        return markup.dim("no robot is selected")
    lines = [", ".join(row.name for row in rows[:3]) + (", ..." if len(rows) > 3 else "")]
    for fact in ("reach", "mass", "dof"):
        values = [value for row in rows if (value := getattr(row, fact)) is not None]
        if values:
            low, high = min(values), max(values)
            numbers = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
            lines.append(f"{'' if fact == 'dof' else fact + ' '}{numbers} {UNITS[fact]}")
    return f"<b>{len(rows)} selected</b>{markup.dim('<br>'.join(map(escape, lines)))}"


SCALE = 8192
"""Steps of the table's integers per height of the picture."""
_INSTALL = """
const hover = window.morphgenHover = { cards: %(cards)s, table: null };
document.getElementById("morphgen-hover")?.remove();
const card = document.createElement("div");
card.id = "morphgen-hover";
card.style.cssText = "position:fixed;display:none;pointer-events:none;z-index:50;padding:6px 9px;"
  + "border-radius:6px;font:12.5px/1.45 system-ui,sans-serif;max-width:300px;color:#212529;"
  + "background:#fffffff2;box-shadow:0 1px 8px #0004";
document.body.append(card);
const hide = () => { card.style.display = "none"; };
const find = (x, y) => {
  const t = hover.table;
  let best = %(tolerance)s, found = -1;
  for (let i = 0; t && i < t.length; i += 6) {
    const ax = t[i] - x, ay = t[i + 1] - y, dx = t[i + 2] - t[i], dy = t[i + 3] - t[i + 1];
    const share = Math.min(1, Math.max(0, -(ax * dx + ay * dy) / Math.max(dx * dx + dy * dy, 1)));
    const distance = Math.hypot(ax + share * dx, ay + share * dy) - t[i + 4];
    if (distance <= 0) return t[i + 5];
    if (distance <= best) { best = distance; found = t[i + 5]; }
  }
  return found;
};
window.addEventListener("pointermove", (event) => {
  if (window.morphgenHover !== hover) return;
  if (event.buttons || event.target.tagName !== "CANVAS") return hide();
  const box = event.target.getBoundingClientRect(), unit = %(scale)s / box.height;
  const robot = find((event.clientX - box.left) * unit, (event.clientY - box.top) * unit);
  event.target.style.cursor = robot < 0 ? "" : "pointer";
  if (robot < 0) return hide();
  card.innerHTML = hover.cards[robot];
  card.style.display = "block";
  card.style.left = Math.min(event.clientX + 14, box.right - card.offsetWidth - 4) + "px";
  card.style.top = Math.min(event.clientY + 14, box.bottom - card.offsetHeight - 4) + "px";
});
window.addEventListener("wheel", hide, { passive: true });
"""
_UPDATE = """
const bytes = Uint8Array.from(atob("%s"), (c) => c.charCodeAt(0));
if (window.morphgenHover) window.morphgenHover.table = new Int16Array(bytes.buffer);
"""


def install_script(cards: Sequence[str]) -> str:
    """Return the JavaScript that shows cards."""
    values = {"cards": json.dumps(list(cards)), "tolerance": TOLERANCE * SCALE, "scale": SCALE}
    return _INSTALL % values


def update_script(capsules: Capsules) -> str:
    """Return the JavaScript that replaces the table of what is where in the picture."""
    return _UPDATE % base64.b64encode(pack_capsules(capsules)).decode()


def pack_capsules(capsules: Capsules) -> bytes:
    """Return six little-endian 16-bit integers per capsule: ends, radius, robot."""
    limit = 2**15 - 1
    table = np.empty((len(capsules.robot), 6))
    table[:, :4] = SCALE * capsules.ends.reshape(-1, 4)
    table[:, 4], table[:, 5] = SCALE * capsules.radius, capsules.robot
    return np.clip(np.round(table), -limit, limit).astype("<i2").tobytes()


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
    return session.cached(
        f"free {page.source.key}",
        lambda: load_free_configurations(population, session.workers),
        "testing {} robots for collisions",
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
    points = session.cached(
        f"map {page.source.key}",
        lambda: load_map(page.population, session.files, session.workers),
        "comparing {} robots",
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


_SELECT = ("all", "none", "invert")


def add_actions(page: PopulationPage) -> None:
    """Add the text of the selection and the controls of what can be done with it."""
    gui, session = page.session.client.gui, page.session
    with gui.add_folder("Selection"):
        page.texts["selection"] = gui.add_html("")
        select = gui.add_button_group("Select", _SELECT)
        compare = gui.add_button("Compare", icon=viser.Icon.ARROWS_LEFT_RIGHT)
        choose = gui.add_button("Choose", icon=viser.Icon.CHECKBOX, hint="add them to the tray")
        export = gui.add_button("Export bundles (.zip)", icon=viser.Icon.DOWNLOAD)
        add_split_form(session, lambda: _add_choice(page))
        if _is_owned_set(page):
            delete = gui.add_button("Delete from the set", icon=viser.Icon.TRASH, color="red")
            session.on_change(delete, lambda: _confirm_delete(page))
    session.on_change(select, lambda: _select(page, select.value))
    session.on_change(compare, lambda: _compare(page))
    session.on_change(choose, lambda: _choose(page))
    session.on_change(export, lambda: _export(page))


def _is_owned_set(page: PopulationPage) -> bool:
    try:
        owned_set(page.session.address.subject, page.session.files)
    except UriError:
        return False
    return True


def _select(page: PopulationPage, choice: str) -> None:
    if choice == "invert":
        page.selected = ~page.selected
    else:
        page.selected = np.full(len(page.population), choice == "all")
    show_selection(page)


def _require_selection(page: PopulationPage) -> list[Row]:
    """Return the selected robots."""
    if rows := selected_rows(page):
        return rows
    raise UriError("no robot is selected: drag a rectangle with the shift key held")


def _compare(page: PopulationPage) -> None:
    rows = _require_selection(page)
    if not 2 <= len(rows) <= MAX_COMPARED:
        raise UriError(f"{len(rows)} selected robots to compare; expected 2 to {MAX_COMPARED}")
    page.session.open_address(Address("compare", tuple(row.uri for row in rows)))


def _export(page: PopulationPage) -> None:
    uris = [row.uri for row in _require_selection(page)]
    page.session.run_in_background(lambda: send_bundles(page.session, uris))


def _choose(page: PopulationPage) -> None:
    """Add the selected robots to the tray."""
    rows = _require_selection(page)
    page.session.choose((*page.session.chosen, *(row.uri for row in rows)))


def _add_choice(page: PopulationPage) -> ChooseSides:
    """Add the side of the selected robots; the others are on the other side."""
    side = page.session.client.gui.add_dropdown(
        "selected robots", SIDES, initial_value="test", hint="the others are on the other side"
    )

    def choose_sides() -> tuple[list[Row], list[Row]]:
        chosen = _require_selection(page)
        rows = zip(page.population.rows, page.selected, strict=True)
        others = [row for row, is_selected in rows if not is_selected]
        if not others:
            raise BenchmarkError("all robots are selected: none is left for the other side")
        return (chosen, others) if side.value == "train" else (others, chosen)

    return choose_sides


def _confirm_delete(page: PopulationPage) -> None:
    """Ask before the selected robots are deleted."""
    rows, subject = _require_selection(page), page.session.address.subject
    owned_set(subject, page.session.files)  # refuses before it asks
    gui = page.session.client.gui
    with gui.add_modal(f"Delete {len(rows)} robots?") as modal:
        names = ", ".join(row.name for row in rows[:5]) + (", ..." if len(rows) > 5 else "")
        gui.add_markdown(f"Their folders in `{subject}` are removed for good: {names}")
        delete = gui.add_button(f"Delete {len(rows)} robots", color="red")
        keep = gui.add_button("Keep them")

    def answer(action: Callable[[], object]) -> None:
        modal.close()
        action()

    page.session.on_change(keep, lambda: answer(lambda: None))
    page.session.on_change(delete, lambda: answer(lambda: _delete(page, rows)))


def _delete(page: PopulationPage, rows: list[Row]) -> None:
    session = page.session
    remove_robots(owned_set(session.address.subject, session.files), [row.name for row in rows])
    session.open_address(session.address.with_state(select=""))


PANEL_WIDTH = 340.0
"""Width of the panel [pixels]."""


def show(session: Session) -> None:
    """Build the page."""
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
    population, faults = session.cached(
        f"population {source.key}",
        lambda: load_population(source, session.files, session.workers),
        "reading {} robots",
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
