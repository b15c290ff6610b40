"""Conformance: how loaders read a bundle, or a file as it is, and whether its robot holds its home.

The files of a bundle must be read alike by all loaders. A file of others need not be: each loader
reads it as its own rules say.

To hold its home, MuJoCo simulates ``robot.xml`` with its position actuators and its compensation of
gravity. PyBullet simulates ``robot.urdf`` with gravity, its own position control and the effort
limits of the file: a URDF has no controllers, and this is how its users hold a robot.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from morphgen.checks.readers import (
    LOADERS,
    NO_LIMITS,
    Loader,
    Reading,
    bullet_client,
    load_model,
    loader_copy,
)
from morphgen.errors import FormatError, MorphgenError, one_line, whole_number
from morphgen.formats.bundle import MJCF, URDF, read_bundle, read_description
from morphgen.formats.quiet import MujocoWarnings, quiet
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.urdf.write import BOUND_INERTIA, BOUND_MASS
from morphgen.model import kinematics
from morphgen.model.dynamics import GRAVITY, actuation, gravity_load, mass_matrix
from morphgen.model.robot import DEFAULT_EFFORT, DEFAULT_VELOCITY, Frame, Joint, Mimic, Robot
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


@dataclass(frozen=True)
class HoldRow:
    """How a robot holds its home configuration in a simulator."""

    simulator: str  # name of the simulator, and of the file
    passed: bool | None
    """Whether no joint drifts farther than ``MAX_DRIFT`` from home; None without the simulator."""
    drift: float | None = None
    """Largest distance of a joint from home within ``HOLD_S`` [rad or m]; None if diverged."""
    unit: str = ""  # unit of `drift`: `rad` or `m`
    joint: str = ""  # name of the joint that drifts farthest
    message: str = ""  # description of the failure; empty if the robot passed


@dataclass(frozen=True)
class ConformanceReport:
    """Results of all loaders for one bundle."""

    robot: str  # name of the robot
    frame: str  # name of the compared frame or link
    samples: int  # number of configurations
    seed: int  # seed of the configurations
    passed: bool
    """Whether every installed loader agrees on the bundle and, if measured, the robot holds its
    home."""
    rows: tuple[ConformanceRow, ...]  # the loaders
    holds: tuple[HoldRow, ...] = ()
    """The simulators in which the robot holds its home configuration."""


def conformance(
    bundle_dir: Path, samples: int = 100, seed: int = 0, *, holds: bool = False
) -> ConformanceReport:
    """Load a bundle in every loader, and compare joints, mass and tool pose; see docs/checks.md.

    Mimic joints are set like any other joint, except in yourdfpy, which moves them itself. A robot
    without a frame ``tool`` is compared at its last link. With ``holds`` it also holds its home.
    """
    robot = read_bundle(bundle_dir)
    with loader_copy(bundle_dir) as folder:
        report = compare(robot, folder, samples, seed)
        rows = hold_files(robot, folder) if holds else ()
    passed = report.passed and all(row.passed is not False for row in rows)
    return replace(report, passed=passed, holds=rows)


def compare(robot: Robot, folder: Path, samples: int = 100, seed: int = 0) -> ConformanceReport:
    """Compare a robot with its files in a folder of morphgen's own or a ``loader_copy``."""
    samples = whole_number("samples", samples, FormatError, 1)
    seed = whole_number("seed", seed, FormatError, 0)
    frame = robot.tool
    if frame is None:
        frame = Frame(robot.links[-1].name, robot.links[-1].name)
        robot = replace(robot, frames=(frame,))
    q = _configurations(robot, samples, seed)
    rows = tuple(_row(loader, robot, folder, frame.name, q, BUNDLE) for loader in LOADERS)
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
    with loader_copy(path, finder) as folder:
        is_urdf = (folder / URDF).is_file()
        loaders = [loader for loader in LOADERS if (loader.file == URDF) is is_urdf]
        return tuple(_row(loader, robot, folder, frame, q, FILE) for loader in loaders)


def _configurations(robot: Robot, samples: int, seed: int) -> Array:
    # A file as it is may have limits in the wrong order.
    joints = tuple(
        replace(joint, limits=(min(joint.limits), max(joint.limits))) if joint.limits else joint
        for joint in robot.joints
    )
    robot = replace(robot, joints=joints)
    q = kinematics.random_configurations(robot, samples, np.random.default_rng(seed))
    return np.clip(q, -MAX_POSITION, MAX_POSITION)


def _row(
    loader: Loader, robot: Robot, folder: Path, frame: str, q: Array, source: str
) -> ConformanceRow:
    if find_spec(loader.module) is None:
        return ConformanceRow(loader.name, None, message="not installed", source=source)
    names = [robot.joints[k].name for k in robot.movable_joints]
    positions = dict(zip(names, kinematics.movable_positions(robot, q).T, strict=True))
    try:
        reading = loader.read(folder, frame, positions, len(q))
    except FormatError as error:
        return ConformanceRow(loader.name, False, message=str(error), source=source)
    except Exception as error:  # whatever a library of others raises is its refusal
        message = f"{type(error).__name__}: {one_line(str(error))}"
        return ConformanceRow(loader.name, False, message=message, source=source)
    if source == FILE:  # only bundles have the gains of morphgen
        reading = replace(reading, has_actuators=False)
    return replace(_compared(loader, robot, reading, frame, q), source=source)


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
    """Return a joint's coupling to the independent joint that it follows; of none, the offset."""
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


HOLD_S = 5.0  # duration of holding [s]
MAX_DRIFT = 0.02  # largest accepted distance of a joint from home while holding [rad or m]
SOLVER_ITERATIONS = 200
"""Iterations of PyBullet's constraint solver, as in the simulator of the tasks. With the default of
50, motors of an arm with a hand of many light joints do not agree: the arm turns on and on."""
MIN_TIMESTEP = 1e-4  # smallest time step of an MJCF that is simulated [s]: 50,000 steps of holding


def hold_files(robot: Robot, folder: Path) -> tuple[HoldRow, ...]:
    """Hold a robot at home with the files of its bundle in each simulator."""
    simulators = (("mujoco", "mjcf", _mjcf), ("pybullet", "urdf", _urdf))
    rows = []
    for module, file, simulate in simulators:
        name = f"{module} ({file})"
        if find_spec(module) is None:
            rows.append(HoldRow(name, None, message="not installed"))
        elif not robot.movable_joints:
            rows.append(HoldRow(name, True, 0.0))
        else:
            try:
                rows.append(_hold(name, robot, simulate(robot, folder)))
            except MorphgenError as error:
                rows.append(HoldRow(name, False, message=str(error)))
    return tuple(rows)


def _hold(name: str, robot: Robot, positions: Iterator[Array]) -> HoldRow:
    """Return the row of a robot whose movable joints are at these positions, shape (n_movable,)."""
    home = kinematics.movable_positions(robot, robot.home)
    drift = np.zeros(len(home))
    for q in positions:
        if not np.isfinite(q).all():
            return HoldRow(name, False, message="diverged")
        drift = np.maximum(drift, np.abs(q - home))
    worst = int(drift.argmax())
    passed = bool(drift[worst] <= MAX_DRIFT)
    joint = robot.joints[robot.movable_joints[worst]]
    unit = "m" if joint.kind == "prismatic" else "rad"
    message = "" if passed else f"{joint.name} moves {drift[worst]:.3g} {unit}"
    if not passed:
        message += "".join(_weak_motors(robot))
    return HoldRow(name, passed, float(drift[worst]), unit, joint.name, message)


def _weak_motors(robot: Robot) -> Iterator[str]:
    """Yield a sentence for each joint whose effort limit is below what holds the weight at home."""
    loads = abs(robot.mimic_map[0].T @ gravity_load(robot, robot.home)).tolist()
    for k, load in zip(robot.independent_joints, loads, strict=True):
        joint = robot.joints[k]
        if joint.effort and joint.effort < load:  # one of zero counts as missing
            yield f"; effort {joint.effort:g} of {joint.name} does not hold the load of {load:.3g}"


def _mjcf(robot: Robot, folder: Path) -> Iterator[Array]:
    """Yield the positions of the movable joints after each time step of ``HOLD_S``."""
    import mujoco

    model = load_model(folder / MJCF)
    names = [model.key(i).name for i in range(model.nkey)]
    if "home" not in names:
        raise FormatError("no keyframe 'home'")
    joints = _joints(robot, {model.joint(i).name: model.jnt_qposadr[i] for i in range(model.njnt)})
    if not model.opt.timestep >= MIN_TIMESTEP:
        raise FormatError(
            f"{MJCF}: timestep {model.opt.timestep:g} s; expected at least {MIN_TIMESTEP:g} s"
        )
    # A robot that diverges must be seen.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, names.index("home"))
    for _ in range(round(HOLD_S / model.opt.timestep)):
        with MujocoWarnings():
            mujoco.mj_step(model, data)
        yield data.qpos[joints]


def _joints(robot: Robot, index: Mapping[str, int]) -> list[int]:
    names = [robot.joints[k].name for k in robot.movable_joints]
    if missing := sorted(set(names) - index.keys()):
        raise FormatError(f"lacks joints {', '.join(missing)}")
    return [index[name] for name in names]


def _urdf(robot: Robot, folder: Path) -> Iterator[Array]:
    """Yield the positions of the movable joints after each time step of ``HOLD_S``."""
    with bullet_client() as client:
        with quiet():
            body = client.loadURDF(str(folder / URDF), useFixedBase=True)
        client.setGravity(0, 0, -GRAVITY)
        client.setPhysicsEngineParameter(numSolverIterations=SOLVER_ITERATIONS)
        infos = [client.getJointInfo(body, i) for i in range(client.getNumJoints(body))]
        joints = _joints(robot, {info[1].decode(): info[0] for info in infos})
        # Item 10 is the effort limit; one of zero counts as missing, as in the MJCF.
        forces = [infos[joint][10] or DEFAULT_EFFORT for joint in joints]
        home = kinematics.movable_positions(robot, robot.home).tolist()
        for joint, q in zip(joints, home, strict=True):
            client.resetJointState(body, joint, q)
        client.setJointMotorControlArray(
            body, joints, client.POSITION_CONTROL, targetPositions=home, forces=forces
        )
        period = client.getPhysicsEngineParameters()["fixedTimeStep"]
        for _ in range(round(HOLD_S / period)):
            client.stepSimulation()
            yield np.array([state[0] for state in client.getJointStates(body, joints)])
