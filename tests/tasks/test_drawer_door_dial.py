"""Articulated objects in simulators, and the tasks with them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.goal_sets import draw_goals, draw_spec
from helpers.scenes import AT, EDGE, POST, PYBULLET, door, drawer, robot, rod
from morphgen.errors import NoGoalsError, PartError, SimulationError, TaskError
from morphgen.model.geometry import Box, Mesh, Pose, Shape
from morphgen.model.kinematics import joint_limits
from morphgen.model.robot import TOOL, Frame
from morphgen.tasks.articulated.envs import GAP, ArticulatedFormulas, object_tables
from morphgen.tasks.configs import DialConfig, DoorConfig, DrawerConfig, PushConfig, ReachConfig
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.goal_sets import set_from_npz, set_npz
from morphgen.tasks.observation import NOISE, ObservationConfig
from morphgen.tasks.registry import SIMULATORS, TASKS
from morphgen.tasks.scenes.make import make_batch
from morphgen.tasks.sim.articulated import ArticulatedObject, ObjectJoints
from morphgen.tasks.sim.base import Scene
from morphgen.tasks.task import TaskState

TURNED = Pose.from_xyz_rpy((0.3, -0.2, 0.5), (0.4, -0.3, 2.0))
WITH_CONTACTS = ("mujoco", PYBULLET, "warp")


def pushed(name, *objects):
    """Return the joints of objects that a rod pushes by 23 cm, and the positions of the rods."""
    scenes = [Scene(rod(), object=each) for each in objects]
    simulation = SIMULATORS[name].load(scenes, None, 1, torch.device("cpu"))
    near = torch.full((len(scenes), 1), -0.06)  # just before the objects: Warp is slow on a CPU
    simulation.reset(torch.ones(len(scenes), dtype=torch.bool), near, simulation.object_pose)
    for step in range(80):
        target = near + min(step / 65, 1.0) * 0.26
        assert not simulation.step(target).any()
    positions = ObjectJoints(objects).positions(simulation.object_pose.double().numpy())
    rods = simulation.q[:, 0].numpy().copy()
    simulation.close()
    return positions, rods


@pytest.fixture(scope="module")
def in_mujoco():
    return pushed("mujoco", drawer(), door())


def test_pushed_object_touches_the_rod(in_mujoco):
    (slid, turned), rods = in_mujoco
    assert slid == pytest.approx(rods[0] + 0.03, abs=2e-3)  # radius of the rod, half of the front
    # The rod touches the panel 0.2 m from the hinge: its axis is 0.03 m from the panel's plane.
    assert 0.2 * np.sin(turned) - rods[1] * np.cos(turned) == pytest.approx(0.03, abs=2e-3)


@pytest.mark.parametrize("name", [PYBULLET, pytest.param("warp", marks=pytest.mark.slow)])
def test_simulators_agree(name, in_mujoco):
    positions, _ = pushed(name, drawer(), door())
    assert positions == pytest.approx(in_mujoco[0], rel=0.05)


@pytest.mark.parametrize("name", WITH_CONTACTS)
def test_reset_by_mask_restores_the_joint(name, opened):
    objects = [drawer(TURNED), drawer(TURNED), door(TURNED), door(TURNED)]
    scenes = [Scene(rod(), object=each, ground=None) for each in objects]
    simulation = opened(SIMULATORS[name].load(scenes, None, 1, torch.device("cpu")))
    joints, wanted = ObjectJoints(objects), np.array([0.1, 0.2, -0.7, 1.2])
    mask = torch.tensor([True, False, True, False])
    poses = torch.tensor(joints.poses(wanted), dtype=torch.float32)
    simulation.reset(mask, torch.full((4, 1), -0.2), poses)
    found = joints.positions(simulation.object_pose.double().numpy())
    assert found == pytest.approx(np.where(mask.numpy(), wanted, 0.0), abs=1e-5)
    assert simulation.object_pose[:3:2].numpy() == pytest.approx(poses[:3:2].numpy(), abs=1e-6)
    simulation.step(torch.full((4, 1), -0.2))
    rested = joints.positions(simulation.object_pose.double().numpy())
    assert rested == pytest.approx(found, abs=1e-3)  # nothing pushes, and its weight is carried


def test_free_space_tests_the_link_that_moves_and_the_base():
    scene = Scene(rod(), object=drawer(Pose((0.0, 0.1, 0.0))))
    space = FreeSpace(scene)
    joints = ObjectJoints([scene.object])
    poses = joints.poses(np.array([0.0]))
    q = [[-0.2], [0.1], [0.3]]
    assert space.free(q, np.tile(poses, (3, 1))).tolist() == [True, False, True]
    assert space.free(q).tolist() == [True, True, True]  # without the link that moves
    around = FreeSpace(replace(scene, object=drawer(Pose((-0.4, 0.1, 0.0)))))  # its post is at 0
    assert around.free(q).tolist() == [True, False, True]


def test_robot_that_is_no_such_object_is_refused():
    body, (case, front) = drawer().body, drawer().body.links
    second = replace(body.joints[0], name="second", parent="front", child="end")
    two = {"links": (case, front, replace(front, name="end")), "joints": (*body.joints, second)}
    mesh = replace(case, collisions=(Shape(Mesh("none.stl")),))
    for faulty, message in (
        (replace(body, **two, home=(0.0, 0.0)), "has 2 movable joints; expected one"),
        (body.with_links([mesh]), "has a mesh for collisions; expected primitives"),
        (replace(body, frames=(Frame(TOOL, "case"),)), "of its frame 'tool' does not move"),
        (body.with_links([replace(front, inertial=None)]), "the link that moves has no mass"),
    ):
        with pytest.raises(SimulationError, match=f"'drawer'.*{message}"):
            ArticulatedObject(faulty)


def test_shapes_of_an_object_are_in_the_frames_of_its_parts():
    thing = door()
    assert thing.base_shapes == (POST,)
    assert thing.moving_shapes == (Shape(Box((0.3, 0.02, 0.2)), Pose((0.15, 0.0, 0.0))),)
    assert thing.moving_inertial.com == pytest.approx((0.15, 0.0, 0.0))
    x, y, z = EDGE.position
    assert thing.contact_shapes[0].T_link_shape.position == pytest.approx((0.15 - x, -y, -z))
    size, centre = thing.contact_box
    assert (*size, *centre) == pytest.approx((0.3, 0.02, 0.2, 0.15 - x, -y, -z))


def test_pose_of_an_object_is_at_its_contact_point():
    thing = door(TURNED)
    for angle in (0.0, 0.7, -1.2):
        turned = Pose.from_xyz_rpy((0.0, 0.0, 0.0), (0.0, 0.0, angle))
        expected = TURNED @ AT @ turned @ EDGE
        (pose,) = thing.placed_joint.poses(np.array([angle]))
        assert pose[:3] == pytest.approx(expected.position)
        assert thing.placed_joint.positions(pose[None]) == pytest.approx([angle])


ROBOT = "arm3-stick"
CONFIGS = {
    kind.task: kind(num_goals=4)
    for kind in (ReachConfig, PushConfig, DrawerConfig, DoorConfig, DialConfig)
}
OBJECTS = ("drawer", "door", "dial")

each_object = pytest.mark.parametrize("task", OBJECTS)


@pytest.fixture(scope="module")
def specs(cache):
    return {task: draw_spec(robot(ROBOT), CONFIGS[task], cache=cache) for task in OBJECTS}


@pytest.fixture(scope="module")
def large():
    """Goal sets of 45 starts, made anew."""
    configs = {task: replace(CONFIGS[task], num_goals=45) for task in OBJECTS}
    return {task: draw_goals(robot(ROBOT), config, anew=True) for task, config in configs.items()}


@pytest.fixture
def make(cache, opened):
    """Make a batch of tasks, an environment each, and begin its episodes."""

    def batch(*tasks, **options):
        options = {"sim": "mujoco", "configs": [*CONFIGS.values()], "cache": cache} | options
        made = opened(make_batch(tasks, [ROBOT] * len(tasks), len(tasks), **options))
        made.reset()
        return made

    return batch


def certify(spec, **changed):
    """Return the faults of a set of which some fields are changed."""
    goals = replace(spec.goals, **changed)
    return TASKS[spec.task].certify(goals, spec.robot, spec.scene)


@each_object
def test_starts_are_free_of_faults_and_the_same_again(task, specs):
    goals = specs[task].goals
    assert certify(specs[task]) == []
    assert {len(goals.q), goals.accepted} == {4}
    assert goals.tried >= 4
    anew = draw_goals(robot(ROBOT), CONFIGS[task], anew=True)
    content = set_npz(goals)
    assert set_npz(anew) == content
    read = set_from_npz(content, type(goals))
    assert set_npz(read) == content
    assert (read.urdf, read.edge, read.scale) == (goals.urdf, goals.edge, goals.scale)


@each_object
def test_motions_of_a_large_set_begin_with_a_small_one_and_are_to_either_side(task, specs, large):
    small, goals = specs[task].goals, large[task]
    assert goals.accepted == 45
    assert (goals.urdf, goals.place.tolist()) == (small.urdf, small.place.tolist())
    for name in ("q", "start", "goal", "distance", "path"):
        np.testing.assert_array_equal(getattr(goals, name)[:4], getattr(small, name), name)
    moved = goals.goal - goals.start
    assert np.abs(moved) == pytest.approx(CONFIGS[task].travel)
    assert 5 < (moved > 0).sum() < 40
    low, high = goals.thing.joint.limits or (-np.pi, np.pi)
    assert ((np.minimum(goals.start, goals.goal) > low) & (goals.goal < high)).all()


def test_robots_without_a_way_to_the_object_have_no_starts():
    config = DrawerConfig(num_goals=4, arm_x=(3.0, 3.0))
    with pytest.raises(NoGoalsError, match=r"can hardly move a drawer of 0\.\d+ m: at 24 places"):
        draw_goals(robot(ROBOT), config, anew=True)


def jumping(spec):
    path = spec.goals.path.copy()
    path[2, 1:] = spec.robot.home
    return {"path": path}


def in_the_object(spec):
    goals = spec.goals
    q, _ = FreeSpace(replace(spec.scene, object=None)).sample(5000, np.random.default_rng(0))
    pose = goals.thing.placed_joint.poses(goals.start)[:1]
    inside = q[~FreeSpace(spec.scene).free(q, pose.repeat(len(q), axis=0))]
    return {"q": np.concatenate([inside[:1], goals.q[1:]])}


def through_the_object(spec):
    path = spec.goals.path.copy()
    path[0] = in_the_object(spec)["q"][0]
    return {"path": path}


def with_a_mesh(spec):
    return {"urdf": spec.goals.urdf.replace("<geometry>", '<geometry><mesh filename="a.stl"/>', 1)}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda s: {"place": s.goals.place + np.eye(7)[2] / 100}, "does not stand on the ground"),
        (lambda s: {"goal": s.goals.goal + 4.0}, "start 0: the object's joint leaves its limits"),
        (lambda s: {"path": s.goals.path[[1, 0, 2, 3]]}, "1: the tool is not behind the object"),
        (jumping, "start 2: its path jumps"),
        (in_the_object, "start 0: it starts in collision"),
        (through_the_object, "start 0: its path is in collision"),
        (with_a_mesh, "the object has meshes; expected primitives"),
        (lambda _: {"urdf": "<robot"}, "the object: "),
        (lambda _: {"urdf": "<robot name='a'><link name='b'/></robot>"}, "expected one"),
        (lambda s: {"start": s.goals.start * np.nan}, "not all numbers are finite"),
        (lambda s: {"q": s.goals.q[:, 1:]}, "are not starts of robot 'arm3-stick'"),
        (lambda s: {"start": s.goals.start[1:]}, "are not starts of robot 'arm3-stick'"),
        (lambda s: {"q": s.goals.q + 9.0 * np.eye(s.robot.dof)[1]}, "outside ("),
    ],
)
def test_faults_of_a_changed_set_are_found(change, fault, specs):
    faults = certify(specs["drawer"], **change(specs["drawer"]))
    assert any(fault in each for each in faults), faults


def test_a_path_with_the_object_between_open_fingers_is_found(cache):
    spec = draw_spec(robot("arm=panda ee=panda_hand"), CONFIGS["dial"], cache=cache)
    assert certify(spec) == []
    arm = spec.robot.joint_chain(spec.robot.frame("tool").link)
    fingers = [j for j, k in enumerate(spec.robot.independent_joints) if k not in arm]
    path = spec.goals.path.copy()
    path[..., fingers] = joint_limits(spec.robot)[fingers, 1] - 1e-6
    assert "start 3: its path does not touch the object" in certify(spec, path=path)


@pytest.mark.parametrize(
    ("config", "error", "message"),
    [
        (DrawerConfig(object="drawr"), PartError, "unknown object 'drawr'.*drawer"),
        (DrawerConfig(object="arm3"), PartError, "arm3"),
        (DrawerConfig(travel=0.8), NoGoalsError, "a travel of 1.2 m: expected 0.01 to 1"),
        (DrawerConfig(size=(0.9, 0.9)), NoGoalsError, "'drawer' of a size of .* m: expected"),
        (DoorConfig(travel=3.5), TaskError, "its joint moves by 3.5, less than the travel of 3.5"),
    ],
)
def test_objects_that_cannot_be_are_refused(config, error, message):
    with pytest.raises(error, match=message):
        draw_goals(robot(ROBOT), replace(config, num_goals=4), anew=True)


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"travel": 0.0}, "to be moved by 0: expected positive numbers"),
        ({"size": (0.3, 0.2)}, "of 0.3 to 0.2"),
        ({"y": (0.3, 0.2)}, r"y \(0.3, 0.2\) is no range"),
        ({"curriculum_steps": 0}, "a curriculum of 0 steps"),
        ({"travel": float("nan")}, "travel nan: expected finite numbers"),
    ],
)
def test_constants_without_a_motion_are_refused(constants, message):
    with pytest.raises(TaskError, match=message):
        DoorConfig(**constants)


@each_object
def test_obstacles_are_refused(task, cache):
    with pytest.raises(TaskError, match=f"^task '{task}' has no obstacles; expected one without$"):
        draw_spec(robot(ROBOT), CONFIGS[task], obstacles=True, cache=cache)


def formulas_of(objects, task="door"):
    tables = object_tables(objects, torch.device("cpu"))
    return ArticulatedFormulas(CONFIGS[task], tables)


def test_positions_by_formulas_are_those_of_the_joints(specs):
    rng = np.random.default_rng(0)
    placed = [specs[task].goals.thing for task in OBJECTS]
    for thing in (drawer(TURNED), door(TURNED), *placed):
        joints = ArticulatedObject(thing.body, thing.pose).placed_joint
        q = rng.uniform(-3.1, 3.1, 20)
        poses = joints.poses(q)
        formulas = formulas_of([thing])
        for sign in (1.0, -1.0):  # the negative of a quaternion is the same rotation
            signed = torch.from_numpy(poses * ([1.0] * 3 + [sign] * 4)).float()
            found = torch.cat([formulas.position(pose[None]) for pose in signed])
            assert found.numpy() == pytest.approx(joints.positions(poses), abs=2e-6)


def state_at(batch, positions, *, diverged=False):
    """Return a state of a batch of one task, with objects at positions of their joints."""
    thing = batch.specs[0].goals.thing
    pose = torch.from_numpy(thing.placed_joint.poses(np.atleast_1d(positions))).float()
    n = len(pose)
    return TaskState(
        tool=pose[:, :3] + torch.tensor([0.0, 0.0, 0.3]),
        object_pose=pose,
        limit_violation=torch.full((n,), 0.5),
        acceleration=torch.zeros(n),
        diverged=torch.full((n,), diverged),
    )


@each_object
def test_success_is_beyond_the_goal(task, make):
    batch = make(task)
    formulas, thing = batch.groups[task].formulas, batch.specs[0].goals.thing
    start, sign, travel = (float(each) for each in (formulas.start, formulas.sign, formulas.travel))
    assert travel == pytest.approx(CONFIGS[task].travel)

    def at(part, **options):
        return formulas.evaluate(state_at(batch, start + sign * travel * part, **options))

    over = at(1.01)
    assert over.success.all()
    assert over.terminated.all()
    assert (float(over.score), float(over.distance)) == (1, 0)
    terms = {name: float(term) for name, term in over.terms.items()}
    approach = terms.pop("approach")
    assert terms == {"joint_limits": -0.5, "distance": 0, "success": 10}
    assert -0.25 < approach < -0.1  # half of 0.3 m, and of half of the object
    for part, to_go in ((0.99, 0.01), (0.5, 0.5), (0.0, 1.0), (-0.2, 1.2)):
        short = at(part)
        assert not short.success.any()
        assert not short.terminated.any()
        assert float(short.score) == float(short.terms["success"]) == 0
        # In metres, along the arc of the contact point.
        assert float(short.distance) == pytest.approx(to_go * travel * thing.lever, rel=1e-3)
        assert float(short.terms["distance"]) == -float(short.distance)
    diverged = at(1.01, diverged=True)
    assert not diverged.success.any()
    assert not diverged.terminated.any()


@each_object
def test_target_points_are_before_on_and_at_the_end_of_the_surface(task, make):
    batch = make(task)
    envs, goals = batch.groups[task], batch.specs[0].goals
    thing, formulas = goals.thing, envs.formulas
    size, centre = np.array(thing.contact_box)
    sign = float(formulas.sign[0])
    direction = np.array(thing.direction)
    end = torch.from_numpy(thing.placed_joint.poses(formulas.goal.double().numpy())).float()
    poses = batch.simulation.object_pose
    points = envs.target_points(poses)[0].double().numpy()

    def in_state(point, pose):
        x, y, z, *q = pose[0].double().tolist()
        T = Pose((x, y, z), tuple(q)).inverse()
        return np.array((T @ Pose(tuple(point.tolist()))).position)

    before, on = (in_state(point, poses) for point in points[:2])
    outside = (np.abs(on - centre) - size / 2).max()
    assert outside == pytest.approx(0.0, abs=5e-4)
    assert sign * (on @ direction) < 0
    assert -sign * ((before - on) @ direction) == pytest.approx(GAP * goals.scale, rel=0.3)
    assert np.linalg.norm(before - on) == pytest.approx(GAP * goals.scale, rel=0.02)
    assert in_state(points[2], end) == pytest.approx(on, abs=1e-6)
    marker = envs.marker_poses(0)["goal"]
    assert in_state(marker[:3].astype(float), end) == pytest.approx(centre, abs=1e-6)


def test_travel_grows_in_the_first_half_of_the_training(make):
    batch = make("door", "door")
    envs, travel = batch.groups["door"], CONFIGS["door"].travel
    found = []
    for progress in (0.0, 0.009, 0.01, 0.5, 0.9, 0.25):
        batch.advance(progress)
        found.append(float(envs.formulas.travel[0]) / travel)
    assert found == pytest.approx([0.1, 0.1, 0.118, 1.0, 1.0, 0.55])
    kept = {name: values.clone() for name, values in envs.state_dict().items()}
    batch.advance(1.0)
    batch.reset()
    assert float(envs.formulas.travel[0]) == pytest.approx(travel)
    envs.load_state_dict(kept)
    batch.reset()
    assert float(envs.formulas.travel[0]) == pytest.approx(0.55 * travel)


@each_object
def test_fields_are_boxes_and_the_joint(task, make):
    batch = make(task)
    goals, formulas = batch.specs[0].goals, batch.groups[task].formulas
    thing, seen = goals.thing, batch.observe()
    size, centre = thing.contact_box
    x, y, z, *q = batch.simulation.object_pose[0].double().tolist()
    T = Pose((x, y, z), tuple(q)) @ Pose(centre)
    wanted = (*T.position, *q, 0, 0, 1, *size)
    assert seen["object"][0].numpy() == pytest.approx(wanted, abs=1e-5)
    assert seen["object_mask"].all()
    assert seen["joint_mask"].all()
    base = seen["object_base"][0]
    assert base[9] == 1  # a box
    assert base[3:7].numpy() == pytest.approx(thing.pose.quaternion, abs=1e-6)
    assert (base[10:] > 0).all()
    joint = seen["object_joint"][0].double().numpy()
    placed = thing.pose @ thing.joint.T_parent_joint
    if task == "drawer":
        along = placed.matrix[:3, :3] @ thing.joint.unit_axis
        assert joint[:3] == pytest.approx(along, abs=1e-6)
    else:
        assert joint[:6] == pytest.approx((0, 0, 1, *placed.position), abs=1e-6)
    assert joint[6] == (task == "drawer")
    position = thing.placed_joint.positions(batch.simulation.object_pose.double().numpy())
    assert joint[7] == pytest.approx(position[0], abs=1e-5)
    assert joint[8] == pytest.approx(float(formulas.goal[0]) - position[0], abs=1e-5)


def test_three_tasks_share_a_batch(make):
    tasks = ("reach", "push", "drawer")
    batch = make(*tasks)
    seen = batch.observe()
    assert seen["goal_mask"].tolist() == [True, False, False]
    assert seen["object_mask"].tolist() == [False, True, True]
    assert seen["joint_mask"].tolist() == [False, False, True]
    assert seen["object_joint"].any(dim=1).tolist() == [False, False, True]
    assert seen["object_base"].any(dim=1).tolist() == [False, False, True]
    assert not seen["line"][2].any()
    rng = torch.Generator().manual_seed(0)
    for _ in range(5):
        step = batch.step(2 * torch.rand(batch.action_mask.shape, generator=rng) - 1)
        assert torch.isfinite(step.reward).all()
        assert not step.terms["success"][1:].any()
    alone = make("drawer")
    assert batch.max_episode_steps[2] == alone.max_episode_steps[0] == 300


@each_object
def test_points_lie_on_the_box_at_the_contact_point(task, make):
    batch = make(task, observe=ObservationConfig(points=60))
    seen = batch.observe()
    assert seen["point_mask"].all()
    size, centre = np.array(batch.specs[0].goals.thing.contact_box)
    x, y, z, *q = batch.simulation.object_pose[0].double().tolist()
    T = (Pose((x, y, z), tuple(q)) @ Pose(tuple(centre))).inverse().matrix
    local = seen["points"][0].double().numpy() @ T[:3, :3].T + T[:3, 3]
    away = (np.abs(local) - size / 2).max(axis=1)
    assert np.abs(away).max() < 5 * NOISE
    assert np.abs(away).mean() < NOISE


LEVER = """\
<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="lever">
  <xacro:property name="size" value="$(arg size)"/>
  <xacro:macro name="solid" params="name z *shape">
    <link name="${name}"><collision><origin xyz="0 0 ${z*size}"/><geometry>
      <xacro:insert_block name="shape"/></geometry></collision></link>
  </xacro:macro>
  <xacro:solid name="foot" z="0.05"><box size="${0.3*size} ${0.3*size} ${0.1*size}"/></xacro:solid>
  <joint name="hinge" type="revolute">
    <parent link="foot"/><child link="bar"/>
    <origin xyz="0 0 ${0.1*size}"/><axis xyz="0 1 0"/>
    <limit lower="-0.9" upper="0.9" effort="0" velocity="10"/>
    <dynamics damping="${1.5*size*size}" friction="${0.6*size}"/>
  </joint>
  <xacro:solid name="bar" z="0.5"><box size="${0.1*size} ${0.5*size} ${0.8*size}"/></xacro:solid>
</robot>
"""
MANIFEST = """\
name: lever
kind: object
summary: An upright bar on a horizontal hinge
file: lever.xacro
root: foot
tool: {link: bar, xyz: [0, 0, "${0.6*size}"]}
home: {hinge: 0}
density: 800
accepted:
  hinge: {effort-missing: the object has no motor}
parameters:
  size: {default: 0.15, min: 0.02, max: 0.6, unit: m, summary: "scale of the whole object"}
licence: MIT
"""


@pytest.fixture
def lever(tmp_path, monkeypatch, xacro_here):
    """Write an object of a user; return its manifest."""
    (tmp_path / "lever.xacro").write_text(LEVER)
    (tmp_path / "lever.yaml").write_text(MANIFEST)
    monkeypatch.setenv("MORPHGEN_LIBRARY", str(tmp_path))
    return tmp_path / "lever.yaml"


def test_an_object_of_a_user_needs_no_code(lever, make, tmp_path):
    config = DoorConfig(object="lever", travel=0.6, num_goals=4)
    spec = draw_spec(robot(ROBOT), config, cache=tmp_path)
    assert certify(spec) == []
    assert spec.goals.thing.joint.unit_axis == (0, 1, 0)
    assert np.abs(spec.goals.goal - spec.goals.start) == pytest.approx(0.6)
    batch = make("door", configs=[config], cache=tmp_path)
    for _ in range(5):
        step = batch.step(torch.zeros(batch.action_mask.shape))
    assert not step.success.any()
    assert 0 < float(step.distance[0]) < 0.6 * spec.goals.edge


def test_an_object_without_size_is_refused(lever):
    lever.write_text(MANIFEST.replace(" size: {", " width: {").replace("*size", "*width"))
    with pytest.raises(TaskError, match="object 'lever' has no parameter 'size'"):
        draw_goals(robot(ROBOT), DoorConfig(object="lever"), anew=True)
