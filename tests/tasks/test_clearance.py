"""The channels `clearance` and `contact` have distances and derivatives of shapes that collide."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

import morphgen
from helpers.device_reads import device_reads
from helpers.goal_sets import draw_spec
from morphgen.errors import TaskError
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere, half_extents
from morphgen.model.kinematics import forward_kinematics
from morphgen.tasks.clearance import box_distance, capsule_box_distance, compile_capsules
from morphgen.tasks.kinematic_channels import CLEARANCES, COLUMN_SCALE, MAX_PLACE
from morphgen.tasks.observation import observation_config
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.sim.base import Block

WORDS = ("arm3", "arm=ur5 ee=stick")
OBSERVE = observation_config(["clearance", "contact"])
NEAR_ERROR, FAR_ERROR = 0.012, 0.036
"""Largest error of distances below `NEAR`, and of others [m]."""
NEAR = 0.05
CONFIG = ReachConfig(num_goals=20, train_layouts=3, eval_layouts=2)

_BOX = Block((1.0, 1.0, 1.0))


@pytest.fixture(scope="module")
def specs(cache):
    robots = [morphgen.compose(words, geometry="primitive") for words in WORDS]
    return [draw_spec(robot, CONFIG, obstacles=True, cache=cache) for robot in robots]


@pytest.fixture(scope="module")
def batch(specs):
    return batch_from_specs(specs, 20, sim="mujoco", observe=OBSERVE, seed=1)


def channel(batch, q=None, name="clearance", object_pose=None):
    """Return a channel at the joints, shape (n, J, size)."""
    q = batch.q if q is None else q
    object_pose = batch.simulation.object_pose if object_pose is None else object_pose
    goals = batch.groups.tool_targets(object_pose, 0)
    values = batch.observation._kinematics(q, q, goals, object_pose)[name]
    links = batch.robot_tables.link_of_joint[batch.env_robot_index]
    return torch.gather(values, 1, links[..., None].expand(-1, -1, values.shape[2]))


def mujoco_geom(shape, T_world_link):
    geometry, pose = shape.geometry, Pose.from_matrix(T_world_link @ shape.T_link_shape.matrix)
    kind, size = {
        Box: ("box", half_extents(geometry)),
        Sphere: ("sphere", half_extents(geometry)[:1]),
        Cylinder: ("cylinder", half_extents(geometry)[1:]),
        Capsule: ("capsule", (half_extents(geometry)[0], getattr(geometry, "length", 0.0) / 2)),
    }[type(geometry)]
    numbers = (" ".join(map(str, each)) for each in (size, pose.position, pose.quaternion))
    return '<geom type="{}" size="{}" pos="{}" quat="{}"/>'.format(kind, *numbers)


def mujoco_distances(shapes, boxes):
    """Return distances (S, O) of posed shapes from boxes by MuJoCo."""
    posed = [mujoco_geom(shape, T) for shape, T in shapes]
    posed += [mujoco_geom(Shape(Box(box.size)), box.pose.matrix) for box in boxes]
    xml = f"<mujoco><worldbody>{''.join(posed)}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    others = range(len(shapes), len(posed))
    rows = [
        [mujoco.mj_geomDistance(model, data, s, o, 10.0, None) for o in others]
        for s in range(len(shapes))
    ]
    return np.array(rows)


def test_capsules_are_as_far_from_boxes_as_in_mujoco():
    rng = np.random.default_rng(0)
    for _ in range(100):
        radius, length = rng.uniform(0.01, 0.1), rng.uniform(0.0, 0.4)
        pose = Pose.from_xyz_rpy(tuple(rng.uniform(-0.5, 0.5, 3)), tuple(rng.uniform(-3, 3, 3)))
        box = replace(_BOX, size=tuple(rng.uniform(0.05, 0.3, 3)))
        expected = mujoco_distances([(Shape(Capsule(radius, length)), pose.matrix)], [box])[0, 0]
        z = pose.matrix[:3, 2] * length / 2
        ends = torch.tensor(np.stack([pose.matrix[:3, 3] - z, pose.matrix[:3, 3] + z]))
        half = torch.tensor(box.size, dtype=torch.float64) / 2
        distance, point, normal = capsule_box_distance(ends, torch.tensor(radius), half)
        assert torch.linalg.vector_norm(normal) == pytest.approx(1)
        along = torch.linalg.cross(point - ends[0], ends[1] - ends[0])
        assert torch.linalg.vector_norm(along) == pytest.approx(0, abs=1e-6)
        if expected > 0:  # of an axis in the box, MuJoCo has another depth
            assert float(distance) == pytest.approx(expected, abs=1e-3)
        else:
            assert distance < 1e-3


def test_inside_a_box_the_distance_is_that_of_the_nearest_face():
    half = torch.tensor([0.1, 0.2, 0.3])
    distance, gradient = box_distance(torch.tensor([[0.0, -0.15, 0.0], [0.0, 0.0, 0.0]]), half)
    torch.testing.assert_close(distance, torch.tensor([-0.05, -0.1]))
    assert gradient.tolist() == [[0, -1, 0], [1, 0, 0]]


def test_the_closeness_is_that_of_the_collision_shapes(batch):
    """The nearest shape that each joint moves is as far away as in MuJoCo, to a stated error."""
    batch.reset()
    limit, errors = CLEARANCES[-1], []
    observed = channel(batch)
    for env in range(batch.num_envs):
        robot = batch.specs[int(batch.env_robot_index[env])].robot
        T = forward_kinematics(robot, batch.q[env, : robot.dof].double().numpy())
        shapes = [(i, shape) for i, link in enumerate(robot.links) for shape in link.collisions]
        boxes = batch.layouts.obstacles(env)
        distances = mujoco_distances([(shape, T[i]) for i, shape in shapes], boxes).min(axis=1)
        for joint, k in enumerate(robot.independent_joints):
            moved = [k in robot.joint_chain(robot.links[i].name) for i, _ in shapes]
            distance = distances[moved].min() if any(moved) else np.inf
            closeness = float(observed[env, joint, len(CLEARANCES) - 1])
            if closeness == 0:
                assert distance > limit - FAR_ERROR
            else:
                error = abs((1 - closeness) * limit - distance)
                assert error < (NEAR_ERROR if distance < NEAR else FAR_ERROR)
                errors.append(error)
    assert len(errors) > 50
    assert np.mean(errors) < 0.008


def test_the_derivative_is_that_of_finite_differences(batch):
    batch.reset()
    q, limit = batch.q, CLEARANCES[-1]
    step = batch.robot_tables.max_step[batch.env_robot_index]
    observed, checked = channel(batch), 0
    for joint in range(q.shape[1]):
        change = torch.zeros_like(q)
        change[:, joint] = 1e-3
        ends = [channel(batch, q + sign * change)[:, joint, 1] for sign in (-1, 1)]
        closeness, rate = observed[:, joint, 1], observed[:, joint, 2]
        expected = -(ends[1] - ends[0]) * limit / 2e-3 * COLUMN_SCALE * step[:, joint] * closeness
        # Where the nearest pair changes in between, both ends are farther than the middle says.
        smooth = ((ends[0] + ends[1]) / 2 - closeness).abs() < 1e-4
        near = (closeness > 0) & (closeness < 1) & smooth
        torch.testing.assert_close(rate[near], expected[near], atol=0.03, rtol=0.03)
        checked += int((near & (rate.abs() > 0.05)).sum())
    assert checked > 30


def test_environments_without_obstacles_see_zeros_and_the_others_what_they_see_alone(specs, cache):
    free = draw_spec(specs[1].robot, CONFIG, obstacles=False, cache=cache)
    mixed = batch_from_specs([*specs, free], 6, sim="mujoco", observe=OBSERVE, seed=1)
    observed = mixed.reset()["clearance"]
    assert not observed[2::3].any()
    assert not mixed.observe()["contact"].any()
    assert not observed[~mixed.observe()["links"]].any()
    for env in (0, 1):
        alone = batch_from_specs(
            [specs[env]], 1, sim="mujoco", observe=OBSERVE, max_links=observed.shape[1]
        )
        alone.layouts.poses.copy_(mixed.layouts.poses[env : env + 1])
        q = mixed.q[env : env + 1, : alone.robot_tables.max_joints]
        torch.testing.assert_close(channel(alone, q)[0], channel(mixed)[env, : q.shape[1]])
    alone = batch_from_specs([free], 1, sim="mujoco", observe=OBSERVE)
    assert not alone.reset()["clearance"].any()


def test_the_channel_reads_no_tensor(batch):
    batch.reset()
    q, object_pose = batch.q, batch.simulation.object_pose
    goals = batch.groups.tool_targets(object_pose, 0)
    with device_reads() as reads:
        batch.observation._kinematics(q, q, goals, object_pose)
    assert not reads.found


def test_meshes_are_refused(specs, tmp_path):
    robot = specs[1].robot
    mesh = (Shape(Mesh(tmp_path / "link.stl")),)
    links = tuple(replace(link, collisions=mesh if i else ()) for i, link in enumerate(robot.links))
    with pytest.raises(TaskError, match=r"clearance: link .* has a mesh"):
        compile_capsules([replace(robot, links=links)], "cpu")


@pytest.fixture(scope="module")
def pushes(cache):
    robots = [morphgen.compose(words, geometry="primitive") for words in ("arm3-stick", WORDS[1])]
    push = [draw_spec(robot, PushConfig(num_goals=5), cache=cache) for robot in robots]
    return batch_from_specs(push, 40, sim="mujoco", observe=OBSERVE, seed=1)


@pytest.fixture
def near(pushes):
    """Return the batch, and poses of its blocks near the tools."""
    pushes.reset()
    random = torch.Generator().manual_seed(0)
    pose = pushes.simulation.object_pose.clone()
    tool = pushes.observation.tool_positions(pushes.q)
    away = torch.nn.functional.normalize(torch.randn(len(pose), 3, generator=random))
    pose[:, :3] = tool + (0.15 + 0.2 * torch.rand(len(pose), 1, generator=random)) * away
    pose[:, 3:] = torch.nn.functional.normalize(torch.randn(len(pose), 4, generator=random))
    return pushes, pose


def contact(near, *, q=None, moved=None):
    batch, pose = near
    pose = pose.clone()
    if moved is not None:
        pose[:, :3] += moved
    return channel(batch, q, "contact", pose)


def test_contact_is_as_near_to_the_block_as_the_collision_shapes(near):
    batch, poses = near
    limit, observed, checked = CLEARANCES[-1], contact(near), 0
    for env in range(batch.num_envs):
        spec = batch.specs[int(batch.env_robot_index[env])]
        robot, block = spec.robot, spec.scene.block
        T = forward_kinematics(robot, batch.q[env, : robot.dof].double().numpy())
        shapes = [(i, shape) for i, link in enumerate(robot.links) for shape in link.collisions]
        x, y, z, *quaternion = poses[env].tolist()
        box = replace(block, pose=Pose((x, y, z), tuple(quaternion)))
        distances = mujoco_distances([(shape, T[i]) for i, shape in shapes], [box])[:, 0]
        for joint, k in enumerate(robot.independent_joints):
            moved = [k in robot.joint_chain(robot.links[i].name) for i, _ in shapes]
            distance = distances[moved].min()
            closeness = float(observed[env, joint, 1])
            if 0 < closeness < 1 and distance > 0:
                assert abs((1 - closeness) * limit - distance) < FAR_ERROR
                checked += 1
    assert checked > 50


def test_contact_changes_with_the_joints_and_along_its_direction(near):
    batch, limit = near[0], CLEARANCES[-1]
    observed, step = contact(near), batch.robot_tables.max_step[batch.env_robot_index]
    closeness = observed[..., 1]
    direction = observed[..., 3:6] / closeness.clamp(min=1e-3)[..., None]
    seen = (closeness > 0.05) & (closeness < 1)
    torch.testing.assert_close(
        torch.linalg.vector_norm(direction[seen], dim=-1), torch.ones(int(seen.sum()))
    )
    checked = 0
    for joint in range(batch.q.shape[1]):
        change = torch.zeros_like(batch.q)
        change[:, joint] = 1e-3
        turned = [contact(near, q=batch.q + sign * change)[:, joint, 1] for sign in (-1, 1)]
        moved = direction[:, joint] * 1e-3
        shifted = [contact(near, moved=sign * moved)[:, joint, 1] for sign in (-1, 1)]
        rate = -(turned[1] - turned[0]) * limit / 2e-3
        expected = observed[:, joint, 2] / (COLUMN_SCALE * step[:, joint] * closeness[:, joint])
        # Where the nearest pair changes in between, both ends are farther than the middle says.
        middle = closeness[:, joint]
        smooth = [((a + b) / 2 - middle).abs() < 1e-4 for a, b in (turned, shifted)]
        here = seen[:, joint]
        both = here & smooth[0]
        torch.testing.assert_close(expected[both], rate[both], atol=0.02, rtol=0.05)
        towards = here & smooth[1]
        change_by_metre = (shifted[1] - shifted[0])[towards] * limit / 2e-3
        torch.testing.assert_close(
            change_by_metre, torch.ones_like(change_by_metre), atol=0.02, rtol=0
        )
        checked += int(both.sum() + towards.sum())
    assert checked > 200


def test_contact_says_where_the_link_is_on_the_block(near):
    """The place is as far from the box as the closeness says, but for a capsule's radius."""
    batch, observed = near[0], contact(near)
    closeness, limit = observed[..., 1], CLEARANCES[-1]
    place = observed[..., 6:] / closeness.clamp(min=1e-3)[..., None]
    seen = (closeness > 0.05) & (closeness < 1) & (place.abs().amax(dim=-1) < MAX_PLACE)
    for env, joint in torch.nonzero(seen).tolist():
        spec = batch.specs[int(batch.env_robot_index[env])]
        half = torch.tensor(spec.scene.block.size) / 2
        distance, _ = box_distance(place[env, joint] * half, half)
        radius = float(distance) - (1 - float(closeness[env, joint])) * limit
        radii = compile_capsules([spec.robot], "cpu").radius[0]
        assert (radii - radius).abs().min() < 1e-4
    assert int(seen.sum()) > 50
