"""Small scenes shared by the simulator tests."""

from functools import cache

import morphgen
from morphgen.model.geometry import Pose, Shape, Sphere
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.tasks.sim.base import Block, Scene

PAPER_ROBOTS = (
    "arm=ur5 ee=stick",
    "arm=ur5 ee=sake_ez",
    "arm=ur5 ee=rethink",
    "arm=kinova_gen3 ee=robotiq_2f85",
    "arm=jaco2 ee=jaco_fingers",
    "arm=xarm7 ee=robotiq_2f85",
    "arm=lwr ee=panda_hand",
    "arm=yumi_right ee=yumi_gripper",
    "arm=widowx ee=widowx_gripper",
    "arm5",
    "stick",
    "nlink",
    "cubes",
    "prims prim=cylinder",
    "prims prim=sphere",
    "chain beads=3",
)
"""Robots of the paper besides those of fast tests."""


@cache
def robot(request):
    """A robot with primitive collision shapes; the same request gives the same object."""
    return morphgen.compose(request, geometry="primitive")


def reach_scene():
    """An arm of primitives with a claw, whose fingers mimic each other, above the ground."""
    return Scene(robot("arm=arm3 ee=claw"))


def real_arm_scene():
    """A UR5 with a plane for a hand, on a plinth."""
    return Scene(robot("arm=ur5 ee=plane"), Pose((0.0, 0.0, 0.3)))


def push_scene(mass=0.1, friction=1.0):
    """A gantry with a vertical plane, a block in front of it, and two obstacles out of its way."""
    edge = 0.15
    return Scene(
        robot("prims"),
        object=Block((edge, edge, edge), Pose((0.0, 0.0, edge / 2)), mass, friction),
        obstacles=(
            Block((0.1, 0.1, 0.1), Pose((0.5, 0.2, 0.05))),
            Block((0.1, 0.1, 0.2), Pose.from_xyz_rpy((-0.5, 0.2, 0.1), (0.0, 0.0, 0.5))),
        ),
    )


def mixed_scenes():
    """Return three scenes with different robots, with and without a block."""
    return [reach_scene(), push_scene(), real_arm_scene()]


def ball(height):
    """A ball of 0.1 m on slides along x and y."""
    base, cart, last = Link("base"), Link("cart"), Link("ball", collisions=(Shape(Sphere(0.1)),))
    joints = (
        Joint("x", "prismatic", "base", "cart", Pose((0, 0, height)), (1, 0, 0), (-2.0, 2.0)),
        Joint("y", "prismatic", "cart", "ball", Pose(), (0, 1, 0), (-2.0, 2.0)),
    )
    return Robot("ball", (base, cart, last), joints, (Frame("tool", "ball"),), (0.0, 0.0))
