"""Robots with exactly one fault each, keyed by finding code."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from helpers.robots import arm
from morphgen.model.geometry import Box, Capsule, Geometry, Mesh, Pose, Shape, Sphere
from morphgen.model.inertia import inertial_from_density, with_inertia
from morphgen.model.robot import Frame, Inertial, Joint, Link, Mimic, Robot
from morphgen.model.tree import rename

FLAT_INERTIA = (1e-3, 0.0, 0.0, 1e-3, 0.0, 2.5e-3)


def valid_robot() -> Robot:
    """A robot without findings: the arm with an independent right finger."""
    return with_joint(arm(), "right", mimic=None)


def with_joint(robot: Robot, name: str, **changes: object) -> Robot:
    """Return the robot with one joint changed; a joint that becomes independent has home 0."""
    home = {
        robot.joints[k].name: q for k, q in zip(robot.independent_joints, robot.home, strict=True)
    }
    joints = tuple(replace(j, **changes) if j.name == name else j for j in robot.joints)
    moving = (j for j in joints if j.is_independent)
    return replace(robot, joints=joints, home=tuple(home.get(j.name, 0.0) for j in moving))


def with_link(robot: Robot, name: str, **changes: object) -> Robot:
    """Return the robot with one link changed."""
    return robot.with_links([replace(robot.link(name), **changes)])


def with_body(name: str, **changes: object) -> Robot:
    """Return the valid robot with the mass properties of one link changed."""
    body = valid_robot().link(name).inertial
    assert body is not None
    return with_link(valid_robot(), name, inertial=replace(body, **changes))


def with_shape(geometry: Geometry, *, visual: bool = True) -> Robot:
    """Return the valid robot with another collision shape, and visual, of its slider."""
    shapes = (Shape(geometry),)
    drawn = (*valid_robot().link("slider").visuals, *(shapes if visual else ()))
    return with_link(valid_robot(), "slider", collisions=shapes, visuals=drawn)


def with_end(link: Link, joint: Joint) -> Robot:
    """Return the valid robot with one more link."""
    robot = valid_robot()
    home = (*robot.home, *([0.0] if joint.is_independent else []))
    return replace(robot, links=(*robot.links, link), joints=(*robot.joints, joint), home=home)


def hinge(child: str, **changes: object) -> Joint:
    """Return a joint at the end of the slider."""
    joint = Joint(child, "revolute", "slider", child, limits=(-1.0, 1.0), effort=1.0, velocity=1.0)
    return replace(joint, **changes)


def _weightless_between() -> Robot:
    tip = Link("tip", Inertial(0.1, inertia=(1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4)))
    robot = with_end(Link("cross"), hinge("cross"))
    joint = replace(hinge("tip", axis=(0.0, 1.0, 0.0)), parent="cross")
    return replace(
        robot, links=(*robot.links, tip), joints=(*robot.joints, joint), home=(*robot.home, 0.0)
    )


def _with_pads(n: int) -> Robot:
    robot = valid_robot()
    for i in range(n):
        pad = Joint(f"pad{i}", "fixed", robot.links[-1].name, f"pad{i}")
        robot = replace(robot, links=(*robot.links, Link(f"pad{i}")), joints=(*robot.joints, pad))
    return robot


ROBOTS: dict[str, Callable[[], Robot]] = {
    "inertia-missing": lambda: with_link(valid_robot(), "lower", inertial=None),
    "massless-body": lambda: with_end(Link("stub"), hinge("stub")),
    "massless-between": _weightless_between,
    "links-too-many": lambda: _with_pads(130),
    "links-apart": lambda: with_link(
        valid_robot(), "upper", visuals=(Shape(Sphere(0.02), Pose((0.0, 0.0, 0.15))),)
    ),
    "massless-root": lambda: with_link(valid_robot(), "base", inertial=None),
    "mass-invalid": lambda: with_body("lower", mass=-1.0),
    "inertia-without-mass": lambda: with_end(
        Link("pad", Inertial(0.0, inertia=(1.0, 0.0, 0.0, 1.0, 0.0, 1.0))),
        Joint("pad", "fixed", "slider", "pad"),
    ),
    "inertia-not-physical": lambda: with_body("lower", inertia=FLAT_INERTIA),
    "inertia-implausible": lambda: with_body("lower", inertia=(1.0, 0.0, 0.0, 1.0, 0.0, 1.0)),
    "com-outside": lambda: with_body("lower", com=(0.0, 0.0, 0.6)),
    "density-implausible": lambda: with_body("lower", mass=100.0),
    "axis-invalid": lambda: with_joint(valid_robot(), "elbow", axis=(0.0, 0.0, 0.0)),
    "axis-not-unit": lambda: with_joint(valid_robot(), "extend", axis=(0.0, 0.0, 2.0)),
    "limits-missing": lambda: with_joint(valid_robot(), "elbow", limits=None),
    "limits-inverted": lambda: with_joint(valid_robot(), "elbow", limits=(1.0, -1.0)),
    "limits-empty": lambda: with_joint(valid_robot(), "elbow", limits=(0.5, 0.5)),
    "limits-on-continuous": lambda: with_joint(valid_robot(), "elbow", kind="continuous"),
    "limits-wide": lambda: with_joint(valid_robot(), "elbow", limits=(-180.0, 180.0)),
    "effort-missing": lambda: with_joint(valid_robot(), "elbow", effort=0.0),
    "velocity-missing": lambda: with_joint(valid_robot(), "elbow", velocity=None),
    "damping-invalid": lambda: with_joint(valid_robot(), "elbow", damping=-1.0),
    "friction-invalid": lambda: with_joint(valid_robot(), "elbow", friction=math.nan),
    "home-outside-limits": lambda: replace(valid_robot(), home=(3.0, *valid_robot().home[1:])),
    "mimic-on-fixed": lambda: with_end(
        Link("pad"), Joint("pad", "fixed", "slider", "pad", mimic=Mimic("elbow"))
    ),
    "mimic-leader-fixed": lambda: with_joint(arm(), "left", kind="fixed"),
    "mimic-invalid": lambda: with_joint(arm(), "right", mimic=Mimic("left", math.inf)),
    "mimic-still": lambda: with_joint(arm(), "right", mimic=Mimic("left", 0.0)),
    "mimic-range": lambda: with_joint(arm(), "right", mimic=Mimic("left", -2.0)),
    "mimic-ignored-by-loaders": arm,
    "size-not-positive": lambda: with_shape(Box((0.1, 0.1, 0.0))),
    "extent-implausible": lambda: with_shape(Box((20.0, 20.0, 20.0))),
    "visual-collision-scale": lambda: with_shape(Box((2.4e-4, 2.4e-4, 2.4e-4)), visual=False),
    "capsule-in-urdf": lambda: with_shape(Capsule(0.02, 0.1)),
    "name-characters": lambda: replace(
        rename(valid_robot(), {"right": "right/pad 1"}), name="an arm"
    ),
    "name-reserved": lambda: rename(valid_robot(), {"right": "world"}),
    "frame-name-taken": lambda: replace(
        valid_robot(), frames=(*valid_robot().frames, Frame("base", "base"))
    ),
    # Its lower rod overlaps the base, two joints away.
    "self-collision": lambda: with_link(
        valid_robot(), "lower", collisions=(Shape(Box((2.0, 2.0, 2.0))),)
    ),
    "tool-missing": lambda: replace(valid_robot(), frames=()),
    "tool-still": lambda: replace(valid_robot(), frames=(Frame("tool", "base"),)),
}


def _ball(path: Path, subdivisions: int = 2) -> Path:
    trimesh.creation.icosphere(subdivisions, radius=0.05).export(path)
    return path


def _triangle(path: Path) -> Path:
    corners = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.1, 0.0]])
    trimesh.Trimesh(corners, [[0, 1, 2]], process=False).export(path)
    return path


def _mesh(path: Path, scale: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Robot:
    """Return the valid robot with a mesh on its slider, and the mesh's mass if it has a volume."""
    robot = with_shape(Mesh(path, scale))
    if path.is_file() and path.stem == "ball" and all(map(math.isfinite, scale)) and all(scale):
        return robot.with_links([with_inertia(robot.link("slider"), 1000.0)])
    shape = Shape(Box((0.1, 0.1, 0.1)))
    return with_link(robot, "slider", inertial=inertial_from_density([shape], 1000.0))


def _text(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


MESHES: dict[str, Callable[[Path], Robot]] = {
    "mesh-unresolved": lambda folder: _mesh(folder / "nowhere.stl"),
    "mesh-unreadable": lambda folder: _mesh(_text(folder / "empty.obj", "v 0 0 0\n")),
    "mesh-flat": lambda folder: _mesh(_triangle(folder / "triangle.stl")),
    "mesh-left-out": lambda folder: _mesh(
        _text(folder / "lines.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nl 1 2\nf 1 2 3\nf 1 2 4\n")
    ),
    "mesh-huge": lambda folder: _mesh(_ball(folder / "ball.stl", subdivisions=4)),
    "mesh-scale-invalid": lambda folder: _mesh(_ball(folder / "ball.stl"), (1.0, 0.0, 1.0)),
    "mesh-mirrored": lambda folder: _mesh(_ball(folder / "ball.stl"), (1.0, -1.0, 1.0)),
    "mesh-stretched": lambda folder: _mesh(_ball(folder / "ball.stl"), (1.0, 1.0, 2.0)),
}


def valid_robot_with_mesh(folder: Path) -> Robot:
    """Return the valid robot with a valid mesh."""
    return _mesh(_ball(folder / "ball.stl"))
