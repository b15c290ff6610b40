"""The task reach and its goal sets: tool poses, each with a configuration that reaches it.

The configurations are also the starts of episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.encoding.similarity import shoulder
from morphgen.errors import NoGoalsError
from morphgen.formats.mjcf.write import MujocoKinematics
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import frame_pose
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.free_space import (
    FreeSpace,
    cspace_components,
    in_other_component,
    outside_limits,
)
from morphgen.tasks.scenes.obstacles import layout_faults, no_obstacles, with_obstacles
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.task import GOAL, EnvSpec, GoalSet, Marker, Task
from morphgen.typing import Array

if TYPE_CHECKING:
    import torch

    from morphgen.tasks.reach.envs import ReachEnvs


EXACT = 1e-6
"""Tolerance between a goal and the tool pose of its configuration [m, and of quaternions]."""


@dataclass(frozen=True, eq=False)
class ReachGoalSet(GoalSet):
    """Goals of a robot, which are also its starts, and its obstacles; see ``GoalSet``."""

    robot: str
    key: str
    q: Array
    """Configurations in the main component of C-space, shape (G, dof) [rad or m]: free without
    obstacles."""
    poses: Array
    """Tool poses of the configurations in the root frame: (x, y, z, qw, qx, qy, qz), qw >= 0,
    shape (G, 7)."""
    obstacles: tuple[Block, ...]
    layouts: Array
    usable: NDArray[np.bool_]  # which configurations are free in each layout, shape (L, G)
    tried: int
    accepted: int
    seed: int

    @property
    def goal_poses(self) -> Array:
        """Poses of the tool, shape (G, 7)."""
        return self.poses


def _pose_rows(T: Array) -> Array:
    """Return poses (n, 4, 4) as (x, y, z, qw, qx, qy, qz), shape (n, 7)."""
    poses = [Pose.from_matrix(matrix) for matrix in T]
    return np.array([[*pose.position, *pose.quaternion] for pose in poses]).reshape(len(T), 7)


def _free_goals(goals: ReachGoalSet, space: FreeSpace) -> NDArray[np.bool_]:
    """Return where a goal is free; those that are not finite are faults already."""
    free = np.ones(len(goals.q), dtype=np.bool_)
    rows = np.flatnonzero(np.isfinite(goals.q).all(axis=1))
    free[rows] = space.free(goals.q[rows])
    return free


MAX_DISTANCE = 3.0
"""Bound on the distance between tool and goal in reaches: each is within one, and a reach is an
estimate."""
_ROUNDING = 1e-6  # rounding of a distance that is computed with single precision [m]


class Reach(Task[ReachConfig, ReachGoalSet]):
    """Bring the tool to a goal and keep it there, within 6 s."""

    name = "reach"
    config_type = ReachConfig
    goal_set_type = ReachGoalSet
    num_targets = 1
    goal_format = 5
    cache_folder = "goals-5"
    fields = (GOAL,)
    discrete_actions = True

    def check(self, robot: Robot, config: ReachConfig) -> None:
        """Refuse a robot whose tool does not move."""
        shoulder(robot)

    def sample(
        self,
        robot: Robot,
        config: ReachConfig,
        *,
        obstacles: bool,
        ground: float,
        seeds: np.random.SeedSequence,
        identity: Mapping[str, Any],
    ) -> ReachGoalSet:
        """Sample free configurations, whose tool poses are the goals; see ``Task.sample``.

        Configurations are uniform within the joint limits. Those that collide, with the ground,
        too, and those outside of the main component of free C-space are drawn again.
        Obstacles do not matter: each of their layouts leaves some of the configurations free.
        """
        goals_seeds, obstacle_seeds = seeds.spawn(2)
        goals_rng = np.random.default_rng(goals_seeds)
        space = FreeSpace(Scene(robot, ground=ground))
        planes = cspace_components(robot)
        q, tried = space.sample(
            config.num_goals, goals_rng, lambda q: not in_other_component(planes, q).any()
        )
        poses = _pose_rows(frame_pose(robot, q, TOOL))
        moved = float(np.linalg.norm(poses[:, :3] - poses[0, :3], axis=1).max())
        if moved <= config.near and len(poses) > 1:
            raise NoGoalsError(
                f"robot {robot.name!r} cannot reach: over {len(poses)} configurations its tool "
                f"moves {moved:.2g} m, and a goal is reached within {config.near:g} m; place the "
                f"frame {TOOL!r} at the working point"
            )
        bare = no_obstacles(len(q))
        goals = ReachGoalSet(q=q, poses=poses, tried=tried, accepted=len(q), **bare, **identity)
        if not obstacles:
            return goals
        return with_obstacles(goals, space.scene, config, obstacle_seeds, _free_goals)

    def certify(self, goals: ReachGoalSet, robot: Robot, scene: Scene) -> list[str]:
        """Test that every goal is reachable.

        Tool poses are computed by MuJoCo, not by our kinematics, which the goals were made with.
        """
        if goals.q.shape != (len(goals.poses), robot.dof) or goals.poses.shape[1:] != (7,):
            return [
                f"configurations {goals.q.shape} and poses {goals.poses.shape} are not goals of "
                f"robot {robot.name!r} with {robot.dof} joints"
            ]
        faults = [f"goal {i}: {why}" for i, why in outside_limits(robot, goals.q)]
        rows = np.flatnonzero(np.isfinite(goals.q).all(axis=1))
        faults += layout_faults(goals, robot, scene, _free_goals)
        free = _free_goals(goals, FreeSpace(replace(scene, robot=robot, obstacles=())))
        blocked = np.flatnonzero(~free).tolist()
        faults += [f"goal {i}: its configuration is in collision" for i in blocked]
        planes = cspace_components(robot)
        for i in rows[free[rows]].tolist():
            for k in np.flatnonzero(in_other_component(planes, goals.q[i])).tolist():
                a, b = planes[k].pairs[0]
                faults.append(f"goal {i}: {a!r} and {b!r} touch on every path to most others")
        tools = _pose_rows(MujocoKinematics(robot).frame_pose(goals.q[rows]))
        for i, tool in zip(rows.tolist(), tools, strict=True):
            pose = goals.poses[i]
            distance = float(np.linalg.norm(pose[:3] - tool[:3]))
            # A quaternion and its negative are the same rotation.
            rotation = min(float(np.linalg.norm(pose[3:] - sign * tool[3:])) for sign in (1, -1))
            if not (distance <= EXACT and rotation <= EXACT):
                faults.append(
                    f"goal {i}: the tool of its configuration is {distance:.2g} m away, and its "
                    f"quaternion {rotation:.2g}"
                )
        return faults

    def make_envs(
        self, specs: Sequence[EnvSpec], env_spec_index: torch.Tensor, num_joints: int
    ) -> ReachEnvs:
        """Make the environments of a batch that reach."""
        from morphgen.tasks.reach.envs import ReachEnvs

        return ReachEnvs(specs, env_spec_index, num_joints)

    def score_range(self, config: ReachConfig, reach: float) -> tuple[float, float]:
        """Return the score at the farthest distance from a goal, and the score near it."""
        return -config.score_square * (MAX_DISTANCE * reach) ** 2, config.score_near

    def outcome_fault(
        self, config: ReachConfig, success: bool, score: float, distance: float
    ) -> str:
        """Compare success with the final distance."""
        if success and distance > config.near + _ROUNDING:
            return f"success at a distance of {distance:g} m; a success is within {config.near:g} m"
        if not success and config.goal == "position" and distance < config.near - _ROUNDING:
            return f"no success at a distance of {distance:g} m, which is within {config.near:g} m"
        return ""

    def markers(self, config: ReachConfig, goals: ReachGoalSet) -> tuple[Marker, ...]:
        """Return a ball with the radius of success, and axes of the goal pose."""
        return (Marker("goal", "frame", (2 * config.near,) * 3),)


REACH = Reach()
