"""Articulated objects shared by the tests of scenes."""

from dataclasses import replace

from morphgen.model.geometry import IDENTITY, Box, Cylinder, Pose, Shape
from morphgen.model.robot import TOOL, Frame, Inertial, Joint, Link, Robot
from morphgen.tasks.sim.articulated import ArticulatedObject

SOLID = (0.01, 0.0, 0.0, 0.01, 0.0, 0.01)
AT = Pose((0.0, 0.0, 0.2))
EDGE = Pose((0.24, 0.01, 0.05))
HINGED = Pose((-0.2, 0.0, 0.0))
POST = Shape(Box((0.05, 0.05, 0.4)), Pose((0.4, 0.0, 0.2)))
"""A part of each object that stands still."""


def drawer(pose=IDENTITY):
    """A front on a slide along y, which moves by up to 40 cm."""
    front = (Shape(Box((0.2, 0.02, 0.1))),)
    joint = Joint("slide", "prismatic", "case", "front", AT, (0.0, 1.0, 0.0), (0.0, 0.4))
    return _object("drawer", replace(joint, damping=1.0, friction=1.0), front, IDENTITY, pose)


def door(pose=HINGED):
    """A panel, which turns about z to either side, pushed near its free edge."""
    middle = Pose((0.15, 0.0, 0.0))
    panel = (Shape(Box((0.3, 0.02, 0.2)), middle),)
    joint = Joint("hinge", "revolute", "case", "panel", AT, (0.0, 0.0, 1.0), (-1.5, 1.5))
    edge = Frame(TOOL, "panel", EDGE)
    return _object("door", replace(joint, damping=0.1, friction=0.1), panel, middle, pose, edge)


def rod():
    """A rod upright on a slide along y."""
    base, shape = Link("base", Inertial(1.0, inertia=SOLID)), Shape(Cylinder(0.02, 0.3))
    tip = Link("tip", Inertial(0.5, inertia=SOLID), collisions=(shape,))
    limits = {"limits": (-0.5, 0.5), "effort": 100.0, "velocity": 2.0}
    slide = Joint("slide", "prismatic", "base", "tip", AT, (0.0, 1.0, 0.0), **limits)
    return Robot("rod", (base, tip), (slide,), home=(-0.2,))


def _object(name, joint, shapes, centre, pose, *frames):
    links = (
        Link("case", Inertial(1.0, inertia=SOLID), collisions=(POST,)),
        Link(joint.child, Inertial(0.5, centre.position, SOLID), collisions=shapes),
    )
    return ArticulatedObject(Robot(name, links, (joint,), frames, home=(0.0,)), pose)
