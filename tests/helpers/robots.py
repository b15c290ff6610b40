"""Small robots that tests build in code or compose by words, and tokens of the test arm."""

from dataclasses import replace
from itertools import pairwise

from morphgen.encoding.tokens import LAYOUT, tokens
from morphgen.grammar.compose import compose, join
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_request
from morphgen.model.geometry import Box, Cylinder, Pose, Shape, Sphere
from morphgen.model.inertia import with_inertia
from morphgen.model.robot import Frame, Inertial, Joint, Link, Mimic, Robot


def rod(name: str, length: float = 0.3) -> Link:
    """A rod along z from its link's origin, with the density of water.

    The collision shape is shorter than the rod, so that adjacent rods do not collide. The visual
    shape is longer, so that there is no visible gap.
    """
    middle = Pose((0.0, 0.0, length / 2))
    solid = Shape(Cylinder(0.02, length - 0.06), middle, (0.8, 0.4, 0.1, 1.0))
    drawn = Shape(Cylinder(0.02, length + 0.04), middle, (0.8, 0.4, 0.1, 1.0))
    return with_inertia(Link(name, visuals=(drawn,), collisions=(solid,)), 1000.0)


def arm() -> Robot:
    """An arm of two revolute joints and a prismatic one, with a finger and a mimic finger."""
    block = Shape(Box((0.1, 0.1, 0.04)))
    base = with_inertia(Link("base", visuals=(block,), collisions=(block,)), 2000.0)
    foot = Shape(Cylinder(0.02, 0.04), Pose((0.0, 0.0, 0.04)))
    slider = rod("slider", 0.2)
    rail = Shape(Box((0.02, 0.2, 0.02)), Pose((0.0, 0.0, 0.2)))
    links = (
        replace(base, visuals=(block, foot)),
        rod("upper"),
        rod("lower"),
        replace(slider, visuals=(*slider.visuals, rail)),
        rod("left", 0.1),
        rod("right", 0.1),
    )
    low, up = Pose((0.0, 0.0, 0.05)), Pose((0.0, 0.0, 0.3))
    left, right = Pose((0.0, 0.05, 0.2)), Pose((0.0, -0.05, 0.2))
    turn = {"limits": (-2.0, 2.0), "effort": 50.0, "velocity": 2.0}
    slide = {"limits": (0.0, 0.04), "effort": 20.0, "velocity": 0.5}
    follow = {**slide, "limits": (-0.04, 0.0), "mimic": Mimic("left", -1.0, 0.0)}
    joints = (
        Joint("shoulder", "revolute", "base", "upper", low, (0, 1, 0), **turn),
        Joint("elbow", "revolute", "upper", "lower", up, (1, 0, 0), **turn),
        Joint("extend", "prismatic", "lower", "slider", up, (0, 0, 1), **slide),
        Joint("left", "prismatic", "slider", "left", left, (0, 1, 0), **slide),
        Joint("right", "prismatic", "slider", "right", right, (0, 1, 0), **follow),
    )
    tool = Frame("tool", "slider", Pose.from_xyz_rpy((0.0, 0.0, 0.28), (0.0, 0.3, 0.0)))
    return Robot("arm", links, joints, (tool,), home=(0.4, 0.5, 0.01, 0.02))


def chain(*links: Link, kind="revolute", step=(0.0, 0.0, 0.3), axis=(0.0, 1.0, 0.0)) -> Robot:
    """A chain of links on joints of one kind, each a step away from the one before."""
    joints = tuple(
        Joint(child.name, kind, parent.name, child.name, Pose(step), axis)
        for parent, child in pairwise(links)
    )
    home = (0.0,) * sum(joint.is_independent for joint in joints)
    return Robot("chain", links, joints, home=home)


def finger(mass: float = 2.0) -> Robot:
    """A ball of 7 mm radius that moves along y and z; at zero its centre is at the origin."""

    def heavy(m: float) -> Inertial:
        return Inertial(m, (0.0, 0.0, 0.0), (m * 1e-3, 0.0, 0.0, m * 1e-3, 0.0, m * 1e-3))

    links = (
        Link("base"),
        Link("carriage", heavy(0.2)),
        Link("ball", heavy(mass), collisions=(Shape(Sphere(0.007)),)),
    )
    slide = {"limits": (-3.0, 3.0), "velocity": 2.0}
    joints = (
        Joint("along", "prismatic", "base", "carriage", axis=(0, 1, 0), **slide),
        Joint("up", "prismatic", "carriage", "ball", axis=(0, 0, 1), **slide),
    )
    return Robot("finger", links, joints, home=(0.0, 0.0))


LIBRARY = default_library()


def derive(text, library=LIBRARY):
    return parse_request(text.split(), library)


def composed(text):
    return compose(derive(text), LIBRARY, "robot")


def joined(text):
    return join(derive(text), LIBRARY, "robot")


FIELDS = {field.name: field.columns for field in LAYOUT}


def shapes_of(robot):
    return {link.name: link.collisions[0] for link in robot.links if link.collisions}


def arm_tokens(**changes):
    robot = replace(arm(), **changes)
    return tokens(robot, shapes_of(robot))


def field_of(token_array, name):
    return token_array[..., FIELDS[name]]
