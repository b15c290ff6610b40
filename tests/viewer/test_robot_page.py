"""The page of a robot: rows, tables, overlays, edits."""

import re
import zipfile
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.pages import choose, click_on, field, nodes, press
from helpers.robots import arm
from helpers.viser_client import PlainClient
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.grammar.library import default_library
from morphgen.model.findings import Finding
from morphgen.model.kinematics import frame_pose
from morphgen.model.robot import Inertial
from morphgen.viewer import markup, robot_rows
from morphgen.viewer.markup import joint_groups, link_card, link_table
from morphgen.viewer.pages.robot import format_joints, parse_joints
from morphgen.viewer.robot_rows import Row, part_rows, passes, sort_rows
from morphgen.viewer.robot_uri import read_robot_uri
from morphgen.viewer.scene.robot import RED, shell
from morphgen.viewer.scene.stage import inertia_box, look_at

ARM = "?robot=robots/some-arm"


@pytest.mark.slow
def test_colliding_links_are_red(see, viewer):
    on = viewer()
    q = [0.0, -1.0, 2.6, 2.5, 0.0, 0.0]
    words = "words:arm=ur5 ee=plane"
    page = see(f"?robot={words}&q={format_joints(q)}", on=on)
    page.get_by_text("collision", exact=True).wait_for()
    robot = read_robot_uri(words, on.files)
    (pairs,) = SelfCollisionChecker(robot).penetrations([q])
    assert len(pairs) > 0
    links = [robot.link_index[name] for pair in pairs for name in pair]
    for link in links:
        assert tuple(nodes(on)[f"/robot/{link}/visual0"].color) == RED
    page.get_by_role("tab", name="Links").click()
    choose(page, "Link", "arm_forearm_link")
    page.wait_for_url(re.compile("link=arm_forearm_link"))
    assert all(tuple(nodes(on)[f"/robot/{link}/visual0"].color) == RED for link in links)
    page.get_by_role("tab", name="Move").click()
    press(page, "home")
    page.get_by_text("no self-collision").wait_for()
    for link in links:
        assert tuple(nodes(on)[f"/robot/{link}/visual0"].color) != RED
    press(page, "random")
    page.wait_for_url(re.compile(r"[?&]q="))


@pytest.mark.slow
def test_workspace_and_gizmo(see, viewer):
    on = viewer()
    page = see(f"{ARM}&show=visual,workspace,drag the tool", on=on)
    page.get_by_text("no self-collision").wait_for()
    field(page, "shoulder").last.fill("-0.5")
    page.wait_for_url(re.compile(r"q=-0\.5"))
    field(page, "shoulder").last.fill("0.5")
    page.wait_for_url(re.compile(r"q=0\.5"))
    names = nodes(on)
    page.wait_for_timeout(1000)
    assert {"/robot/workspace", "/gizmo"} <= names.keys()
    robot = read_robot_uri("robots/some-arm", on.files)
    pose = frame_pose(robot, [0.5, *robot.home[1:]])
    assert names["/gizmo"].position == pytest.approx(pose[:3, 3], abs=1e-6)


@pytest.mark.slow
def test_a_bundle_is_downloaded_whole(see, folder):
    page = see(ARM)
    page.get_by_text("no self-collision").wait_for()
    page.get_by_role("tab", name="Get").click()
    with page.expect_download() as found:
        page.get_by_role("button", name="Bundle (.zip)").click()
    with zipfile.ZipFile(found.value.path()) as archive:
        names = set(archive.namelist())
    assert {"arm/robot.urdf", "arm/robot.xml", "arm/card.json"} <= names


ROWS = [
    Row("b-arm", "b", "arms", "train", dof=6, reach=0.9, mass=20.0, findings=(), order=0),
    Row("a-hand", "a", "hands", "test", dof=2, reach=None, mass=1.0, findings=("axis",), order=1),
    Row("c-arm", "c", "arms", "test", dof=7, reach=1.2, mass=None, findings=None, order=2),
]


def names(rows):
    return [row.name[0] for row in rows]


@pytest.mark.parametrize(
    ("condition", "left"),
    [
        ({}, "bac"),
        ({"search": "ARM", "sort": "name"}, "bc"),
        ({"search": "arm train"}, "b"),
        ({"search": "axis", "category": ""}, "a"),
        ({"category": "hands"}, "a"),
        ({"role": "test"}, "ac"),
        ({"findings": "with"}, "a"),
        ({"findings": "without"}, "bc"),
        ({"dof": "3..6"}, "b"),
        ({"reach": "0.5..2"}, "bc"),
        ({"mass": "0..100"}, "ba"),
        ({"search": "arm", "role": "test", "dof": "7..7"}, "c"),
    ],
)
def test_filters(condition, left):
    assert names(row for row in ROWS if passes(row, condition)) == list(left)


ORDERS = {
    **{"order": "bac", "-order": "cab", "name": "abc", "-name": "cba", "reach": "bca"},
    **{"-reach": "cba", "mass": "abc", "-mass": "bac"},
}


@pytest.mark.parametrize(("key", "order"), ORDERS.items())
def test_sorting_puts_unknown_values_last(key, order):
    assert names(sort_rows(ROWS, key)) == list(order)


def test_parts_have_their_stored_facts_before_they_are_drawn():
    rows = part_rows(default_library())
    facts = [(row.dof, row.reach, row.mass, row.licence) for row in rows]
    assert all(None not in each and each[-1] for each in facts)
    wide = [row.name for row in sort_rows(rows, "-reach")]
    assert wide.index("ur10") < wide.index("ur5") < wide.index("plane")
    assert all(1 <= row.reach <= 2 for row in rows if passes(row, {"reach": "1..2"}))
    assert passes(next(row for row in rows if row.name == "ur10"), {"reach": "1..2"})


def test_a_robot_passes_with_each_of_its_licences():
    row = Row("d", "d", licence="MIT, Apache-2.0")
    assert robot_rows.fact_choices([row, Row("e", "e")], "licence") == ["Apache-2.0", "MIT"]
    assert [passes(row, {"licence": each}) for each in ("MIT", "Apache-2.0", "BSD")] == [1, 1, 0]


def test_licences_of_parts_are_shown_with_their_restrictions():
    assert markup.licence_line(arm()) == ""
    parts = [{"licence": each} for each in ("MIT", "CC-BY-NC-SA-4.0", "MIT")]
    line = markup.licence_line(replace(arm(), provenance={"parts": parts}))
    restricted = "CC-BY-NC-SA-4.0 non-commercial, share-alike"
    assert re.sub("<[^>]*>", "", line) == f"licences of its parts: MIT, {restricted}"


def test_joints_are_grouped_by_their_part():
    robot = arm()
    assert joint_groups(robot) == [("", "joints", [0, 1, 2, 3])]
    renamed = tuple(
        replace(joint, name=f"{'ee' if i > 2 else 'arm'}_{joint.name}", mimic=None, limits=(-1, 1))
        for i, joint in enumerate(robot.joints)
    )
    parts = [{"label": "arm", "part": "x"}, {"label": "ee", "part": "y"}]
    named = replace(robot, joints=renamed, home=(0,) * 5, provenance={"parts": parts})
    assert joint_groups(named) == [("arm", "arm (x)", [0, 1, 2]), ("ee", "ee (y)", [3, 4])]


def test_tables_name_every_link_and_escape_it():
    robot = arm()
    table = link_table(robot)
    assert all(link.name in table for link in robot.links)
    assert "prismatic (mimic)" in table
    links = (replace(robot.links[0], name="<b>"), *robot.links[1:])
    joints = (replace(robot.joints[0], parent="<b>"), *robot.joints[1:])
    odd = replace(robot, links=links, joints=joints)
    assert "&lt;b&gt;" in link_table(odd)
    assert "<b>" not in link_card(odd, "<b>", ())
    assert "mimics" in link_card(robot, "right", ())
    assert "6 links · 4 DoF · 1 mimic joint · " in markup.summary(robot, "")


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


def test_a_card_shows_mass_limits_in_both_units_and_the_findings_of_its_link():
    robot = arm()
    findings = [
        Finding("a", "warning", "link upper", "too heavy", "make it lighter"),
        Finding("b", "error", "joint shoulder", "too weak", "make it stronger"),
        Finding("c", "info", "link lower", "something else", "nothing"),
        Finding("d", "info", "links upper, lower", "too near", "move them"),
        Finding("e", "info", "links upper2, lower", "something else", "nothing"),
    ]
    card = link_card(robot, "upper", findings)
    assert f"{robot.link('upper').inertial.mass:.4g} kg" in card
    assert "-2 to 2 rad (-115 to 115°)" in card
    assert "too heavy" in card
    assert "too weak" in card
    assert "too near" in card
    assert "something else" not in card
    assert "none, it is the root" in link_card(robot, "base", ())


def test_a_click_selects_a_link(viewer):
    on = viewer()
    with PlainClient(on.port, ARM) as client:
        client.shows("no Compose: it is not made of parts")
        client.shows("no self-collision")
        frame = client.until(
            lambda: next((m for m in client.messages if m.get("name") == "/robot/1"), None)
        )
        view = nodes(on)
        click = click_on(frame)
        client.send(click)
        client.shows("link=upper")
        client.until(lambda: "/robot/1/outline0" in view)
        client.send(click)
        client.until(lambda: "/robot/1/outline0" not in view)


@pytest.fixture(scope="module")
def ball():
    """Points in a spherical shell with radii 0.5 to 1 m around (0, 0, 0.3)."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return rng.uniform(0.5, 1.0, (200_000, 1)) * directions + [0, 0, 0.3]


def test_the_shell_encloses_the_points(ball):
    vertices, faces = shell(ball)
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.05)


def test_toggles_draw_grown_shapes_names_boxes_and_the_workspace(viewer):
    on = viewer()
    shown = "visual,collision,inertia,x-ray,frames,joint axes,names,workspace"
    with PlainClient(on.port, f"{ARM}&show={shown}") as client:
        client.shows("no self-collision")
        view = nodes(on)

        def radius():
            shape = view.get("/robot/1/collision0")  # not there while it is drawn again
            return np.linalg.norm(shape.vertices[:, :2], axis=1).max() if shape else np.inf

        client.until(lambda: "/robot/workspace" in view)
        assert view["/robot/1/visual0"].opacity == pytest.approx(0.2)
        assert view["/robot/1/name"].text == "upper"
        assert {"/robot/1/inertia", "/robot/1/axis"} <= view.keys()
        assert view["/robot/1"].show_axes
        assert 0.0205 < radius() < 0.03  # the cylinder has 0.02 m
        client.change(client.control("Checkbox", "visual"), False)
        client.shows("show=collision,inertia,x-ray,frames")
        assert view["/robot/1/visual0"].visible
        client.change(client.control("Checkbox", "x-ray"), False)
        client.until(lambda: not view["/robot/1/visual0"].visible)
        client.until(lambda: radius() < 0.0201)
        client.change(client.control("Checkbox", "workspace"), False)
        client.until(lambda: "/robot/workspace" not in view)


LOW, HIGH = np.array([-1.0, -0.2, 0.0]), np.array([1.0, 0.2, 0.5])


class Camera(SimpleNamespace):
    """A camera of a browser with a picture of an aspect."""

    def __init__(self, aspect):
        super().__init__(aspect=aspect, position=np.zeros(3), _state=SimpleNamespace(camera_cb=[]))
        self.on_update = self._state.camera_cb.append

    def resize(self, aspect):
        self.aspect = aspect
        for callback in self._state.camera_cb:
            callback(self)

    @property
    def distance(self):
        return float(np.linalg.norm(self.position - self.look_at))


def looking(aspect):
    camera = Camera(aspect)
    look_at(SimpleNamespace(camera=camera), LOW, HIGH, (0.0, -1.0, 0.2))
    return camera


@pytest.mark.parametrize("before", [0.14, 1.5])
def test_the_camera_is_placed_again_when_panels_open_or_close(before):
    camera = looking(before)
    camera.resize(0.9)
    assert camera.distance == pytest.approx(looking(0.9).distance)
    assert camera.distance > 1.2 * looking(1.5).distance


def test_the_strip_beside_a_gallery_does_not_decide_the_distance():
    assert looking(0.14).distance == looking(1.0).distance


def test_a_camera_that_the_user_has_moved_stays():
    camera = looking(1.2)
    camera.position = camera.position + 0.1
    before = camera.position.copy()
    camera.resize(0.9)
    np.testing.assert_array_equal(camera.position, before)
