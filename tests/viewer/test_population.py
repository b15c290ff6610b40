"""Populations as arrays: instances, poses, layouts, picking, and sources."""

import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.robots import arm
from helpers.viser_client import PlainClient
from morphgen.errors import FormatError
from morphgen.grammar.library import default_library
from morphgen.grammar.robot_set import read_index, remove_robots
from morphgen.model.geometry import Capsule, Shape
from morphgen.model.kinematics import forward_kinematics, joint_limits
from morphgen.model.robot import Link, Robot
from morphgen.viewer import population_layout as layout
from morphgen.viewer.comparison import parse_moves, with_roles
from morphgen.viewer.pages.population import (
    SCALE,
    card,
    format_selection,
    pack_capsules,
    parse_selection,
)
from morphgen.viewer.population import (
    NUM_POSES,
    find_source,
    free_configurations,
    make_population,
    move_roles,
    read_robots,
    robot_bounds,
    sample_robots,
    shape_poses,
    token_rows,
)
from morphgen.viewer.population_pick import View, project, project_points, robot_at, robots_in
from morphgen.viewer.robot_rows import Row
from morphgen.viewer.robot_uri import FileAccess, UriError, owned_set, read_robot_uri
from morphgen.viewer.scene import population as scene_population
from morphgen.viewer.scene.population import quaternions, world_poses
from morphgen.viewer.scene.robot import robot_bounds as one_robot_bounds
from morphgen.viewer.scene.stage import batch_colours, fit_camera


@pytest.fixture
def files(folder):
    return FileAccess(default_library().folders, (folder.resolve(),), folder / "none")


@pytest.fixture
def population(folder, files):
    uris = [f"robots/prims/prims-{i:06d}" for i in range(6)] + ["robots/some-arm"]
    robots = [read_robot_uri(uri, files) for uri in uris]
    return make_population([Row(uri, uri, order=i) for i, uri in enumerate(uris)], robots)


def test_poses_of_all_robots_equal_those_of_each(population):
    rng = np.random.default_rng(0)
    q = rng.uniform(population.lower, population.upper)
    poses, instances = shape_poses(population, q), population.instances
    for i, robot in enumerate(population.robots):
        T_root_link = forward_kinematics(robot, q[i, : robot.dof])
        mine = instances.robot == i
        expected = T_root_link[instances.link[mine]] @ instances.T_link_shape[mine]
        np.testing.assert_allclose(poses[mine], expected, atol=1e-5)


def test_every_shape_is_an_instance_of_its_size(population):
    shapes = sum(len(link.visuals) for robot in population.robots for link in robot.links)
    assert len(population.instances.robot) == shapes
    for i, robot in enumerate(population.robots):
        np.testing.assert_allclose(population.home_bounds[i], one_robot_bounds(robot), atol=0.02)


def test_a_capsule_is_a_cylinder_and_two_balls():
    robot = Robot("pill", (Link("root", visuals=(Shape(Capsule(0.1, 0.4)),)),))
    pill = make_population([Row("pill", "pill")], [robot])
    assert len(pill.instances.robot) == 3
    bounds = robot_bounds(pill, shape_poses(pill, pill.home))
    np.testing.assert_allclose(bounds[0], [(-0.1, -0.1, -0.3), (0.1, 0.1, 0.3)], atol=1e-6)


def test_a_role_moves_in_every_robot_by_the_same_share(population):
    q = move_roles(population, population.home, {"joint 1": 1.0, "joint 2": 0.25})
    for i, robot in enumerate(population.robots):
        expected = with_roles(robot, np.array(robot.home), {"joint 1": 1.0, "joint 2": -0.5})
        np.testing.assert_allclose(q[i, : robot.dof], expected)
    np.testing.assert_array_equal(move_roles(population, population.home, {}), population.home)


def test_robots_stand_at_their_positions(population):
    positions = np.arange(14.0).reshape(7, 2)
    moved = world_poses(population, positions, population.home)
    offset = moved[:, :2, 3] - shape_poses(population, population.home)[:, :2, 3]
    np.testing.assert_allclose(offset, positions[population.instances.robot], atol=1e-5)


def test_quaternions_are_those_of_the_rotations():
    turns = Rotation.random(500, np.random.default_rng(0))
    halves = Rotation.from_rotvec(np.pi * np.eye(3))
    poses = np.tile(np.eye(4, dtype=np.float32), (503, 1, 1))
    poses[:, :3, :3] = Rotation.concatenate([turns, halves]).as_matrix()
    expected = Rotation.concatenate([turns, halves]).as_quat()[:, [3, 0, 1, 2]]
    similarity = np.abs((quaternions(poses) * expected).sum(axis=1))
    np.testing.assert_allclose(similarity, 1, atol=1e-6)
    assert quaternions(poses[:0]).shape == (0, 4)


def test_batched_meshes_get_linear_colours():
    assert batch_colours([(0, 128, 255)]).tolist() == [[0, 55, 255]]


def test_rows_are_sorted_and_labelled_by_their_first_robot():
    rows = [
        Row(name, name, reach=reach) for name, reach in zip("abcd", (3, 1, None, 2), strict=True)
    ]
    bounds = np.tile([[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]], (4, 1, 1))
    sorted_rows = layout.sorted_grid(rows, "reach", bounds)
    order = np.lexsort((sorted_rows.positions[:, 0], -sorted_rows.positions[:, 1]))
    assert [rows[i].name for i in order] == ["b", "d", "a", "c"]
    assert [text for text, _ in sorted_rows.labels] == ["1 m", "3 m"]


def test_robots_in_rows_take_their_own_width_so_that_a_large_one_does_not_spread_the_others():
    size = np.tile([0.3, 0.1, 0.2], (1000, 1))
    size[::50] = [3.0, 0.1, 0.2]
    bounds = np.stack([np.zeros_like(size), size], axis=1)
    places = layout.grid(bounds).positions
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


def test_points_at_one_place_are_spread():
    points = layout.spread(np.zeros((300, 2)))
    distance = np.linalg.norm(points[:, None] - points[None], axis=2) + 9 * np.eye(300)
    assert distance.min() > 0.6
    assert np.abs(points).max() < 20
    far = np.array([[0.0, 0.0], [10.0, 0.0]])
    np.testing.assert_allclose(layout.spread(far), far, atol=0.1)


@pytest.mark.parametrize("known", [6, 5, 0])
def test_a_scatter_has_the_order_of_its_facts_and_puts_unknown_robots_in_front(known):
    rows = [
        Row(str(i), str(i), reach=float(i) if i < known else None, mass=float(10 - i))
        for i in range(6)
    ]
    places = layout.scatter(rows, "reach", "mass", np.array([0.5, 0.5])).positions
    assert np.isfinite(places).all()
    assert (np.diff(places[:known, 0]) > 0).all()
    assert (np.diff(places[:known, 1]) < 0).all()
    if 0 < known < 6:
        assert places[known:, 1].max() < places[:known, 1].min()


def test_a_map_keeps_its_proportions_and_places_robots_that_cannot_be_compared():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.5], [np.nan, np.nan]])
    places = layout.similarity_map(points, np.array([0.01, 0.01])).positions
    width, depth = np.ptp(places[:3], axis=0)
    assert width > 1.5 * depth
    assert places[3, 1] < places[:3, 1].min()


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


def test_the_robot_under_the_pointer_is_found(population):
    positions = np.stack([np.arange(7) - 3.0, np.zeros(7)], axis=1)
    view = looking_down(8.0)
    poses = world_poses(population, positions, population.home)
    capsules = project(view, population, poses)
    for i in range(7):
        mine = np.flatnonzero(population.instances.robot == i)
        top = mine[poses[mine, 2, 3].argmax()]
        point, _ = project_points(view, poses[top, :3, 3].astype(float))
        assert robot_at(capsules, point) == i
    assert robot_at(capsules, np.array([0.75, 0.02])) is None
    centres = np.pad(positions, ((0, 0), (0, 1)))
    inside = robots_in(view, centres, np.array([0.0, 0.0]), np.array([0.75, 1.0]))
    assert inside.tolist() == [True] * 4 + [False] * 3
    table = np.frombuffer(pack_capsules(capsules), "<i2").reshape(-1, 6)
    np.testing.assert_allclose(table[:, :4] / SCALE, capsules.ends.reshape(-1, 4), atol=1e-3)
    np.testing.assert_array_equal(table[:, 5], capsules.robot)


def test_what_is_behind_the_camera_is_not_in_the_picture(population):
    view = View(np.array([0.0, 0.0, -5.0]), looking_down().R_world_camera, 1.0, 1.5)
    poses = world_poses(population, np.zeros((7, 2)), population.home)
    capsules = project(view, population, poses)
    assert len(capsules.robot) == 0
    assert robot_at(capsules, np.array([0.75, 0.5])) is None


def test_selections_and_shares_survive_the_address():
    selected = np.array([True, True, True, False, False, True, False])
    assert format_selection(selected) == "0-2,5"
    np.testing.assert_array_equal(parse_selection("0-2,5", 7), selected)
    assert not parse_selection("", 7).any()
    assert parse_selection("5-99,x,3-", 7).tolist() == [False] * 5 + [True] * 2
    assert format_selection(np.zeros(3, bool)) == ""
    roles = ("joint 1", "joint 2", "finger 1")
    state = {"joint1": "0.25", "joint2": "7", "finger1": "x"}
    assert parse_moves(state, roles, 0.0) == {"joint 1": 0.25, "joint 2": 1.0}


def test_cards_escape_names():
    text = card(Row("<img>", "x", reach=0.5, mass=2.0, dof=3, findings=()))
    assert "&lt;img&gt;" in text
    assert "no findings" in text
    assert "0.50 m" in text


def test_folders_splits_sides_and_grammars_are_populations(files):
    assert len(find_source("robots/prims", files, 0, 0).rows) == 30
    split = "extrapolation/primitives/reach"
    assert len(find_source(split, files, 0, 0).rows) == 12
    assert len(find_source(f"{split}@test", files, 0, 0).rows) == 2
    source = find_source("prims", files, 3, 4)
    results = sample_robots("prims", 3, source.rows, files)
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
    results = {result.row.name: result for result in read_robots(rows, files)}
    assert results["broken"].robot is None
    assert "lost" in results["broken"].error
    assert results["some-arm"].row.reach is not None


def test_random_poses_are_free_and_within_the_limits():
    robot = arm()
    (q,) = free_configurations([(0, robot)])
    assert q.shape == (NUM_POSES, robot.dof)
    lower, upper = joint_limits(robot).T
    assert ((q >= lower) & (q <= upper)).all()


def test_a_robot_without_joints_has_no_random_pose_of_its_own():
    (q,) = free_configurations([(0, Robot("rock", (Link("rock"),), ()))])
    assert q.shape[1] == 0


def test_the_key_of_a_population_changes_with_its_files(folder, tmp_path):
    shutil.copytree(folder / "robots" / "some-arm", tmp_path / "some-arm")
    files = FileAccess((), (tmp_path,), tmp_path / "none")
    before = find_source(".", files, 0, 0).key
    assert find_source(".", files, 0, 0).key == before
    urdf = tmp_path / "some-arm" / "robot.urdf"
    urdf.write_text(urdf.read_text() + "\n")
    assert find_source(".", files, 0, 0).key != before


def test_tokens_are_vectors_and_missing_where_there_are_none(files):
    (table,) = token_rows([arm()], 16, files)
    assert table.ndim == 1
    assert token_rows([arm()], 2, files) == [None]  # more links than tokens


def test_robots_are_deleted_from_the_users_own_sets_only(folder, tmp_path):
    mine, other = tmp_path / "served" / "prims", tmp_path / "other"
    shutil.copytree(folder / "robots" / "prims", mine)
    shutil.copytree(folder / "robots" / "some-arm", mine.parent / "some-arm")
    files = FileAccess((), (mine.parent,), tmp_path / "none")
    assert owned_set("prims", files) == mine
    remove_robots(mine, ["prims-000001", "prims-000003"])
    assert len(read_index(mine)) == 28
    assert not (mine / "prims-000001").exists()
    assert (mine / "prims-000002").exists()
    with pytest.raises(FormatError, match="no robot 'prims-000001'"):
        remove_robots(mine, ["prims-000001"])
    other.mkdir()
    shutil.rmtree(mine / "prims-000002")
    (mine / "prims-000002").symlink_to(other)
    with pytest.raises(FormatError, match="is a link"):
        remove_robots(mine, ["prims-000002"])
    assert other.exists()
    assert len(read_index(mine)) == 28
    for text, message in (
        (".", "sets only"),
        ("some-arm", "sets only"),
        ("split:x@test/y", "sets only"),
        ("nowhere", "no such file"),
        ("../other", "outside"),
    ):
        with pytest.raises(UriError, match=message):
            owned_set(text, files)


@pytest.mark.slow
def test_a_large_population_says_that_it_has_no_shadows(shared_viewer, monkeypatch):
    monkeypatch.setattr(scene_population, "MAX_SHADOWS", 10)
    with PlainClient(shared_viewer.port, "?population=robots/prims") as client:
        client.shows("without shadows: more than 10 robots")
        batches = [m for m in client.messages if m["type"] == "BatchedMeshesMessage"]
        assert batches
        assert not any(message["props"]["cast_shadow"] for message in batches)
