"""Whether every start of a push set is what it claims to be: a block that the robot can push."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morphgen.formats.mujoco_kinematics import MujocoKinematics
from morphgen.model.robot import Robot
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.goals import outside_limits
from morphgen.tasks.push_proofs import CLOSE
from morphgen.tasks.push_sets import PushSet
from morphgen.tasks.sim.base import Scene

Array = NDArray[np.float64]

RESTS = 1e-6
"""Largest height of a block above the ground that counts as standing on it, metres."""


def certify_pushes(pushes: PushSet, robot: Robot, scene: Scene) -> list[str]:
    """Prove that every block can be pushed across the line, as far as configurations tell.

    Tool positions are MuJoCo's, not those of our kinematics, which the proofs were found with.

    Args:
        pushes: The set.
        robot: The body.
        scene: Its ground and obstacles; the block is the set's.

    Returns:
        What is wrong, a line each: a block that does not stand on the ground, is past the line or
        in what stands still; a configuration out of limits or in collision; a proof whose tool is
        not behind the block, or not on the line; a set of another robot or other obstacles.

    Raises:
        FormatError: If MJCF cannot express the robot.
        MeshError: If a mesh cannot be read.
    """
    n = len(pushes.blocks)
    configurations = {
        "start": pushes.q,
        "proof behind": pushes.behind,
        "proof across": pushes.across,
    }
    if any(q.shape != (n, robot.dof) for q in configurations.values()) or pushes.blocks.shape != (
        n,
        7,
    ):
        shapes = ", ".join(str(q.shape) for q in (*configurations.values(), pushes.blocks))
        return [f"arrays {shapes} are no starts of robot {robot.name!r} with {robot.dof} joints"]
    if not all(np.isfinite(q).all() for q in (*configurations.values(), pushes.blocks)):
        return ["not all numbers are finite"]
    wrong = []
    if scene.obstacles != pushes.obstacles:
        wrong.append("the obstacles of the scene are not those of the push set")
    for name, q in configurations.items():
        wrong += [f"start {i}: {name}: {why}" for i, why in outside_limits(robot, q)]
    space = FreeSpace(replace(scene, robot=robot, block=pushes.block))
    wrong += _blocks(pushes, space)
    for name, q in configurations.items():
        free = space.free(q, None if q is pushes.across else pushes.blocks)
        wrong += [f"start {i}: {name} is in collision" for i in np.flatnonzero(~free).tolist()]
    return [*wrong, *_tools(pushes, robot)]


def _blocks(pushes: PushSet, space: FreeSpace) -> Iterator[str]:
    edge = pushes.block.size[2]
    above = pushes.blocks[:, 2] - edge / 2 - pushes.ground
    for i in np.flatnonzero(np.abs(above) > RESTS).tolist():
        yield f"start {i}: the block is {above[i]:.2g} m above the ground"
    for i in np.flatnonzero(pushes.blocks[:, 1] >= pushes.line).tolist():
        yield f"start {i}: the block is across the line already"
    for i in np.flatnonzero(~space.room(pushes.blocks)).tolist():
        yield f"start {i}: the block is in an obstacle or the base"


def _tools(pushes: PushSet, robot: Robot) -> Iterator[str]:
    tool = MujocoKinematics(robot)
    behind, across = (tool.frame_pose(q)[:, :3, 3] for q in (pushes.behind, pushes.across))
    for i, (back, front, block) in enumerate(zip(behind, across, pushes.blocks, strict=True)):
        if abs(back[0] - block[0]) > CLOSE or back[1] >= block[1]:
            yield f"start {i}: the tool of its proof is not behind the block"
        if abs(front[0] - block[0]) > CLOSE or abs(front[1] - pushes.line) > CLOSE:
            yield f"start {i}: the tool of its proof is not on the line"
