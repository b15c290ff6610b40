"""Joints as loaders read them, and how they differ from a robot's."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from morphgen.model.dynamics import actuation
from morphgen.model.robot import DEFAULT_EFFORT, DEFAULT_VELOCITY, Joint, Mimic, Robot
from morphgen.typing import Array

RELATIVE_TOLERANCE = 1e-5
"""Largest accepted relative difference of a joint's value: gains are written with 6 digits."""
ABSOLUTE_TOLERANCE = 1e-9
"""Largest accepted difference of a joint's value near zero, in its SI unit."""


_WITHOUT_VELOCITY = (None, 0.0, math.inf)
"""Velocity limits that loaders read where a file names none."""
DYNAMICS_SAMPLES = 20
"""Number of configurations in which forces and inertia are compared."""


@dataclass(frozen=True)
class JointReading:
    """A movable joint as a loader reads it; None where the loader reads no such value."""

    limits: tuple[float, float] = (-math.inf, math.inf)
    """Lower and upper position limit, infinite without limits [rad or m]."""
    effort: float | None = None
    """Effort limit, infinite without one [N m or N]."""
    velocity: float | None = None
    """Velocity limit [rad/s or m/s]."""
    damping: float | None = None
    """Viscous damping [N m s/rad or N s/m]."""
    friction: float | None = None
    """Dry friction [N m or N]."""
    stiffness: float | None = None
    """Proportional gain of the joint's position actuator [N m/rad or N/m]."""
    derivative_gain: float | None = None
    """Derivative gain of the joint's position actuator [N m s/rad or N s/m]."""
    armature: float | None = None
    """Inertia that the motor adds to the joint [kg m^2 or kg]."""


@dataclass(frozen=True)
class Reading:
    """Robot as a loader reads it."""

    joints: Mapping[str, JointReading]
    """The movable joints by name."""
    mass: float
    """Total mass [kg]."""
    T_root_frame: Array
    """Pose of the frame in each configuration, shape (n, 4, 4)."""
    mimics: Mapping[str, Mimic] | None = field(default_factory=dict)
    """Couplings of the mimic joints by name; None if the loader ignores them."""
    has_actuators: bool = False
    """Whether the file has an actuator for every independent joint."""
    forces: Array | None = None
    """Forces that hold the weight of the fixed robot in the first ``DYNAMICS_SAMPLES``
    configurations, a column per joint in the order of ``joints`` [N m or N]; None, here and below,
    if the loader computes none."""
    inertia: Array | None = None
    """Joint-space inertia in these configurations, shape (samples, n_joints, n_joints) [kg m^2,
    kg m or kg], without armature and with mimic joints uncoupled."""


@dataclass(frozen=True)
class JointAgreement:
    """Whether a loader's joints agree with the robot's; None if the loader reads no such value."""

    limits: bool | None
    """Position, effort and velocity limits."""
    mimic: bool | None
    """Leader, multiplier and offset of mimic joints."""
    damping: bool | None
    """Damping and friction."""
    gains: bool | None
    """Gains and armature of position actuators."""
    faults: tuple[str, ...]
    """Description of each difference."""


def compare_joints(robot: Robot, reading: Reading) -> JointAgreement:
    """Compare the joints of a robot with a loader's; joints that only one has are left out.

    A chain of mimic joints counts as its product.
    """
    movable = [robot.joints[k].name for k in robot.movable_joints]
    shared = [name for name in movable if name in reading.joints]
    gains = {gain.joint: gain for gain in actuation(robot)} if reading.has_actuators else {}
    faults: dict[str, list[str]] = {name: [] for name in ("limits", "damping", "gains")}
    for name in shared:
        joint, read = robot.joints[robot.joint_index[name]], reading.joints[name]
        lower, upper = (-math.inf, math.inf) if joint.is_continuous else joint.effective_limits
        faults["limits"] += _differences(
            name, ("lower limit", read.limits[0], lower), ("upper limit", read.limits[1], upper)
        )
        if read.effort not in _accepted_efforts(joint):
            faults["limits"] += _differences(name, ("effort", read.effort, joint.effort or 0.0))
        if joint.velocity is not None or read.velocity not in _WITHOUT_VELOCITY:
            velocity = DEFAULT_VELOCITY if joint.velocity is None else joint.velocity
            faults["limits"] += _differences(name, ("velocity", read.velocity, velocity))
        faults["damping"] += _differences(
            name,
            ("damping", read.damping, joint.damping),
            ("friction", read.friction, joint.friction),
        )
        if name in gains:
            gain = gains[name]
            faults["gains"] += _differences(
                name,
                ("stiffness", _or_nan(read.stiffness), gain.stiffness),
                ("derivative gain", _or_nan(read.derivative_gain), gain.damping),
                ("armature", _or_nan(read.armature), gain.armature),
            )
    mimic_faults = list(_mimic_differences(robot, reading.mimics, shared))
    reads_damping = any(reading.joints[name].damping is not None for name in shared)
    return JointAgreement(
        limits=not faults["limits"],
        mimic=None if reading.mimics is None else not mimic_faults,
        damping=not faults["damping"] if reads_damping else None,
        gains=not faults["gains"] if reading.has_actuators else None,
        faults=(*faults["limits"], *mimic_faults, *faults["damping"], *faults["gains"]),
    )


def _accepted_efforts(joint: Joint) -> tuple[float | None, ...]:
    """Return the efforts that a loader may read besides the joint's own.

    Where the source names none, the URDF of a bundle has the default and its MJCF no limit.
    """
    if joint.effort in (None, 0.0, DEFAULT_EFFORT):
        return (None, 0.0, DEFAULT_EFFORT, math.inf)
    return (None,)


def _or_nan(value: float | None) -> float:
    """Return a value that is required; a missing one differs from every number."""
    return math.nan if value is None else value


def _differences(name: str, *values: tuple[str, float | None, float]) -> Iterator[str]:
    """Describe values that differ, each given as its name, the loader's and the robot's."""
    for quantity, read, expected in values:
        if read is not None and not _is_close(read, expected):
            yield f"joint {name}: {quantity} {read:.6g}, not {expected:.6g}"


def _is_close(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=RELATIVE_TOLERANCE, abs_tol=ABSOLUTE_TOLERANCE)


def _mimic_differences(
    robot: Robot, mimics: Mapping[str, Mimic] | None, shared: list[str]
) -> Iterator[str]:
    if mimics is None:
        return
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
