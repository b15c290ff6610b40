"""Drift of a robot that holds its home configuration with the files of its bundle.

MuJoCo simulates ``robot.xml`` with its position actuators and its compensation of gravity. PyBullet
simulates ``robot.urdf`` with gravity, its own position control and the effort limits of the file: a
URDF has no controllers, and this is how its users hold a robot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from morphgen.errors import FormatError, MorphgenError
from morphgen.formats.bundle import MJCF, URDF
from morphgen.formats.quiet import quiet
from morphgen.model.dynamics import GRAVITY, gravity_load
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import DEFAULT_EFFORT, Robot
from morphgen.typing import Array

HOLD_S = 5.0
"""Duration of holding [s]."""
MAX_DRIFT = 0.02
"""Largest accepted distance of a joint from home while holding [rad or m]."""
SOLVER_ITERATIONS = 200
"""Iterations of PyBullet's constraint solver, as in the simulator of the tasks. With the default of
50, motors of an arm with a hand of many light joints do not agree: the arm turns on and on."""

MORE_ITERATIONS = 1000
"""Iterations that tell whether a drift is the solver's, which has not converged."""


@dataclass(frozen=True)
class HoldRow:
    """How far a robot moves in a simulator while it holds its home configuration."""

    simulator: str
    """Name of the simulator, and of the file or the environments."""
    passed: bool | None
    """Whether no joint is farther than ``MAX_DRIFT`` from home; None without the simulator."""
    drift: float | None = None
    """Largest distance of a joint from home within ``HOLD_S`` [rad or m]; None if diverged."""
    joint: str = ""
    """Name of the joint that moves farthest."""
    message: str = ""
    """Cause of a drift if it is known, or what went wrong."""


def hold_files(robot: Robot, folder: Path) -> tuple[HoldRow, ...]:
    """Hold a robot at home with the files of its bundle, for ``HOLD_S`` in each simulator.

    Args:
        robot: The robot that the bundle holds.
        folder: Folder of the bundle.
    """
    mjcf = hold_row("mujoco (mjcf)", "mujoco", robot, lambda: _hold_mjcf(robot, folder))

    def hold_urdf(iterations: int) -> HoldRow:
        hold = partial(_hold_urdf, robot, folder, iterations)
        return hold_row("pybullet (urdf)", "pybullet", robot, hold)

    urdf = hold_urdf(SOLVER_ITERATIONS)
    if urdf.passed is not False:
        return mjcf, urdf
    causes = overloads(robot)
    if not causes and hold_urdf(MORE_ITERATIONS).passed:
        causes = (f"holds with {MORE_ITERATIONS} solver iterations",)
    return mjcf, replace(urdf, message="; ".join((urdf.message, *causes)))


def hold_row(
    name: str, module: str, robot: Robot, positions: Callable[[], Iterator[Array]]
) -> HoldRow:
    """Return the row of a simulator.

    Args:
        name: Name of the row.
        module: Import name of the simulator, which may not be installed.
        robot: The robot.
        positions: Runs the simulation and yields the positions of the movable joints, shape
            (n_movable,) [rad or m], after every step; raises ``MorphgenError`` if it cannot.
    """
    if find_spec(module) is None:
        return HoldRow(name, None, message="not installed")
    home = movable_positions(robot, robot.home)
    if not len(home):
        return HoldRow(name, True, 0.0)
    drift = np.zeros(len(home))
    try:
        for q in positions():
            if not np.isfinite(q).all():
                return HoldRow(name, False, message="diverged")
            drift = np.maximum(drift, np.abs(q - home))
    except MorphgenError as error:
        return HoldRow(name, False, message=str(error))
    worst = int(drift.argmax())
    passed = bool(drift[worst] <= MAX_DRIFT)
    joint = robot.joints[robot.movable_joints[worst]]
    unit = "m" if joint.kind == "prismatic" else "rad"
    message = "" if passed else f"{joint.name} moves {drift[worst]:.3g} {unit}"
    return HoldRow(name, passed, float(drift[worst]), joint.name, message)


def overloads(robot: Robot) -> tuple[str, ...]:
    """Return a description of every joint whose effort cannot carry the weight at home."""
    loads = gravity_load(robot, robot.home).tolist()
    causes = []
    for joint, load in zip((robot.joints[k] for k in robot.movable_joints), loads, strict=True):
        if joint.effort and abs(load) > joint.effort:
            needed = f"{abs(load):.3g} {'N' if joint.kind == 'prismatic' else 'N m'}"
            effort = f"its effort is {joint.effort:.3g}"
            causes.append(f"{joint.name} needs {needed} to carry the weight, {effort}")
    return tuple(causes)


def _hold_mjcf(robot: Robot, folder: Path) -> Iterator[Array]:
    import mujoco

    from morphgen.formats.mujoco_warnings import MujocoWarnings

    try:
        model = mujoco.MjModel.from_xml_path(str(folder / MJCF))
    except ValueError as error:
        raise FormatError("MuJoCo: " + " ".join(str(error).split())) from error
    if "home" not in (model.key(i).name for i in range(model.nkey)):
        raise FormatError("no keyframe 'home'")
    addresses = {model.joint(i).name: model.jnt_qposadr[i] for i in range(model.njnt)}
    joints = _joints(robot, addresses)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    for _ in range(round(HOLD_S / model.opt.timestep)):
        with MujocoWarnings():
            mujoco.mj_step(model, data)
        yield data.qpos[joints]


def _joints(robot: Robot, index: Mapping[str, int]) -> list[int]:
    """Return a simulator's indices of the movable joints.

    Raises:
        FormatError: If the simulator lacks one.
    """
    names = [robot.joints[k].name for k in robot.movable_joints]
    if missing := sorted(set(names) - index.keys()):
        raise FormatError(f"lacks joints {', '.join(missing)}")
    return [index[name] for name in names]


def _hold_urdf(robot: Robot, folder: Path, iterations: int) -> Iterator[Array]:
    with quiet():
        import pybullet

        client = pybullet.connect(pybullet.DIRECT)
    options = {"physicsClientId": client}
    try:
        with quiet():
            body = pybullet.loadURDF(str(folder / URDF), useFixedBase=True, **options)
        pybullet.setGravity(0, 0, -GRAVITY, **options)
        pybullet.setPhysicsEngineParameter(numSolverIterations=iterations, **options)
        infos = [
            pybullet.getJointInfo(body, i, **options)
            for i in range(pybullet.getNumJoints(body, **options))
        ]
        joints = _joints(robot, {info[1].decode(): info[0] for info in infos})
        for joint, q in zip(joints, movable_positions(robot, robot.home).tolist(), strict=True):
            pybullet.resetJointState(body, joint, q, **options)
            pybullet.setJointMotorControl2(
                body,
                joint,
                pybullet.POSITION_CONTROL,
                targetPosition=q,
                # Item 10 is the effort limit; one of zero counts as missing, as in the MJCF.
                force=infos[joint][10] or DEFAULT_EFFORT,
                **options,
            )
        period = pybullet.getPhysicsEngineParameters(**options)["fixedTimeStep"]
        for _ in range(round(HOLD_S / period)):
            pybullet.stepSimulation(**options)
            yield np.array([state[0] for state in pybullet.getJointStates(body, joints, **options)])
    except pybullet.error as error:
        raise FormatError(f"PyBullet: {error}") from error
    finally:
        pybullet.disconnect(**options)
