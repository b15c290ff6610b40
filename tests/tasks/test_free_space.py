"""Free configurations, their connected components, and straight paths between them."""

import math
import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from helpers.goal_sets import draw_goals
from helpers.scenes import ball, push_scene, reach_scene, real_arm_scene
from morphgen.checks.self_collision import PENETRATION
from morphgen.errors import BenchmarkError
from morphgen.formats.mjcf.write import to_spec
from morphgen.model.geometry import Box, Pose, Shape, Sphere
from morphgen.model.kinematics import movable_positions, random_configurations
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.tasks import free_space as module
from morphgen.tasks.free_space import SAME, FreeSpace, cspace_components, in_other_component
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.task import REACH
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.sim.rigid_bodies import ground_contact_links

DEEP, SHALLOW = 2 * PENETRATION, PENETRATION / 2
HALF_TURN = Pose.from_xyz_rpy((0.0, 0.0, 1.0), (np.pi, 0.0, 0.0))
SLAB = Block((0.2, 0.2, 0.2), Pose((0.5, 0.0, 0.5)))


def lift(**changes):
    """A ball of 0.1 m on a vertical slide, starting 0.5 m above a plate on the ground."""
    plate = Link("plate", collisions=(Shape(Box((0.1, 0.1, 0.1))),))
    ball = Link("ball", collisions=(Shape(Sphere(0.1)),))
    slide = Joint("z", "prismatic", "plate", "ball", Pose((0, 0, 0.5)), (0, 0, 1), (-1.0, 1.0))
    lift_robot = Robot("lift", (plate, ball), (slide,), (Frame("tool", "ball"),), (0.0,))
    return replace(lift_robot, **changes)


def aside():
    """The same robot with the ball 0.5 m beside its plate."""
    (slide,) = lift().joints
    return lift(joints=(replace(slide, T_parent_joint=Pose((0.5, 0.0, 0.5))),))


def free(scene, *q):
    return FreeSpace(scene).free([[value] for value in q]).tolist()


def with_foot():
    """The robot with a ball below the ground that is fixed to its plate."""
    foot = Link("foot", collisions=(Shape(Sphere(0.2)),))
    fixed = Joint("to_foot", "fixed", "plate", "foot", Pose((0.0, 0.5, 0.0)))
    return replace(aside(), links=(*aside().links, foot), joints=(*aside().joints, fixed))


def named_like_surroundings():
    names = ("world", "ground")
    links = tuple(replace(a, name=b) for a, b in zip(aside().links, names, strict=True))
    joint = replace(aside().joints[0], name="to_root", parent="world", child="ground")
    return Robot("r", links, (joint,), (Frame("tool", "ground"),), (0.0,))


def pointing(z):
    """The robot whose tool is above or below its ball."""
    return replace(aside(), frames=(Frame("tool", "ball", Pose((0.0, 0.0, z))),))


LOWEST, UNDER_SLAB = -0.5 + 0.1, 1.0 - 0.1 - 0.1 - 0.5
HIGH_SLAB, THIN = (
    replace(SLAB, pose=Pose((0.5, 0.0, 1.0))),
    Block((0.1,) * 3, Pose((0.5, 0.0, 0.9))),
)


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        (Scene(aside()), {0.0: True, LOWEST - SHALLOW: True, LOWEST - DEEP: False}),
        (Scene(aside(), ground=None), {LOWEST - DEEP: True}),
        (Scene(aside(), Pose((0.0, 0.0, -3.0))), {0.0: False}),
        (Scene(with_foot()), {0.0: True}),
        (
            Scene(aside(), obstacles=(HIGH_SLAB,)),
            {UNDER_SLAB + SHALLOW: True, UNDER_SLAB + DEEP: False},
        ),
        # Simulators do not test contacts between static objects, so FreeSpace must.
        (Scene(aside(), obstacles=(Block((0.05,) * 3),)), {0.0: False, 0.5: False}),
        (Scene(pointing(0.3), obstacles=(THIN,)), {0.0: True, 0.1: False, 0.2: True}),
        (Scene(replace(aside(), frames=()), obstacles=(THIN,)), {0.1: True}),
        (Scene(pointing(-0.3), obstacles=(THIN,)), {-0.25: True}),
        (Scene(aside(), HALF_TURN), {0.0: True, 0.5: False, -0.5: True}),  # the slide points down
        (Scene(aside(), Pose((0.0, 0.0, 1.0))), {0.5: True, -0.5: True}),
        (Scene(aside(), object=replace(SLAB, mass=0.1)), {0.0: True}),
        (Scene(aside(), obstacles=(replace(SLAB, mass=0.1),)), {0.0: False}),
        (
            Scene(named_like_surroundings(), obstacles=(SLAB,)),
            {0.0: False, -0.41: False, 0.9: True},
        ),
    ],
)
def test_configurations_are_free_where_nothing_penetrates(scene, expected):
    assert free(scene, *expected) == list(expected.values())


def test_links_collide_unless_adjacent_or_their_pair_is_ignored():
    touching = -0.5 + 0.05 + 0.1
    q = (touching - SHALLOW, touching - DEEP)
    above = Pose((0.0, 0.0, 0.3))
    assert free(Scene(lift(), above), *q) == [True, True]
    plate, ball = lift().links
    carriage = Link("carriage", collisions=(Shape(Sphere(0.1), Pose((5.0, 0.0, 0.0))),))
    aside = Joint("y", "prismatic", "plate", "carriage", axis=(0, 1, 0), limits=(-1.0, 1.0))
    rising = replace(lift().joints[0], parent="carriage")
    far = lift(links=(plate, carriage, ball), joints=(aside, rising), home=(0.0, 0.0))
    known = replace(far, ignore_pairs=(("ball", "plate"),))
    for body, expected in ((far, [True, False]), (known, [True, True])):
        assert FreeSpace(Scene(body, above)).free([[0.0, z] for z in q]).tolist() == expected


def test_obstacle_hits_are_named_and_obstacles_may_overlap():
    near, far = SLAB, replace(SLAB, pose=Pose((0.5, 0.0, 0.35)))
    sunk = Block((1.0, 1.0, 1.0), Pose((5.0, 0.0, 0.0)))
    space = FreeSpace(Scene(aside(), obstacles=(near, sunk, far)))
    hits = space.obstacle_hits([[0.0], [0.15], [-0.2], [0.5]])
    assert hits.tolist() == [
        [True, False, True],
        [True, False, False],
        [False, False, True],
        [False, False, False],
    ]
    assert space.free([[0.5]]).all()


@pytest.mark.filterwarnings("ignore:Attach conflict")
@pytest.mark.parametrize("scene", [reach_scene, real_arm_scene, push_scene])
def test_results_agree_with_mujoco_plane_contacts(scene):
    """The reference model is the exported MJCF in a world with a plane."""
    scene = scene()
    robot = scene.robot
    q = random_configurations(robot, 300, np.random.default_rng(1))
    free_mask = FreeSpace(scene).free(q)
    assert 0.1 < free_mask.mean() < 0.95
    assert free_mask.tolist() == [not hit for hit in plane_hits(scene, q)]


def plane_hits(scene, q):
    """Return whether MuJoCo finds contacts, except of level links with the plane."""
    robot = scene.robot
    spec, child = mujoco.MjSpec(), to_spec(robot)
    # Otherwise MuJoCo writes a log file to the working directory.
    spec.option.timestep, spec.option.integrator = child.option.timestep, child.option.integrator
    place = {"pos": scene.T_world_root.position, "quat": scene.T_world_root.quaternion}
    spec.attach(child, frame=spec.worldbody.add_frame(**place), prefix="robot/")
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    for block in scene.obstacles:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[edge / 2 for edge in block.size],
            pos=block.pose.position,
            quat=block.pose.quaternion,
        )
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    model = spec.compile()
    data = mujoco.MjData(model)
    level = {f"robot/{name}" for name in ground_contact_links(robot, scene.T_world_root)}
    turntable = np.array([model.body(i).name in level for i in model.geom_bodyid])
    flat = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    at = [model.joint(f"robot/{robot.joints[k].name}").qposadr[0] for k in robot.movable_joints]
    for positions in movable_positions(robot, q):
        data.qpos[at] = positions
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        first, second = data.contact.geom.T
        counts = ~(flat[first] & turntable[second])
        yield bool((data.contact.dist[counts] < -PENETRATION).any())


def test_samples_are_free_uniform_and_a_prefix_of_larger_samples():
    space = FreeSpace(Scene(aside()))
    q, tried = space.sample(400, np.random.default_rng(0))
    assert q.shape == (400, 1)
    assert space.free(q).all()
    assert 400 / tried == pytest.approx(1.4 / 2, abs=0.05)
    assert np.histogram(q, 4, (-0.4, 1.0))[0] == pytest.approx(100, abs=35)
    few, fewer = space.sample(30, np.random.default_rng(0))
    assert (few == q[:30]).all()
    assert fewer < tried
    drawn = random_configurations(aside(), tried, np.random.default_rng(0))
    assert space.free(drawn).sum() == 400
    assert (drawn[tried - 1] == q[-1]).all()


def test_robot_without_free_configuration_is_named_with_its_collisions(monkeypatch):
    monkeypatch.setattr(module, "TRIES", 20)
    with pytest.raises(BenchmarkError) as caught:
        FreeSpace(Scene(aside(), Pose((0.0, 0.0, -3.0)))).sample(10, np.random.default_rng(0))
    text = str(caught.value)
    assert "'lift': only 0 of 200 random" in text
    assert "rate 0)" in text
    assert "'ball' and 'ground' collide, in 100%" in text


def block_at(x, z, *, yaw=0.0, pitch=0.0):
    pose = Pose.from_xyz_rpy((x, 0.0, z), (0.0, pitch, yaw))
    return [*pose.position, *pose.quaternion]


def pushed(robot=None, **changes):
    block = Block((0.2, 0.2, 0.2), mass=0.1)
    return FreeSpace(Scene(robot or aside(), object=block, **changes))


ABOVE = 0.5 + 0.1 + 0.1
"""Height of a block that touches the ball of 0.1 m, 0.5 m beside the plate and above the ground."""
DIAGONAL = 0.1 * np.sqrt(2)
TILTED, ASIDE = 0.5 + 0.1 + DIAGONAL - DEEP, 0.5 - 0.1 - DIAGONAL + DEEP
WALL = Block((0.2, 0.2, 0.2), Pose((1.6, 0.0, 0.1)))


@pytest.mark.parametrize(
    ("block", "q", "is_free"),
    [
        (block_at(0.5, ABOVE + SHALLOW), 0.0, True),
        (block_at(0.5, ABOVE - SHALLOW), 0.0, True),
        (block_at(0.5, ABOVE - DEEP), 0.0, False),
        (block_at(0.5, ABOVE), 0.3, False),
        (block_at(0.5, TILTED, yaw=np.pi / 4), 0.0, True),
        (block_at(0.5, TILTED, pitch=np.pi / 4), 0.0, False),
        (block_at(ASIDE, 0.5), 0.0, True),
        (block_at(ASIDE, 0.5, yaw=np.pi / 4), 0.0, False),
        (block_at(2.0, 0.1), 0.0, True),
        (block_at(2.0, 0.0), 0.0, True),  # it may stand on the ground, or in it
        (block_at(0.0, 0.1), 0.0, False),  # in the plate
        (block_at(1.5, 0.1), 0.0, False),  # in the wall
    ],
)
def test_a_block_is_an_obstacle_where_it_is(block, q, is_free):
    space = pushed(obstacles=(WALL,))
    assert space.free([[q]], [block]).tolist() == [is_free]
    assert space.free([[q]])[0]


def test_block_clearance_ignores_moving_links_and_the_tool_point_does_not():
    clear = pushed().block_is_clear([block_at(0.5, 0.5), block_at(0.1, 0.1)])
    assert clear.tolist() == [True, False]
    fingertip = Frame("tool", "ball", Pose((0.0, 0.0, 0.3)))
    space = pushed(replace(aside(), frames=(fingertip,)))
    blocks = [block_at(0.5, 0.85), block_at(0.5, 0.95)]
    assert space.free([[0.0]] * 2, blocks).tolist() == [False, True]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: pushed().free([0.0]), r"needs \(n, 1\)"),
        (lambda: pushed(obstacles=(SLAB,)).free([[0.0, 0.0]]), r"needs \(n, 1\)"),
        (lambda: pushed().free([[0.0]], block_at(0.5, 0.5)), r"shape \(7,\); 1 configurations"),
        (lambda: pushed().free([[0.0]], [block_at(0.5, 0.5)] * 2), r"shape \(2, 7\)"),
        (lambda: FreeSpace(Scene(aside())).free([[0.0]], [block_at(0.5, 0.5)]), "with a block"),
        (lambda: pushed().free([[np.nan]]), "q of lift is not finite"),
        (lambda: pushed().free([[0.0]], [block_at(np.inf, 0.5)]), "pose of the block is not fin"),
        (lambda: pushed().block_is_clear([block_at(np.nan, 0.5)]), "pose of the block is not fin"),
        (lambda: pushed().obstacle_hits([[np.inf]]), "q of lift is not finite"),
    ],
)
def test_invalid_input_is_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_block_clearance_far_away_equals_the_full_test():
    """Poses whose block is surely far from everything fixed are not tested one by one."""
    wall = Block((0.2, 0.4, 0.2), Pose.from_xyz_rpy((1.6, 0.0, 0.1), (0.0, 0.0, 0.5)))
    space = pushed(obstacles=(wall,))
    rng = np.random.default_rng(0)
    blocks = np.array([block_at(*rng.uniform((-2, 0), (2, 0.4)), yaw=yaw) for yaw in range(200)])
    away = np.tile([[1.0]], (len(blocks), 1))  # no block is as high as the ball at its limit
    clear = space.block_is_clear(blocks)
    assert clear.tolist() == space.free(away, blocks).tolist()
    assert 0 < clear.sum() < len(clear)


ACROSS = ((0.5, 0.0), (0.12, 6.0))
GAP = (((0.5, -1.2), (0.1, 2.0)), ((0.5, 1.2), (0.1, 2.0)))
HERE, THERE = np.array([-1.5, 1.0]), np.array([1.5, 1.0])


def walled(*walls):
    """A ball on slides, among walls: (x, y) of their middles and edges.

    The cart has a shape, far above, lest ball and base are neighbours, which may touch.
    """
    shapes = tuple(Shape(Box((*edges, 0.4)), Pose((*middle, 0.2))) for middle, edges in walls)
    above = Shape(Sphere(0.01), Pose((0.0, 0.0, 5.0)))
    links = [Link("base", collisions=shapes), Link("cart", collisions=(above,))]
    return ball(0.2).with_links(links)


def hinged(kind, *walls):
    """The same robot with a hinge as first joint, so that the ball circles the origin."""
    body = walled(*walls)
    first, second = body.joints
    limits = None if kind == "continuous" else (-2 * math.pi, 2 * math.pi)
    turning = replace(first, kind=kind, axis=(0.0, 0.0, 1.0), limits=limits)
    sliding = replace(second, axis=(1.0, 0.0, 0.0), limits=(0.6, 1.2))
    return replace(body, joints=(turning, sliding), home=(0.0, 0.9))


def test_wall_splits_the_joint_range():
    body = walled(ACROSS)
    (component,) = cspace_components(body)
    assert component.pairs == (("ball", "base"),)
    assert component.joints == (0, 1)
    assert in_other_component([component], THERE).tolist() == [True]
    assert in_other_component([component], HERE).tolist() == [False]
    for x, far in ((0.33, False), (0.67, True)):
        assert FreeSpace(Scene(body)).free([[x, 0.0]])[0]
        assert in_other_component([component], np.array([x, 0.0]))[0] == far


@pytest.mark.parametrize("walls", [(), GAP])
def test_passable_obstacle_does_not_split_the_range(walls):
    assert cspace_components(walled(*walls)) == ()


def test_continuous_joint_wraps_around():
    """Two walls split a continuous joint; with joint limits one wall is enough."""
    left, right = ((-0.3, 0.9), (0.1, 1.0)), ((-0.3, -0.9), (0.1, 1.0))
    assert cspace_components(hinged("continuous", left)) == ()
    body = hinged("continuous", left, right)
    components = cspace_components(body)
    assert in_other_component(components, np.array([math.pi - 0.1, 0.9])).all()
    assert in_other_component(components, np.array([0.1 - math.pi, 0.9])).all()
    assert not in_other_component(components, np.array([0.5, 0.9])).any()


def test_ranges_of_full_turns_are_not_split():
    """For a hinge with two turns, the angle matters and not the turn."""
    body = hinged("revolute", ((-0.3, 0.9), (0.1, 1.0)), ((-0.3, -0.9), (0.1, 1.0)))
    found = cspace_components(body)
    for turns in (-1, 0):
        assert not in_other_component(found, np.array([0.5 + 2 * math.pi * turns, 0.9])).any()
    assert in_other_component(found, np.array([math.pi, 0.9])).all()


def test_goals_are_in_the_larger_component(tmp_path):
    body = walled(ACROSS)
    both, _ = FreeSpace(Scene(body)).sample(40, np.random.default_rng(0))
    assert 5 < (both[:, 0] > 0.5).sum() < 35
    goals = draw_goals(body, ReachConfig(num_goals=40), obstacles=False, seed=0, cache=tmp_path)
    assert (goals.q[:, 0] < 0.5).all()
    assert goals.accepted == 40 < goals.tried
    few = draw_goals(body, ReachConfig(num_goals=7), obstacles=False, seed=0, cache=tmp_path)
    assert (few.q == goals.q[:7]).all()
    assert REACH.certify(goals, body, Scene(body)) == []


def test_too_few_goals_error_counts_the_unreachable_ones():
    space = FreeSpace(Scene(walled(ACROSS)))
    with pytest.raises(BenchmarkError) as caught:
        space.sample(1, np.random.default_rng(0), lambda q: False)
    said = re.search(
        r"only 0 of 1,000 .* free of collisions and (\d+) more are, but cut", str(caught.value)
    )
    q = random_configurations(space.scene.robot, 1000, np.random.default_rng(0))
    assert int(said[1]) == space.free(q).sum() > 100


def test_certificate_detects_goals_in_another_component(tmp_path):
    goals = draw_goals(
        ball(0.2), ReachConfig(num_goals=12), obstacles=False, seed=0, cache=tmp_path
    )
    body = walled(ACROSS)
    lines = REACH.certify(goals, body, Scene(body))
    there = [i for i, q in enumerate(goals.q) if q[0] > 0.65]
    assert there
    said = "'ball' and 'base' touch on every path to most others"
    assert [line for line in lines if "touch" in line] == [f"goal {i}: {said}" for i in there]


def test_joints_that_do_not_move_the_tool_are_not_split():
    body = walled(ACROSS)
    (frame,) = body.frames
    assert cspace_components(replace(body, frames=(replace(frame, link="cart"),))) == ()


START, BEHIND, BESIDE = np.array([-0.5, 0.0]), np.array([0.5, 0.0]), np.array([-0.5, 0.5])


def test_the_first_end_with_a_free_path_is_found():
    wall = Block((0.2, 0.4, 0.4), Pose((0.0, 0.0, 0.2)))
    space, empty = FreeSpace(Scene(ball(0.2), obstacles=(wall,))), FreeSpace(Scene(ball(0.2)))
    assert space.first_reachable(START, np.array([BEHIND, BESIDE])) == 1
    assert space.first_reachable(START, np.array([BEHIND, BEHIND + SAME / 2, BESIDE])) == 2
    assert space.first_reachable(START, BEHIND[None]) is None
    assert space.first_reachable(START, np.zeros((0, 2))) is None
    assert empty.first_reachable(START, np.array([BEHIND, BESIDE])) == 0
    padded = np.array([[*BEHIND, 0.0], [*BESIDE, 0.0]])
    assert space.first_reachable(np.array([*START, 9.0]), padded) == 1
    space.place_obstacles([Pose((0.0, 2.0, 0.2))])  # obstacles count where they are
    assert space.first_reachable(START, BEHIND[None]) == 0
