"""The task push, and poses of a block from which a robot can push it, with certificates."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.encoding.similarity import tool_reach
from morphgen.errors import NoGoalsError, TaskError
from morphgen.formats.mjcf.write import MujocoKinematics
from morphgen.model.geometry import Pose
from morphgen.model.inertia import box_corners
from morphgen.model.kinematics import (
    forward_kinematics,
    frame_positions,
    joint_axes,
    random_configurations,
    solve_position_ik,
)
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.configs import PushConfig
from morphgen.tasks.free_space import FreeSpace, outside_limits
from morphgen.tasks.scenes.obstacles import layout_faults, no_obstacles, with_obstacles
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.task import LINE, OBJECT, EnvSpec, GoalSet, Marker, ObjectTask
from morphgen.typing import Array

if TYPE_CHECKING:
    import torch

    from morphgen.tasks.push.envs import PushEnvs

FULL_REACH = 0.4  # reach below which everything is scaled down in proportion [m]

_SAMPLES, _SEED = 16_384, 0  # number and seed of the configurations that sample the tool's range
_LEVEL = 1e-3  # variation of its height below which a tool moves in a plane [m]


@dataclass(frozen=True)
class Region:
    """Size of a block, range of its start poses and line that it must cross, in the world frame."""

    edge: float  # edge length of the block, a cube [m]
    scale: float  # scale of lengths: 1, or less for robots that reach less than `FULL_REACH`
    x: tuple[float, float]  # range of x of the block's centre at the start [m]
    y: tuple[float, float]  # range of y of the block's centre at the start [m]
    line: float  # y that the block's centre must cross [m]


def push_region(
    robot: Robot, config: PushConfig, ground: float, rng: np.random.Generator
) -> Region:
    """Return the region of a robot's block, of which x and edge are those of ``work_region``.

    y at the start is at most ``config.start_depth`` below ``config.start``, and the line is at
    ``config.line``; both are scaled down in proportion for robots that reach less than 0.4 m.
    """
    size = float(rng.uniform(*config.block_size))
    edge, scale, x = work_region(robot, size, config.arm_x, config.free_x, ground)
    y = ((config.start - config.start_depth) * scale, config.start * scale)
    return Region(edge, scale, x, y, config.line * scale)


def work_region(
    robot: Robot,
    size: float,
    arm_x: tuple[float, float],
    free_x: tuple[float, float],
    ground: float,
) -> tuple[float, float, tuple[float, float]]:
    """Return edge, scale of lengths and range of x of things that a robot pushes on the ground.

    They depend on how its tool moves:

    - Free robots, whose tool slides along two horizontal directions: the edge is ``size`` in
      metres, x in ``free_x``.
    - Arms, whose tool slides along none and changes its height: the edge is relative to the
      effective reach, x in ``arm_x`` effective reaches beyond the shoulder.
    - All others, such as a rod on one slide or a chain in a horizontal plane: x is anywhere the
      tool can be at the height of the thing while slides are at home; feasibility tests decide
      where it can push. The edge is in metres if the tool slides, else relative to the effective
      reach.

    The scale is below 1 for robots that reach less than 0.4 m, in proportion. That reach is the
    effective reach, or for robots that slide half of the range of y of the tool; for slides along
    one direction only it is divided by the square root of 2, since the tool has to swing around
    the thing.
    """
    shoulder, arm_reach = tool_reach(robot)  # refuses a robot whose tool does not move
    tool_positions = _tool_positions(robot)
    slides = _num_slide_directions(robot)
    if slides:
        reach = float(np.ptp(tool_positions[1])) / 2 / (1.0 if slides == 2 else math.sqrt(2))
    else:
        reach = effective_reach(arm_reach, shoulder[2] - ground, size)
    if not reach > 0:
        fault = "does not move along y" if slides else "does not get down to the ground"
        raise TaskError(f"robot {robot.name!r} cannot push: its tool {fault}")
    scale = min(1.0, reach / FULL_REACH)
    edge = size * (scale if slides else reach)
    if slides == 2:
        x = (free_x[0] * scale, free_x[1] * scale)
    elif not slides and np.ptp(tool_positions[2]) > _LEVEL:
        x = (shoulder[0] + arm_x[0] * reach, shoulder[0] + arm_x[1] * reach)
    else:
        x = _tool_x_range(robot, ground, edge)
    return edge, scale, x


def draw_blocks(region: Region, ground: float, n: int, rng: np.random.Generator) -> Array:
    """Draw poses (n, 7) of blocks on the ground, uniform in the region and turned at random."""
    x, y, yaw = rng.random((n, 3)).T
    blocks = np.empty((n, 7))
    blocks[:, 0] = region.x[0] + x * (region.x[1] - region.x[0])
    blocks[:, 1] = region.y[0] + y * (region.y[1] - region.y[0])
    blocks[:, 2] = ground + region.edge / 2
    blocks[:, 3:] = yawed((2 * yaw - 1) * np.pi)
    return blocks


def yawed(yaw: Array) -> Array:
    """Return quaternions of rotations about z, shape (n, 4), w >= 0."""
    zero = np.zeros_like(yaw)
    q = np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1)  # w, x, y, z
    return np.where(q[:, :1] < 0, -q, q)


def effective_reach(reach: float, height: float, size: float) -> float:
    """Return the largest horizontal distance from the shoulder to a block's centre in reach [m].

    The block's edge is ``size`` times this effective reach e, so its centre is size e / 2 above the
    ground, and by Pythagoras e^2 + (height - size e / 2)^2 = reach^2; e is the larger root, or 0
    if the tool cannot get down to the block. The height is that of the shoulder [m].
    """
    a, b = 1 + size**2 / 4, height * size / 2
    root = b**2 - a * (height**2 - reach**2)
    return max((b + math.sqrt(root)) / a, 0.0) if root >= 0 else 0.0


def _tool_positions(robot: Robot, *, sliding: bool = True) -> Array:
    """Return positions of the tool at random configurations, in the root frame, shape (3, n)."""
    q = random_configurations(robot, _SAMPLES, np.random.default_rng(_SEED))
    if not sliding:
        slides = [robot.joints[k].kind == "prismatic" for k in robot.independent_joints]
        q[:, slides] = np.array(robot.home)[slides]
    return frame_positions(robot, np.ascontiguousarray(q.T))


def _num_slide_directions(robot: Robot) -> int:
    """Return the number of horizontal directions along which the tool slides, at home."""
    _, directions = joint_axes(robot, forward_kinematics(robot, np.array(robot.home)))
    axes = [
        directions[k + 1, :2]  # joint k moves link k + 1
        for k in robot.joint_chain(robot.frame(TOOL).link)
        if robot.joints[k].kind == "prismatic"
    ]
    # Parallel slides count once.
    return int(np.linalg.matrix_rank(np.array(axes), tol=1e-3)) if axes else 0


def _tool_x_range(robot: Robot, ground: float, edge: float) -> tuple[float, float]:
    """Return the range of x of the tool at the height of the block, its slides at home."""
    tool_positions = _tool_positions(robot, sliding=False)
    x_low = tool_positions[0, (tool_positions[2] > ground) & (tool_positions[2] < ground + edge)]
    if not len(x_low):
        raise TaskError(
            f"robot {robot.name!r} cannot push: its tool is never as low as a block of "
            f"{edge:.3g} m, its height is {tool_positions[2].min() - ground:.3g} m at least"
        )
    return float(x_low.min()), float(x_low.max())


BEHIND = (0.1, 0.4, 0.8, 1.2, 1.6)
"""Distances of the tool behind the block's rearmost point, in block edges, in the order of trial.
The largest exceeds the radius of the largest end-effector `sphere`, which reaches further forward
than its tool, its lowest point."""
CLOSE = 1e-3  # largest distance of a tool from its goal along x and along y [m]
NEAREST = (1, 2, 3, 6)
"""Numbers of nearest sampled configurations from which inverse kinematics starts, in turn."""

_SPACING = 0.125  # distance of the tested poses on a path, in block edges
_BANK = 2048  # number of free configurations to collect
_DRAWN, _ROUNDS = 65_536, 8  # configurations drawn per round, and number of rounds
_ARRIVED = 1e-6  # distance from its goal at which inverse kinematics leaves a tool [m]
_LOW, _HIGH = 0.15, 0.85  # range of heights of the tool, in block edges


Indices = NDArray[np.int64]


class FeasibilityTest:
    """Finds certificates of pushes, by inverse kinematics from sampled free configurations."""

    def __init__(self, space: FreeSpace, region: Region, rng: np.random.Generator) -> None:
        """Sample free configurations whose tools are low and near the blocks."""
        self._space, self._region = space, region
        self._robot: Robot = space.scene.robot
        self._ground = space.scene.ground or 0.0
        edge = region.edge
        low = np.array([region.x[0] - edge, region.y[0] - 2 * edge, self._ground])
        high = np.array([region.x[1] + edge, region.line + edge, self._ground + 1.5 * edge])
        self._bank_q, self._bank_tools = sample_tools_in_box(space, low, high, rng)

    def __call__(self, blocks: Array) -> tuple[NDArray[np.bool_], Array, Array]:
        """Find certificates for blocks that stand on the ground at poses (n, 7).

        Return whether no obstacle or base is on the straight path of each, shape (n,), and the
        configurations ``behind`` and ``across`` of ``PushStartSet``, NaN where there is none.
        """
        n, edge = len(blocks), self._region.edge
        clear = path_is_clear(self._space, self._region.line, blocks)
        behind, across = (np.full((n, self._robot.dof), np.nan) for _ in range(2))
        if len(self._bank_q):
            at_line = blocks[:, :2].copy()
            at_line[:, 1] = self._region.line
            self._fill(across, clear, at_line, None)
            # A block that is turned by its yaw extends |cos| + |sin| edges along y.
            yaw = _yaws(blocks)
            rear_y = blocks[:, 1] - edge / 2 * (np.abs(np.cos(yaw)) + np.abs(np.sin(yaw)))
            for distance in BEHIND:
                goals = np.stack([blocks[:, 0], rear_y - distance * edge], axis=1)
                missing = np.isfinite(across[:, 0]) & ~np.isfinite(behind[:, 0])
                self._fill(behind, missing, goals, blocks)
        return clear, behind, across

    def _fill(
        self, q_out: Array, mask: NDArray[np.bool_], tool_xy: Array, blocks: Array | None
    ) -> None:
        """Write free configurations with tools at ``tool_xy`` (n, 2) into the rows of a mask."""
        rows = np.flatnonzero(mask)
        if not len(rows):
            return
        starts = _nearest(tool_xy[rows], self._bank_tools[:, :2], sum(NEAREST))
        begin = 0
        for count in NEAREST:  # most succeed from the nearest, which spares the others
            missing = ~np.isfinite(q_out[rows, 0])
            rows, starts = rows[missing], starts[missing]
            candidates = starts[:, begin : begin + count]
            begin += count
            if not candidates.size:
                return
            q, free = self._solve(
                candidates, tool_xy[rows], None if blocks is None else blocks[rows]
            )
            first, has_free = free.argmax(axis=1), free.any(axis=1)
            q_out[rows[has_free]] = q[has_free, first[has_free]]

    def _solve(
        self, start: Indices, tool_xy: Array, blocks: Array | None
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Solve inverse kinematics for goals (m, 2) from k configurations of the bank each.

        Return configurations (m, k, dof), and which of them are free, with the block at its pose
        if there is one, and bring the tool to its goal between the block's bottom and top, (m, k).
        """
        (m, k), edge = start.shape, self._region.edge
        height = self._bank_tools[start.ravel(), 2] - self._ground
        height = np.clip(height, _LOW * edge, _HIGH * edge)
        goals = np.concatenate(
            [np.repeat(tool_xy, k, axis=0), self._ground + height[:, None]], axis=1
        )
        q, error = solve_position_ik(
            self._robot, self._bank_q[start.ravel()], goals, tolerance=_ARRIVED
        )
        tool_z = height - error[:, 2]
        is_close = (np.abs(error[:, :2]) < CLOSE).all(axis=1)
        reached = is_close & (tool_z > 0) & (tool_z < edge)
        free = np.zeros(len(q), dtype=np.bool_)
        poses = None if blocks is None else np.repeat(blocks, k, axis=0)[reached]
        free[reached] = self._space.free(q[reached], poses)
        return q.reshape(m, k, -1), free.reshape(m, k)


def path_is_clear(space: FreeSpace, line: float, blocks: Array) -> NDArray[np.bool_]:
    """Return whether paths of blocks (n, 7) to a line are clear of obstacles and base, (n,)."""
    assert space.scene.block is not None
    step = _SPACING * space.scene.block.size[1]
    parts = int((line - blocks[:, 1].min()) / step) + 2
    turned = blocks.copy()
    turned[:, 3:] = yawed(_yaws(blocks) + np.pi / 4)  # and turned: a push may turn a block
    poses = np.tile(np.stack([blocks, turned]), (parts, 1, 1, 1))
    advance = step * np.arange(parts)[:, None]
    poses[..., 1] = np.minimum(blocks[:, 1] + advance, line)[:, None]
    return np.asarray(
        space.block_is_clear(poses.reshape(-1, 7)).reshape(-1, len(blocks)).all(axis=0)
    )


def sample_tools_in_box(
    space: FreeSpace, low: Array, high: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Sample free configurations (n, dof) whose tools (n, 3) [m] are in a box: ``_BANK`` at most.

    They are fewer if ``_ROUNDS`` rounds find fewer.
    """
    robot = space.scene.robot
    kept, kept_tools = np.zeros((0, robot.dof)), np.zeros((0, 3))
    for _ in range(_ROUNDS):
        q = random_configurations(robot, _DRAWN, rng)
        tools = frame_positions(robot, np.ascontiguousarray(q.T)).T
        inside = np.flatnonzero(((tools > low) & (tools < high)).all(axis=1))[:_BANK]
        free = inside[space.free(q[inside])]
        kept = np.concatenate([kept, q[free]])
        kept_tools = np.concatenate([kept_tools, tools[free]])
        if len(kept) >= _BANK:
            break
    return kept[:_BANK], kept_tools[:_BANK]


def _nearest(goals: Array, points: Array, count: int) -> Indices:
    """Return indices of the points (m, 2) nearest to goals (n, 2), in order, (n, up to count)."""
    x, y = (goals[:, i, None] - points[:, i] for i in range(2))
    return np.argsort(np.sqrt(x * x + y * y), axis=1, kind="stable")[:, :count]


def _yaws(blocks: Array) -> Array:
    """Return rotations of blocks (n, 7) about z, shape (n,) [rad]."""
    return np.asarray(2 * np.arctan2(blocks[:, 6], blocks[:, 3]))


TRIES = 30  # poses of the block to test per required start before giving up
RESTS = 1e-6  # largest height above the ground of a block that stands on it [m]

_CONFIGURATIONS = 1000  # free configurations to test for a start before giving up


@dataclass(frozen=True, eq=False)
class PushStartSet(GoalSet):
    """Starts of a robot's push episodes, and the block and obstacles that they share.

    See ``GoalSet`` for the fields that all tasks have.
    """

    robot: str
    key: str
    q: Array  # configurations at the start, free without obstacles, shape (S, dof) [rad or m]
    blocks: Array
    """Poses of the block at the start in the world: (x, y, z, qw, qx, qy, qz), shape (S, 7)."""
    block: Block  # cube that the robot pushes, at its pose in the first start
    line: float  # y that the block's centre must cross [m]
    scale: float  # scale of lengths: 1, or less for robots that reach less than 0.4 m
    ground: float  # height of the ground [m]
    obstacles: tuple[Block, ...]
    layouts: Array
    usable: NDArray[np.bool_]  # which starts are feasible in each layout, by their certificates
    tried: int
    accepted: int
    seed: int
    behind: Array
    """Certificates: free configurations with the tool behind the block, at its height, (S, dof)."""
    across: Array
    """Certificates: free configurations with the tool where the block's centre crosses the line."""

    @property
    def goal_poses(self) -> Array:
        """Poses of the block at the start, shape (S, 7)."""
        return self.blocks


def draw_feasible(
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
        for block, is_clear, behind, across in zip(blocks, *test(blocks), strict=True):
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
    raise NoGoalsError(
        f"robot {robot.name!r} can hardly push: only {len(starts)} of {tried:,} poses of a block "
        f"of {region.edge:.3g} m with x in ({region.x[0]:.3g}, {region.x[1]:.3g}) and y in "
        f"({region.y[0]:.3g}, {region.y[1]:.3g}) are feasible (acceptance rate "
        f"{len(starts) / tried:.2g}), {needed} are needed; {reasons}"
    )


def feasible_starts(pushes: PushStartSet, space: FreeSpace) -> NDArray[np.bool_]:
    """Return which starts the obstacles leave feasible, by their certificates, shape (S,)."""
    blocks = pushes.blocks
    feasible = path_is_clear(space, pushes.line, blocks)
    for configurations, poses in (
        (pushes.q, blocks),
        (pushes.behind, blocks),
        (pushes.across, None),
    ):
        rows = np.flatnonzero(feasible)
        feasible[rows] = space.free(configurations[rows], None if poses is None else poses[rows])
    return feasible


def draw_starts(space: FreeSpace, blocks: Array, seeds: np.random.SeedSequence) -> Array:
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


def start_faults(pushes: PushStartSet, space: FreeSpace) -> Iterator[str]:
    """Yield the faults of each start: of its block, its configurations and their tools."""
    x, y, z = pushes.blocks[:, :3].T
    above = z - pushes.block.size[2] / 2 - pushes.ground
    for i in np.flatnonzero(np.abs(above) > RESTS).tolist():
        yield f"start {i}: the block is {above[i]:.2g} m above the ground"
    behind, across = pushes.behind, pushes.across
    tool = MujocoKinematics(space.scene.robot)
    back, front = (tool.frame_pose(q)[:, :3, 3].T for q in (behind, across))
    is_behind = (np.abs(back[0] - x) <= CLOSE) & (back[1] < y)
    is_across = (np.abs(front[0] - x) <= CLOSE) & (np.abs(front[1] - pushes.line) <= CLOSE)
    for fault, is_sound in (
        ("the block is across the line already", y < pushes.line),
        ("the block is in the base", space.block_is_clear(pushes.blocks)),
        ("start is in collision", space.free(pushes.q, pushes.blocks)),
        ("proof behind is in collision", space.free(behind, pushes.blocks)),
        ("proof across is in collision", space.free(across)),
        ("the tool of its proof is not behind the block", is_behind),
        ("the tool of its proof is not on the line", is_across),
    ):
        yield from (f"start {i}: {fault}" for i in np.flatnonzero(~is_sound).tolist())


_LINE_WIDTH, _LINE_HEIGHT = 0.012, 0.002  # size of the strip that shows the line [m]


class Push(ObjectTask[PushConfig, PushStartSet]):
    """Push a block across a line within 6 s."""

    name = "push"
    config_type = PushConfig
    goal_set_type = PushStartSet
    goal_format = 3
    cache_folder = "pushes-4"
    fields = (OBJECT, LINE)
    target = "line"

    def key_parts(self, config: PushConfig) -> list[object]:
        """Return the number of starts, and the constants that they depend on."""
        ranges = [*config.block_size, *config.arm_x, *config.free_x]
        numbers = [config.line, config.start, config.start_depth]
        numbers += [config.block_mass, config.friction]
        return [config.num_goals, [*map(float, ranges), *map(float, numbers)]]

    def sample(
        self,
        robot: Robot,
        config: PushConfig,
        *,
        obstacles: bool,
        ground: float,
        seeds: np.random.SeedSequence,
        identity: Mapping[str, Any],
    ) -> PushStartSet:
        """Sample poses of the block that can be pushed; see ``Task.sample``.

        Blocks stand on the ground in the ``push_region``, turned at random. A pose is feasible if
        the base is not on the straight path along y across the line, and if there are free
        configurations with the tool behind the block and with the tool on the line, both at the
        height of the block. Start configurations are uniform within the joint limits; those that
        collide, also with the block, are drawn again. Obstacles do not matter: each of their
        layouts leaves some of the starts feasible.
        """
        region_seeds, test_seeds, block_seeds, start_seeds, obstacle_seeds = seeds.spawn(5)
        region = push_region(robot, config, ground, np.random.default_rng(region_seeds))
        edge = region.edge
        block = Block((edge, edge, edge), mass=config.block_mass, friction=config.friction)
        space = FreeSpace(Scene(robot, object=block, ground=ground))
        test = FeasibilityTest(space, region, np.random.default_rng(test_seeds))
        starts, tried = draw_feasible(robot, config.num_goals, region, test, ground, block_seeds)
        blocks, behind, across = (np.array(column) for column in zip(*starts, strict=True))
        x, y, z, qw, qx, qy, qz = blocks[0].tolist()
        q = draw_starts(space, blocks, start_seeds)
        pushes = PushStartSet(
            q=q,
            blocks=blocks,
            block=replace(block, pose=Pose((x, y, z), (qw, qx, qy, qz))),
            line=region.line,
            scale=region.scale,
            ground=ground,
            tried=tried,
            accepted=len(starts),
            behind=behind,
            across=across,
            **no_obstacles(len(q)),
            **identity,
        )
        if not obstacles:
            return pushes
        return with_obstacles(pushes, space.scene, config, obstacle_seeds, feasible_starts)

    def certify(self, goals: PushStartSet, robot: Robot, scene: Scene) -> list[str]:
        """Test that every block can be pushed across the line, by the configurations of the set.

        Tool positions are computed by MuJoCo, not by our kinematics, which found the certificates.
        """
        n = len(goals.blocks)
        configurations = {
            "start": goals.q,
            "proof behind": goals.behind,
            "proof across": goals.across,
        }
        arrays = [*configurations.values(), goals.blocks]
        if [array.shape for array in arrays] != [*[(n, robot.dof)] * 3, (n, 7)]:
            shapes = ", ".join(str(array.shape) for array in arrays)
            return [
                f"arrays {shapes} are not starts of robot {robot.name!r} with {robot.dof} joints"
            ]
        if not all(np.isfinite(array).all() for array in arrays):
            return ["not all numbers are finite"]
        faults = layout_faults(goals, robot, scene, feasible_starts, block=goals.block)
        for name, q in configurations.items():
            faults += [f"start {i}: {name}: {reason}" for i, reason in outside_limits(robot, q)]
        space = FreeSpace(replace(scene, robot=robot, object=goals.block, obstacles=()))
        return [*faults, *start_faults(goals, space)]

    def scene(self, robot: Robot, goals: PushStartSet, ground: float) -> Scene:
        """Return the scene with the block."""
        return Scene(robot, object=goals.block, obstacles=goals.obstacles, ground=ground)

    def make_envs(
        self, specs: Sequence[EnvSpec], env_spec_index: torch.Tensor, num_joints: int
    ) -> PushEnvs:
        """Make the environments of a batch that push."""
        from morphgen.tasks.push.envs import PushEnvs

        return PushEnvs(specs, env_spec_index, num_joints)

    def markers(self, config: PushConfig, goals: PushStartSet) -> tuple[Marker, ...]:
        """Return a strip on the ground, longer than the starts of the block are spread."""
        length = float(np.ptp(goals.blocks[:, 0])) + 4 * max(goals.block.size)
        return (Marker("line", "box", (length, _LINE_WIDTH, _LINE_HEIGHT)),)

    def points_in_view(self, goals: PushStartSet) -> NDArray[np.float64]:
        """Return corners of the block at its starts, and where it has crossed the line."""
        across = goals.blocks[:, :3].copy()
        across[:, 1] = goals.line
        half = np.array(goals.block.size) / 2
        centres = np.concatenate([goals.blocks[:, :3], across])
        return (centres[:, None] + box_corners(-half, half)).reshape(-1, 3)


PUSH = Push()
