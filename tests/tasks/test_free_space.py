"""Collision-free configurations, compared with hand-computed spheres and MuJoCo's plane."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from helpers.scenes import push_scene, reach_scene, real_arm_scene
from morphgen.checks.self_collision import PENETRATION
from morphgen.errors import BenchmarkError
from morphgen.formats.mjcf.write import to_spec
from morphgen.model.geometry import Box, Pose, Shape, Sphere
from morphgen.model.kinematics import movable_positions, random_configurations
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.tasks import free_space as module
from morphgen.tasks.free_space import FreeSpace
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


def test_links_may_touch_but_not_penetrate_the_ground():
    lowest = -0.5 + 0.1
    assert free(Scene(aside()), 0.0, lowest - SHALLOW, lowest - DEEP) == [True, True, False]
    assert free(Scene(aside(), ground=None), lowest - DEEP) == [True]


def test_links_deep_below_the_ground_are_in_collision():
    assert free(Scene(aside(), Pose((0.0, 0.0, -3.0))), 0.0) == [False]


def test_root_and_links_fixed_to_it_may_be_in_the_ground():
    foot = Link("foot", collisions=(Shape(Sphere(0.2)),))
    fixed = Joint("to_foot", "fixed", "plate", "foot", Pose((0.0, 0.5, 0.0)))
    robot = aside()
    robot = replace(robot, links=(*robot.links, foot), joints=(*robot.joints, fixed))
    assert free(Scene(robot), 0.0) == [True]


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


def test_links_collide_with_obstacles():
    scene = Scene(aside(), obstacles=(replace(SLAB, pose=Pose((0.5, 0.0, 1.0))),))
    touching = 1.0 - 0.1 - 0.1 - 0.5
    assert free(scene, touching + SHALLOW, touching + DEEP) == [True, False]


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


def test_obstacle_in_the_base_leaves_no_free_configuration():
    """Simulators do not test contacts between static objects, so FreeSpace must."""
    inside = Block((0.05, 0.05, 0.05))
    assert free(Scene(aside(), obstacles=(inside,)), 0.0, 0.5) == [False, False]


def test_tool_point_inside_an_obstacle_is_in_collision():
    fingertip = Frame("tool", "ball", Pose((0.0, 0.0, 0.3)))
    robot = replace(aside(), frames=(fingertip,))
    thin = Block((0.1, 0.1, 0.1), Pose((0.5, 0.0, 0.9)))
    assert free(Scene(robot, obstacles=(thin,)), 0.0, 0.1, 0.2) == [True, False, True]
    assert free(Scene(replace(robot, frames=()), obstacles=(thin,)), 0.1) == [True]
    below = replace(aside(), frames=(Frame("tool", "ball", Pose((0.0, 0.0, -0.3))),))
    assert free(Scene(below, obstacles=(thin,)), -0.25) == [True]


def test_robot_base_pose_of_the_scene_is_used():
    """With an inverted base the slide points down."""
    assert free(Scene(aside(), HALF_TURN), 0.0, 0.5, -0.5) == [True, False, True]
    assert free(Scene(aside(), Pose((0.0, 0.0, 1.0))), 0.5, -0.5) == [True, True]


def test_pushable_block_is_not_an_obstacle():
    block = replace(SLAB, mass=0.1)
    assert free(Scene(aside(), block=block), 0.0) == [True]
    assert free(Scene(aside(), obstacles=(block,)), 0.0) == [False]


def test_any_link_names_are_accepted():
    links = tuple(
        replace(link, name=name)
        for link, name in zip(aside().links, ("world", "ground"), strict=True)
    )
    joint = replace(aside().joints[0], name="to_root", parent="world", child="ground")
    robot = Robot("r", links, (joint,), (Frame("tool", "ground"),), (0.0,))
    assert free(Scene(robot, obstacles=(SLAB,)), 0.0, -0.41, 0.9) == [False, False, True]


def test_configurations_have_the_shape_of_the_robot():
    with pytest.raises(ValueError, match=r"needs \(n, 1\)"):
        FreeSpace(Scene(aside())).free([0.0])
    with pytest.raises(ValueError, match=r"needs \(n, 1\)"):
        FreeSpace(Scene(aside(), obstacles=(SLAB,))).free([[0.0, 0.0]])
    assert FreeSpace(Scene(aside())).free(np.zeros((0, 1))).tolist() == []


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


def test_sample_returns_the_number_of_tested_configurations(monkeypatch):
    monkeypatch.setattr(module, "_CHUNK", 7)
    space = FreeSpace(Scene(aside()))
    q, tried = space.sample(50, np.random.default_rng(0))
    all_drawn = random_configurations(aside(), tried, np.random.default_rng(0))
    free_mask = space.free(all_drawn)
    assert free_mask.sum() == 50
    assert free_mask[-1]
    assert (all_drawn[free_mask] == q).all()


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
    return FreeSpace(Scene(robot or aside(), block=block, **changes))


def test_block_is_an_obstacle_at_the_given_pose():
    """The 0.1 m ball is 0.5 m beside the plate and its centre 0.5 m above the ground."""
    space = pushed()
    above = 0.5 + 0.1 + 0.1
    heights = (above + SHALLOW, above - SHALLOW, above - DEEP, 5.0)
    blocks = [block_at(0.5, z) for z in heights]
    assert space.free(np.zeros((4, 1)), blocks).tolist() == [True, True, False, True]
    assert space.free(np.zeros((4, 1))).all()
    assert space.free([[0.3], [0.0]], [block_at(0.5, above)] * 2).tolist() == [False, True]


def test_block_may_have_any_orientation():
    diagonal = 0.1 * np.sqrt(2)
    space = pushed()

    def free(**turn):
        return space.free([[0.0]], [block_at(0.5, 0.5 + 0.1 + diagonal - DEEP, **turn)])[0]

    assert free(yaw=np.pi / 4)
    assert not free(pitch=np.pi / 4)
    aside_of = [block_at(0.5 - 0.1 - diagonal + DEEP, 0.5, yaw=yaw) for yaw in (0.0, np.pi / 4)]
    assert space.free([[0.0]] * 2, aside_of).tolist() == [True, False]


def test_block_may_rest_on_the_ground_but_not_in_static_objects():
    blocks = [block_at(2.0, 0.1), block_at(2.0, 0.0), block_at(0.0, 0.1), block_at(1.5, 0.1)]
    wall = Block((0.2, 0.2, 0.2), Pose((1.6, 0.0, 0.1)))
    space = pushed(obstacles=(wall,))
    expected = [True, True, False, False]
    assert space.free(np.zeros((4, 1)), blocks).tolist() == expected
    assert space.block_is_clear(blocks).tolist() == expected


def test_block_clearance_ignores_moving_links():
    space = pushed()
    in_ball, in_plate = block_at(0.5, 0.5), block_at(0.1, 0.1)
    assert not space.free([[0.0]], [in_ball])[0]
    assert space.block_is_clear([in_ball, in_plate]).tolist() == [True, False]


def test_tool_point_inside_the_block_is_in_collision():
    fingertip = Frame("tool", "ball", Pose((0.0, 0.0, 0.3)))
    space = pushed(replace(aside(), frames=(fingertip,)))
    assert space.free([[0.0]] * 2, [block_at(0.5, z) for z in (0.85, 0.95)]).tolist() == [
        False,
        True,
    ]


def test_block_poses_with_a_wrong_shape_or_scene_are_rejected():
    with pytest.raises(ValueError, match=r"blocks have shape \(7,\); 1 configurations need"):
        pushed().free([[0.0]], block_at(0.5, 0.5))
    with pytest.raises(ValueError, match=r"a scene with a block"):
        FreeSpace(Scene(aside())).free([[0.0]], [block_at(0.5, 0.5)])
    with pytest.raises(ValueError, match=r"shape \(2, 7\)"):
        pushed().free([[0.0]], [block_at(0.5, 0.5)] * 2)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_non_finite_input_is_rejected(value):
    scene = push_scene()
    space, home = FreeSpace(scene), np.array([scene.robot.home])
    block = np.array([[0.0, 0.0, 0.075, 1.0, 0.0, 0.0, 0.0]])
    lost, gone = home.copy(), block.copy()
    lost[0, 1] = gone[0, 0] = value
    for q, blocks in ((lost, None), (lost, block), (home, gone)):
        with pytest.raises(ValueError, match="not finite"):
            space.free(q, blocks)
    with pytest.raises(ValueError, match="not finite"):
        space.block_is_clear(gone)
    with pytest.raises(ValueError, match="not finite"):
        space.obstacle_hits(lost)


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
