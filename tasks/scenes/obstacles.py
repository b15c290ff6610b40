"""Obstacles: boxes in a robot's workspace, whose layouts vary over episodes.

The sizes of a robot's boxes are fixed. A layout is a pose for each of them, such that the robot has
room to move; see ``draw_layouts``. Training draws its episodes from some layouts, evaluation from
others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from morphgen.encoding.similarity import tool_reach
from morphgen.errors import BenchmarkError, TaskError
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import frame_pose
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.task import GoalSet, TaskConfig
from morphgen.typing import Array

LayoutSide = Literal["train", "eval"]
"""Layouts that episodes draw from: those of training, or those of evaluation."""
G = TypeVar("G", bound=GoalSet)
Usable = Callable[[FreeSpace], NDArray[np.bool_]]
"""Function that returns which goals a scene leaves possible, shape (G,)."""
UsableOf = Callable[[G, FreeSpace], NDArray[np.bool_]]
"""Function that returns which goals of a set a scene leaves possible, shape (G,)."""

KEPT = 0.5  # fraction of otherwise free configurations that a layout must leave free
PROBES = 128  # number of free configurations that test it
CANDIDATES = 16  # number of random poses of a box before its layout is drawn anew
ATTEMPTS = 16  # number of times that a layout is drawn before giving up
KEPT_GOALS = 0.25
"""Fraction of the first ``FIRST_GOALS`` goals of a set that a layout must leave possible."""
FIRST_GOALS = 20
"""Only these goals decide about a layout, so that a larger set has the same layouts."""

_AWAY = Pose((0.0, 0.0, -1e4))
"""Pose of boxes without one: far below everything; ``FreeSpace`` keeps its block far above."""


def no_obstacles(num_goals: int) -> dict[str, Any]:
    """Return the fields of a goal set without obstacles that ``with_obstacles`` fills."""
    usable = np.zeros((0, num_goals), dtype=np.bool_)
    return {"obstacles": (), "layouts": np.zeros((0, 0, 7)), "usable": usable}


def with_obstacles(
    goals: G, scene: Scene, config: TaskConfig, seeds: np.random.SeedSequence, usable: UsableOf[G]
) -> G:
    """Return a robot's goal set with obstacles, whose layouts leave some of the goals possible."""
    size_seeds, layout_seeds = seeds.spawn(2)  # more boxes change no random number of layouts
    rng = np.random.default_rng(size_seeds)
    boxes = draw_boxes(scene.robot, config.obstacles, config.obstacle_size, rng)
    space = FreeSpace(replace(scene, obstacles=boxes))
    counts = (config.train_layouts, config.eval_layouts)
    layouts, possible = draw_layouts(space, counts, layout_seeds, partial(usable, goals))
    placed = place_boxes(boxes, layouts[0])
    return replace(goals, obstacles=placed, layouts=layouts, usable=possible)


def draw_boxes(
    robot: Robot, count: int, size: tuple[float, float], rng: np.random.Generator
) -> tuple[Block, ...]:
    """Draw the sizes of a robot's obstacles.

    Edges are uniform in ``size`` times the reach, the largest distance of the tool from the robot's
    shoulder (``workspace``), which depends neither on a pedestal nor on the position of a rail.
    """
    low, high = size
    if count < 1:
        raise BenchmarkError(f"{count} obstacles: expected at least one")
    _, reach = tool_reach(robot)
    edges = (rng.uniform(low, high, (count, 3)) * reach).tolist()
    return tuple(Block((a, b, c)) for a, b, c in edges)


def draw_layouts(
    space: FreeSpace, counts: tuple[int, int], seeds: np.random.SeedSequence, usable: Usable
) -> tuple[Array, NDArray[np.bool_]]:
    """Draw poses of a robot's obstacles around positions of its tool.

    Each box is centred on the tool at a random free configuration and turned about the vertical at
    random; one that would cut the ground rests on it. Poses are accepted in the order in which they
    are drawn, unless the robot with its base touches the box at home, or the boxes so far leave
    less than ``KEPT`` of the free configurations. A layout is accepted if it leaves ``KEPT_GOALS``
    of the goals. Boxes may overlap. Fewer layouts of a kind are the beginning of more.

    Return poses in the world of L layouts of O boxes, those for training first, (L, O, 7), in
    single precision, as simulators have them; and which goals they leave possible, (L, G).
    """
    probe_seeds, *side_seeds = seeds.spawn(3)
    plain = FreeSpace(replace(space.scene, obstacles=(), object=None))
    probes, _ = plain.sample(PROBES, np.random.default_rng(probe_seeds))
    layouts, masks = [], []
    for side, count in zip(side_seeds, counts, strict=True):
        for child in side.spawn(count):
            layout, mask = _draw_layout(space, plain, probes, np.random.default_rng(child), usable)
            layouts.append(layout)
            masks.append(mask)
    space.place_obstacles(poses_of(layouts[0]))
    return np.array(layouts), np.array(masks)


def _draw_layout(
    space: FreeSpace, plain: FreeSpace, probes: Array, rng: np.random.Generator, usable: Usable
) -> tuple[Array, NDArray[np.bool_]]:
    """Draw one layout, shape (O, 7), and which goals it leaves possible, shape (G,)."""
    most = 0
    for _ in range(ATTEMPTS):
        layout = _draw_poses(space, plain, probes, rng)
        if layout is None:
            continue
        space.place_obstacles(poses_of(layout))
        mask = usable(space)
        count = int(mask[:FIRST_GOALS].sum())
        if count >= fewest_goals(len(mask)):
            return layout, mask
        most = max(most, count)
    raise BenchmarkError(
        f"robot {space.scene.robot.name!r}: each of {ATTEMPTS} random layouts of "
        f"{len(space.scene.obstacles)} obstacles touches it at home, or leaves less than "
        f"{KEPT:.0%} of its free configurations, or of its first {FIRST_GOALS} goals only {most} "
        "or fewer: take fewer or smaller obstacles"
    )


def fewest_goals(num_goals: int) -> int:
    """Return how many of the first goals of a set a layout must leave possible, 2 or more."""
    return min(num_goals, max(2, math.ceil(KEPT_GOALS * min(num_goals, FIRST_GOALS))))


def _draw_poses(
    space: FreeSpace, plain: FreeSpace, probes: Array, rng: np.random.Generator
) -> Array | None:
    """Draw poses of all boxes, shape (O, 7); None if a box has none among ``CANDIDATES``."""
    robot, ground = space.scene.robot, space.scene.ground
    boxes = space.scene.obstacles
    poses = [_AWAY] * len(boxes)
    for i, box in enumerate(boxes):
        q, _ = plain.sample(CANDIDATES, rng)
        tools = frame_pose(robot, q, TOOL)[:, :3, 3].tolist()
        turns = rng.uniform(-math.pi, math.pi, CANDIDATES).tolist()
        for tool, turn in zip(tools, turns, strict=True):
            poses[i] = _box_pose(tool, box, turn, ground)
            space.place_obstacles(poses)
            if space.obstacle_hits([robot.home])[0, i]:
                continue
            left = probes[space.free(probes)]
            if len(left) >= KEPT * PROBES:
                probes = left  # the next box may block only what this one leaves
                break
        else:
            return None
    return np.array([[*pose.position, *pose.quaternion] for pose in poses])


def _box_pose(centre: list[float], box: Block, turn: float, ground: float | None) -> Pose:
    """Return the pose of a box at a point, or on the ground above it, in single precision."""
    x, y, z = centre
    if ground is not None:
        z = max(z, ground + box.size[2] / 2)
    row = [x, y, z, math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]
    return poses_of(np.array([row], dtype=np.float32))[0]


def poses_of(layout: NDArray[np.floating]) -> list[Pose]:
    """Return the poses of a layout, shape (O, 7)."""
    return [Pose((x, y, z), (w, a, b, c)) for x, y, z, w, a, b, c in layout.tolist()]


def place_boxes(boxes: Sequence[Block], layout: NDArray[np.floating]) -> tuple[Block, ...]:
    """Return boxes at the poses of a layout, shape (O, 7)."""
    placed = zip(boxes, poses_of(layout), strict=True)
    return tuple(replace(box, pose=pose) for box, pose in placed)


def layouts_of(config: TaskConfig, side: LayoutSide) -> range:
    """Return the indices of the layouts of a goal set that episodes draw from."""
    ranges = {
        "train": range(config.train_layouts),
        "eval": range(config.train_layouts, config.train_layouts + config.eval_layouts),
    }
    if side not in ranges:
        raise TaskError(f"unknown layouts {side!r}; valid: {', '.join(ranges)}")
    return ranges[side]


def layout_faults(
    goals: G, robot: Robot, scene: Scene, usable: UsableOf[G], *, block: Block | None = None
) -> list[str]:
    """Return the faults of a set's layouts, a line each.

    They are other obstacles than those of the scene; arrays of a wrong shape; a box that touches
    the robot at home; a goal that its layout does not leave possible; too few goals.
    """
    if scene.obstacles != goals.obstacles:
        return ["the obstacles of the scene are not those of the goal set"]
    shape = (len(goals.layouts), len(goals.obstacles), 7)
    if goals.layouts.shape != shape or goals.usable.shape != (shape[0], len(goals.q)):
        return [
            f"layouts of shape {goals.layouts.shape} and goals that they leave possible of shape "
            f"{goals.usable.shape} are not those of {shape[1]} obstacles and {len(goals.q)} goals"
        ]
    if not goals.obstacles:
        return []
    if not shape[0] or place_boxes(goals.obstacles, goals.layouts[0]) != goals.obstacles:
        return ["the obstacles are not at the poses of the first layout"]
    faults = []
    space = FreeSpace(replace(scene, robot=robot, object=block))
    for k, layout in enumerate(goals.layouts):
        space.place_obstacles(poses_of(layout))
        if space.obstacle_hits([robot.home]).any():
            faults.append(f"layout {k}: the robot at home is in collision")
        blocked = goals.usable[k] & ~usable(goals, space)
        faults += [f"layout {k}: goal {i} is blocked" for i in np.flatnonzero(blocked).tolist()]
        if goals.usable[k].sum() < fewest_goals(len(goals.q)):
            faults.append(f"layout {k}: it leaves {goals.usable[k].sum()} goals, too few")
    return faults
