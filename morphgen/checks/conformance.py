"""Conformance: compare how different loaders read a bundle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from morphgen.arguments import whole_number
from morphgen.checks.hold import HoldRow
from morphgen.checks.joint_readings import compare_joints
from morphgen.checks.readers import LOADERS, Loader
from morphgen.errors import FormatError
from morphgen.formats.bundle import read_bundle
from morphgen.formats.gate import loader_copy
from morphgen.formats.urdf_text import BOUND_MASS
from morphgen.model.kinematics import frame_pose, movable_positions, random_configurations
from morphgen.model.robot import TOOL, Frame, Robot
from morphgen.typing import Array

POSITION_TOLERANCE = 1e-5
"""Largest accepted distance between a loader's tool and morphgen's [m]."""
ROTATION_TOLERANCE = 1e-5
"""Largest accepted angle between a loader's tool and morphgen's [rad]."""
MAX_POSITION = 10.0
"""Bound of the compared joint positions [rad or m], because PyBullet uses single precision."""
MASS_TOLERANCE = 1e-6
"""Largest accepted relative difference between a loader's total mass and morphgen's.

In addition, MuJoCo may add ``BOUND_MASS`` per link.
"""


@dataclass(frozen=True)
class ConformanceRow:
    """Result of one loader."""

    loader: str
    """Name of the loader and its file."""
    passed: bool | None
    """Whether the loader agrees with morphgen; None if it is not installed."""
    joints: bool | None = None
    """Whether the loader has the same movable joints, by name."""
    mass: float | None = None
    """Total mass [kg]."""
    position_error: float | None = None
    """Largest distance between the frame and morphgen's over all configurations [m]."""
    rotation_error: float | None = None
    """Largest angle between the frame and morphgen's over all configurations [rad]."""
    limits: bool | None = None
    """Whether position, effort and velocity limits agree; None, here and below, if the loader reads
    no such values."""
    mimic: bool | None = None
    """Whether leader, multiplier and offset of mimic joints agree."""
    damping: bool | None = None
    """Whether damping and friction agree."""
    gains: bool | None = None
    """Whether gains and armature of the position actuators agree."""
    message: str = ""
    """Description of the disagreement, or ``not installed``."""


@dataclass(frozen=True)
class ConformanceReport:
    """Results of all loaders for one bundle."""

    robot: str
    """Name of the robot."""
    frame: str
    """Name of the compared frame or link."""
    samples: int
    """Number of configurations."""
    seed: int
    """Seed of the configurations."""
    passed: bool
    """Whether every installed loader agrees and, if measured, the robot holds its home."""
    rows: tuple[ConformanceRow, ...]
    """The loaders."""
    holds: tuple[HoldRow, ...] = ()
    """The simulators in which the robot holds its home configuration."""
    penetrations: Mapping[str, float] = field(default_factory=dict)
    """Depth of every pair of links, as ``a, b``, that penetrate at home [m]; ignored pairs are not
    tested."""


def conformance(bundle_dir: Path, samples: int = 100, seed: int = 0) -> ConformanceReport:
    """Load a bundle in every loader and compare joints, total mass and tool pose.

    The values of joints are compared as far as a loader reads them: position, effort and velocity
    limits, couplings of mimic joints, damping and friction, and the gains of the MJCF's actuators.

    The loaders are yourdfpy, PyBullet, MuJoCo (URDF and MJCF) and Pinocchio. They are compared with
    ``morphgen.model.kinematics``. Mimic joints are set like any other joint, except in yourdfpy,
    which moves them itself. A robot without a frame ``tool`` is compared at its last link.

    Args:
        bundle_dir: Folder of the bundle.
        samples: Number of random configurations within the joint limits.
        seed: Seed of the configurations.

    Raises:
        FormatError: If ``bundle_dir`` is not a bundle, ``samples`` is below 1 or ``seed`` below 0.
    """
    robot = read_bundle(bundle_dir)
    with loader_copy(bundle_dir) as folder:
        return compare(robot, folder, samples, seed)


def compare(robot: Robot, folder: Path, samples: int = 100, seed: int = 0) -> ConformanceReport:
    """Compare a robot with ``robot.urdf`` and ``robot.xml`` in a folder; see ``conformance``.

    The loaders open the folder, so it must be morphgen's own or a ``loader_copy``.

    Raises:
        FormatError: If ``samples`` is below 1, ``seed`` below 0, or one of them no whole number.
    """
    samples = whole_number("samples", samples, FormatError, 1)
    seed = whole_number("seed", seed, FormatError, 0)
    frame = next((frame for frame in robot.frames if frame.name == TOOL), None)
    if frame is None:
        frame = Frame(robot.links[-1].name, robot.links[-1].name)
        robot = replace(robot, frames=(frame,))
    q = random_configurations(robot, samples, np.random.default_rng(seed))
    q = np.clip(q, -MAX_POSITION, MAX_POSITION)
    rows = tuple(_row(robot, folder, loader, frame.name, q) for loader in LOADERS)
    passed = all(row.passed is not False for row in rows)
    return ConformanceReport(robot.name, frame.name, samples, seed, passed, rows)


def _row(robot: Robot, folder: Path, loader: Loader, frame: str, q: Array) -> ConformanceRow:
    if find_spec(loader.module) is None:
        return ConformanceRow(loader.name, None, message="not installed")
    names = [robot.joints[k].name for k in robot.movable_joints]
    positions = dict(zip(names, movable_positions(robot, q).T, strict=True))
    try:
        reading = loader.read(folder, frame, positions, len(q))
    except FormatError as error:
        return ConformanceRow(loader.name, False, message=str(error))
    expected = frame_pose(robot, q, frame)
    position_offset = reading.T_root_frame[:, :3, 3] - expected[:, :3, 3]
    position_error = float(np.linalg.norm(position_offset, axis=1).max(initial=0.0))
    # The Frobenius norm of the difference of two rotations is sqrt(8) sin(angle / 2), from which
    # small angles follow exactly.
    R_difference = reading.T_root_frame[:, :3, :3] - expected[:, :3, :3]
    sines = np.linalg.norm(R_difference, axis=(1, 2)) / np.sqrt(8.0)
    rotation_error = float(2 * np.arcsin(np.clip(sines, 0.0, 1.0)).max(initial=0.0))
    expected_joints, joints = set(names), set(reading.joints)
    faults = []
    if missing := sorted(expected_joints - joints):
        faults.append(f"lacks joints {', '.join(missing)}")
    if surplus := sorted(joints - expected_joints):
        faults.append(f"has additional joints {', '.join(surplus)}")
    slack = MASS_TOLERANCE * robot.mass + BOUND_MASS * (len(robot.links) + len(robot.frames))
    if abs(reading.mass - robot.mass) > slack:
        faults.append(f"weighs {reading.mass:.9g} kg, not {robot.mass:.9g} kg")
    agreement = compare_joints(robot, reading)
    faults += agreement.faults
    if position_error > POSITION_TOLERANCE:
        faults.append(f"{frame} is {position_error:.3g} m off")
    if rotation_error > ROTATION_TOLERANCE:
        faults.append(f"{frame} is {rotation_error:.3g} rad off")
    return ConformanceRow(
        loader.name,
        passed=not faults,
        joints=joints == expected_joints,
        mass=reading.mass,
        position_error=position_error,
        rotation_error=rotation_error,
        limits=agreement.limits,
        mimic=agreement.mimic,
        damping=agreement.damping,
        gains=agreement.gains,
        message="; ".join(faults),
    )
