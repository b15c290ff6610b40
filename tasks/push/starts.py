"""Push sets: poses of a block from which a robot can push it, with feasibility certificates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.formats.mujoco_kinematics import MujocoKinematics
from morphgen.model.geometry import Pose
from morphgen.model.robot import Robot
from morphgen.tasks.free_space import FreeSpace, outside_limits
from morphgen.tasks.obstacles import draw_boxes, draw_layouts, layout_faults, place_boxes
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.push.feasibility import CLOSE, FeasibilityTest, path_is_clear
from morphgen.tasks.push.region import Region, draw_blocks, push_region
from morphgen.tasks.sim.base import Block, Scene
from morphgen.typing import Array

TRIES = 30
"""Poses of the block to test per required start before giving up."""
RESTS = 1e-6
"""Largest height above the ground of a block that stands on it [m]."""

_STANDS = 1e-3
"""Tolerance of a block that stands upright on the ground [m, and of a quaternion]."""
_CONFIGURATIONS = 1000
"""Free configurations to test for a start before giving up."""


@dataclass(frozen=True, eq=False)
class PushStartSet:
    """Starts of a robot's push episodes, and the block and obstacles that they share."""

    start_belongs_to_goal: ClassVar[bool] = True
    not_compared: ClassVar[frozenset[str]] = frozenset(("robot", "behind", "across"))

    robot: str
    key: str
    """Hash of everything that the set depends on: 64 hexadecimal digits."""
    q: Array
    """Configurations at the start, free without obstacles, shape (S, dof) [rad or m]."""
    blocks: Array
    """Poses of the block at the start in the world: (x, y, z, qw, qx, qy, qz), shape (S, 7)."""
    block: Block
    """Cube that the robot pushes, at its pose in the first start."""
    line: float
    """y that the block's centre must cross [m]."""
    scale: float
    """Scale of lengths: 1, or less for robots that reach less than 0.4 m."""
    ground: float
    """Height of the ground [m]."""
    obstacles: tuple[Block, ...]
    """Boxes at the poses of the first layout."""
    layouts: Array
    """Poses of the boxes in each layout, those for training first, shape (L, O, 7)."""
    usable: NDArray[np.bool_]
    """Which starts are feasible in each layout, by their certificates, shape (L, S)."""
    tried: int
    """Number of tested poses of the block."""
    accepted: int
    """Number of feasible poses that became starts: S."""
    seed: int
    behind: Array
    """Certificates: free configurations with the tool behind the block, at its height, (S, dof)."""
    across: Array
    """Certificates: free configurations with the tool where the block's centre crosses the line."""

    @property
    def goal_poses(self) -> Array:
        """Poses of the block at the start, shape (S, 7)."""
        return self.blocks


def sample_starts(
    robot: Robot,
    config: PushConfig,
    *,
    obstacles: bool,
    ground: float,
    seeds: np.random.SeedSequence,
    identity: Mapping[str, Any],
) -> PushStartSet:
    """Sample a robot's push set; see ``Task.sample``.

    Blocks stand on the ground in the ``push_region``, turned at random. A pose is feasible if the
    base is not on the straight path along y across the line, and if there are free
    configurations with the tool behind the block and with the tool on the line, both at the height
    of the block. Start configurations are uniform within the joint limits; those that collide, also
    with the block, are drawn again. Obstacles do not matter: each of their layouts leaves some of
    the starts feasible.

    Raises:
        TaskError: If the robot cannot push, or too few poses are feasible.
        BenchmarkError: If the robot has no tool that moves, or hardly a free configuration, or
            obstacles block most starts.
        MeshError: If a mesh cannot be read.
    """
    region_seeds, test_seeds, block_seeds, start_seeds, obstacle_seeds = seeds.spawn(5)
    region = push_region(robot, config, ground, np.random.default_rng(region_seeds))
    edge = region.edge
    block = Block((edge, edge, edge), mass=config.block_mass, friction=config.friction)
    space = FreeSpace(Scene(robot, block=block, ground=ground))
    test = FeasibilityTest(space, region, np.random.default_rng(test_seeds))
    starts, tried = _feasible(robot, config.num_goals, region, test, ground, block_seeds)
    blocks, behind, across = (np.array(column) for column in zip(*starts, strict=True))
    x, y, z, qw, qx, qy, qz = blocks[0].tolist()
    q = _starts(space, blocks, start_seeds)
    boxes: tuple[Block, ...] = ()
    layouts, usable = np.zeros((0, 0, 7)), np.zeros((0, len(q)), dtype=np.bool_)
    if obstacles:
        size_seeds, layout_seeds = obstacle_seeds.spawn(2)
        count, size = config.obstacles, config.obstacle_size
        boxes = draw_boxes(robot, count, size, np.random.default_rng(size_seeds))
        layouts, usable = draw_layouts(
            FreeSpace(Scene(robot, block=block, obstacles=boxes, ground=ground)),
            (config.train_layouts, config.eval_layouts),
            layout_seeds,
            lambda space: _feasible_starts(space, region.line, q, blocks, behind, across),
        )
        boxes = place_boxes(boxes, layouts[0])
    return PushStartSet(
        q=q,
        blocks=blocks,
        block=replace(block, pose=Pose((x, y, z), (qw, qx, qy, qz))),
        line=region.line,
        scale=region.scale,
        ground=ground,
        obstacles=boxes,
        layouts=layouts,
        usable=usable,
        tried=tried,
        accepted=len(starts),
        behind=behind,
        across=across,
        **identity,
    )


def _feasible(
    robot: Robot,
    needed: int,
    region: Region,
    test: FeasibilityTest,
    ground: float,
    seeds: np.random.SeedSequence,
) -> tuple[list[tuple[Array, Array, Array]], int]:
    """Return feasible poses with their certificates, and the number of tested poses."""
    rng = np.random.default_rng(seeds)
    starts: list[tuple[Array, Array, Array]] = []
    refusals: Counter[str] = Counter()
    tried = 0
    while tried < TRIES * needed:
        blocks = draw_blocks(region, ground, needed, rng)
        result = test(blocks)
        for block, is_clear, behind, across in zip(
            blocks, result.path_is_clear, result.behind, result.across, strict=True
        ):
            tried += 1
            if not is_clear:
                refusals["something stands in the block's way"] += 1
            elif not np.isfinite(across).all():
                refusals["the tool does not get to the line at its height"] += 1
            elif not np.isfinite(behind).all():
                refusals["the tool does not get behind it"] += 1
            else:
                starts.append((block, behind, across))
            if len(starts) == needed:
                return starts, tried
    reasons = ", ".join(
        f"{reason} ({count / tried:.0%})" for reason, count in refusals.most_common()
    )
    raise TaskError(
        f"robot {robot.name!r} can hardly push: only {len(starts)} of {tried:,} poses of a block "
        f"of {region.edge:.3g} m with x in ({region.x[0]:.3g}, {region.x[1]:.3g}) and y in "
        f"({region.y[0]:.3g}, {region.y[1]:.3g}) are feasible (acceptance rate "
        f"{len(starts) / tried:.2g}), {needed} are needed; {reasons}"
    )


def require_pushable(space: FreeSpace, block: Array, line: float) -> None:
    """Require a pose of the block from which the robot can push it, as ``sample_starts`` does.

    Args:
        space: The robot with its obstacles and block.
        block: Pose of the block, shape (7,).
        line: y that the block's centre must cross [m].

    Raises:
        TaskError: If it does not stand upright on the ground before the line, something is in its
            way, or no configurations are found that push it.
    """
    assert space.scene.block is not None
    edge, ground = space.scene.block.size[0], space.scene.ground or 0.0
    x, y, z, _, qx, qy, _ = block.tolist()
    what = f"option 'block' at ({x:g}, {y:g}, {z:g})"
    if abs(z - ground - edge / 2) > _STANDS or abs(qx) > _STANDS or abs(qy) > _STANDS:
        raise TaskError(
            f"{what}: expected a block that stands upright on the ground, its centre at z = "
            f"{ground + edge / 2:g}"
        )
    if y >= line:
        raise TaskError(f"{what} is across the line, which is at y = {line:g}")
    region = Region(edge, 1.0, (x, x), (y, y), line)
    test = FeasibilityTest(space, region, np.random.default_rng(0))(block[None])
    if not test.path_is_clear[0]:
        raise TaskError(f"{what}: something stands in the block's way to the line")
    for found, place in ((test.across, "to the line"), (test.behind, "behind the block")):
        if not np.isfinite(found).all():
            raise TaskError(f"{what}: no configuration was found that gets the tool {place}")


def _feasible_starts(
    space: FreeSpace, line: float, q: Array, blocks: Array, behind: Array, across: Array
) -> NDArray[np.bool_]:
    """Return which starts the obstacles leave feasible, by their certificates, shape (n,).

    Args:
        space: The robot with its obstacles and block.
        line: y that the block's centre must cross [m].
        q: Configurations at the start, shape (n, dof).
        blocks: Poses of the block at the start, shape (n, 7).
        behind: Configurations with the tool behind the block, shape (n, dof).
        across: Configurations with the tool on the line, shape (n, dof).
    """
    feasible = path_is_clear(space, line, blocks)
    for configurations, poses in ((q, blocks), (behind, blocks), (across, None)):
        rows = np.flatnonzero(feasible)
        feasible[rows] = space.free(configurations[rows], None if poses is None else poses[rows])
    return feasible


def _starts(space: FreeSpace, blocks: Array, seeds: np.random.SeedSequence) -> Array:
    """Return a free configuration for each block, shape (n, dof); they do not depend on n."""
    starts = []
    for block, child in zip(blocks, seeds.spawn(len(blocks)), strict=True):
        rng = np.random.default_rng(child)
        for _ in range(_CONFIGURATIONS):
            q, _ = space.sample(1, rng)
            if space.free(q, block[None])[0]:
                starts.append(q[0])
                break
        else:
            raise TaskError(
                f"robot {space.scene.robot.name!r}: {_CONFIGURATIONS} free configurations all "
                f"penetrate the block at ({block[0]:.3g}, {block[1]:.3g}, {block[2]:.3g})"
            )
    return np.array(starts)


def certify_starts(pushes: PushStartSet, robot: Robot, scene: Scene) -> list[str]:
    """Test that every block can be pushed across the line, by the configurations of the set.

    Tool positions are computed by MuJoCo, not by our kinematics, which found the certificates.

    Args:
        pushes: The set.
        robot: The robot.
        scene: Ground and obstacles; the block is the set's.

    Returns:
        Faults, a line each: a block that does not stand on the ground, is past the line or in the
        base; a configuration out of limits or in collision; a certificate whose tool is not behind
        the block, or not on the line; a set of another robot or other obstacles; see also
        ``layout_faults``.

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
        return [f"arrays {shapes} are not starts of robot {robot.name!r} with {robot.dof} joints"]
    if not all(np.isfinite(q).all() for q in (*configurations.values(), pushes.blocks)):
        return ["not all numbers are finite"]
    faults = layout_faults(
        pushes,
        robot,
        scene,
        lambda space: _feasible_starts(
            space, pushes.line, pushes.q, pushes.blocks, pushes.behind, pushes.across
        ),
        block=pushes.block,
    )
    for name, q in configurations.items():
        faults += [f"start {i}: {name}: {reason}" for i, reason in outside_limits(robot, q)]
    space = FreeSpace(replace(scene, robot=robot, block=pushes.block, obstacles=()))
    faults += _misplaced_blocks(pushes, space)
    for name, q in configurations.items():
        free = space.free(q, None if q is pushes.across else pushes.blocks)
        faults += [f"start {i}: {name} is in collision" for i in np.flatnonzero(~free).tolist()]
    return [*faults, *_misplaced_tools(pushes, robot)]


def _misplaced_blocks(pushes: PushStartSet, space: FreeSpace) -> Iterator[str]:
    """Yield a fault for each start whose block is not where a push may begin."""
    edge = pushes.block.size[2]
    above = pushes.blocks[:, 2] - edge / 2 - pushes.ground
    for i in np.flatnonzero(np.abs(above) > RESTS).tolist():
        yield f"start {i}: the block is {above[i]:.2g} m above the ground"
    for i in np.flatnonzero(pushes.blocks[:, 1] >= pushes.line).tolist():
        yield f"start {i}: the block is across the line already"
    for i in np.flatnonzero(~space.block_is_clear(pushes.blocks)).tolist():
        yield f"start {i}: the block is in the base"


def _misplaced_tools(pushes: PushStartSet, robot: Robot) -> Iterator[str]:
    """Yield a fault for each certificate whose tool is not behind its block or at the line."""
    tool = MujocoKinematics(robot)
    behind, across = (tool.frame_pose(q)[:, :3, 3] for q in (pushes.behind, pushes.across))
    for i, (back, front, block) in enumerate(zip(behind, across, pushes.blocks, strict=True)):
        if abs(back[0] - block[0]) > CLOSE or back[1] >= block[1]:
            yield f"start {i}: the tool of its proof is not behind the block"
        if abs(front[0] - block[0]) > CLOSE or abs(front[1] - pushes.line) > CLOSE:
            yield f"start {i}: the tool of its proof is not on the line"
