"""Robots that hold their home configuration, and step from it, with the files of their bundle.

MuJoCo simulates ``robot.xml`` with its position actuators and its compensation of gravity. PyBullet
simulates ``robot.urdf`` with gravity, its own position control and the effort limits of the file: a
URDF has no controllers, and this is how its users hold a robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from itertools import chain, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from morphgen.checks.readers import NO_LIMITS, bullet_client, load_model
from morphgen.checks.rules import home_penetrations
from morphgen.errors import FormatError, MorphgenError
from morphgen.formats.bundle import MJCF, URDF, bundle_folder, write_bundle
from morphgen.formats.quiet import MujocoWarnings, quiet
from morphgen.model.dynamics import GRAVITY, gravity_load
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import DEFAULT_EFFORT, Joint, Robot
from morphgen.typing import Array

HOLD_S = 5.0  # duration of holding [s]
MAX_DRIFT = 0.02  # largest accepted distance of a joint from home while holding [rad or m]
SOLVER_ITERATIONS = 200
"""Iterations of PyBullet's constraint solver, as in the simulator of the tasks. With the default of
50, motors of an arm with a hand of many light joints do not agree: the arm turns on and on."""

MORE_ITERATIONS = 1000
"""Iterations that tell whether a drift is the solver's, which has not converged."""

STEP = {"prismatic": 0.02, "revolute": 0.2, "continuous": 0.2}
"""Step of an independent joint by its kind, unless its range has less room [m or rad]."""
MAX_STEP = 0.8  # largest part of the room to a limit that a step takes
BAND = 0.1
"""Distance from the target at which a joint has settled, relative to its step: 0.02 rad or 2 mm of
a whole step, as for the drift."""
MAX_FOLLOWER_ERROR = {"prismatic": 0.005, "revolute": 0.02, "continuous": 0.02}
"""Largest accepted distance of a mimic joint from its leader's position, at any time during a step
[m or rad]: 5 mm are 0.02 rad at 25 cm."""
STEP_S = 3.0  # duration within which a step must settle [s]
SETTLED_S = 0.2  # duration for which all joints must be settled, after which a step ends [s]
MIN_TIMESTEP = 1e-4  # smallest time step of an MJCF that is simulated [s]: 50,000 steps of holding

CHANGES: Mapping[str, Callable[[Joint], Joint]] = {
    "it settles without the joint damping": lambda joint: replace(joint, damping=0.0),
    "it settles without the dry friction": lambda joint: replace(joint, friction=0.0),
    "ten times the effort limits are enough": lambda joint: replace(
        joint, effort=None if joint.effort is None else 10 * joint.effort
    ),
}
"""Changes of the joints that tell a cause of a failure, by the words of the cause."""


@dataclass(frozen=True)
class SimulatedRobot:
    """A robot in a simulator."""

    period: float  # time between the positions that ``run`` yields [s]
    run: Callable[[Array], Iterator[Array]]
    """Function of targets of the independent joints, shape (dof,) [rad or m]. It puts the robot to
    its home, at rest, drives it to the targets, and yields the positions of the movable joints,
    shape (n_movable,) [rad or m], after every period, without end."""


@dataclass(frozen=True)
class HoldRow:
    """How a robot holds its home configuration in a simulator, and how its joints step."""

    simulator: str  # name of the simulator, and of the file or the environments
    passed: bool | None
    """Whether no joint drifts farther than ``MAX_DRIFT`` from home, all steps settle within
    ``STEP_S`` and mimic joints stay with their leaders; None without the simulator."""
    drift: float | None = None
    """Largest distance of a joint from home within ``HOLD_S`` [rad or m]; None if diverged."""
    unit: str = ""  # unit of `drift`: `rad` or `m`
    joint: str = ""  # name of the joint that drifts farthest
    step_error: float | None = None
    """Largest distance of a joint from its target at the end of a step [rad or m]; None, here and
    below, if a step diverged."""
    follower_error: float | None = None
    """Largest distance of a mimic joint from its leader's position during a step [rad or m]."""
    settling_time: float | None = None
    """Longest time until all joints are within ``BAND`` of their targets [s]; None if never."""
    message: str = ""  # description of the failure; empty if the robot passed
    causes: tuple[str, ...] = ()  # known causes of the failure; empty if none is known

    @property
    def is_unexplained(self) -> bool:
        """Whether the robot fails without a known cause."""
        return self.passed is False and not self.causes


def hold_files(robot: Robot, folder: Path) -> tuple[HoldRow, ...]:
    """Hold a robot at home and step its joints with the files of its bundle in each simulator."""

    def in_new_bundle(hold: Callable[[Robot, Path], HoldRow], robot: Robot) -> HoldRow:
        with TemporaryDirectory() as parent:
            bundle = bundle_folder(Path(parent), robot.name)
            write_bundle(robot, bundle, picture=False)
            return hold(robot, bundle)

    def hold_mjcf(robot: Robot, folder: Path) -> HoldRow:
        return hold_row("mujoco (mjcf)", "mujoco", robot, partial(_mjcf, robot, folder), 0.0)

    rows = []
    for hold in (hold_mjcf, _hold_urdf):
        row, hold_anew = hold(robot, folder), partial(in_new_bundle, hold)
        # A robot that passes with new files has its fault in the old ones.
        if row.is_unexplained and hold_anew(robot).passed is False:
            row = with_causes(row, robot, hold_anew)
        rows.append(row)
    return tuple(rows)


def with_causes(row: HoldRow, robot: Robot, hold: Callable[[Robot], HoldRow]) -> HoldRow:
    """Add the causes to the row of a robot that fails without a known one.

    That is a property of the joints without which it passes, or fails only for known causes.
    """
    if not row.is_unexplained:
        return row
    causes: list[str] = []
    for cause, change in CHANGES.items():
        changed = replace(robot, joints=tuple(change(joint) for joint in robot.joints))
        if changed != robot:
            trial = hold(changed)
            if trial.passed or trial.causes:
                causes += (cause, *trial.causes)
    return replace(row, causes=tuple(dict.fromkeys(causes)))


def _hold_urdf(robot: Robot, folder: Path) -> HoldRow:
    def hold(iterations: int) -> HoldRow:
        urdf = partial(_urdf, robot, folder, iterations)
        return hold_row("pybullet (urdf)", "pybullet", robot, urdf, None)

    row = hold(SOLVER_ITERATIONS)
    if not row.is_unexplained:
        return row
    more, causes = hold(MORE_ITERATIONS), []
    if more.passed or (row.step_error is None and more.step_error is not None):
        causes.append(f"holds with {MORE_ITERATIONS} solver iterations")
    if not more.passed and more.settling_time is not None:  # only mimic joints fail
        causes.append("PyBullet ignores <mimic>, so that followers have motors of their own")
    return replace(row, causes=tuple(causes))


def hold_row(
    name: str,
    module: str,
    robot: Robot,
    simulated: Callable[[], AbstractContextManager[SimulatedRobot]],
    contact_margin: float | None,
) -> HoldRow:
    """Return the row of a simulator: drift at home for ``HOLD_S``, then a step of each joint.

    Each starts from home, away from the nearer limit; a robot that does not hold its home makes
    none. Links nearer than ``contact_margin`` [m] push each other away; None if they never do.
    """
    if find_spec(module) is None:
        return HoldRow(name, None, message="not installed")
    if not robot.movable_joints:
        return HoldRow(name, True, 0.0, "", "", 0.0, 0.0, 0.0)
    try:
        with simulated() as simulation:
            row = _hold(name, robot, simulation)
            if row.passed:
                return _stepped(row, robot, simulation, contact_margin)
    except MorphgenError as error:
        return HoldRow(name, False, message=str(error))
    return replace(row, causes=_causes(robot, contact_margin, np.array(robot.home)))


def _hold(name: str, robot: Robot, simulation: SimulatedRobot) -> HoldRow:
    home = movable_positions(robot, robot.home)
    drift = np.zeros(len(home))
    run = simulation.run(np.array(robot.home))
    for q in islice(run, round(HOLD_S / simulation.period)):
        if not np.isfinite(q).all():
            return HoldRow(name, False, message="diverged")
        drift = np.maximum(drift, np.abs(q - home))
    worst = int(drift.argmax())
    passed = bool(drift[worst] <= MAX_DRIFT)
    joint = robot.joints[robot.movable_joints[worst]]
    message = "" if passed else f"{joint.name} moves {drift[worst]:.3g} {_unit(joint)}"
    return HoldRow(name, passed, float(drift[worst]), _unit(joint), joint.name, message=message)


def _stepped(
    row: HoldRow, robot: Robot, simulation: SimulatedRobot, contact_margin: float | None
) -> HoldRow:
    """Add the steps of all independent joints to the row of a robot that holds its home."""
    steps: list[_Step] = []
    for target in step_targets(robot):
        step = _step(robot, simulation, target)
        if step is None:
            return replace(row, passed=False, message="a step diverged")
        steps.append(step)
    slowest = max((step.settling_time for step in steps), default=0.0)
    row = replace(
        row,
        step_error=max((step.error for step in steps), default=0.0),
        follower_error=max((step.follower_error for step in steps), default=0.0),
        settling_time=slowest if slowest < math.inf else None,
    )
    failed = sorted((s for s in steps if s.severity > 1), key=lambda s: s.severity, reverse=True)
    if not failed:
        return row
    others = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
    # Links that penetrate at home may hold a joint that steps out of the contact.
    find_causes, home = partial(_causes, robot, contact_margin), np.array(robot.home)
    causes = [find_causes(step.target) or find_causes(home) for step in failed]
    # They are the causes only if every step that fails has one.
    known = tuple(dict.fromkeys(chain.from_iterable(causes))) if all(causes) else ()
    return replace(row, passed=False, message=f"{failed[0].fault}{others}", causes=known)


def step_targets(robot: Robot) -> Array:
    """Return the targets of the steps, shape (n_steps, dof) [rad or m].

    Each is home with one joint moved by ``STEP`` where there is more room; none without room.
    """
    targets = []
    for i, k in enumerate(robot.independent_joints):
        joint, home = robot.joints[k], robot.home[i]
        lower, upper = NO_LIMITS if joint.is_continuous else joint.limits or NO_LIMITS
        is_up = upper - home >= home - lower
        room = upper - home if is_up else home - lower
        size = min(STEP[joint.kind], MAX_STEP * room)
        if size > 0:
            target = np.array(robot.home)
            target[i] += size if is_up else -size
            targets.append(target)
    return np.array(targets).reshape(-1, robot.dof)


class _Step(NamedTuple):
    """Result of one step."""

    target: Array
    error: float
    follower_error: float
    settling_time: float
    severity: float  # error of the worst joint, relative to the accepted one
    fault: str  # description of the largest error


def _step(robot: Robot, simulation: SimulatedRobot, target: Array) -> _Step | None:
    """Move to a target; return None if the simulation diverges."""
    joints, independent = [robot.joints[k] for k in robot.movable_joints], robot.independent_rows
    moved = int(np.argmax(np.abs(target - robot.home)))
    stepped, size = joints[independent[moved]], abs(float(target[moved] - robot.home[moved]))
    accepted = np.array([MAX_FOLLOWER_ERROR[joint.kind] for joint in joints])
    band = BAND * np.array([STEP[joints[i].kind] for i in independent])
    band[moved] = BAND * size
    lag, settled_at = np.zeros(len(joints)), math.inf
    for i, q in enumerate(islice(simulation.run(target), round(STEP_S / simulation.period))):
        if not np.isfinite(q).all():
            return None
        time = (i + 1) * simulation.period
        lag = np.maximum(lag, np.abs(q - movable_positions(robot, q[independent])))
        errors = np.abs(q[independent] - target)
        settled_at = min(settled_at, time) if (errors <= band).all() else math.inf
        if time - settled_at >= SETTLED_S:
            break
    severities, distances = lag / accepted, lag.copy()
    if settled_at == math.inf:
        severities[independent], distances[independent] = errors / band, errors
    worst = int(severities.argmax())
    where = "its target" if worst in independent else "its leader"
    fault = (
        f"{joints[worst].name} is {distances[worst]:.2g} {_unit(joints[worst])} from {where} when "
        f"{stepped.name} steps by {size:.2g} {_unit(stepped)}"
    )
    error, follower_error = float(errors.max()), float(lag.max())
    return _Step(target, error, follower_error, settled_at, float(severities[worst]), fault)


def _causes(robot: Robot, contact_margin: float | None, q: Array) -> tuple[str, ...]:
    """Return what keeps a robot from a configuration: weak motors, and links in the way."""
    causes = overloads(robot, q)
    if contact_margin is None:
        return causes
    pairs = home_penetrations(replace(robot, home=tuple(q.tolist())), contact_margin)
    words = {True: "penetrate by", False: "come within PyBullet's collision margin, to"}
    return causes + tuple(
        f"{a}, {b} {words[depth > 0]} {1000 * abs(depth):.2g} mm"
        for (a, b), depth in sorted(pairs.items())
    )


def _unit(joint: Joint) -> str:
    return "m" if joint.kind == "prismatic" else "rad"


def overloads(robot: Robot, q: ArrayLike) -> tuple[str, ...]:
    """Return a description of every joint whose effort cannot carry the weight."""
    loads = gravity_load(robot, q).tolist()
    causes = []
    for joint, load in zip((robot.joints[k] for k in robot.movable_joints), loads, strict=True):
        if joint.effort and abs(load) > joint.effort:
            unit = "N" if joint.kind == "prismatic" else "N m"
            causes.append(
                f"{joint.name} needs {abs(load):.3g} {unit} to carry the weight, its effort is "
                f"{joint.effort:.3g}"
            )
    return tuple(causes)


@contextmanager
def _mjcf(robot: Robot, folder: Path) -> Iterator[SimulatedRobot]:
    import mujoco

    model = load_model(folder / MJCF)
    if "home" not in (model.key(i).name for i in range(model.nkey)):
        raise FormatError("no keyframe 'home'")
    addresses = {model.joint(i).name: model.jnt_qposadr[i] for i in range(model.njnt)}
    joints = _joints(robot, addresses)
    driven = {model.joint(model.actuator_trnid[i, 0]).name: i for i in range(model.nu)}
    # A robot that diverges must be seen.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data = mujoco.MjData(model)

    def run(targets: Array) -> Iterator[Array]:
        mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
        for k, target, home in zip(robot.independent_joints, targets, robot.home, strict=True):
            if target != home:
                data.ctrl[driven[robot.joints[k].name]] = target
        while True:
            with MujocoWarnings():
                mujoco.mj_step(model, data)
            yield data.qpos[joints]

    if not model.opt.timestep >= MIN_TIMESTEP:
        raise FormatError(
            f"{MJCF}: timestep {model.opt.timestep:g} s; expected at least {MIN_TIMESTEP:g} s"
        )
    yield SimulatedRobot(model.opt.timestep, run)


def _joints(robot: Robot, index: Mapping[str, int]) -> list[int]:
    names = [robot.joints[k].name for k in robot.movable_joints]
    if missing := sorted(set(names) - index.keys()):
        raise FormatError(f"lacks joints {', '.join(missing)}")
    return [index[name] for name in names]


@contextmanager
def _urdf(robot: Robot, folder: Path, iterations: int) -> Iterator[SimulatedRobot]:
    with bullet_client() as client:
        with quiet():
            body = client.loadURDF(str(folder / URDF), useFixedBase=True)
        client.setGravity(0, 0, -GRAVITY)
        client.setPhysicsEngineParameter(numSolverIterations=iterations)
        infos = [client.getJointInfo(body, i) for i in range(client.getNumJoints(body))]
        joints = _joints(robot, {info[1].decode(): info[0] for info in infos})
        # Item 10 is the effort limit; one of zero counts as missing, as in the MJCF.
        forces = [infos[joint][10] or DEFAULT_EFFORT for joint in joints]

        def run(targets: Array) -> Iterator[Array]:
            home = movable_positions(robot, robot.home).tolist()
            for joint, q in zip(joints, home, strict=True):
                client.resetJointState(body, joint, q)
            positions = movable_positions(robot, targets).tolist()
            client.setJointMotorControlArray(
                body, joints, client.POSITION_CONTROL, targetPositions=positions, forces=forces
            )
            while True:
                client.stepSimulation()
                yield np.array([state[0] for state in client.getJointStates(body, joints)])

        yield SimulatedRobot(client.getPhysicsEngineParameters()["fixedTimeStep"], run)
