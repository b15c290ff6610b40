"""Forward kinematics of many configurations in NumPy, torch, MuJoCo and Pinocchio.

    python benchmarks/kinematics.py [--robot "arm=ur5 ee=plane"] [--n 1024] [--rounds 15]
                                    [--device cpu]

Measures the poses of all links, the tool pose with its Jacobian, and the tool position, at random
configurations. MuJoCo (`mj_kinematics`; for the Jacobian also `mj_comPos` and `mj_jacSite`) and
Pinocchio take one configuration at a time in a Python loop. Every round measures all rows in turn,
so that other load on the machine affects all rows. Times are medians; "MuJoCo = 1" is the median
ratio to MuJoCo's time for the same result in the same round. Torch uses one thread. Compiling the
robots is not counted.

Without Pinocchio (`pip install morphgen[test]`) its rows are missing.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import torch
from tabulate import tabulate

import morphgen
from morphgen.formats.mjcf.write import MujocoKinematics
from morphgen.formats.urdf.write import urdf_text
from morphgen.model import kinematics, kinematics_torch
from morphgen.model.kinematics import frame_positions, movable_positions, random_configurations
from morphgen.model.robot import TOOL, Robot
from morphgen.typing import Array

LINKS, JACOBIAN, POSITION = "links", "tool, Jacobian", "tool position"
Call = Callable[[], object]
Rows = dict[tuple[str, str], Call]
"""Functions to measure, by computation and library."""


def main() -> int:
    """Measure all rows and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robot", default="arm=ur5 ee=plane")
    parser.add_argument("--n", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    torch.set_num_threads(1)
    robot = morphgen.compose(args.robot, geometry="primitive")
    q = random_configurations(robot, args.n, np.random.default_rng(0))
    rows = {**_mujoco(robot, q), **_pinocchio(robot, q), **_numpy(robot, q)}
    for dtype in (torch.float64, torch.float32):
        rows |= _torch(robot, q, dtype, args.device)
    seconds: dict[tuple[str, str], list[float]] = {name: [] for name in rows}
    for _ in range(args.rounds + 1):
        for name, call in rows.items():
            start = time.perf_counter()
            call()
            if args.device != "cpu":
                torch.cuda.synchronize()
            seconds[name].append(time.perf_counter() - start)
    table = []
    for (what, who), times in sorted(seconds.items(), key=lambda row: row[0][0]):
        beside = seconds[(JACOBIAN if what == JACOBIAN else LINKS, "MuJoCo loop")]
        pairs = zip(times[1:], beside[1:], strict=True)  # the first round warms up
        ratio = statistics.median(own / theirs for own, theirs in pairs)
        table.append((what, who, 1e3 * statistics.median(times[1:]), ratio))
    print(f"{robot.name}: {len(robot.links)} links, {robot.dof} joints, {args.n} configurations")
    print(tabulate(table, ["result", "by", "ms", "MuJoCo = 1"], floatfmt=".3g"))
    return 0


def _numpy(robot: Robot, q: Array) -> Rows:
    columns = np.ascontiguousarray(q.T)
    return {
        (LINKS, "NumPy"): lambda: kinematics.forward_kinematics(robot, q),
        (JACOBIAN, "NumPy"): lambda: kinematics.frame_jacobian(robot, q),
        (POSITION, "NumPy"): lambda: frame_positions(robot, columns),
    }


def _torch(robot: Robot, q: Array, dtype: torch.dtype, device: str) -> Rows:
    tree = kinematics_torch.compile_tree([robot], dtype=dtype, device=device)
    chain = kinematics_torch.compile_chain([robot], dtype=dtype, device=device)
    rows = torch.zeros(len(q), dtype=torch.int64, device=device)
    values = torch.from_numpy(q).to(device, dtype)
    positions = kinematics_torch.FramePositions(chain, rows)
    name = f"torch {str(dtype).removeprefix('torch.')} ({device})"
    return {
        (LINKS, name): lambda: kinematics_torch.forward_kinematics(tree, rows, values),
        (JACOBIAN, name): lambda: kinematics_torch.frame_jacobian(chain, rows, values),
        (POSITION, name): lambda: positions(values),
    }


def _mujoco(robot: Robot, q: Array) -> Rows:
    compiled = MujocoKinematics(robot)
    model, data = compiled.model, compiled.data
    columns = [model.joint(robot.joints[k].name).qposadr[0] for k in robot.movable_joints]
    qpos = np.tile(data.qpos, (len(q), 1))
    qpos[:, columns] = movable_positions(robot, q)
    linear, angular = np.zeros((2, 3, model.nv))
    site = model.site(TOOL).id

    def links() -> None:
        for row in qpos:
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)

    def jacobian() -> None:
        for row in qpos:
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, linear, angular, site)

    return {(LINKS, "MuJoCo loop"): links, (JACOBIAN, "MuJoCo loop"): jacobian}


def _pinocchio(robot: Robot, q: Array) -> Rows:
    try:
        import pinocchio
    except ImportError:
        return {}
    bare = robot.with_links([replace(link, visuals=(), collisions=()) for link in robot.links])
    model = pinocchio.buildModelFromXML(urdf_text(bare, str))
    data = model.createData()
    names = (robot.joints[k].name for k in robot.movable_joints)
    v = np.zeros((len(q), model.nv))
    v[:, [model.idx_vs[model.getJointId(name)] for name in names]] = movable_positions(robot, q)
    neutral = pinocchio.neutral(model)
    configurations = [pinocchio.integrate(model, neutral, row) for row in v]
    link = model.getFrameId(robot.frame(TOOL).link, pinocchio.FrameType.BODY)

    def links() -> None:
        for configuration in configurations:
            pinocchio.framesForwardKinematics(model, data, configuration)

    def jacobian() -> None:
        for configuration in configurations:
            pinocchio.computeFrameJacobian(
                model, data, configuration, link, pinocchio.LOCAL_WORLD_ALIGNED
            )

    return {(LINKS, "Pinocchio loop"): links, (JACOBIAN, "Pinocchio loop"): jacobian}


if __name__ == "__main__":
    raise SystemExit(main())
