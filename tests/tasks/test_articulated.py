"""Articulated objects: three simulators agree, resets, tests of collisions, pictures."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.objects import AT, EDGE, POST, door, drawer, rod
from helpers.simulators import PYBULLET
from morphgen.errors import SimulationError
from morphgen.model.geometry import Box, Mesh, Pose, Shape
from morphgen.model.robot import TOOL, Frame
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.sim.articulated import ArticulatedObject, ObjectJoints
from morphgen.tasks.sim.base import Scene

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
        assert not simulation.step(target).any(), simulation.faults()
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


@pytest.mark.parametrize("name", [PYBULLET, "warp"])
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


@pytest.mark.parametrize("make", [drawer, door])
def test_positions_are_the_inverse_of_poses(make):
    joints = ObjectJoints([make(TURNED)] * 3)
    q = np.array([-1.3, 0.0, 0.4])
    poses = joints.poses(q)
    assert joints.positions(poses) == pytest.approx(q)
    assert joints.positions(poses * ([1] * 3 + [-1] * 4)) == pytest.approx(q)  # -q is q
    assert (poses[:, 3] >= 0).all()


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


def faulty(fault):
    """A robot that is no articulated object."""
    body, (case, front) = drawer().body, drawer().body.links
    if fault == "joints":
        second = replace(body.joints[0], name="second", parent="front", child="end")
        links = (case, front, replace(front, name="end"))
        return replace(body, links=links, joints=(*body.joints, second), home=(0.0, 0.0))
    if fault == "frame":
        return replace(body, frames=(Frame(TOOL, "case"),))
    if fault == "mesh":
        return replace(body, links=(replace(case, collisions=(Shape(Mesh("none.stl")),)), front))
    return replace(body, links=(case, replace(front, inertial=None)))


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("joints", "'drawer' has 2 movable joints; expected one"),
        ("mesh", "'drawer' has a mesh for collisions; expected primitives"),
        ("frame", "'drawer': the link 'case' of its frame 'tool' does not move"),
        ("mass", "'drawer': the link that moves has no mass"),
    ],
)
def test_robot_that_is_no_such_object_is_refused(fault, message):
    body = faulty(fault)
    with pytest.raises(SimulationError, match=message):
        ArticulatedObject(body)


def test_kinematic_simulator_refuses_an_object():
    scenes, cpu = [Scene(rod(), object=door())], torch.device("cpu")
    with pytest.raises(SimulationError, match="the scene has an object"):
        SIMULATORS["kinematic"].load(scenes, None, 1, cpu)


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
