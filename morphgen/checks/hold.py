"""Robots that hold their home configuration with the files of their bundle.

MuJoCo simulates ``robot.xml`` with its position actuators and its compensation of gravity. PyBullet
simulates ``robot.urdf`` with gravity, its own position control and the effort limits of the file: a
URDF has no controllers, and this is how its users hold a robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from morphgen.checks.readers import bullet_client, load_model
from morphgen.errors import FormatError, MorphgenError
from morphgen.formats.bundle import MJCF, URDF
from morphgen.formats.quiet import MujocoWarnings, quiet
from morphgen.model.dynamics import GRAVITY, gravity_load
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import DEFAULT_EFFORT, Robot
from morphgen.typing import Array

HOLD_S = 5.0  # duration of holding [s]
MAX_DRIFT = 0.02  # largest accepted distance of a joint from home while holding [rad or m]
SOLVER_ITERATIONS = 200
"""Iterations of PyBullet's constraint solver, as in the simulator of the tasks. With the default of
50, motors of an arm with a hand of many light joints do not agree: the arm turns on and on."""
MIN_TIMESTEP = 1e-4  # smallest time step of an MJCF that is simulated [s]: 50,000 steps of holding


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
    home = movable_positions(robot, robot.home)
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
        home = movable_positions(robot, robot.home).tolist()
        for joint, q in zip(joints, home, strict=True):
            client.resetJointState(body, joint, q)
        client.setJointMotorControlArray(
            body, joints, client.POSITION_CONTROL, targetPositions=home, forces=forces
        )
        period = client.getPhysicsEngineParameters()["fixedTimeStep"]
        for _ in range(round(HOLD_S / period)):
            client.stepSimulation()
            yield np.array([state[0] for state in client.getJointStates(body, joints)])
