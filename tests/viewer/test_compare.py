"""Robots are compared joint by joint and by their tokens."""

import re

import numpy as np
import pytest

from helpers.pages import nodes
from helpers.robots import arm
from helpers.viser_client import PlainClient
from morphgen.grammar.compose import compose
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words
from morphgen.model.kinematics import joint_limits
from morphgen.viewer.comparison import (
    all_roles,
    compare_robots,
    joint_roles,
    normalized_positions,
    similarity_table,
    with_roles,
)
from morphgen.viewer.figures import heatmap_svg, map_svg

LIBRARY = default_library()


def robot_of(words):
    derivation, name = parse_words(words.split(), LIBRARY)
    return compose(derivation, LIBRARY, name)


def test_joint_roles_count_joints_on_the_path_to_the_tool():
    assert joint_roles(arm()) == ["joint 1", "joint 2", "joint 3", "finger 1"]
    panda = robot_of("arm=panda ee=panda_hand")
    assert joint_roles(panda) == [f"joint {i}" for i in range(1, 8)] + ["finger 1"]
    assert all_roles([arm(), panda]) == [f"joint {i}" for i in range(1, 8)] + ["finger 1"]


def test_joint_role_moves_every_robot_by_the_same_fraction():
    for robot in (arm(), robot_of("arm=panda ee=panda_hand")):
        home = np.array(robot.home)
        assert with_roles(robot, home, {}) == pytest.approx(home)
        moved = with_roles(robot, home, {"joint 2": -1.0, "finger 1": 1.0, "joint 99": 1.0})
        rows = {role: i for i, role in enumerate(joint_roles(robot))}
        low, high = joint_limits(robot).T
        assert moved[rows["joint 2"]] == pytest.approx(low[rows["joint 2"]])
        assert moved[rows["finger 1"]] == pytest.approx(high[rows["finger 1"]])
        values = dict(zip(joint_roles(robot), normalized_positions(robot, home), strict=True))
        assert with_roles(robot, home, values) == pytest.approx(home)


def test_robot_compared_with_itself_is_identical():
    robots = [robot_of("base=planar ee=cube"), robot_of("base=gantry ee=plane")]
    similarity = compare_robots(robots, LIBRARY.folders)
    assert similarity["cosine"].diagonal() == pytest.approx([1, 1])
    assert similarity["tree"].diagonal() == pytest.approx([0, 0])
    assert similarity["tree"][0, 1] > 0
    table = similarity_table(["<a>", "b"], similarity)
    assert "&lt;a&gt; and b" in table


def test_positions_of_roles_are_clipped_or_left_out_and_shown_in_the_address(viewer):
    on = viewer()
    query = "?compare=robots/some-arm&joint1=-3&joint2=x&joint3=nan&lost=1"
    with PlainClient(on.port, query) as client:
        client.shows("compare=robots/some-arm&joint1=-1")
        before = nodes(on)["/robot0/2"].position.copy()
        client.change(client.control("Slider", "joint 2"), 0.5)
        client.shows("joint1=-1&joint2=0.5")
        rotated = nodes(on)["/robot0/2"]
        assert not np.allclose(rotated.position, before) or not np.allclose(
            rotated.wxyz, [1, 0, 0, 0]
        )
        client.change(client.control("ButtonGroup", "Go to"), "middle")
        client.shows("joint1=0&joint2=0&joint3=0&finger1=0")
        client.change(client.control("ButtonGroup", "Go to"), "home")
        shown = (0, "?compare=robots/some-arm")
        client.until(lambda: client.addresses[-1] == shown)


def test_figures_link_to_robots_and_escape_names():
    names, sides = ["<a>", "b"], ["train", "test"]
    text = map_svg(np.array([[0.0, 0.0], [1.0, 0.5]]), names, sides, ["x y", "z"], {"z": "data:,"})
    assert text.count("<image") == 1
    assert 'href="?robot=x%20y"' in text
    assert "&lt;a&gt;" in text
    assert "<a>" not in text.replace("<a href", "")
    heatmap = heatmap_svg(np.array([[1.0, 0.3], [0.3, 1.0]]), names, sides, larger=True)
    assert heatmap.count("<rect") == 4
    assert "b and &lt;a&gt;: 0.300" in heatmap


@pytest.mark.parametrize(
    "points", [np.random.default_rng(0).normal(size=(60, 2)), np.zeros((60, 2))]
)
def test_pictures_of_a_map_do_not_cover_each_other(points):
    names = [str(i) for i in range(60)]
    text = map_svg(points, names, ["test"] * 60, names, {})
    pattern = r'class="point" x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"'
    boxes = np.array(re.findall(pattern, text), dtype=float)
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    overlap = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    shared = np.maximum(overlap, 0).prod(axis=2)[~np.eye(60, dtype=bool)]
    assert len(boxes) == 60
    assert shared.max() == 0
    assert np.ptp(low, axis=0).min() > 2 * boxes[0, 2]  # they fill the map
