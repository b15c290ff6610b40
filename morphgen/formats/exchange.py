"""Write a robot for other tools: SDFormat, binary glTF, OpenUSD, and a ROS 2 package."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape

import numpy as np
import trimesh
from lxml import etree
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from morphgen.errors import FormatError
from morphgen.formats import rounding
from morphgen.formats.bundle import (
    MESHES,
    bundle_folder,
    part_licences,
    split_colours,
    write_meshes,
)
from morphgen.formats.quiet import quiet
from morphgen.formats.urdf.write import BOUND_INERTIA, BOUND_MASS, MeshUri, urdf_text
from morphgen.formats.xml import parse_xml
from morphgen.model.geometry import Box, Geometry, Mesh, Pose, Rgba, Shape, dimensions
from morphgen.model.inertia import solid_mesh
from morphgen.model.kinematics import joint_motions, movable_positions
from morphgen.model.mesh import load_mesh
from morphgen.model.robot import Inertial, Joint, Link, Robot
from morphgen.model.tree import take_name
from morphgen.typing import Array

if TYPE_CHECKING:
    from pxr import Usd

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


GREY: Rgba = (0.7, 0.7, 0.7, 1.0)  # colour of shapes without their own
T_GLTF_ROOT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Pose of the robot's root in the scene: up is y in glTF and z in a robot; shape (4, 4)."""
_SHARP_ANGLE = np.radians(35.0)
"""Edges between faces that meet at a larger angle are drawn sharp, as in the viewer."""
_MAX_SMOOTHED_FACES = 150_000
"""Largest mesh whose sharp edges are searched; larger ones would take seconds [faces]."""


def glb_bytes(robot: Robot) -> bytes:
    """Return a robot at home as binary glTF; the same robot gives the same bytes.

    Links and frames are nodes of their names, visual shapes are ``LINK_visual_0`` and so on. A node
    whose name is taken gets a number.
    """
    if not any(link.visuals for link in robot.links):
        raise FormatError(f"robot {robot.name!r} has no visual shape, so a GLB would be empty")
    names = set(robot.link_index)
    scene = trimesh.Scene(base_frame=take_name("scene", names))
    for link, parent, T in zip(robot.links, robot.parents, _home_transforms(robot), strict=True):
        above = robot.links[parent].name if parent >= 0 else scene.graph.base_frame
        scene.graph.update(frame_from=above, frame_to=link.name, matrix=T)
        for i, shape in enumerate(link.visuals):
            name = take_name(f"{link.name}_visual_{i}", names)
            scene.add_geometry(
                _mesh(shape),
                node_name=name,
                geom_name=name,
                parent_node_name=link.name,
                transform=shape.T_link_shape.matrix,
            )
    for frame in robot.frames:
        name, matrix = take_name(frame.name, names), frame.T_link_frame.matrix
        scene.graph.update(frame_from=frame.link, frame_to=name, matrix=matrix)
    data: bytes = export_glb(scene, include_normals=True)
    return data


def _home_transforms(robot: Robot) -> Iterator[Array]:
    """Yield the pose of every link at home in its parent's frame, the root's in the scene."""
    yield T_GLTF_ROOT
    movable = [robot.joints[k] for k in robot.movable_joints]
    motions = iter(joint_motions(movable, movable_positions(robot, robot.home)))
    for joint in robot.joints:
        T = joint.T_parent_joint.matrix
        yield T @ next(motions) if joint.is_movable else T


def _mesh(shape: Shape) -> trimesh.Trimesh:
    """Return the surface of a shape in its own frame, with sharp edges and its colour."""
    geometry = shape.geometry
    mesh = load_mesh(geometry) if isinstance(geometry, Mesh) else solid_mesh(geometry)
    if len(mesh.faces) <= _MAX_SMOOTHED_FACES:
        mesh = trimesh.graph.smooth_shade(mesh, angle=_SHARP_ANGLE)
    # A cached mesh is shared, so its colour is not set.
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    rgba = shape.rgba or GREY
    mesh.visual = TextureVisuals(
        material=PBRMaterial(
            baseColorFactor=[round(255 * channel) for channel in rgba],
            metallicFactor=0.0,
            roughnessFactor=0.7,
            alphaMode="BLEND" if rgba[3] < 1 else "OPAQUE",
            doubleSided=True,  # open meshes are drawn from inside, too
        )
    )
    return mesh


def convert_urdf(urdf: Path, folder: Path) -> Path:
    """Write a robot as USD, with layers in ``folder/Payload``; return the file to open.

    Simulators compute what is missing from the collision shapes. So a centre of mass at the origin
    of its link, which the converter leaves out, is added, and massless bodies get the bounds of the
    MJCF, because USD takes a mass of zero for a missing one.
    """
    import urdf_usd_converter
    from pxr import Gf, Tf, Usd, UsdPhysics

    try:
        with quiet():
            asset = urdf_usd_converter.Converter().convert(str(urdf), str(folder))
            stage = Usd.Stage.Open(asset.path)
            for prim in stage.Traverse():
                if not prim.HasAPI(UsdPhysics.RigidBodyAPI):
                    continue
                body = UsdPhysics.MassAPI.Apply(prim)
                if not body.GetCenterOfMassAttr().HasAuthoredValue():
                    body.GetCenterOfMassAttr().Set(Gf.Vec3f(0))
                if not body.GetMassAttr().Get():
                    body.GetMassAttr().Set(BOUND_MASS)
                    body.GetDiagonalInertiaAttr().Set(Gf.Vec3f(BOUND_INERTIA))
            _write_poses(stage, urdf)
            stage.Save()
    except (Tf.ErrorException, RuntimeError, ValueError) as error:
        raise FormatError("urdf-usd-converter: " + " ".join(str(error).split())) from error
    return Path(asset.path)


def _prim_name(prim: Usd.Prim) -> str:
    """Return the URDF's name of a prim: USD allows fewer characters, so it may be a label."""
    return str(prim.GetMetadata("displayName") or prim.GetName())


def _write_poses(stage: Usd.Stage, urdf: Path) -> None:
    """Write the poses of all links and joints from the origins of the URDF's joints.

    urdf-usd-converter 0.3.4 makes quaternions of matrices in single precision: a turn of less than
    0.34 mrad becomes none, and one of 0.5 mrad 0.7.
    """
    from pxr import Gf, UsdPhysics

    origins: dict[tuple[str, str], Pose] = {}
    for joint in parse_xml(urdf.read_bytes(), str(urdf)).iterfind("joint"):
        origin = joint.find("origin")
        texts = ("", "") if origin is None else (origin.get("xyz", ""), origin.get("rpy", ""))
        (x, y, z), (roll, pitch, yaw) = (map(float, (text or "0 0 0").split()) for text in texts)
        ends = (joint.find(end) for end in ("parent", "child"))
        parent, child = ("" if end is None else str(end.get("link")) for end in ends)
        origins[parent, child] = Pose.from_xyz_rpy((x, y, z), (roll, pitch, yaw))

    def origin_of(prim: Usd.Prim) -> Pose | None:
        parent = prim.GetParent()
        is_link = parent and prim.GetTypeName() == "Xform"
        return origins.get((_prim_name(parent), _prim_name(prim))) if is_link else None

    for prim in stage.Traverse():
        orient, T_parent_link = prim.GetAttribute("xformOp:orient"), origin_of(prim)
        if orient and T_parent_link is not None:
            orient.Set(Gf.Quatf(*T_parent_link.quaternion))
    for joint in filter(None, map(UsdPhysics.Joint, stage.Traverse())):
        ends = joint.GetBody0Rel().GetTargets()
        link, T_end_link = stage.GetPrimAtPath(joint.GetBody1Rel().GetTargets()[0]), Pose()
        # Links without a rigid body of their own may lie between the two ends.
        while link.GetPath() not in ends and (T_parent_link := origin_of(link)) is not None:
            link, T_end_link = link.GetParent(), T_parent_link @ T_end_link
        turn = joint.GetLocalRot1Attr().Get()
        T_end_joint = T_end_link @ Pose(quaternion=(turn.GetReal(), *turn.GetImaginary()))
        joint.GetLocalPos0Attr().Set(Gf.Vec3f(*T_end_joint.position))
        joint.GetLocalRot0Attr().Set(Gf.Quatf(*T_end_joint.quaternion))


_FOLDERS = {"display.launch.py": "launch", "display.rviz": "config"}
"""Folders of the files that are made of templates; the others are in the package's own."""
_UNKNOWN_LICENCE = "unknown"


def ros_package_name(robot_name: str) -> str:
    """Return the name of a description package that ROS allows: ``ur5_plane_description``."""
    words = "_".join(re.findall(r"[a-z0-9]+", robot_name.lower()))
    return f"{words if words[:1].isalpha() else f'robot_{words}'.rstrip('_')}_description"


def write_ros_package(robot: Robot, folder: Path, srdf: str) -> None:
    """Write the files of a description package into an empty folder."""
    robot = split_colours(robot)
    package, stem = ros_package_name(robot.name), bundle_folder(folder, robot.name).name
    files = write_meshes(robot, folder / MESHES)
    root = robot.root.name
    if not re.fullmatch(r"[A-Za-z_][\w./-]*", root, re.ASCII):
        raise FormatError(
            f"robot {robot.name!r}: root link {root!r} is no name of a ROS frame; use letters, "
            "digits and '_', '-', '.', '/', with a letter or '_' first"
        )
    folders = ["config", "launch", *([MESHES] if files else []), "urdf"]
    values = {
        "package": package,
        "stem": stem,
        "root": root,
        "robot": escape(robot.name),
        "folders": " ".join(folders),
        "licences": "\n".join(
            f"  <license>{escape(each)}</license>"
            for each in part_licences(robot.provenance) or (_UNKNOWN_LICENCE,)
        ),
    }
    texts = {
        f"urdf/{stem}.urdf": urdf_text(robot, lambda mesh: f"package://{package}/{files[mesh]}"),
        f"config/{stem}.srdf": srdf,
    }
    for path in Path(__file__).with_name("ros").glob("*.template"):
        text = Template(path.read_text(encoding="utf-8")).substitute(values)
        texts[f"{_FOLDERS.get(path.stem, '.')}/{path.stem}"] = text
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
