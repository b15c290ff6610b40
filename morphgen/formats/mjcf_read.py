"""MJCF to ``Robot``, by MuJoCo's own compiler."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from morphgen.formats.mjcf_actuators import read_efforts
from morphgen.formats.mjcf_bodies import WORLD, RobotBodies, robot_bodies
from morphgen.formats.mjcf_compile import compile_document
from morphgen.formats.mjcf_couplings import Couplings, read_couplings
from morphgen.formats.mjcf_document import MjcfDocument, read_document
from morphgen.formats.mjcf_frames import read_frames
from morphgen.formats.mjcf_meshes import inline_meshes
from morphgen.formats.mjcf_shapes import (
    BodyShapes,
    body_shapes,
    ellipsoid_findings,
    pose_of,
)
from morphgen.formats.resolve import PackageFinder, default_finder
from morphgen.formats.urdf import require_description_file
from morphgen.formats.urdf_text import BOUND_MASS
from morphgen.model.findings import Finding
from morphgen.model.geometry import IDENTITY, Pose
from morphgen.model.robot import Inertial, Joint, JointKind, Link, Robot, sorted_pair
from morphgen.model.rotation import Vec3
from morphgen.model.tree import take_name

_HOME = "home"
"""Name of the keyframe that is the home configuration."""
_TOLERANCE = 1e-9
"""Excess over a limit at which a home position is still within it [rad or m]."""


def read_mjcf(
    path: Path, finder: PackageFinder | None = None, *, root_body: str | None = None
) -> Robot:
    """Read an MJCF, with its defaults, angles and inertias resolved by MuJoCo.

    Bodies become links, hinges revolute or continuous joints, slides prismatic joints, and bodies
    without a joint are fixed. Links without mass, named ``BODY_JOINT``, separate several joints of
    a body. A link's frame is its body's; if the body's last hinge has a ``pos``, the frame is there
    instead, as URDF requires. A joint's position is MuJoCo's, also with a ``ref``.

    Meshes without a file and ellipsoids get one in the user's cache; see ``mjcf_meshes``.

    ``robot_bodies`` says which bodies are the robot, ``body_shapes`` which geoms are visual and
    collision shapes, ``read_couplings`` what becomes a mimic joint, ``read_efforts`` how joints get
    effort limits, and ``read_frames`` what becomes the frame ``tool``. Masses up to that of
    ``mjcf_text`` for links without mass count as none. The keyframe ``home``, or the first one, is
    the home configuration if it is within the limits; otherwise every joint is at its ``ref``, or
    in the middle of its range. ``<exclude>`` makes ignored pairs. What a ``Robot`` does not hold is
    left out: stiffness, armature, gains, sensors, cameras, lights and textures.

    Args:
        path: The file.
        finder: Finds ROS packages, and the folder that files may come from besides the document's.
        root_body: Body that is the root of the robot; see ``robot_bodies``.

    Raises:
        UnsoundError: If meshes are not found.
        MeshError: If a mesh cannot be read.
        FormatError: If the file cannot be read, MuJoCo refuses it, or it has something that a
            robot cannot have, such as a ball joint.
        RobotError: If joints follow each other in a circle.
    """
    require_description_file(path)
    document = read_document(path, finder or default_finder())
    spec, model, warnings = compile_document(document)
    document = replace(document, meshes={**document.meshes, **inline_meshes(spec, document)})
    chosen = robot_bodies(model, document, root_body)
    couplings = read_couplings(model, chosen.joints, chosen.bodies, document)
    tree = _Tree(model, chosen, couplings)
    links, ignored = [], []
    ellipsoids: list[str] = []
    for body in chosen.bodies:
        for joint in tree.steps[body][:-1]:
            links.append(Link(joint.child))
        shapes = body_shapes(spec, model, body, document).moved(tree.T_link_body[body])
        links.append(_link(model, body, tree, shapes))
        ellipsoids += shapes.ellipsoids
    for signature in model.exclude_signature.tolist():
        a, b = signature >> 16, signature & 0xFFFF
        if a in tree.link and b in tree.link:
            ignored.append(sorted_pair(tree.link[a], tree.link[b]))
    joints = tuple(joint for body in chosen.bodies for joint in tree.steps[body])
    home, findings = _home(model, joints, tree, document)
    return Robot(
        document.name,
        tuple(links),
        joints,
        read_frames(model, tree.link, tree.T_link_body, joints),
        home,
        tuple(sorted(set(ignored))),
        source_findings=(
            *document.findings,
            *warnings,
            *chosen.findings,
            *couplings.findings,
            *findings,
            *ellipsoid_findings(ellipsoids, document),
        ),
    )


class _Tree:
    """Joints and link frames of the bodies.

    Attributes:
        link: Name of the link of every body.
        T_link_body: Pose of every body's frame in its link's frame.
        steps: Joints that attach every body's link to that of its parent, with links in between.
        joint_index: Index in the model of every movable joint by name.
    """

    def __init__(self, model: mujoco.MjModel, chosen: RobotBodies, couplings: Couplings) -> None:
        names = {model.body(body).name for body in chosen.bodies}
        self._link_names = names
        self._joint_names = {model.joint(j).name for j in chosen.joints}
        self._model = model
        self._couplings = couplings
        self._efforts = read_efforts(model)
        self.link = {
            body: model.body(body).name or take_name(f"body_{body}", self._link_names)
            for body in chosen.bodies
        }
        self._names = {
            joint: model.joint(joint).name
            or take_name(f"{self.link[int(model.jnt_bodyid[joint])]}_joint", self._joint_names)
            for joint in sorted(chosen.joints)
        }
        self.joint_index = {name: joint for joint, name in self._names.items()}
        self.T_link_body: dict[int, Pose] = {chosen.root: IDENTITY}
        self.steps: dict[int, list[Joint]] = {chosen.root: []}
        for body in chosen.bodies[1:]:
            self._attach(body)

    def _attach(self, body: int) -> None:
        model = self._model
        parent = int(model.body_parentid[body])
        link, name = self.link[parent], self.link[body]
        T = self.T_link_body[parent] @ pose_of(model.body_pos[body], model.body_quat[body])
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        self.steps[body] = []
        for joint in range(first, first + count):
            is_last = joint == first + count - 1
            own = self._names[joint]
            child = name if is_last else take_name(f"{name}_{own}", self._link_names)
            step, T = self._joint(joint, own, link, child, T)
            self.steps[body].append(step)
            link = child
        if count == 0:
            own = take_name(f"{name}_joint", self._joint_names)
            self.steps[body].append(Joint(own, "fixed", link, name, T))
            T = IDENTITY
        self.T_link_body[body] = T

    def _joint(
        self, joint: int, name: str, parent: str, child: str, T_parent_body: Pose
    ) -> tuple[Joint, Pose]:
        """Return a joint, and the pose of its body's frame in the frame of its child link."""
        model = self._model
        is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        axis = _vector(model.jnt_axis[joint])
        # The link of a hinge is at its anchor; a slide moves every point alike.
        anchor = (0.0, 0.0, 0.0) if is_slide else _vector(model.jnt_pos[joint])
        position = self._couplings.locks.get(joint, 0.0)
        motion = position - float(model.qpos0[model.jnt_qposadr[joint]])
        T_parent_joint = T_parent_body @ Pose(anchor) @ _displacement(is_slide, axis, motion)
        T_child_body = Pose((-anchor[0], -anchor[1], -anchor[2])) if any(anchor) else IDENTITY
        if joint in self._couplings.locks:
            return Joint(name, "fixed", parent, child, T_parent_joint, axis), T_child_body
        lower, upper = model.jnt_range[joint].tolist()
        is_limited = bool(model.jnt_limited[joint])
        kind: JointKind = "prismatic" if is_slide else "revolute" if is_limited else "continuous"
        dof = int(model.jnt_dofadr[joint])
        return (
            Joint(
                name,
                kind,
                parent,
                child,
                T_parent_joint,
                axis,
                (lower, upper) if is_limited else None,
                self._efforts.get(joint),
                damping=float(model.dof_damping[dof]),
                friction=float(model.dof_frictionloss[dof]),
                mimic=self._couplings.mimic(joint, model, self._names),
            ),
            T_child_body,
        )


def _displacement(is_slide: bool, axis: Vec3, motion: float) -> Pose:
    """Return the displacement of a joint that moves by an angle [rad] or a length [m]."""
    if motion == 0.0:
        return IDENTITY
    x, y, z = axis
    if is_slide:
        return Pose((motion * x, motion * y, motion * z))
    sine = math.sin(motion / 2)
    return pose_of(np.zeros(3), np.array([math.cos(motion / 2), sine * x, sine * y, sine * z]))


def _link(model: mujoco.MjModel, body: int, tree: _Tree, shapes: BodyShapes) -> Link:
    """Return the link of a body, with its mass properties in the link's frame."""
    inertial = None
    if body != WORLD and model.body_mass[body] > BOUND_MASS * (1 + 1e-9):
        T = tree.T_link_body[body] @ pose_of(model.body_ipos[body], model.body_iquat[body])
        R = T.matrix[:3, :3]
        matrix = R @ np.diag(model.body_inertia[body]) @ R.T
        inertial = Inertial.from_matrix(float(model.body_mass[body]), T.position, matrix)
    return Link(tree.link[body], inertial, shapes.visuals, shapes.collisions)


def _home(
    model: mujoco.MjModel, joints: tuple[Joint, ...], tree: _Tree, document: MjcfDocument
) -> tuple[tuple[float, ...], tuple[Finding, ...]]:
    """Return the home configuration, and a finding about a keyframe that is out of limits."""
    keys = [model.key(k).name for k in range(model.nkey)]
    key = keys.index(_HOME) if _HOME in keys else 0
    independent = [joint for joint in joints if joint.is_independent]
    address = {
        joint.name: int(model.jnt_qposadr[tree.joint_index[joint.name]]) for joint in independent
    }
    outside = []
    if keys:
        home = tuple(float(model.key_qpos[key, address[joint.name]]) for joint in independent)
        outside = [
            joint.name
            for joint, q in zip(independent, home, strict=True)
            if not _is_within(joint, q)
        ]
        if not outside:
            return home, ()
    refs = [(joint, float(model.qpos0[address[joint.name]])) for joint in independent]
    home = tuple(q if _is_within(j, q) else sum(j.effective_limits) / 2 for j, q in refs)
    if not outside:
        return home, ()
    finding = Finding(
        "keyframe-outside-limits",
        "warning",
        f"{document.path.name}: key {keys[key]!r}",
        f"the position of joint {outside[0]!r} is outside its limits",
        "correct qpos of the keyframe",
        "the keyframe was left out; home is the reference position",
    )
    return home, (finding,)


def _is_within(joint: Joint, position: float) -> bool:
    if joint.limits is None:
        return True
    lower, upper = joint.limits
    return lower - _TOLERANCE <= position <= upper + _TOLERANCE


def _vector(values: np.ndarray) -> Vec3:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
