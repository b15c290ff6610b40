"""Push sets: places of a block from which a robot can push it, each with its proof."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

from morphgen.benchmark.split import robot_hash
from morphgen.errors import TaskError
from morphgen.model.geometry import Pose
from morphgen.model.robot import Robot
from morphgen.tasks.config import PushConfig
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.push_proofs import Prover
from morphgen.tasks.push_region import Region, push_region
from morphgen.tasks.push_ways import clear_obstacles, draw_places
from morphgen.tasks.set_files import cached, require_own
from morphgen.tasks.sim.base import Block, Scene

Array = NDArray[np.float64]

FORMAT = 2
"""Of a stored set; a change of how sets are drawn needs another."""
TRIES = 30
"""Places of the block tried for each start that is needed, before giving up."""

_CHUNK = 32
_CONFIGURATIONS = 1000


@dataclass(frozen=True, eq=False)
class PushSet:
    """Starts of a robot's episodes of push, and the block and obstacles that they share."""

    robot: str
    key: str
    """Hash of all that the set follows from: 64 hexadecimal digits."""
    q: Array
    """Free configurations at the start, shape (S, dof), rad or m."""
    blocks: Array
    """Poses of the block then in the world: (x, y, z, qw, qx, qy, qz), shape (S, 7)."""
    block: Block
    """A cube; its own pose is that of the first start."""
    line: float
    """y that the block's centre must cross, metres."""
    scale: float
    """1, or less for bodies that reach under 0.4 m."""
    ground: float
    """Height of the ground, metres."""
    obstacles: tuple[Block, ...]
    tried: int
    """Places of the block that were tested."""
    accepted: int
    """How many of these are proven: S."""
    seed: int
    behind: Array
    """Proofs: free configurations with the tool behind the block, at its height, (S, dof)."""
    across: Array
    """Proofs: the same with the tool on the line, where the block's centre is to cross it."""


def push_set(
    robot: Robot,
    config: PushConfig,
    *,
    obstacles: bool,
    seed: int,
    ground: float = 0.0,
    cache: Path | None = None,
    shipped: PushSet | None = None,
) -> PushSet:
    """A robot's push set, from the cache or made and kept there.

    Blocks stand on the ground where ``push_region`` has them, turned at random. A place counts if
    nothing that stands still, obstacle or base, is on the straight way along y across the line,
    and if there are free configurations with the tool behind the block and with the tool on the
    line, both at the height of the block. Configurations at the start are drawn uniformly within
    the joint limits; what collides, also with the block, is drawn again. The same body, pairs to
    ignore, seed, ground and what ``config`` says of places and obstacles give the same set,
    whatever the robot is called; fewer starts are the first of more.

    Args:
        robot: The body, with a tool.
        config: How many starts, where, and what obstacles.
        obstacles: Whether there are any.
        seed: Of all that is drawn, at least 0.
        ground: Height of the ground in the root frame, metres.
        cache: Folder of stored sets; by default ``pushes`` in the user's cache.
        shipped: The set to take, which must be of all this.

    Raises:
        TaskError: If the numbers are none, the robot cannot push, too few of the places tried can
            be proven, obstacles stand in the way whatever is drawn, the set's file is broken, or
            the one that is shipped is another.
        BenchmarkError: If the robot has no tool that moves, or hardly a free configuration.
        MeshError: If a mesh cannot be read.
    """
    _require(config, seed)
    body = robot_hash(robot, visuals=False)
    key = _key(robot, body, config, obstacles, seed, ground)
    if shipped is not None:
        require_own(shipped, key, robot.name)
        return shipped
    folder = user_cache_path("morphgen") / "pushes-3" if cache is None else cache
    make = partial(_made, robot, body, config, obstacles, seed, ground)
    return cached(PushSet, folder / f"{key}.npz", robot.name, make)


def _require(config: PushConfig, seed: int) -> None:
    low, high = config.block_size
    if seed < 0 or config.starts < 1:
        raise TaskError(
            f"{config.starts} starts with seed {seed}: at least one start, and no negative seed"
        )
    if config.curriculum_steps < 1:
        raise TaskError(f"a curriculum of {config.curriculum_steps} steps: expected 1 or more")
    nearest_line = config.line * min(1.0, config.curriculum_start)
    if not (0 < low <= high < np.inf and config.start < nearest_line and config.start_depth >= 0):
        raise TaskError(
            f"a block of {low:g} to {high:g} that starts {config.start_depth:g} below "
            f"{config.start:g} and is to cross {config.line:g}: sizes are positive, and it starts "
            "before the line"
        )


def _made(
    robot: Robot,
    body: str,
    config: PushConfig,
    obstacles: bool,
    seed: int,
    ground: float,
    key: str,
) -> PushSet:
    seeds = np.random.SeedSequence([seed, int(body, 16), int(obstacles)])
    of_region, of_proofs, of_places, of_starts, of_obstacles = seeds.spawn(5)
    region = push_region(robot, config, ground, np.random.default_rng(of_region))
    edge = region.edge
    block = Block((edge, edge, edge), mass=config.block_mass, friction=config.friction)
    placed: tuple[Block, ...] = ()
    if obstacles:
        placed = clear_obstacles(robot, config, region, block, ground, of_obstacles)
    space = FreeSpace(Scene(robot, block=block, obstacles=placed, ground=ground))
    prover = Prover(space, region, np.random.default_rng(of_proofs))
    kept, tried = _proven(robot, config.starts, region, prover, ground, of_places)
    places = np.array([each[0] for each in kept])
    return PushSet(
        robot=robot.name,
        key=key,
        q=_starts(space, places, of_starts),
        blocks=places,
        block=_standing(block, places),
        line=region.line,
        scale=region.scale,
        ground=ground,
        obstacles=placed,
        tried=tried,
        accepted=len(kept),
        seed=seed,
        behind=np.array([each[1] for each in kept]),
        across=np.array([each[2] for each in kept]),
    )


def _proven(
    robot: Robot,
    wanted: int,
    region: Region,
    prover: Prover,
    ground: float,
    seeds: np.random.SeedSequence,
) -> tuple[list[tuple[Array, Array, Array]], int]:
    """Places of the block with their proofs, and how many were tried."""
    rng = np.random.default_rng(seeds)
    kept: list[tuple[Array, Array, Array]] = []
    refused: Counter[str] = Counter()
    tried = 0
    while tried < TRIES * wanted:
        blocks = draw_places(region, ground, _CHUNK, rng)
        found = prover.prove(blocks)
        for place, room, behind, across in zip(
            blocks, found.room, found.behind, found.across, strict=True
        ):
            tried += 1
            if not room:
                refused["something stands in the block's way"] += 1
            elif not np.isfinite(across).all():
                refused["the tool does not get to the line at its height"] += 1
            elif not np.isfinite(behind).all():
                refused["the tool does not get behind it"] += 1
            else:
                kept.append((place, behind, across))
            if len(kept) == wanted:
                return kept, tried
    reasons = ", ".join(f"{why} ({times / tried:.0%})" for why, times in refused.most_common())
    raise TaskError(
        f"robot {robot.name!r} can hardly push: only {len(kept)} of {tried:,} places of a block of "
        f"{region.edge:.3g} m with x in ({region.x[0]:.3g}, {region.x[1]:.3g}) and y in "
        f"({region.y[0]:.3g}, {region.y[1]:.3g}) are proven (acceptance rate "
        f"{len(kept) / tried:.2g}), {wanted} are needed; {reasons}"
    )


def _starts(space: FreeSpace, blocks: Array, seeds: np.random.SeedSequence) -> Array:
    """A free configuration for each block, shape (n, dof); they do not depend on n."""
    found = []
    for block, child in zip(blocks, seeds.spawn(len(blocks)), strict=True):
        rng = np.random.default_rng(child)
        for _ in range(_CONFIGURATIONS):
            q, _ = space.draw(1, rng)
            if space.free(q, block[None])[0]:
                found.append(q[0])
                break
        else:
            raise TaskError(
                f"robot {space.scene.robot.name!r}: {_CONFIGURATIONS} free configurations all "
                f"penetrate the block at ({block[0]:.3g}, {block[1]:.3g}, {block[2]:.3g})"
            )
    return np.array(found)


def _standing(block: Block, places: Array) -> Block:
    """The block where it is first."""
    x, y, z, *quaternion = places[0].tolist()
    return replace(block, pose=Pose((x, y, z), tuple(quaternion)))


def _key(
    robot: Robot, body: str, config: PushConfig, obstacles: bool, seed: int, ground: float
) -> str:
    index = robot.link_index
    ignored = sorted(sorted((index[a], index[b])) for a, b in robot.ignore_pairs)
    boxes = [config.obstacles, *map(float, config.obstacle_size)] if obstacles else None
    ranges = [*config.block_size, *config.arm_x, *config.free_x]
    numbers = [config.line, config.start, config.start_depth, config.block_mass, config.friction]
    places = [*map(float, ranges), *map(float, numbers)]
    parts = [FORMAT, body, ignored, config.starts, places, boxes, seed, float(ground)]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
