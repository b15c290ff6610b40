"""Write a robot as a URDF."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from math import dist

from lxml import etree

from morphgen.errors import FormatError
from morphgen.formats import rounding
from morphgen.model.geometry import Box, Capsule, Cylinder, Geometry, Mesh, Pose, Shape, Sphere
from morphgen.model.robot import DEFAULT_EFFORT, DEFAULT_VELOCITY, Inertial, Joint, Link, Robot

CAPSULE_SUFFIX = "_capsule"  # end of the names of a capsule's three elements
_TOLERANCE = 1e-9  # largest difference of a sphere from an end of its cylinder [m]


def urdf_pieces(shape: Shape) -> tuple[Shape, ...]:
    """Return the cylinder and the two spheres of a capsule, and other shapes unchanged."""
    if not isinstance(shape.geometry, Capsule):
        return (shape,)
    radius, length = shape.geometry.radius, shape.geometry.length
    T = shape.T_link_shape
    return (
        Shape(Cylinder(radius, length), T, shape.rgba),
        Shape(Sphere(radius), T @ Pose((0.0, 0.0, length / 2)), shape.rgba),
        Shape(Sphere(radius), T @ Pose((0.0, 0.0, -length / 2)), shape.rgba),
    )


def joined_capsules(shapes: Iterable[tuple[str, Shape]]) -> tuple[Shape, ...]:
    """Return named shapes in their order, with the pieces of capsules joined.

    Three in a row are joined if their names say so and they still are a capsule: a user may have
    changed one.
    """
    rows = list(shapes)
    joined = []
    while rows:
        capsule = _capsule([shape for name, shape in rows[:3] if name.endswith(CAPSULE_SUFFIX)])
        joined.append(capsule or rows[0][1])
        del rows[: 3 if capsule else 1]
    return tuple(joined)


def _capsule(pieces: list[Shape]) -> Shape | None:
    """Return the capsule that the pieces of ``urdf_pieces`` are of; None if they are not."""
    if len(pieces) != 3 or not isinstance(pieces[0].geometry, Cylinder):
        return None
    cylinder = pieces[0].geometry
    capsule = Shape(
        Capsule(cylinder.radius, cylinder.length), pieces[0].T_link_shape, pieces[0].rgba
    )
    are_same = all(
        piece.geometry == whole.geometry
        and dist(piece.T_link_shape.position, whole.T_link_shape.position) <= _TOLERANCE
        for piece, whole in zip(pieces[1:], urdf_pieces(capsule)[1:], strict=True)
    )
    return capsule if are_same else None


MORPHGEN_TAG = "morphgen"  # tag of the URDF element for data that only morphgen reads
BOUND_MASS = 1e-12
"""Mass that MuJoCo gives a massless link [kg]; it refuses moving bodies without mass."""
BOUND_INERTIA = 1e-14  # smallest principal inertia that MuJoCo gives a link [kg m^2]
MUJOCO_BOUNDS = {"boundmass": f"{BOUND_MASS:g}", "boundinertia": f"{BOUND_INERTIA:g}"}
_MUJOCO_COMPILER = {
    "strippath": "false",  # mesh paths stay relative to the URDF
    "fusestatic": "false",  # links on fixed joints, such as the tool, stay bodies with a name
    "discardvisual": "true",  # a flat visual mesh stops MuJoCo's URDF reader
    **MUJOCO_BOUNDS,
}
"""Attributes of ``<mujoco><compiler/></mujoco>``, so that MuJoCo reads a URDF as others do."""

MeshUri = Callable[[Mesh], str]  # maps a mesh to the file name to write for it


def urdf_text(robot: Robot, mesh_uri: MeshUri) -> str:
    """Write a robot as URDF; the same robot gives the same bytes.

    Links without mass get an explicit zero ``<inertial>``, because PyBullet reads a missing one as
    1 kg. A missing effort or velocity becomes the default, because Pinocchio refuses an incomplete
    ``<limit>`` and PyBullet reads it as zero. A ``<mujoco>`` element makes MuJoCo keep names,
    masses and mesh paths; ``<morphgen>``, which loaders ignore, holds home and frames.
    """
    root = etree.Element("robot", name=robot.name)
    etree.SubElement(etree.SubElement(root, "mujoco"), "compiler", _MUJOCO_COMPILER)
    for link in robot.links:
        _write_link(root, link, mesh_uri)
    for frame in robot.frames:
        _write_link(root, Link(frame.name), mesh_uri)
    for joint in robot.joints:
        _write_joint(root, joint)
    for frame in robot.frames:
        T = frame.T_link_frame
        _write_joint(root, Joint(f"{frame.name}_joint", "fixed", frame.link, frame.name, T))
    _write_morphgen_element(root, robot)
    etree.indent(root)
    return etree.tostring(root, encoding="unicode", xml_declaration=False) + "\n"


def _write_morphgen_element(root: etree._Element, robot: Robot) -> None:
    if not (robot.home or robot.frames):
        return
    element = etree.SubElement(root, MORPHGEN_TAG)
    for row, position in zip(robot.independent_joints, robot.home, strict=True):
        home = {"joint": robot.joints[row].name, "position": rounding.format_number(position)}
        etree.SubElement(element, "home", home)
    for frame in robot.frames:
        etree.SubElement(element, "frame", name=frame.name)


def _write_link(root: etree._Element, link: Link, mesh_uri: MeshUri) -> None:
    element = etree.SubElement(root, "link", name=link.name)
    inertial = link.inertial or Inertial(0.0)
    inertial_element = etree.SubElement(element, "inertial")
    _write_origin(inertial_element, Pose(inertial.com))
    etree.SubElement(inertial_element, "mass", value=rounding.format_number(inertial.mass))
    values = zip(
        rounding.INERTIA_NAMES, map(rounding.format_inertia, inertial.inertia), strict=True
    )
    etree.SubElement(inertial_element, "inertia", dict(values))
    for kind, shapes in (("visual", link.visuals), ("collision", link.collisions)):
        pieces = ((whole, piece) for whole in shapes for piece in urdf_pieces(whole))
        for i, (whole, shape) in enumerate(pieces):
            suffix = CAPSULE_SUFFIX if isinstance(whole.geometry, Capsule) else ""
            holder = etree.SubElement(element, kind, name=f"{link.name}_{kind}_{i}{suffix}")
            _write_origin(holder, shape.T_link_shape)
            _write_geometry(etree.SubElement(holder, "geometry"), shape.geometry, mesh_uri)
            if shape.rgba is not None and kind == "visual":
                colour = rounding.format_numbers(shape.rgba)
                material = etree.SubElement(holder, "material", name=f"{link.name}_material_{i}")
                etree.SubElement(material, "color", rgba=colour)


def _write_origin(element: etree._Element, pose: Pose) -> None:
    xyz = rounding.format_numbers(pose.position)
    rpy = rounding.format_numbers(rounding.rounded_pose(pose).rpy)
    if (xyz, rpy) != ("0 0 0", "0 0 0"):
        etree.SubElement(element, "origin", xyz=xyz, rpy=rpy)


def _write_geometry(element: etree._Element, geometry: Geometry, mesh_uri: MeshUri) -> None:
    match geometry:
        case Box(size):
            etree.SubElement(element, "box", size=rounding.format_numbers(size))
        case Sphere(radius):
            etree.SubElement(element, "sphere", radius=rounding.format_number(radius))
        case Cylinder(radius, length):
            etree.SubElement(element, "cylinder", _texts({"radius": radius, "length": length}))
        case Mesh():
            etree.SubElement(element, "mesh", filename=mesh_uri(geometry))
        case Capsule():
            raise FormatError("URDF has no capsule; write the pieces of urdf_pieces")


def _write_joint(root: etree._Element, joint: Joint) -> None:
    kind = "continuous" if joint.is_continuous else joint.kind
    element = etree.SubElement(root, "joint", name=joint.name, type=kind)
    _write_origin(element, joint.T_parent_joint)
    etree.SubElement(element, "parent", link=joint.parent)
    etree.SubElement(element, "child", link=joint.child)
    if not joint.is_movable:
        return
    etree.SubElement(element, "axis", xyz=rounding.format_numbers(rounding.rounded_axis(joint)))
    effort = DEFAULT_EFFORT if joint.effort is None else joint.effort
    velocity = DEFAULT_VELOCITY if joint.velocity is None else joint.velocity
    limit = {"effort": effort, "velocity": velocity}
    if kind != "continuous":
        if joint.limits is None:
            raise FormatError(
                f"joint {joint.name!r} is prismatic without limits; a URDF needs them"
            )
        limit = {"lower": joint.limits[0], "upper": joint.limits[1]} | limit
    etree.SubElement(element, "limit", _texts(limit))
    if joint.damping or joint.friction:
        dynamics = {"damping": joint.damping, "friction": joint.friction}
        etree.SubElement(element, "dynamics", _texts(dynamics))
    if (mimic := joint.mimic) is not None:
        coupling = _texts({"multiplier": mimic.multiplier, "offset": mimic.offset})
        etree.SubElement(element, "mimic", {"joint": mimic.joint} | coupling)


def _texts(values: Mapping[str, float]) -> dict[str, str]:
    return {name: rounding.format_number(value) for name, value in values.items()}
