"""Write a robot as SDFormat, the model format of Gazebo and Drake."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from lxml import etree

from morphgen.errors import FormatError
from morphgen.formats import rounding
from morphgen.formats.urdf.write import BOUND_INERTIA, BOUND_MASS, MeshUri
from morphgen.model.geometry import Box, Geometry, Mesh, Pose, dimensions
from morphgen.model.robot import Inertial, Joint, Link, Robot

SDF_VERSION, SDF_MIMIC_VERSION = "1.10", "1.11"
"""Version of the format, and the first version with ``<mimic>``, for robots that need it."""
MODEL_SDF, MODEL_CONFIG = "model.sdf", "model.config"
"""Files of a model's folder; Gazebo finds the first by the second."""
_WORLD = "world"
_MASSLESS = Inertial(
    BOUND_MASS, inertia=(BOUND_INERTIA, 0.0, 0.0, BOUND_INERTIA, 0.0, BOUND_INERTIA)
)
"""Mass properties of massless links; SDFormat refuses zero and reads missing ones as 1 kg."""


def sdf_text(robot: Robot, mesh_uri: MeshUri) -> str:
    """Write a robot as an SDFormat model; the same robot gives the same bytes.

    Poses of links are relative to the model, at position zero of all joints, so that readers
    without frame semantics place them, too. All names in a model must differ, unlike in a URDF: a
    joint that is named like a link gets ``_joint`` appended, a frame ``_frame``, as by SDFormat's
    own converter.
    """
    has_world_root = robot.root.name == _WORLD and robot.root.is_empty
    links = {link.name for link in robot.links}
    joints = _free_names((joint.name for joint in robot.joints), links, "_joint")
    frames = _free_names((f.name for f in robot.frames), {*links, *joints.values()}, "_frame")
    for name in (
        robot.name,
        *sorted(links - {_WORLD} if has_world_root else links),
        *joints,
        *frames,
    ):
        if name == _WORLD or "::" in name or (name.startswith("__") and name.endswith("__")):
            raise FormatError(
                f"robot {robot.name!r}: the name {name!r} is reserved in SDFormat, as are 'world', "
                "'__...__' and names with '::'; rename it"
            )
    root = etree.Element("sdf", version=_version(robot))
    model = etree.SubElement(root, "model", name=robot.name)
    for i, (link, T) in enumerate(zip(robot.links, _zero_poses(robot), strict=True)):
        if i > 0 or not has_world_root:
            _write_link(model, link, T, mesh_uri)
    for frame in robot.frames:
        element = etree.SubElement(model, "frame", name=frames[frame.name])
        if frame.link != _WORLD:  # the model's own frame coincides with such a root
            element.set("attached_to", frame.link)
        _write_pose(element, frame.T_link_frame)
    if not has_world_root:
        taken = {*links, *joints.values(), *frames.values()}
        (anchor,) = _free_names([f"{_WORLD}_joint"], taken, "_anchor").values()
        element = etree.SubElement(model, "joint", name=anchor, type="fixed")
        _write_ends(element, _WORLD, robot.root.name)
    for joint in robot.joints:
        _write_joint(model, joint, joints)
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def model_config_text(robot: Robot) -> str:
    """Return the ``model.config`` of a folder with a robot's ``model.sdf``."""
    root = etree.Element("model")
    etree.SubElement(root, "name").text = robot.name
    etree.SubElement(root, "version").text = "1.0"
    etree.SubElement(root, "sdf", version=_version(robot)).text = MODEL_SDF
    about = f"{robot.name}: {len(robot.links)} links, {robot.dof} independent joints"
    etree.SubElement(root, "description").text = about
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def _version(robot: Robot) -> str:
    has_mimics = any(joint.is_movable and joint.mimic for joint in robot.joints)
    return SDF_MIMIC_VERSION if has_mimics else SDF_VERSION


def _free_names(names: Iterable[str], taken: Collection[str], suffix: str) -> dict[str, str]:
    """Return names by the old ones; those that are taken get a suffix until they are free."""
    names, used, free = list(names), set(taken), {}
    for name in names:
        new = name
        while new in used or (new != name and new in names):
            new += suffix
        used.add(new)
        free[name] = new
    return free


def _zero_poses(robot: Robot) -> list[Pose]:
    """Return the pose of every link in the model at position zero of all joints, mimic ones too."""
    poses = [Pose()]
    for k, joint in enumerate(robot.joints):
        poses.append(poses[robot.parents[k + 1]] @ joint.T_parent_joint)
    return poses


def _write_link(model: etree._Element, link: Link, T_model_link: Pose, mesh_uri: MeshUri) -> None:
    element = etree.SubElement(model, "link", name=link.name)
    _write_pose(element, T_model_link)
    inertial = link.inertial if link.inertial is not None and link.inertial.mass else _MASSLESS
    inertial_element = etree.SubElement(element, "inertial")
    _write_pose(inertial_element, Pose(inertial.com))
    etree.SubElement(inertial_element, "mass").text = f"{inertial.mass:.12g}"
    inertia_element = etree.SubElement(inertial_element, "inertia")
    inertia = inertial.inertia if any(inertial.inertia) else _MASSLESS.inertia
    for name, value in zip(rounding.INERTIA_NAMES, inertia, strict=True):
        etree.SubElement(inertia_element, name).text = rounding.format_inertia(value)
    for kind, shapes in (("visual", link.visuals), ("collision", link.collisions)):
        for i, shape in enumerate(shapes):
            holder = etree.SubElement(element, kind, name=f"{link.name}_{kind}_{i}")
            _write_pose(holder, shape.T_link_shape)
            _write_geometry(etree.SubElement(holder, "geometry"), shape.geometry, mesh_uri)
            if shape.rgba is not None and kind == "visual":
                material = etree.SubElement(holder, "material")
                for tag in ("ambient", "diffuse"):
                    etree.SubElement(material, tag).text = rounding.format_numbers(shape.rgba)


def _write_geometry(element: etree._Element, geometry: Geometry, mesh_uri: MeshUri) -> None:
    match geometry:
        case Box(size):
            _write_values(element, "box", size=rounding.format_numbers(size))
        case Mesh():
            _write_values(element, "mesh", uri=mesh_uri(geometry))
        case _:
            sizes = zip(("radius", "length"), dimensions(geometry), strict=False)
            values = {name: rounding.format_number(size) for name, size in sizes}
            _write_values(element, type(geometry).__name__.lower(), **values)


def _write_joint(model: etree._Element, joint: Joint, names: dict[str, str]) -> None:
    kind = "continuous" if joint.is_continuous else joint.kind
    element = etree.SubElement(model, "joint", name=names[joint.name], type=kind)
    _write_ends(element, joint.parent, joint.child)
    if not joint.is_movable:
        return
    axis = etree.SubElement(element, "axis")
    etree.SubElement(axis, "xyz").text = rounding.format_numbers(rounding.rounded_axis(joint))
    if joint.mimic is not None:
        mimic = etree.SubElement(axis, "mimic", joint=names[joint.mimic.joint], axis="axis")
        etree.SubElement(mimic, "multiplier").text = rounding.format_number(joint.mimic.multiplier)
        etree.SubElement(mimic, "offset").text = rounding.format_number(joint.mimic.offset)
        # SDFormat's line is about a reference position of the leader.
        etree.SubElement(mimic, "reference").text = "0"
    lower, upper = (joint.limits if kind != "continuous" else None) or (None, None)
    bounds = {"lower": lower, "upper": upper}
    bounds |= {"effort": joint.effort or None, "velocity": joint.velocity or None}
    texts = {
        name: rounding.format_number(value) for name, value in bounds.items() if value is not None
    }
    _write_values(axis, "limit", **texts)
    if joint.damping or joint.friction:
        dynamics = {"damping": joint.damping, "friction": joint.friction}
        _write_values(
            axis, "dynamics", **{k: rounding.format_number(v) for k, v in dynamics.items()}
        )


def _write_ends(element: etree._Element, parent: str, child: str) -> None:
    etree.SubElement(element, "parent").text = parent
    etree.SubElement(element, "child").text = child


def _write_values(parent: etree._Element, tag: str, **values: str) -> None:
    element = etree.SubElement(parent, tag)
    for name, value in values.items():
        etree.SubElement(element, name).text = value


def _write_pose(element: etree._Element, pose: Pose) -> None:
    xyz, rpy = map(rounding.format_numbers, (pose.position, rounding.rounded_pose(pose).rpy))
    if (xyz, rpy) != ("0 0 0", "0 0 0"):
        etree.SubElement(element, "pose").text = f"{xyz} {rpy}"
