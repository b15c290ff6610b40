"""Bodies whose tokens tests look at, and their fields by name."""

from dataclasses import replace

from morphgen.benchmark.tokens import LAYOUT, tokens
from morphgen.model.robot import Joint, Link, Robot
from robots import arm

FIELDS = {field.name: field.columns for field in LAYOUT}


def shapes_of(robot):
    return {link.name: link.collisions[0] for link in robot.links if link.collisions}


def arm_tokens(**changes):
    robot = replace(arm(), **changes)
    return tokens(robot, shapes_of(robot))


def hinge(kind="revolute", limits=(-1.0, 1.0), **changes):
    """A body of one joint."""
    joint = Joint("j", kind, "a", "b", axis=(0, 0, 1), limits=limits, **changes)
    home = () if kind == "fixed" else (0.0,)
    return Robot("hinge", (Link("a"), Link("b")), (joint,), home=home)


def field_of(made, name):
    return made[..., FIELDS[name]]
