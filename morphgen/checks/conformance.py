"""Conformance: compare how different loaders read a bundle, or a file as it is.

The files of a bundle must be read alike by all loaders. A file of others need not be: each loader
reads it as its own rules say. Such a row names the causes of its differences. A cause, a ``Quirk``,
is tried: the loader must agree with morphgen's reading of the file that the cause has changed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from morphgen.arguments import whole_number
from morphgen.checks.hold import HoldRow
from morphgen.checks.readers import LOADERS, NO_LIMITS, Loader, Reading
from morphgen.checks.rules import PYBULLET_LINKS
from morphgen.errors import FormatError, one_line
from morphgen.formats.bundle import URDF, read_bundle
from morphgen.formats.description import read_description
from morphgen.formats.gate import loader_copy
from morphgen.formats.resolve import PackageFinder, default_finder
from morphgen.formats.rounding import INERTIA_NAMES
from morphgen.formats.urdf.read import robot_from_xml
from morphgen.formats.urdf.write import BOUND_INERTIA, BOUND_MASS
from morphgen.model import kinematics
from morphgen.model.dynamics import actuation, gravity_load, mass_matrix
from morphgen.model.geometry import Pose
from morphgen.model.robot import DEFAULT_EFFORT, DEFAULT_VELOCITY, Frame, Joint, Mimic, Robot
from morphgen.model.rotation import unit_quaternion
from morphgen.typing import Array

POSITION_TOLERANCE = 1e-5  # largest accepted distance between a loader's tool and morphgen's [m]
ROTATION_TOLERANCE = 1e-5  # largest accepted angle between a loader's tool and morphgen's [rad]
MAX_POSITION = 10.0
"""Bound of the compared joint positions [rad or m], because PyBullet uses single precision."""
MASS_TOLERANCE = 1e-6
"""Largest accepted relative difference between a loader's total mass and morphgen's.

In addition, MuJoCo may add ``BOUND_MASS`` per link.
"""
RELATIVE_TOLERANCE = 1e-5
"""Largest accepted relative difference of a joint's value: gains are written with 6 digits."""
ABSOLUTE_TOLERANCE = 1e-9
"""Largest accepted difference of a joint's value near zero, in its SI unit."""
_WITHOUT_VELOCITY = (None, 0.0, math.inf)
"""Velocity limits that loaders read where a file names none."""
GRAVITY_TOLERANCE = 1e-6
"""Largest accepted difference of a force that holds the weight, relative to the robot's largest one
or to ``MIN_FORCE``."""
MIN_FORCE = 1e-3  # force below which a difference is not relative [N m or N]
INERTIA_TOLERANCE = 1e-5
"""Largest accepted difference of an entry of the joint-space inertia; see ``inertia_error``. In
addition, MuJoCo may add ``BOUND_MASS`` and ``BOUND_INERTIA`` to links without mass."""
MIN_INERTIA = 1e-8
"""Diagonal entry below which a difference is not relative [kg m^2 or kg]: that of a joint that
carries no mass is whatever the loader adds."""
BUNDLE, FILE = "bundle", "file"  # sources of a row


@dataclass(frozen=True)
class ConformanceRow:
    """Result of one loader."""

    loader: str  # name of the loader and its file
    passed: bool | None  # whether the loader agrees with morphgen; None if it is not installed
    joints: bool | None = None  # whether the loader has the same movable joints, by name
    mass: float | None = None  # total mass [kg]
    position_error: float | None = None
    """Largest distance between the frame and morphgen's over all configurations [m]."""
    rotation_error: float | None = None
    """Largest angle between the frame and morphgen's over all configurations [rad]."""
    limits: bool | None = None
    """Whether position, effort and velocity limits agree; None, here and below, if the loader reads
    no such values."""
    mimic: bool | None = None  # whether leader, multiplier and offset of mimic joints agree
    damping: bool | None = None  # whether damping and friction agree
    gains: bool | None = None  # whether gains and armature of the position actuators agree
    gravity_error: float | None = None
    """Largest difference of a force that holds the weight [N m or N]; None, here and below, if the
    loader computes none."""
    inertia_error: float | None = None
    """Largest difference of an entry of the joint-space inertia, relative to the root of the
    product of its two diagonal entries."""
    message: str = ""  # description of the disagreement, or `not installed`
    source: str = BUNDLE  # `bundle`, or `file` if the loader read the file of others as it is
    causes: tuple[str, ...] = ()
    """The deviations of the loader that explain all its differences from morphgen."""

    @property
    def is_unexplained(self) -> bool:
        """Whether a difference has no known cause."""
        return self.passed is False and not self.causes


@dataclass(frozen=True)
class ConformanceReport:
    """Results of all loaders for one bundle."""

    robot: str  # name of the robot
    frame: str  # name of the compared frame or link
    samples: int  # number of configurations
    seed: int  # seed of the configurations
    passed: bool
    """Whether every installed loader agrees, or differs on a file of others with known causes, and,
    if measured, the robot holds its home and steps from it."""
    rows: tuple[ConformanceRow, ...]  # the loaders
    holds: tuple[HoldRow, ...] = ()
    """The simulators in which the robot holds its home configuration, and steps from it."""
    penetrations: Mapping[str, float] = field(default_factory=dict)
    """Depth of every pair of links, as ``a, b``, that penetrate at home [m]; ignored pairs are not
    tested."""


def conformance(bundle_dir: Path, samples: int = 100, seed: int = 0) -> ConformanceReport:
    """Load a bundle in every loader, and compare joints, mass and tool pose; see docs/checks.md.

    Mimic joints are set like any other joint, except in yourdfpy, which moves them itself. A robot
    without a frame ``tool`` is compared at its last link.
    """
    robot = read_bundle(bundle_dir)
    with loader_copy(bundle_dir) as folder:
        return compare(robot, folder, samples, seed)


def compare(robot: Robot, folder: Path, samples: int = 100, seed: int = 0) -> ConformanceReport:
    """Compare a robot with its files in a folder of morphgen's own or a ``loader_copy``."""
    samples = whole_number("samples", samples, FormatError, 1)
    seed = whole_number("seed", seed, FormatError, 0)
    frame = robot.tool
    if frame is None:
        frame = Frame(robot.links[-1].name, robot.links[-1].name)
        robot = replace(robot, frames=(frame,))
    q = _configurations(robot, samples, seed)
    read = (_row(loader, robot, folder, frame.name, q, has_gains=True) for loader in LOADERS)
    rows = tuple(row for row, _ in read)
    passed = all(row.passed is not False for row in rows)
    return ConformanceReport(robot.name, frame.name, samples, seed, passed, rows)


def compare_file(
    path: Path, finder: PackageFinder, samples: int = 100, seed: int = 0
) -> tuple[ConformanceRow, ...]:
    """Compare morphgen's reading of a URDF, xacro or MJCF with that of every loader.

    The loaders get a private copy of the file, with its meshes beside it; see ``loader_copy``. The
    pose is that of the last link that moves, because loaders may join others to their parents.
    """
    robot = read_description(path, finder=finder)
    moving = [joint.child for joint in robot.joints if joint.is_movable]
    robot = replace(robot, frames=tuple(Frame(link, link) for link in moving[-1:]))
    frame, q = "".join(moving[-1:]), _configurations(robot, samples, seed)
    rows = []
    with loader_copy(path, finder) as folder:
        is_urdf = (folder / URDF).is_file()
        for loader in LOADERS:
            if (loader.file == URDF) is not is_urdf:
                continue
            row, reading = _row(loader, robot, folder, frame, q, has_gains=False)
            if row.passed is False:
                known = (folder, frame, _positions(robot, q))
                if reading is None:
                    causes = _refused(loader, row.message, *known)
                else:
                    causes = _differing(loader, reading, *known)
                row = replace(row, causes=causes)
            rows.append(replace(row, source=FILE))
    return tuple(rows)


def _configurations(robot: Robot, samples: int, seed: int) -> Array:
    # A file as it is may have limits in the wrong order.
    joints = tuple(
        replace(joint, limits=(min(joint.limits), max(joint.limits))) if joint.limits else joint
        for joint in robot.joints
    )
    robot = replace(robot, joints=joints)
    q = kinematics.random_configurations(robot, samples, np.random.default_rng(seed))
    return np.clip(q, -MAX_POSITION, MAX_POSITION)


def _positions(robot: Robot, q: Array) -> dict[str, Array]:
    """Return the positions of every movable joint by name, shape (n,)."""
    names = [robot.joints[k].name for k in robot.movable_joints]
    return dict(zip(names, kinematics.movable_positions(robot, q).T, strict=True))


def _row(
    loader: Loader, robot: Robot, folder: Path, frame: str, q: Array, *, has_gains: bool
) -> tuple[ConformanceRow, Reading | None]:
    """Return a loader's row, and what it read unless it refused the file."""
    if find_spec(loader.module) is None:
        return ConformanceRow(loader.name, None, message="not installed"), None
    reading = _read(loader, folder, frame, _positions(robot, q), len(q))
    if isinstance(reading, str):
        return ConformanceRow(loader.name, False, message=reading), None
    if not has_gains:
        reading = replace(reading, has_actuators=False)
    return _compared(loader, robot, reading, frame, q), reading


def _read(
    loader: Loader, folder: Path, frame: str, positions: Mapping[str, Array], n: int
) -> Reading | str:
    """Return what a loader reads, or the message with which it refuses the file."""
    try:
        return loader.read(folder, frame, positions, n)
    except FormatError as error:
        return str(error)
    except Exception as error:  # whatever a library of others raises is its refusal
        return f"{type(error).__name__}: {one_line(str(error))}"


def _compared(
    loader: Loader, robot: Robot, reading: Reading, frame: str, q: Array
) -> ConformanceRow:
    expected = (
        kinematics.frame_pose(robot, q, frame) if frame else np.tile(np.eye(4), (len(q), 1, 1))
    )
    position_offset = reading.T_root_frame[:, :3, 3] - expected[:, :3, 3]
    position_error = float(np.linalg.norm(position_offset, axis=1).max(initial=0.0))
    # The Frobenius norm of the difference of two rotations is sqrt(8) sin(angle / 2), from which
    # small angles follow exactly.
    R_difference = reading.T_root_frame[:, :3, :3] - expected[:, :3, :3]
    sines = np.linalg.norm(R_difference, axis=(1, 2)) / np.sqrt(8.0)
    rotation_error = float(2 * np.arcsin(np.clip(sines, 0.0, 1.0)).max(initial=0.0))
    expected_joints = {robot.joints[k].name for k in robot.movable_joints}
    joints = set(reading.joints)
    faults = []
    if missing := sorted(expected_joints - joints):
        faults.append(f"lacks joints {', '.join(missing)}")
    if surplus := sorted(joints - expected_joints):
        faults.append(f"has additional joints {', '.join(surplus)}")
    slack = MASS_TOLERANCE * robot.mass + BOUND_MASS * (len(robot.links) + len(robot.frames))
    if abs(reading.mass - robot.mass) > slack:
        faults.append(f"weighs {reading.mass:.9g} kg, not {robot.mass:.9g} kg")
    columns = _compare_joints(robot, reading)
    faults += chain.from_iterable(each or () for each in columns.values())
    agreements: dict[str, Any] = {
        name: None if each is None else not each for name, each in columns.items()
    }
    if position_error > POSITION_TOLERANCE:
        faults.append(f"{frame} is {position_error:.3g} m off")
    if rotation_error > ROTATION_TOLERANCE:
        faults.append(f"{frame} is {rotation_error:.3g} rad off")
    gravity_error = inertia_error = None
    if reading.forces is not None and joints == expected_joints:
        gravity_error, inertia_error, more = _dynamics(robot, reading, q)
        faults += more
    return ConformanceRow(
        loader.name,
        passed=not faults,
        joints=joints == expected_joints,
        mass=reading.mass,
        position_error=position_error,
        rotation_error=rotation_error,
        **agreements,
        gravity_error=gravity_error,
        inertia_error=inertia_error,
        message="; ".join(faults),
    )


def _compare_joints(robot: Robot, reading: Reading) -> dict[str, list[str] | None]:
    """Return the differences of a loader's joints in every column that it reads; None if none.

    Joints that only one has are left out. A chain of mimic joints counts as its product.
    """
    movable = [robot.joints[k].name for k in robot.movable_joints]
    shared = [name for name in movable if name in reading.joints]
    gains = {gain.joint: gain for gain in actuation(robot)} if reading.has_actuators else {}
    faults: dict[str, list[str]] = {"limits": [], "damping": [], "gains": []}
    for name in shared:
        joint, read = robot.joints[robot.joint_index[name]], reading.joints[name]
        # Without limits, a loader may read none, or those that a bundle has.
        is_open = joint.is_continuous or (joint.limits is None and read.limits == NO_LIMITS)
        lower, upper = NO_LIMITS if is_open else joint.effective_limits
        values: list[tuple[str, str, float | None, float]] = [
            ("limits", "lower limit", read.limits[0], lower),
            ("limits", "upper limit", read.limits[1], upper),
            ("damping", "damping", read.damping, joint.damping),
            ("damping", "friction", read.friction, joint.friction),
        ]
        if read.effort not in _accepted_efforts(joint):
            values.append(("limits", "effort", read.effort, joint.effort or 0.0))
        if joint.velocity is not None or read.velocity not in _WITHOUT_VELOCITY:
            velocity = DEFAULT_VELOCITY if joint.velocity is None else joint.velocity
            values.append(("limits", "velocity", read.velocity, velocity))
        if name in gains:
            gain = gains[name]
            values += [
                ("gains", "stiffness", read.stiffness, gain.stiffness),
                ("gains", "derivative gain", read.derivative_gain, gain.damping),
                ("gains", "armature", read.armature, gain.armature),
            ]
        for column, quantity, value, expected in values:
            if value is not None and not _is_close(value, expected):
                fault = f"joint {name}: {quantity} {value:.6g}, not {expected:.6g}"
                faults[column].append(fault)
    reads_damping = any(reading.joints[name].damping is not None for name in shared)
    mimics = reading.mimics
    return {
        "limits": faults["limits"],
        "mimic": None if mimics is None else [*_mimic_differences(robot, mimics, shared)],
        "damping": faults["damping"] if reads_damping else None,
        "gains": faults["gains"] if reading.has_actuators else None,
    }


def _accepted_efforts(joint: Joint) -> tuple[float | None, ...]:
    """Return the efforts that a loader may read besides the joint's own.

    Where the source names none, the URDF of a bundle has the default and its MJCF no limit.
    """
    if joint.effort in (None, 0.0, DEFAULT_EFFORT):
        return (None, 0.0, DEFAULT_EFFORT, math.inf)
    return (None,)


def _is_close(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=RELATIVE_TOLERANCE, abs_tol=ABSOLUTE_TOLERANCE)


def _mimic_differences(
    robot: Robot, mimics: Mapping[str, Mimic], shared: list[str]
) -> Iterator[str]:
    known = {joint.name: joint.mimic for joint in robot.joints if joint.mimic is not None}
    independent = {robot.joints[k].name for k in robot.independent_joints}
    for name in shared:
        read = _follow(name, mimics, independent)
        expected = _follow(name, known, independent)
        is_same = (
            read.joint == expected.joint
            and _is_close(read.multiplier, expected.multiplier)
            and _is_close(read.offset, expected.offset)
        )
        if not is_same:
            yield f"joint {name}: {_formula(read)}, not {_formula(expected)}"


def _follow(name: str, mimics: Mapping[str, Mimic], independent: set[str]) -> Mimic:
    """Return a joint's coupling to the independent joint at the end of its chain of leaders.

    A fixed joint at the end stays at zero: its name is empty and only the offset counts.
    """
    joint, multiplier, offset = name, 1.0, 0.0
    for _ in range(len(mimics)):
        if joint not in mimics:
            break
        mimic = mimics[joint]
        offset += multiplier * mimic.offset
        joint, multiplier = mimic.joint, multiplier * mimic.multiplier
    return Mimic(joint, multiplier, offset) if joint in independent else Mimic("", 0.0, offset)


def _formula(mimic: Mimic) -> str:
    return f"{mimic.multiplier:.6g} {mimic.joint} {mimic.offset:+.6g}"


def _dynamics(robot: Robot, reading: Reading, q: Array) -> tuple[float, float, list[str]]:
    """Return the largest differences of forces and inertia, and what they are."""
    if reading.forces is None or reading.inertia is None or not robot.dof:
        return 0.0, 0.0, []
    order = [list(reading.joints).index(robot.joints[k].name) for k in robot.movable_joints]
    coupling, _ = robot.mimic_map
    samples = q[: len(reading.forces)]  # forces and inertia are read in the first ones only
    forces = np.array([gravity_load(robot, configuration) for configuration in samples])
    M = np.array([mass_matrix(robot, configuration) for configuration in samples])
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", M), MIN_INERTIA))
    force_errors = np.abs(reading.forces[:, order] - forces)
    read_M = coupling.T @ reading.inertia[:, order][:, :, order] @ coupling
    differences = np.abs(read_M - M) - _added_inertia(robot, samples)
    inertia_errors = np.maximum(differences, 0.0) / (scale[:, :, None] * scale[:, None, :])
    gravity_error, inertia_error = float(force_errors.max()), float(inertia_errors.max())
    faults = []
    if not gravity_error <= GRAVITY_TOLERANCE * max(MIN_FORCE, float(np.abs(forces).max())):
        sample, column = np.unravel_index(int(np.argmax(force_errors)), force_errors.shape)
        joint = robot.joints[robot.movable_joints[column]]
        unit = "N" if joint.kind == "prismatic" else "N m"
        read = reading.forces[sample, order[column]]
        faults.append(
            f"joint {joint.name}: carries {read:.4g}, not {forces[sample, column]:.4g} {unit}"
        )
    if not inertia_error <= INERTIA_TOLERANCE:
        _, row, column = np.unravel_index(int(np.argmax(inertia_errors)), inertia_errors.shape)
        names = [robot.joints[k].name for k in robot.independent_joints]
        faults.append(f"inertia of {names[row]}, {names[column]} is {inertia_error:.2g} off")
    return gravity_error, inertia_error, faults


def _added_inertia(robot: Robot, q: Array) -> float:
    """Return the most that MuJoCo adds to joint-space inertia for links without mass, and frames.

    Each may get ``BOUND_MASS`` and ``BOUND_INERTIA``, at most two poses of the tree from an axis.
    """
    T_root_link = kinematics.forward_kinematics(robot, q)
    lengths = [np.linalg.norm(frame.T_link_frame.position) for frame in robot.frames]
    size = np.linalg.norm(T_root_link[..., :3, 3], axis=-1).max() + max(lengths, default=0.0)
    gains = np.maximum(np.abs(robot.mimic_map[0]).sum(axis=0), 1.0).max(initial=1.0)
    count = len(robot.links) + len(robot.frames)
    inertia = BOUND_INERTIA + BOUND_MASS * max(1.0, 4 * size**2)
    return float(gains**2 * count * inertia)


def _refused(
    loader: Loader, message: str, folder: Path, frame: str, positions: Mapping[str, Array]
) -> tuple[str, ...]:
    """Return what a loader refuses in a file: without all of it, it reads the file."""
    file = folder / loader.file
    words: list[str] = []
    text, first = file.read_bytes(), {name: q[:1] for name, q in positions.items()}
    root, left = etree.fromstring(text), [*REFUSALS]
    try:
        while quirk := next((each for each in left if re.search(each.refusal, message)), None):
            left.remove(quirk)
            changed = deepcopy(root)
            quirk.change(changed, file)
            file.write_bytes(etree.tostring(changed))
            result = _read(loader, folder, frame, first, 1)
            if isinstance(result, Reading):
                return (*words, quirk.words)
            if not re.search(quirk.refusal, result):
                words.append(quirk.words)
                root, message = changed, result
    finally:
        file.write_bytes(text)
    return ()


def _differing(
    loader: Loader, reading: Reading, folder: Path, frame: str, positions: Mapping[str, Array]
) -> tuple[str, ...]:
    """Return the fewest quirks of a loader that explain what it read; none if they do not."""
    text, n = (folder / loader.file).read_bytes(), len(reading.T_root_frame)

    def explain(quirks: Sequence[Quirk]) -> bool:
        root = etree.fromstring(text)
        try:
            for quirk in quirks:
                quirk.change(root, folder / loader.file)
            robot = robot_from_xml(etree.tostring(root), folder / loader.file, default_finder())
        except (FormatError, ValueError):
            return False
        robot = replace(robot, frames=(Frame(frame, frame),) if frame else ())
        names = [robot.joints[k].name for k in robot.independent_joints]
        q = np.array([positions[name] for name in names]).reshape(len(names), n).T
        return bool(_compared(loader, robot, reading, frame, q).passed)

    chosen = known = [quirk for quirk in QUIRKS if loader.name in quirk.loaders]
    if not known or not explain(known):
        return ()
    for quirk in known:
        fewer = [each for each in chosen if each is not quirk]
        if explain(fewer):
            chosen = fewer
    return tuple(quirk.words for quirk in chosen)


Change = Callable[[etree._Element, Path], None]
"""Function of the root of a URDF, which it changes to what a loader reads, and of the file."""


@dataclass(frozen=True)
class Quirk:
    """How loaders read a URDF otherwise than morphgen, or what they refuse in it."""

    words: str  # description of the deviation
    change: Change
    """Changes a URDF so that morphgen reads it as the loaders do, or so that they read it."""
    loaders: tuple[str, ...] = ()  # names of the loaders that read so
    refusal: str = ""  # regular expression of the message with which a loader refuses the file


QUIRKS: list[Quirk] = []
"""All deviations of loaders from the URDF specification, in the order in which they are applied."""


def _quirk(words: str, *loaders: str, refusal: str = "") -> Callable[[Change], Change]:
    """Make a change of a URDF the test of a quirk."""

    def register(change: Change) -> Change:
        QUIRKS.append(Quirk(words, change, loaders, refusal))
        return change

    return register


@_quirk("reads no quat_xyzw", "yourdfpy", "pybullet", "mujoco (urdf)", "usd")
def _drop_quaternions(root: etree._Element, urdf: Path) -> None:
    for origin in root.iter("origin"):
        origin.attrib.pop("quat_xyzw", "")


@_quirk("counts the inertia of links without mass", "pybullet", "pinocchio")
def _count_massless(root: etree._Element, urdf: Path) -> None:
    for mass in root.iterfind("link/inertial/mass"):
        if float(mass.get("value") or 0) == 0:
            mass.set("value", repr(BOUND_MASS))


@_quirk("gives links without inertia 1 kg and 1 kg m^2", "pybullet")
def _add_inertia(root: etree._Element, urdf: Path) -> None:
    for link in root.iterfind("link"):
        if link.find("inertial") is None and link.get("name") != "world":
            _set_inertial(link, 1.0, np.eye(3))


@_quirk("gives links without inertia that of their shapes, of 1000 kg/m^3", "mujoco (urdf)")
def _add_solids(root: etree._Element, urdf: Path) -> None:
    import mujoco

    spec = mujoco.MjSpec.from_file(str(urdf))
    spec.compiler.fusestatic = False
    spec.compiler.boundmass, spec.compiler.boundinertia = BOUND_MASS, BOUND_INERTIA
    model = spec.compile()
    for link in root.iterfind("link"):
        if link.find("inertial") is None and link.find("collision") is not None:
            body = model.body(link.get("name", ""))
            R = Pose(quaternion=unit_quaternion(body.iquat.tolist())).matrix[:3, :3]
            inertia = R @ np.diag(body.inertia) @ R.T
            _set_inertial(link, float(body.mass[0]), inertia, body.ipos.tolist())


def _set_inertial(
    link: etree._Element, mass: float, inertia: Array, com: Sequence[float] = (0, 0, 0)
) -> None:
    for old in link.findall("inertial"):
        link.remove(old)
    element = etree.SubElement(link, "inertial")
    etree.SubElement(element, "origin", xyz=" ".join(map(repr, com)))
    etree.SubElement(element, "mass", value=repr(mass))
    values = inertia[np.triu_indices(3)].tolist()
    etree.SubElement(element, "inertia", dict(zip(INERTIA_NAMES, map(repr, values), strict=True)))


@_quirk("joins the base to the world, without its mass", "mujoco (urdf)")
def _empty_base(root: etree._Element, urdf: Path) -> None:
    """Remove the inertia of the root and of the links that are fixed to it."""
    parents = {}
    for joint in root.iterfind("joint"):
        parent, child = (joint.find(end) for end in ("parent", "child"))
        if joint.get("type") == "fixed" and parent is not None and child is not None:
            parents[child.get("link")] = parent.get("link")
        elif child is not None:
            parents[child.get("link")] = None
    for link in root.iterfind("link"):
        name = link.get("name")
        while name is not None and name in parents:
            name = parents[name]
        if name is not None:
            for inertial in link.findall("inertial"):
                link.remove(inertial)


def _set_inertias(
    root: etree._Element, is_wrong: Callable[[float, float, float], bool], moment: str
) -> None:
    """Set the moments of inertia that are wrong; they are tested in ascending order."""
    for inertia in root.iterfind("link/inertial/inertia"):
        xx, xy, xz, yy, yz, zz = (float(inertia.get(name) or 0) for name in INERTIA_NAMES)
        a, b, c = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).tolist()
        if is_wrong(a, b, c):
            for name in INERTIA_NAMES:
                # The names of the diagonal are ixx, iyy and izz.
                inertia.set(name, moment if name[1] == name[2] else "0")


@_quirk("sets inertia that no body has to zero", "pybullet")
def _zero_impossible(root: etree._Element, urdf: Path) -> None:
    _set_inertias(root, lambda a, b, c: a < 0 or c > a + b, "0")


@_quirk("limits continuous joints that name a range", "pybullet")
def _limit_continuous(root: etree._Element, urdf: Path) -> None:
    for joint in root.iterfind("joint[@type='continuous']"):
        limit = joint.find("limit")
        if limit is not None and {"lower", "upper"} & set(limit.attrib):
            joint.set("type", "revolute")


def _open_ranges(root: etree._Element, is_open: Callable[[float, float], bool]) -> None:
    for limit in root.iterfind("joint/limit"):
        if is_open(*(float(limit.get(name) or 0) for name in ("lower", "upper"))):
            for name in ("lower", "upper"):
                limit.attrib.pop(name, "")


@_quirk("reads a range in the wrong order as none", "pybullet", "mujoco (urdf)")
def _open_inverted(root: etree._Element, urdf: Path) -> None:
    _open_ranges(root, lambda lower, upper: lower > upper)


@_quirk("reads a range of 0 to 0 as none", "mujoco (urdf)")
def _open_empty(root: etree._Element, urdf: Path) -> None:
    _open_ranges(root, lambda lower, upper: lower == upper == 0)


@_quirk("reads a range that is missing as 0 to 0", "pinocchio", "usd")
def _zero_ranges(root: etree._Element, urdf: Path) -> None:
    for limit in root.iterfind("joint/limit"):
        if not {"lower", "upper"} & set(limit.attrib):
            limit.set("lower", "0")
            limit.set("upper", "0")


@_quirk("holds joints that mimic a missing one", "yourdfpy")
def _hold_lost_followers(root: etree._Element, urdf: Path) -> None:
    """Let joints that mimic a missing one follow a fixed one, and so stay."""
    joints = {joint.get("name"): joint.get("type") for joint in root.iterfind("joint")}
    fixed = next((name for name, kind in joints.items() if kind == "fixed"), None)
    for mimic in root.iterfind("joint/mimic"):
        if mimic.get("joint") not in joints and fixed is not None:
            mimic.set("joint", fixed)


MIN_VALUE = 1e-14
"""Largest mass and moment of inertia that MuJoCo 4.0 takes for zero [kg or kg m^2]."""


@_quirk("refuses moving links without mass or inertia", refusal="mass and inertia of moving bodies")
def _add_mass(root: etree._Element, urdf: Path) -> None:
    for link in root.iterfind("link"):
        mass = link.find("inertial/mass")
        if mass is None or float(mass.get("value") or 0) <= MIN_VALUE:
            _set_inertial(link, 1.0, np.eye(3))
    _set_inertias(root, lambda a, b, c: c <= MIN_VALUE, "1")


@_quirk("refuses inertia that no body has", refusal=r"A \+ B >= C")
def _correct_impossible(root: etree._Element, urdf: Path) -> None:
    # Rounding may have passed a + b = c already.
    _set_inertias(root, lambda a, b, c: a + b <= c * (1 + 1e-9), "1")


@_quirk("refuses inertia that is not positive", refusal="must have positive eigenvalues")
def _correct_negative(root: etree._Element, urdf: Path) -> None:
    _set_inertias(root, lambda a, b, c: a <= MIN_VALUE, "1")


@_quirk(
    "refuses <inertial> without <inertia>",
    refusal="missing element: 'inertia'|Cannot load URDF file",
)
def _add_missing_inertia(root: etree._Element, urdf: Path) -> None:
    for inertial in root.iterfind("link/inertial"):
        if inertial.find("inertia") is None:
            etree.SubElement(inertial, "inertia", dict(zip(INERTIA_NAMES, "100101", strict=True)))


@_quirk("refuses a repeated element", refusal="repeated element")
def _take_first(root: etree._Element, urdf: Path) -> None:
    for parent in (*root.iterfind("joint"), *root.iterfind("link/*")):
        for name in {str(child.tag) for child in parent}:
            for surplus in parent.findall(name)[1:]:
                parent.remove(surplus)


@_quirk(
    "refuses a mesh scale of more than three numbers",
    refusal="'scale' has too much data|mesh: scale: .* but 3 expected",
)
def _shorten_scales(root: etree._Element, urdf: Path) -> None:
    for mesh in root.iter("mesh"):
        mesh.set("scale", " ".join(mesh.get("scale", "1 1 1").split()[:3]))


@_quirk("refuses shapes without a size", refusal=r"size \d must be positive")
def _thicken(root: etree._Element, urdf: Path) -> None:
    for shape in root.iterfind("link/*/geometry/*"):
        for name in {"size", "radius", "length"} & set(shape.attrib):
            sizes = [size if float(size) else "0.001" for size in shape.get(name, "").split()]
            shape.set(name, " ".join(sizes))


@_quirk(
    f"fails on robots with more than {PYBULLET_LINKS} links",
    refusal="Cannot load URDF file|getLinkState failed",
)
def _drop_links(root: etree._Element, urdf: Path) -> None:
    """Remove links that are fixed to others and carry none, until 127 are left below the root."""
    links = {link.get("name"): link for link in root.iterfind("link")}
    for joint in reversed(root.findall("joint[@type='fixed']")):
        parents = {parent.get("link") for parent in root.iterfind("joint/parent")}
        child = joint.find("child")
        name = None if child is None else child.get("link")
        if len(root.findall("link")) > PYBULLET_LINKS + 1 and name not in parents and name in links:
            root.remove(joint)
            root.remove(links[name])


@_quirk("refuses a joint that mimics a missing one", refusal="Mimic joint '.*' not found")
def _drop_lost_mimics(root: etree._Element, urdf: Path) -> None:
    joints = {joint.get("name") for joint in root.iterfind("joint")}
    for joint in root.iterfind("joint"):
        for mimic in joint.findall("mimic"):
            if mimic.get("joint") not in joints:
                joint.remove(mimic)


REFUSALS = [quirk for quirk in QUIRKS if quirk.refusal]
"""Causes of refusals; each is one only if the loader reads the file without it."""
