"""The task push."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.model.geometry import Pose
from morphgen.model.inertia import box_corners
from morphgen.model.robot import Robot
from morphgen.tasks.configs import PushConfig
from morphgen.tasks.free_space import FreeSpace, outside_limits
from morphgen.tasks.push.starts import (
    FeasibilityTest,
    PushStartSet,
    draw_feasible,
    draw_starts,
    feasible_starts,
    push_region,
    start_faults,
)
from morphgen.tasks.scenes.obstacles import layout_faults, no_obstacles, with_obstacles
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.task import LINE, OBJECT, EnvSpec, Marker, ObjectTask

if TYPE_CHECKING:
    import torch

    from morphgen.tasks.push.envs import PushEnvs

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
