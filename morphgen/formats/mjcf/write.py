"""Write a robot as an MJCF."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import PurePosixPath

import mujoco
import numpy as np
from lxml import etree

from morphgen.errors import FormatError
from morphgen.formats.quiet import log_mujoco_warnings
from morphgen.formats.rounding import format_inertia, format_number, format_numbers
from morphgen.formats.urdf.write import MUJOCO_BOUNDS
from morphgen.model.dynamics import Actuation, actuation, armature
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.kinematics import movable_positions
from morphgen.model.mesh import hull_triangles, mesh_triangles
from morphgen.model.robot import TOOL, Joint, Link, Robot
from morphgen.model.tree import take_name
from morphgen.typing import Array

MeshFile = Callable[[Mesh], str]
"""Function that writes a mesh, or finds it, and returns its path for the document."""
FLAT = 1e-5  # extent below which a collision hull counts as flat [m]; MuJoCo refuses flat hulls
FLAT_THICKNESS = 1e-4  # thickness that a flat collision hull gets [m]


class Meshes:
    """Mesh assets of a document, in order of first use.

    With a ``MeshFile`` the document names files (``write``). Without one, the compiled model gets
    the triangles themselves (``add_to``).
    """

    def __init__(self, mesh_file: MeshFile | None = None) -> None:
        self._mesh_file = mesh_file
        self._names: dict[tuple[Mesh, bool], str] = {}
        self._taken: set[str] = set()
        self._files: dict[str, str] = {}  # names by file
        self._vertices: dict[str, Array] = {}

    def name(self, mesh: Mesh, *, collision: bool) -> str:
        """Return the asset name of a mesh, for collision the name of its hull."""
        key = (mesh, collision)
        if key not in self._names:
            self._names[key] = self._add(mesh, collision)
        return self._names[key]

    def write(self, asset: etree._Element) -> None:
        """Add a ``<mesh>`` for every file and every flat hull."""
        for file, name in self._files.items():
            etree.SubElement(asset, "mesh", name=name, file=file, inertia="shell")
        for name, vertices in self._vertices.items():
            vertex = format_numbers(vertices.ravel().tolist())
            etree.SubElement(asset, "mesh", name=name, vertex=vertex)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the triangles of the meshes to a model."""
        for (mesh, collision), name in self._names.items():
            if name in self._vertices:
                continue
            triangles = hull_triangles(mesh) if collision else mesh_triangles(mesh)
            vertices = triangles.vertices
            missing = max(0, 4 - len(vertices))  # MuJoCo refuses meshes of fewer than four vertices
            spec.add_mesh(
                name=name,
                uservert=np.concatenate([vertices, vertices[:1].repeat(missing, 0)]).ravel(),
                userface=np.asarray(triangles.faces, dtype=np.int32).ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
            )

    def _add(self, mesh: Mesh, collision: bool) -> str:
        if collision:
            corners = _thickened(mesh_triangles(mesh).vertices)
            if corners is not None:
                name = take_name(f"{mesh.path.stem}_flat", self._taken)
                self._vertices[name] = corners
                return name
        if self._mesh_file is None:
            return take_name(mesh.path.stem, self._taken)
        file = self._mesh_file(mesh)
        if file not in self._files:
            self._files[file] = take_name(PurePosixPath(file).stem, self._taken)
        return self._files[file]


def geom_attributes(shape: Shape, meshes: Meshes, *, collision: bool) -> dict[str, str]:
    """Return the type, size or mesh, and pose attributes of a shape's ``<geom>``."""
    match shape.geometry:
        case Box(size):
            form = {"type": "box", "size": format_numbers(edge / 2 for edge in size)}
        case Sphere(radius):
            form = {"type": "sphere", "size": format_number(radius)}
        case Cylinder(radius, length):
            form = {"type": "cylinder", "size": format_numbers([radius, length / 2])}
        case Capsule(radius, length):
            form = {"type": "capsule", "size": format_numbers([radius, length / 2])}
        case Mesh():
            form = {"type": "mesh", "mesh": meshes.name(shape.geometry, collision=collision)}
    return form | pose_attributes(shape.T_link_shape)


def joint_attributes(joint: Joint) -> dict[str, str]:
    """Return the name, type and axis attributes of a movable joint."""
    kind = "slide" if joint.kind == "prismatic" else "hinge"
    return {"name": joint.name, "type": kind, "axis": format_numbers(joint.unit_axis)}


def pose_attributes(pose: Pose) -> dict[str, str]:
    """Return the pose attributes of an element; none for the identity."""
    attributes = {}
    position, quaternion = format_numbers(pose.position), format_numbers(pose.quaternion)
    if position != "0 0 0":
        attributes["pos"] = position
    if quaternion != "1 0 0 0":
        attributes["quat"] = quaternion
    return attributes


def _thickened(vertices: Array) -> Array | None:
    """Return the corners of a thin solid around flat vertices; None if they are not flat."""
    centred = vertices - vertices.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    if np.ptp(centred @ axes[:, 0]) >= FLAT:
        return None
    import trimesh  # here, because few robots have flat meshes

    shift = axes[:, 0] * FLAT_THICKNESS / 2
    sides = np.concatenate([vertices + shift, vertices - shift])
    return np.asarray(trimesh.convex.convex_hull(sides).vertices, dtype=np.float64)


log_mujoco_warnings()

TIMESTEP = 0.002
"""Physics step of the written model, MuJoCo's default [s]; environments set their own."""
VISUAL_GROUP, COLLISION_GROUP = 2, 3  # geom groups; MuJoCo's viewers show groups 0 to 2
_SITE_GROUP = 4
MJCF_COMPILER = {"angle": "radian", "inertiafromgeom": "false", **MUJOCO_BOUNDS}
"""Attributes of ``<compiler/>``: inertias as written, massless links allowed."""
MIMIC_SOLVER = {"solref": "0.01 1", "solimp": "0.999 0.999 0.001"}
"""Stiffness of the equality of a mimic joint: an error vanishes in 10 ms, two steps of the
environments and the shortest time that MuJoCo accepts there; 0.1% of a disturbance remains.
MuJoCo's default leaves up to a tenth, in proportion to the force over the joint's own inertia: the
link between a rod and a motor that pushes against it would yield by radians."""


def mjcf_text(robot: Robot, mesh_file: MeshFile) -> str:
    """Write a robot as MJCF; the same robot gives the same bytes.

    Gravity is compensated, as by the controllers of real arms. An effort of zero counts as missing,
    as in most URDFs. MuJoCo refuses a massless link on a moving joint, so ``<compiler>`` bounds
    links far below any real part. ``MjSpec.to_xml`` is not used: its 6 digits move a tool by
    micrometres.

    mesh_file: Maps a mesh to its file relative to the MJCF, such as ``meshes/hand.stl``, which has
    it as the shape uses it: only its part, with scale applied.
    """
    meshes = Meshes(mesh_file)
    root = _document(robot, meshes)
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def to_spec(robot: Robot) -> mujoco.MjSpec:
    """Build an editable MuJoCo model, equal to what ``mjcf_text`` writes, with triangles."""
    meshes = Meshes()
    spec = mujoco.MjSpec.from_string(etree.tostring(_document(robot, meshes), encoding="unicode"))
    meshes.add_to(spec)
    return spec


def _document(robot: Robot, meshes: Meshes) -> etree._Element:
    root = etree.Element("mujoco", model=robot.name)
    etree.SubElement(root, "compiler", MJCF_COMPILER)
    etree.SubElement(root, "option", timestep=f"{TIMESTEP:g}", integrator="implicitfast")
    default = etree.SubElement(root, "default")
    visual = etree.SubElement(default, "default", {"class": "visual"})
    etree.SubElement(visual, "geom", group=str(VISUAL_GROUP), contype="0", conaffinity="0")
    collision = etree.SubElement(default, "default", {"class": "collision"})
    etree.SubElement(collision, "geom", group=str(COLLISION_GROUP))
    asset = etree.SubElement(root, "asset")
    world = etree.SubElement(root, "worldbody")
    gains = actuation(robot)
    _write_bodies(world, robot, meshes, gains)
    meshes.write(asset)
    _write_constraints(root, robot)
    _write_actuators(root, robot, gains)
    _write_home(root, robot, world)
    for section in ("asset", "contact", "equality", "actuator"):
        element = root.find(section)
        if element is not None and len(element) == 0:
            root.remove(element)
    return root


def _write_bodies(
    world: etree._Element, robot: Robot, meshes: Meshes, gains: tuple[Actuation, ...]
) -> None:
    sites: dict[str, list[dict[str, str]]] = {}
    for frame in robot.frames:
        attributes = {"name": frame.name, "group": str(_SITE_GROUP)}
        sites.setdefault(frame.link, []).append(attributes | pose_attributes(frame.T_link_frame))
    armatures = dict(zip(robot.movable_joints, armature(robot).tolist(), strict=True))
    bodies: list[etree._Element] = []
    for i, link in enumerate(robot.links):
        if link.name == "world":
            if i > 0 or (link.inertial is not None and link.inertial.mass > 0):
                raise FormatError(
                    f"robot {robot.name!r}: link 'world' is not a root without mass; MuJoCo "
                    "reserves that name, rename the link"
                )
            body = world
        else:
            joint = robot.joints[i - 1] if i else None
            body = etree.SubElement(
                bodies[robot.parents[i]] if i else world,
                "body",
                {"name": link.name, "gravcomp": "1"}
                | (pose_attributes(joint.T_parent_joint) if joint else {}),
            )
            _write_inertial(body, link)
            if joint is not None and joint.is_movable:
                _write_joint(body, joint, armatures[i - 1])
        for kind, shapes in (("visual", link.visuals), ("collision", link.collisions)):
            for shape in shapes:
                attributes = geom_attributes(shape, meshes, collision=kind == "collision")
                if shape.rgba is not None:
                    attributes["rgba"] = format_numbers(shape.rgba)
                etree.SubElement(body, "geom", {"class": kind} | attributes)
        for site in sites.get(link.name, ()):
            etree.SubElement(body, "site", site)
        bodies.append(body)


def _write_inertial(body: etree._Element, link: Link) -> None:
    if link.inertial is None or link.inertial.mass == 0:
        return
    xx, xy, xz, yy, yz, zz = link.inertial.inertia
    mass = f"{link.inertial.mass:.12g}"
    inertial = etree.SubElement(body, "inertial", pos=format_numbers(link.inertial.com), mass=mass)
    off_diagonal = " ".join(map(format_inertia, (xy, xz, yz)))
    diagonal = " ".join(map(format_inertia, (xx, yy, zz)))
    if off_diagonal == "0 0 0":
        inertial.set("diaginertia", diagonal)
    else:
        inertial.set("fullinertia", f"{diagonal} {off_diagonal}")


def _write_joint(body: etree._Element, joint: Joint, armature: float) -> None:
    element = etree.SubElement(body, "joint", joint_attributes(joint))
    limits = _limits(joint)
    if limits is not None:
        element.set("range", limits)
    if armature:
        element.set("armature", format_number(armature))
    if joint.damping:
        element.set("damping", format_number(joint.damping))
    if joint.friction:
        element.set("frictionloss", format_number(joint.friction))


def _write_constraints(root: etree._Element, robot: Robot) -> None:
    contact = etree.SubElement(root, "contact")
    for a, b in robot.ignore_pairs:
        etree.SubElement(contact, "exclude", body1=a, body2=b)
    equality = etree.SubElement(root, "equality")
    matrix, offset = robot.mimic_map
    for row, k in enumerate(robot.movable_joints):
        joint = robot.joints[k]
        if joint.mimic is None:
            continue
        element = etree.SubElement(
            equality, "joint", {"name": f"{joint.name}_mimic", "joint1": joint.name} | MIMIC_SOLVER
        )
        for column in np.flatnonzero(matrix[row]).tolist():
            element.set("joint2", robot.joints[robot.independent_joints[column]].name)
        element.set("polycoef", format_numbers([offset[row], matrix[row].sum(), 0, 0, 0]))


def _write_actuators(root: etree._Element, robot: Robot, gains: tuple[Actuation, ...]) -> None:
    section = etree.SubElement(root, "actuator")
    for gain in gains:
        element = etree.SubElement(
            section,
            "position",
            name=gain.joint,
            joint=gain.joint,
            kp=f"{gain.stiffness:.6g}",
            kv=f"{gain.damping:.6g}",
        )
        limits = _limits(robot.joints[robot.joint_index[gain.joint]])
        if limits is not None:
            element.set("ctrlrange", limits)
        if gain.effort:
            element.set("forcerange", format_numbers([-gain.effort, gain.effort]))


def _write_home(root: etree._Element, robot: Robot, world: etree._Element) -> None:
    values = movable_positions(robot, robot.home).tolist()
    positions = {robot.joints[k].name: q for k, q in zip(robot.movable_joints, values, strict=True)}
    key = etree.SubElement(etree.SubElement(root, "keyframe"), "key", name="home")
    if positions:
        # MuJoCo's qpos is in the order of the document, depth first, and not in the robot's.
        names = (joint.get("name", "") for joint in world.iter("joint"))
        key.set("qpos", format_numbers(positions[name] for name in names))
    if robot.home:
        key.set("ctrl", format_numbers(robot.home))


def _limits(joint: Joint) -> str | None:
    if joint.limits is None or joint.kind == "continuous":
        return None
    lower, upper = joint.limits
    if lower >= upper:
        raise FormatError(
            f"joint {joint.name!r}: limits ({lower:g}, {upper:g}) leave no range; MJCF "
            "needs lower < upper, or make the joint fixed"
        )
    return format_numbers(joint.limits)


class MujocoKinematics:
    """The kinematic tree of a robot in MuJoCo, to verify ``morphgen.model.kinematics``.

    Attributes:
        model: The compiled model; bodies have the names of links, sites those of frames.
        data: The state of the model at the last configuration.
    """

    def __init__(self, robot: Robot) -> None:
        """Compile a robot."""
        bare = [replace(link, visuals=(), collisions=()) for link in robot.links]
        self._robot = robot
        self.model = to_spec(robot.with_links(bare)).compile()
        self.data = mujoco.MjData(self.model)
        names = (robot.joints[k].name for k in robot.movable_joints)
        self._address = [self.model.joint(name).qposadr[0] for name in names]

    def frame_pose(self, q: Array, frame: str = TOOL) -> Array:
        """Return ``T_root_frame`` at configurations (n, dof), shape (n, 4, 4)."""
        site = self.data.site(frame)
        T = np.tile(np.eye(4), (len(q), 1, 1))
        for T_root_frame, positions in zip(T, movable_positions(self._robot, q), strict=True):
            self.data.qpos[self._address] = positions
            mujoco.mj_kinematics(self.model, self.data)
            T_root_frame[:3, :3] = site.xmat.reshape(3, 3)
            T_root_frame[:3, 3] = site.xpos
        return T
