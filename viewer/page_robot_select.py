"""Direct manipulation on the robot page: select a link, drag it, point at the slider of a joint.

viser has no event for the pointer over a slider. So a script in the browser writes the number of
the joint under the pointer, or of the focused slider, into a text field that is hidden by CSS.
"""

from __future__ import annotations

import functools
import json
from typing import Any

import numpy as np
import viser

from morphgen.model.kinematics import (
    driving_joints,
    forward_kinematics,
    joint_limits,
    link_jacobians,
)
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import markup, robot_tables, scene_selection
from morphgen.viewer.page_robot_show import RobotPage, set_configuration, show_in_address
from morphgen.viewer.session import set_value
from morphgen.viewer.viser_internals import control_id, run_javascript

NO_LINK = "(none)"
"""Choice of the dropdown of links that selects none."""
_DRAG_ROUNDS = 4
"""Newton steps by which a joint follows the pointer, per event."""
_MAX_TURN = 0.4
"""Largest such step [rad or m]."""
_WATCH = """
const field = %(field)s, rows = %(rows)s;
const report = (row) => {
  const label = document.querySelector(`label[for="${field}"]`);
  const input = label?.closest(".mantine-Flex-root").querySelector("input");
  if (!input || input.value === row) return;
  Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(input, row);
  input.dispatchEvent(new Event("input", { bubbles: true }));
};
const joint = (event) => {
  for (let at = event.target; at instanceof Element; at = at.parentElement) {
    const label = at.querySelector(":scope > * > * > label[for]");
    if (label) return rows[label.htmlFor] ?? "";
  }
  return "";
};
window.morphgenWatch?.abort();
window.morphgenWatch = new AbortController();
const options = { signal: window.morphgenWatch.signal };
document.addEventListener("pointerover", (e) => { if (!e.buttons) report(joint(e)); }, options);
document.addEventListener("focusin", (e) => report(joint(e)), options);
"""


def select_link(page: RobotPage, name: str) -> None:
    """Select a link: outline, card and slider; an empty name selects none."""
    for node in page.outline:
        node.remove()
    page.selected = name
    page.outline = []
    if name:
        page.outline = scene_selection.draw_outline(page.view, page.robot.link_index[name])
    if page.link_choice is not None:
        set_value(page.link_choice, name or NO_LINK)
        details = robot_tables.link_details(page.robot, name) if name else ""
        page.texts["details"].content = markup.framed(details)
    show_card(page)
    mark_slider(page)
    show_in_address(page)


def show_card(page: RobotPage) -> None:
    """Show the card of the selected link."""
    card = ""
    if page.selected:
        text = robot_tables.link_card(page.robot, page.selected, page.findings)
        card = f'<div class="selected">{text}</div>'
    page.texts["card"].content = markup.framed(card)


def joint_of_link(robot: Robot, link: int) -> int | None:
    """Return the index in q of the joint nearest above a link that moves it; None for the base."""
    while link:
        if rows := driving_joints(robot, (link - 1,)):
            return rows[0]
        link = robot.parents[link]
    return None


def mark_slider(page: RobotPage) -> None:
    """Colour the slider of the joint that moves the selected link."""
    style = ""
    if page.selected:
        row = joint_of_link(page.robot, page.robot.link_index[page.selected])
        if row is not None:
            name, colour = control_id(page.sliders[row]), markup.SELECTED
            style = (
                f'<style>[id="{name}"] .mantine-Slider-bar,[id="{name}"] .mantine-Slider-thumb'
                f"{{background:{colour}!important}}"
                f'div:has(>*>*>label[for="{name}"]){{box-shadow:-4px 0 {colour};'
                f"background:{colour}22}}</style>"
            )
    page.texts["mark"].content = style


def watch_sliders(page: RobotPage) -> None:
    """Draw a joint's axis and range while the pointer or the focus is at its slider."""
    channel = page.hover_channel
    if channel is None:
        gui, session = page.session.client.gui, page.session
        channel = page.hover_channel = gui.add_text("", "")
        style = f'<style>div:has(>*>*>*>label[for="{control_id(channel)}"]){{display:none}}</style>'
        gui.add_html(style)
        session.on_change(channel, lambda: show_range(page, _row(channel.value, page)), "range")
    rows = {control_id(slider): str(row) for row, slider in enumerate(page.sliders)}
    script = _WATCH % {"field": json.dumps(control_id(channel)), "rows": json.dumps(rows)}
    run_javascript(page.session.client, script)


def _row(text: str, page: RobotPage) -> int | None:
    """Return the index in q that a browser sent; None for anything else."""
    return int(text) if text.isdecimal() and int(text) < page.robot.dof else None


def show_range(page: RobotPage, row: int | None) -> None:
    """Draw the axis and the range of a joint, given by its index in q; None removes them."""
    if row == page.range_row:
        return
    with page.session.client.atomic():
        for node in page.range_nodes:
            node.remove()
        page.range_row, page.range_nodes = row, []
        if row is not None:
            joint = page.robot.independent_joints[row]
            page.range_nodes = scene_selection.draw_range(page.view, joint)


def connect_links(page: RobotPage) -> None:
    """Let clicks in the scene select links, and drags turn their joints."""
    for link, frame in enumerate(page.view.links):
        frame.on_click(functools.partial(_clicked, page, link))
        row = joint_of_link(page.robot, link)
        if row is not None:
            frame.on_drag(_LinkDrag(page, link, row).moved)


async def _clicked(page: RobotPage, link: int, event: viser.SceneNodePointerEvent[Any]) -> None:
    """Select the link that was clicked, or none if it already was."""
    del event
    name = page.robot.links[link].name
    page.session.enqueue(lambda: select_link(page, "" if name == page.selected else name))


class _LinkDrag:
    """A drag of one link, which turns the joint above it."""

    def __init__(self, page: RobotPage, link: int, row: int) -> None:
        """Remember the link and the index in q of its joint."""
        self._page, self._link, self._row = page, link, row
        self._point = self._target = np.zeros(3)

    async def moved(self, event: viser.SceneNodeDragEvent[Any]) -> None:
        """Follow the pointer; the gripped point is fixed to the link."""
        page = self._page
        if event.phase == "start":
            T_root_link = page.view.T_root_link[self._link]
            offset = np.array(event.start_position) - T_root_link[:3, 3]
            self._point = T_root_link[:3, :3].T @ offset
            page.session.enqueue(lambda: show_range(page, self._row))
        self._target = np.array(event.end_position)
        if event.phase == "end":
            page.session.enqueue(lambda: show_range(page, None))
        else:
            page.session.enqueue(self._follow, "drag link")

    def _follow(self) -> None:
        page = self._page
        q = turn_towards(page.robot, page.q, self._row, self._link, self._point, self._target)
        set_configuration(page, q)


def turn_towards(robot: Robot, q: Array, row: int, link: int, point: Array, target: Array) -> Array:
    """Return a configuration in which a point of a link is as near as possible to a target.

    Args:
        robot: The robot.
        q: Configuration, shape (dof,).
        row: The only index in q that changes, within its limits.
        link: Index of the link.
        point: Point in the link's frame, shape (3,) [m].
        target: Point in the root frame, shape (3,) [m].
    """
    q, (low, high) = q.copy(), joint_limits(robot)[row]
    column = robot.mimic_map[0][:, row]
    for _ in range(_DRAG_ROUNDS):
        T_root_link = forward_kinematics(robot, q)
        position = T_root_link[link, :3, :3] @ point + T_root_link[link, :3, 3]
        linear, angular = (link_jacobians(robot, T_root_link)[link] @ column).reshape(2, 3)
        velocity = linear + np.cross(angular, position)
        square = float(velocity @ velocity)
        if square < 1e-12:  # the point is on the joint's axis
            break
        step = float(velocity @ (target - position)) / square
        q[row] = np.clip(q[row] + np.clip(step, -_MAX_TURN, _MAX_TURN), low, high)
    return q
