"""Physics of robots of many structures in one batch on a GPU, beside two other ways.

    python benchmarks/mixed_structures.py [--grammar serial] [--numbers 1 10 100 300] [--envs 9600]
        [--skip union Kamino]

Drawn arms on the ground beside a block, with random joint targets: control steps per second of all
environments. The columns:

- morphgen: the simulation of ``morphgen train --sim warp``, with its control law and states. Robots
  of one structure share kernels, and structures are branches of one CUDA graph.
- union: MuJoCo Warp with one model of an arm of each structure, of which all but one sleep in every
  environment, without control law and states. A block is that of all arms. If worlds lose contacts,
  they get twice the memory, and the measurement is repeated.
- Kamino: the solver of Newton for any mixture of models, likewise, if the package newton is
  installed, with ``--kamino-envs`` environments.

Each figure is printed on stderr as soon as it is measured; ``--skip`` leaves columns out. All take
``SUBSTEPS`` physics steps of ``TIMESTEP`` for a control step.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp as wp
from tabulate import tabulate

import morphgen
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP, Block, Contacts, Scene
from morphgen.tasks.sim.mujoco_model import _robot_spec, _world, worlds
from morphgen.tasks.sim.warp_sim import (
    CONTACTS_PER_WORLD,
    IGNORED_OVERFLOW,
    WarpSimulation,
    max_contacts,
    structures,
)

STEPS, WARM_UP, TARGETS = 60, 10, 20
"""Measured control steps, those before, and number of different targets."""
BLOCK = Block((0.1, 0.1, 0.1), mass=0.3)
AWAKE = -11  # state of a tree that moved in the last step
APART = 10.0  # distance of the arms of the union [m]
COLUMNS = ("morphgen", "union", "Kamino")
Row = dict[str, str | int | float]


def main() -> int:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grammar", default="serial")
    parser.add_argument("--numbers", type=int, nargs="+", default=(1, 10, 100, 300))
    parser.add_argument("--envs", type=int, default=9600)
    parser.add_argument("--kamino-envs", type=int, default=960)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--skip", choices=COLUMNS, nargs="+", default=(), help="leave columns out")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    args = parser.parse_args()
    rows = [_row(args, number) for number in args.numbers]
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    print(tabulate(rows, headers="keys", floatfmt=",.0f", intfmt=","))
    return 0


def _row(args: argparse.Namespace, number: int) -> Row:
    robots = list(morphgen.sample(args.grammar, number))
    scenes = [Scene(robots[i % number], object=BLOCK) for i in range(args.envs)]
    found = structures(scenes[:number], worlds(scenes[:number], Contacts()))
    kinds = [scenes[int(structure.envs[0])] for structure in found]
    shares = [len(structure.envs) for structure in found]
    columns: dict[str, Callable[[], float]] = {
        "morphgen": lambda: _morphgen(scenes, args.device),
        "union": lambda: _union(kinds, shares, args.envs, args.device),
    }
    if find_spec("newton"):
        columns["Kamino"] = lambda: _kamino(scenes[: args.kamino_envs], args.device)
    row: Row = {"robots": number, "structures": len(found), "environments": args.envs}
    for name, measure in columns.items():
        if name not in args.skip:
            row[f"{name}, steps/s"] = speed = measure()
            print(f"{number} robots, {name}: {speed:,.0f} steps/s", file=sys.stderr, flush=True)
    return row


def _steps_per_second(step: Callable[[int], object], envs: int) -> float:
    for i in range(WARM_UP):
        step(i)
    wp.synchronize()
    began = time.perf_counter()
    for i in range(STEPS):
        step(i)
    wp.synchronize()
    return envs * STEPS / (time.perf_counter() - began)


def _morphgen(scenes: Sequence[Scene], device: str) -> float:
    simulation = WarpSimulation(scenes, Contacts(), device=device)
    home = simulation.q.clone()
    generator = torch.Generator(home.device).manual_seed(0)
    noise = torch.randn(TARGETS, *home.shape, generator=generator, device=home.device)
    speed = _steps_per_second(
        lambda i: simulation.step(home + 0.3 * noise[i % TARGETS]), len(scenes)
    )
    simulation.close()
    return speed


def _captured(step: Callable[[], object], times: int, device: str) -> Callable[[int], object]:
    """Return a control step, which repeats a step, as a CUDA graph on a GPU."""

    def repeat() -> None:
        for _ in range(times):
            step()

    with wp.ScopedDevice(device):
        repeat()
        if not wp.get_device(device).is_cuda:
            return lambda i: repeat()
        with wp.ScopedCapture() as capture:
            repeat()
    return lambda i: wp.capture_launch(capture.graph)


def _union(kinds: Sequence[Scene], shares: Sequence[int], envs: int, device: str) -> float:
    """Return the speed of one model of an arm of each kind; environments have them by share."""
    union = mujoco.MjSpec()
    for i, scene in enumerate(kinds):
        _, spec = _robot_spec(scene.robot, Contacts())
        union.option = spec.option
        for body in spec.bodies[1:]:
            body.gravcomp = 1
        for each in (*spec.keys, *spec.actuators):  # a tree with an actuator does not sleep
            spec.delete(each)
        frame = union.worldbody.add_frame(pos=[APART * i, 0, 0])
        union.attach(spec, prefix=f"{i}_", frame=frame)
    union.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    block = union.worldbody.add_body(pos=[0.5, 0, 0.05])
    block.add_freejoint()
    block.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05] * 3, mass=BLOCK.mass)
    union.option.disableflags = 0
    union.option.enableflags = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    model = union.compile()
    number = np.array(shares) * envs // sum(shares)
    number[0] += envs - number.sum()
    states = np.tile(np.arange(model.ntree, dtype=np.int32), (envs, 1))  # each sleeps alone
    active = np.repeat([_tree(model, i, scene) for i, scene in enumerate(kinds)], number)
    states[np.arange(envs), active] = states[:, -1] = AWAKE
    force = np.zeros((envs, model.nv), dtype=np.float32)
    force[model.dof_treeid[None, :] == active[:, None]] = 0.1
    rows, contacts = _union_rows(model, kinds), envs * CONTACTS_PER_WORLD
    while True:
        with wp.ScopedDevice(device):
            ours = mujoco_warp.put_model(model)
            ours.opt.warn_overflow = 0  # counted below
            data = mujoco_warp.make_data(model, nworld=envs, naconmax=contacts, njmax=rows)
            data.tree_asleep.assign(states)
            data.qfrc_applied.assign(force)
        step = _captured(partial(mujoco_warp.step, ours, data), SUBSTEPS, device)
        speed = _steps_per_second(step, envs)
        lost = np.count_nonzero(data.overflow.numpy() & ~IGNORED_OVERFLOW)
        if not lost:
            return speed
        print(f"union: {lost} of {envs} worlds lost contacts", file=sys.stderr, flush=True)
        rows, contacts = 2 * rows, 2 * contacts


def _union_rows(model: mujoco.MjModel, kinds: Sequence[Scene]) -> int:
    """Return the number of constraints of a union: joint limits of all, contacts of one arm.

    A limit or an equality of a sleeping arm may have a row all the same.
    """
    shapes = max(sum(len(link.collisions) for link in kind.robot.links) for kind in kinds)
    return int(model.neq + np.count_nonzero(model.jnt_limited) + 3 * max_contacts(shapes + 2))


def _tree(model: mujoco.MjModel, kind: int, scene: Scene) -> int:
    """Return the tree of a kind's arm in the union."""
    joint = scene.robot.joints[scene.robot.movable_joints[0]].name
    return int(model.body_treeid[model.jnt_bodyid[model.joint(f"{kind}_{joint}").id]])


def _kamino(scenes: Sequence[Scene], device: str) -> float:
    """Return the speed of Newton's solver for the models of all scenes."""
    newton = import_module("newton")

    builder, xml = newton.ModelBuilder(), {}
    for scene in scenes:
        if id(scene.robot) not in xml:
            robot, spec = _robot_spec(scene.robot, Contacts())
            _world(scene, robot, spec)
            spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
            one = newton.ModelBuilder()
            one.add_mjcf(spec.to_xml())
            xml[id(scene.robot)] = one
        builder.add_world(xml[id(scene.robot)])
    model = builder.finalize(device=device)
    solver = newton.solvers.SolverKamino(model)
    state, other, control = model.state(), model.state(), model.control()
    contacts = model.contacts()

    def step() -> None:
        model.collide(state, contacts)
        solver.step(state, other, control, contacts, TIMESTEP)
        solver.step(other, state, control, contacts, TIMESTEP)

    return _steps_per_second(_captured(step, SUBSTEPS // 2, device), len(scenes))


if __name__ == "__main__":
    raise SystemExit(main())
