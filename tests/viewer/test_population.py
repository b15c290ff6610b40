"""Populations as arrays: instances, poses, layouts, picking, and sources."""

import shutil

import numpy as np
import pytest

from helpers.robots import arm
from helpers.viser_client import PlainClient
from morphgen.model.geometry import Capsule, Shape
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Link, Robot
from morphgen.viewer import population as population_arrays
from morphgen.viewer.comparison import with_roles
from morphgen.viewer.pages import population as population_page
from morphgen.viewer.pages.population import format_selection, parse_selection, selection_text
from morphgen.viewer.population import (
    ReadRobot,
    arrange,
    find_source,
    make_population,
    move_roles,
    read_robots,
    shape_poses,
)
from morphgen.viewer.robot_rows import Row
from morphgen.viewer.robot_uri import FileAccess, UriError, read_robot_uri
from morphgen.viewer.scene.robot import robot_bounds
from morphgen.viewer.scene.stage import View, fit_camera, project_points


@pytest.fixture
def population(folder, files):
    uris = [f"robots/prims/prims-{i:06d}" for i in range(6)] + ["robots/some-arm"]
    read = []
    for i, uri in enumerate(uris):
        robot = read_robot_uri(uri, files)
        read.append(ReadRobot(Row(uri, uri, order=i), robot, np.array(robot_bounds(robot))))
    return make_population(read)


def test_poses_of_all_robots_equal_those_of_each(population):
    rng = np.random.default_rng(0)
    q = rng.uniform(population.lower, population.upper)
    poses, instances = shape_poses(population, q), population.instances
    for i, robot in enumerate(population.robots):
        T_root_link = forward_kinematics(robot, q[i, : robot.dof])
        mine = instances.robot == i
        expected = T_root_link[instances.link[mine]] @ instances.T_link_shape[mine]
        np.testing.assert_allclose(poses[mine], expected, atol=1e-5)


def test_a_capsule_is_a_cylinder_and_two_balls():
    robot = Robot("pill", (Link("root", visuals=(Shape(Capsule(0.1, 0.4)),)),))
    pill = make_population([ReadRobot(Row("pill", "pill"), robot, np.zeros((2, 3)))])
    assert len(pill.instances.robot) == 3
    heights = sorted(shape_poses(pill, pill.home)[:, 2, 3])
    np.testing.assert_allclose(heights, (-0.2, 0.0, 0.2), atol=1e-6)


def test_a_role_moves_in_every_robot_by_the_same_share(population):
    q = move_roles(population, population.home, {"joint 1": 1.0, "joint 2": 0.25})
    for i, robot in enumerate(population.robots):
        expected = with_roles(robot, np.array(robot.home), {"joint 1": 1.0, "joint 2": -0.5})
        np.testing.assert_allclose(q[i, : robot.dof], expected)
    np.testing.assert_array_equal(move_roles(population, population.home, {}), population.home)


def plain(sizes, reaches):
    """Return a population of robots without shapes that take boxes (n, 3) [m] on the ground."""
    read = []
    for i, (size, reach) in enumerate(zip(sizes, reaches, strict=True)):
        bounds = np.array([np.zeros(3), size])
        read.append(ReadRobot(Row(f"{i}", f"{i}", reach=reach, order=i), arm(), bounds))
    return make_population(read)


def test_rows_are_sorted_and_labelled_by_their_first_robot():
    positions, labels = arrange(plain(np.ones((4, 3)), (3, 1, None, 2)), "reach")
    assert np.lexsort((positions[:, 0], -positions[:, 1])).tolist() == [1, 3, 0, 2]
    assert [text for text, _ in labels] == ["1 m", "3 m"]


def test_robots_in_rows_take_their_own_width_so_that_a_large_one_does_not_spread_the_others():
    size = np.tile([0.3, 0.1, 0.2], (300, 1))
    size[::50] = [3.0, 0.1, 0.2]
    places, labels = arrange(plain(size, [None] * len(size)))
    assert labels == []
    left, right = places[:, 0], places[:, 0] + size[:, 0]
    for y in np.unique(places[:, 1]):
        row = places[:, 1] == y
        assert (left[row][1:] > right[row][:-1]).all()
    assert np.ptp(left) * np.ptp(places[:, 1]) < 1.6 * (size[:, 0] * 0.15).sum()


def test_a_camera_has_all_points_in_its_picture_and_touches_the_strictest_sides():
    points = np.random.default_rng(0).normal(size=(100, 3))
    tangents = np.array([0.5, 0.3])
    camera = fit_camera(points, tangents)
    offset = points - camera
    share = offset[:, :2] / (tangents * offset[:, 2:])
    assert np.abs(share).max() == pytest.approx(1)
    low, high = share.min(axis=0), share.max(axis=0)
    strictest = int(np.argmax(high - low))
    assert (low[strictest], high[strictest]) == pytest.approx((-1, 1))


def looking_down(height=5.0):
    """A camera above the origin: right is x, up is y."""
    axes = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    return View(np.array([0.0, 0.0, height]), axes, 1.0, 1.5)


def test_points_are_projected_to_the_picture():
    points, depth = project_points(looking_down(), np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    np.testing.assert_allclose(points[0], (0.75, 0.5))
    assert points[1, 0] > 0.75
    assert points[2, 1] < 0.5
    np.testing.assert_allclose(depth, 5)


def test_selections_survive_the_address():
    selected = np.array([True, True, True, False, False, True, False])
    assert format_selection(selected) == "0-2,5"
    np.testing.assert_array_equal(parse_selection("0-2,5", 7), selected)
    assert not parse_selection("", 7).any()
    assert parse_selection("5-99,x,3-", 7).tolist() == [False] * 5 + [True] * 2
    assert format_selection(np.zeros(3, bool)) == ""


def test_the_text_of_a_selection_has_links_facts_and_ranges():
    one = Row("<img>", "x", reach=0.5, mass=2.0, dof=3, findings=("axis",))
    text = selection_text([one])
    assert '<a href="?robot=x">&lt;img&gt;</a> 3 DoF · 0.50 m · 2 kg axis' in text
    many = selection_text([one, Row("b", "y", reach=0.7)] + 5 * [one])
    assert "7 selected" in many
    assert "reach 0.5 to 0.7 m" in many
    assert "..." in many


def test_folders_splits_sides_and_grammars_are_populations(files):
    assert len(find_source("robots/prims", files, 0, 0).rows) == 30
    split = "extrapolation/primitives/reach"
    assert len(find_source(split, files, 0, 0).rows) == 12
    assert len(find_source(f"{split}@test", files, 0, 0).rows) == 2
    source = find_source("prims", files, 3, 4)
    results = read_robots(source.rows, files, "prims", 3)
    assert [result.row.name for result in results] == [f"prims-{i:06d}" for i in range(4)]
    for result in results:
        assert read_robot_uri(result.row.uri, files).dof == result.row.dof == result.robot.dof


@pytest.mark.parametrize(
    ("subject", "message"),
    [
        ("../..", "outside"),
        ("nowhere", "no such file"),
        ("robots/prims@train", "only a split has sides"),
        ("extrapolation/primitives/reach@both", "unknown side 'both'"),
    ],
)
def test_what_is_not_a_population_is_named(files, subject, message):
    with pytest.raises(UriError, match=message):
        find_source(subject, files, 0, 0)


def test_broken_robots_are_reported_with_their_reason(files):
    rows = find_source("robots", files, 0, 0).rows
    results = read_robots(rows, files)
    read = {result.row.name: result for result in results if isinstance(result, ReadRobot)}
    ((name, error),) = [result for result in results if not isinstance(result, ReadRobot)]
    assert name == "broken"
    assert "lost" in error
    assert read["some-arm"].row.reach is not None


def test_the_key_of_a_population_changes_with_its_files(folder, tmp_path):
    shutil.copytree(folder / "robots" / "some-arm", tmp_path / "some-arm")
    files = FileAccess((), (tmp_path,), tmp_path / "none")
    before = find_source(".", files, 0, 0).key
    assert find_source(".", files, 0, 0).key == before
    urdf = tmp_path / "some-arm" / "robot.urdf"
    urdf.write_text(urdf.read_text() + "\n")
    assert find_source(".", files, 0, 0).key != before


@pytest.mark.slow
def test_a_large_population_says_that_it_has_no_shadows(shared_viewer, monkeypatch):
    for module in (population_arrays, population_page):
        monkeypatch.setattr(module, "MAX_SHADOWS", 10)
    with PlainClient(shared_viewer.port, "?population=robots/prims") as client:
        client.shows("without shadows: more than 10 robots")
        batches = [m for m in client.messages if m["type"] == "BatchedMeshesMessage"]
        assert batches
        assert not any(message["props"]["cast_shadow"] for message in batches)
