"""The robot page: texts and tables, selection, drags, and marks of joints."""

import re
from dataclasses import replace

import numpy as np
import pytest

from helpers.pages import field, nodes, pointer
from helpers.robots import arm, finger
from helpers.viser_client import PlainClient
from morphgen.model.findings import Finding
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Inertial
from morphgen.model.rotation import to_matrix
from morphgen.viewer.pages.robot import (
    format_joints,
    joint_of_link,
    parse_joints,
    turn_towards,
)
from morphgen.viewer.robot_tables import (
    is_about,
    joint_groups,
    joint_hint,
    licence_line,
    link_card,
    link_table,
    slider_step,
    summary,
)
from morphgen.viewer.scene.overlays import range_lines
from morphgen.viewer.scene.stage import View, inertia_box, project_points


def test_licences_of_parts_are_shown_with_their_restrictions():
    assert licence_line(arm()) == ""
    parts = [{"licence": each} for each in ("MIT", "CC-BY-NC-SA-4.0", "MIT")]
    line = licence_line(replace(arm(), provenance={"parts": parts}))
    assert re.sub("<[^>]*>", "", line) == (
        "licences of its parts: MIT, CC-BY-NC-SA-4.0 non-commercial, share-alike"
    )


def test_joints_are_grouped_by_their_part():
    robot = arm()
    assert [(chain.title, chain.rows) for chain in joint_groups(robot)] == [
        ("joints", (0, 1, 2, 3))
    ]
    renamed = tuple(
        replace(joint, name=f"{'ee' if i > 2 else 'arm'}_{joint.name}", mimic=None, limits=(-1, 1))
        for i, joint in enumerate(robot.joints)
    )
    parts = [{"label": "arm", "part": "x"}, {"label": "ee", "part": "y"}]
    named = replace(robot, joints=renamed, home=(0,) * 5, provenance={"parts": parts})
    assert [(c.title, c.rows) for c in joint_groups(named)] == [
        ("arm (x)", (0, 1, 2)),
        ("ee (y)", (3, 4)),
    ]


def test_slider_hint_names_joint_type_and_limits():
    assert joint_hint(arm().joints[0]) == (
        "shoulder: revolute, -2 to 2 rad, at most 50 N m, 2 rad/s"
    )
    assert joint_hint(arm().joints[2]).startswith("extend: prismatic, 0 to 0.04 m, at most 20 N")


@pytest.mark.parametrize(
    ("low", "high", "step"), [(-3.14, 3.14, 0.01), (0, 0.04, 0.0001), (0, 0, 0.001), (-1, 1, 0.01)]
)
def test_slider_steps_are_round_and_small(low, high, step):
    assert slider_step(low, high) == pytest.approx(step)


def test_tables_name_every_link_and_escape_it():
    robot = arm()
    table = link_table(robot)
    assert all(link.name in table for link in robot.links)
    assert "prismatic (mimic)" in table
    odd = replace(
        robot,
        links=(replace(robot.links[0], name="<b>"), *robot.links[1:]),
        joints=(replace(robot.joints[0], parent="<b>"), *robot.joints[1:]),
    )
    assert "&lt;b&gt;" in link_table(odd)
    assert "<b>" not in link_card(odd, "<b>", ())
    assert "mimics" in link_card(robot, "right", ())
    assert summary(robot, 0.9).startswith("6 links · 4 DoF · 1 mimic joint · ")


def test_configurations_are_restored_from_urls():
    robot = arm()
    q = np.array([0.1234, -1.5, 0.02, 0.04])
    assert parse_joints(format_joints(q), robot) == pytest.approx(q)
    assert parse_joints("9,9,9,9", robot) == pytest.approx([2, 2, 0.04, 0.04])
    for bad in ("", "1,2", "a,b,c,d", "nan,0,0,0"):
        assert parse_joints(bad, robot) is None


def test_the_box_has_the_inertia_of_the_link():
    a, b, c, m = 0.1, 0.2, 0.3, 2.0
    moments = np.array([b * b + c * c, a * a + c * c, a * a + b * b]) * m / 12
    box = inertia_box(Inertial.from_matrix(m, (0, 0, 0), np.diag(moments)))
    assert box is not None
    sizes, axes = box
    rebuilt = axes @ np.diag(m / 12 * (np.sum(sizes**2) - sizes**2)) @ axes.T
    assert rebuilt == pytest.approx(np.diag(moments))
    assert np.linalg.det(axes) == pytest.approx(1)
    assert inertia_box(Inertial(0.0)) is None
    assert inertia_box(Inertial.from_matrix(1.0, (0, 0, 0), np.diag([1.0, 0.1, 0.1]))) is None


ARM = "?robot=robots/some-arm"


def poses(q):
    return forward_kinematics(arm(), q)


def on_screen(page, camera, point):
    """Return where a point of the world is in the window [pixels]."""
    box = page.locator("canvas").first.bounding_box()
    rotation = np.array(to_matrix(tuple(camera.wxyz)))
    view = View(np.array(camera.position), rotation, camera.fov, camera.aspect)
    x, y = project_points(view, point)[0] * box["height"]
    return box["x"] + x, box["y"] + y


def test_a_dragged_joint_takes_the_gripped_point_to_the_pointer():
    robot, q = arm(), np.array([0.4, 0.5, 0.01, 0.02])
    point, link = np.array([0.0, 0.0, 0.3]), robot.link_index["upper"]
    goal = poses([1.3, 0.5, 0.01, 0.02])[link] @ [*point, 1]
    turned = turn_towards(robot, q, 0, link, point, goal[:3])
    assert turned == pytest.approx([1.3, 0.5, 0.01, 0.02], abs=1e-3)


def test_a_dragged_joint_keeps_its_limits_and_mimics_are_dragged_by_their_leader():
    robot, q = arm(), np.array([0.4, 0.5, 0.01, 0.02])
    right = robot.link_index["right"]
    row = joint_of_link(robot, right)
    assert row == 3
    away = poses(q)[right, :3, 3] + 10 * poses(q)[right, :3, 1]
    assert turn_towards(robot, q, row, right, np.zeros(3), away)[3] == 0
    assert turn_towards(robot, q, row, right, np.zeros(3), -away)[3] == 0.04


def test_a_point_on_the_axis_does_not_turn_the_joint():
    robot, q = arm(), np.array([0.4, 0.5, 0.01, 0.02])
    link = robot.link_index["upper"]
    assert turn_towards(robot, q, 0, link, np.zeros(3), np.ones(3)) == pytest.approx(q)


def test_the_range_of_a_hinge_is_an_arc_between_its_limits():
    joint = arm().joints[0]
    needle, track, axis = range_lines(joint, 0.2, (0.0, 0.0, 1.0))
    assert np.linalg.norm(track[:-2], axis=-1) == pytest.approx(0.2, abs=1e-9)
    angles = [np.arctan2(p[0], p[2]) for p in (track[0, 0], track[-3, 1])]
    assert angles == pytest.approx(joint.limits)
    assert np.cross(axis[0, 1] - axis[0, 0], joint.axis) == pytest.approx(0)
    assert needle @ joint.axis == pytest.approx(0)


def test_the_range_of_a_slide_is_a_line_between_its_limits():
    joint = finger().joints[0]
    _, track, _ = range_lines(joint, 0.2, (1.0, 0.0, 0.0))
    assert track[0] == pytest.approx(np.array([[0, -3, 0], [0, 3, 0]]))


def test_a_card_shows_mass_limits_in_both_units_and_the_findings_of_its_link():
    robot = arm()
    findings = [
        Finding("a", "warning", "link upper", "too heavy", "make it lighter"),
        Finding("b", "error", "joint shoulder", "too weak", "make it stronger"),
        Finding("c", "info", "link lower", "something else", "nothing"),
    ]
    card = link_card(robot, "upper", findings)
    assert f"{robot.link('upper').inertial.mass:.4g} kg" in card
    assert "-2 to 2 rad (-115 to 115°)" in card
    assert "too heavy" in card
    assert "too weak" in card
    assert "something else" not in card
    assert "none, it is the root" in link_card(robot, "base", ())


def test_a_finding_is_about_the_links_and_joints_that_it_names():
    pair = Finding("x", "warning", "links upper, lower", "", "")
    assert is_about(pair, "upper", "")
    assert is_about(pair, "lower", "")
    assert not is_about(pair, "low", "")
    assert not is_about(Finding("x", "info", "joint ", "", ""), "base", "")


def test_a_click_selects_a_link_and_a_drag_turns_its_joint(viewer):
    on = viewer()
    with PlainClient(on.port, ARM) as client:
        client.shows("no Compose: it is not made of parts")
        client.shows("no self-collision")
        frame = client.until(
            lambda: next((m for m in client.messages if m.get("name") == "/robot/1"), None)
        )
        view = nodes(on)
        click = pointer("Click", frame)
        client.send(click)
        client.shows("link=upper")
        client.until(lambda: "/robot/1/outline0" in view)
        robot = arm()
        grip = poses(robot.home)[1] @ [0, 0, 0.3, 1]
        start = grip[:3].tolist()
        drag = pointer("Drag", frame, phase="start", start_position=start, end_position=start)
        client.send(drag)
        goal = poses([1.0, *robot.home[1:]])[1] @ [0, 0, 0.3, 1]
        client.send({**drag, "phase": "update", "end_position": goal[:3].tolist()})
        client.until(lambda: "/robot/0/range" in view)
        client.shows("q=1,0.5,0.01,0.02")
        client.send({**drag, "phase": "end", "end_position": goal[:3].tolist()})
        client.until(lambda: "/robot/0/range" not in view)
        client.send(click)
        client.until(lambda: "/robot/1/outline0" not in view)


@pytest.mark.slow
def test_pointer_selects_drags_and_shows_ranges(see, viewer, picture):
    on = viewer()
    page = see(f"{ARM}&link=lower&angles=deg", on=on)
    page.get_by_text("no self-collision").wait_for()
    (session,) = on.sessions.values()
    assert "/robot/2/outline0" in nodes(on)
    assert field(page, "shoulder").last.input_value() == "23"
    page.get_by_text("shoulder", exact=True).hover()
    page.wait_for_timeout(1500)
    assert "/robot/0/range" in nodes(on)
    picture(page, "robot-selection")
    page.mouse.move(300, 100)
    page.wait_for_timeout(1500)
    assert "/robot/0/range" not in nodes(on)
    middle = (poses(arm().home)[1] @ [0, 0, 0.15, 1])[:3]
    x, y = on_screen(page, session.client.camera, middle)
    page.mouse.click(x, y)
    page.wait_for_url(re.compile("link=upper"))
    page.mouse.move(x, y)
    page.mouse.down()
    for i in range(8):
        page.mouse.move(x + 8 * i, y)
        page.wait_for_timeout(100)
    page.mouse.up()
    page.wait_for_url(re.compile("q="))
    assert "link=upper" in page.url
    assert page.failures == []
