"""A batch of robots at their tasks: actions, physics, rewards and new episodes, in torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from morphgen.errors import DivergedError, TaskError
from morphgen.model.kinematics_torch import FramePositions, frame_pose
from morphgen.tasks.actions import ActionKind, JointTargets, decode_actions
from morphgen.tasks.episode_layouts import EpisodeLayouts
from morphgen.tasks.kinematic_channels import KinematicChannels
from morphgen.tasks.observation import (
    LinkTokens,
    Observation,
    ObservationConfig,
    PointClouds,
    joint_to_link,
    tree_entries,
)
from morphgen.tasks.obstacles import LayoutSide
from morphgen.tasks.random_streams import random_streams
from morphgen.tasks.robot_tables import RobotTables
from morphgen.tasks.rows import limit_violation, row_sums
from morphgen.tasks.sim.base import CONTROL_PERIOD, Simulation
from morphgen.tasks.step_result import TaskState
from morphgen.tasks.straight_paths import StraightPaths
from morphgen.tasks.task import OBJECT, EnvSpec
from morphgen.tasks.task_groups import BatchResult, TaskGroups


@dataclass(frozen=True, eq=False)
class Step:
    """Result of a control step; where an episode ended, the next one has begun.

    The caller owns all tensors: the batch does not use them again.
    """

    observation: Observation
    """Observation after the action, or at the start of the next episode where one ended."""
    reward: torch.Tensor
    """Sum of the reward terms, shape (n,)."""
    terminated: torch.Tensor
    """Whether the task ended the episode, shape (n,), bool."""
    truncated: torch.Tensor
    """Whether the time limit or a diverged simulation ended the episode, shape (n,), bool."""
    diverged: torch.Tensor
    """Whether the simulation diverged, shape (n,), bool. The step is then undone and the episode
    truncated."""
    final_observation: Observation
    """Observation after the action, also where an episode ended: to bootstrap the value there."""
    success: torch.Tensor
    """Whether the task is fulfilled now, shape (n,), bool; never where a simulation diverged."""
    distance: torch.Tensor
    """Distance from success, such as between tool and goal, shape (n,) [m]."""
    score: torch.Tensor
    """Score of the step, shape (n,); see ``Task.episode_score``."""
    terms: dict[str, torch.Tensor]
    """Reward terms by name, each of shape (n,); zero where the task has no such term."""
    q: torch.Tensor
    """Joint positions after the action, also where an episode ended, shape (n, J) [rad or m]."""
    block_pose: torch.Tensor
    """Poses of the blocks after the action, also where an episode ended, shape (n, 7)."""
    angle: torch.Tensor | None = None
    """Angle from success, such as between tool and goal, shape (n,) [rad]; nan where the task wants
    no orientation, None if no task wants one."""


class TaskBatch:
    """Environments; each has a robot at a task, and its own stream of random numbers.

    Robots stand at the origin of the world. The tensors of targets, actions, velocities and episode
    steps are updated in place, so that NumPy views of them stay valid.

    Attributes:
        robot_tables: The robots as tensors.
        specs: Specification of the environments of each robot.
        env_robot_index: Index of each environment's robot and specification, shape (n,), int64.
        simulation: Simulation of the environments.
        groups: The environments grouped by task.
        action_kind: ``continuous`` or ``discrete``.
        action_mask: Links whose joint obeys actions, shape (n, L), bool.
        max_episode_steps: Time limit of episodes, shape (n,) [control steps].
        episode_step: Control steps since the episode began, shape (n,), int64.
        targets: Targets of the independent joints, shape (n, J) [rad or m].
        previous_action: Normalized actions of the last step, shape (n, L); 0 in a new episode.
        layouts: Layouts of the obstacles in the running episodes.
        previous_qd: Velocities of the independent joints after the last step, shape (n, J).
        observation_config: Optional entries of observations.
        device: Device of all tensors.
    """

    def __init__(
        self,
        robot_tables: RobotTables,
        specs: Sequence[EnvSpec],
        env_robot_index: Sequence[int],
        simulation: Simulation,
        *,
        kind: ActionKind = "continuous",
        observe: ObservationConfig | None = None,
        seed: int = 0,
        first: int = 0,
        layouts: LayoutSide = "train",
    ) -> None:
        """Gather the tables of all environments; ``reset`` begins the episodes.

        Args:
            robot_tables: The robots.
            specs: Specification of the environments of each robot.
            env_robot_index: Index of each environment's robot and specification.
            simulation: Simulation of the environments, with the scenes of their specifications.
            kind: Kind of the actions.
            observe: Optional entries of observations.
            seed: Seed of all episodes.
            first: Number of the first environment. An environment's episodes depend on its number
                and the seed only, whatever batch it is in.
            layouts: Layouts of obstacles that episodes draw from: those of training or of
                evaluation.

        Raises:
            TaskError: If a task is unknown, has different constants, or too few goals of a robot.
        """
        self.robot_tables, self.specs, self.action_kind = robot_tables, tuple(specs), kind
        self.simulation, self.device = simulation, robot_tables.device
        device, n = self.device, len(env_robot_index)
        self.env_robot_index = index = torch.tensor(list(env_robot_index), device=device)
        self.groups = TaskGroups(self.specs, index, robot_tables.max_joints)
        self.action_mask = torch.where(
            self.groups.moves_fingers[:, None],
            robot_tables.action_mask(fingers=True)[index],
            robot_tables.action_mask(fingers=False)[index],
        )
        self.max_episode_steps = self.groups.max_episode_steps
        self.targets = torch.zeros(n, robot_tables.max_joints, device=device)
        self.episode_step = torch.zeros(n, dtype=torch.int64, device=device)
        self._env_numbers = range(first, first + n)
        self._streams = random_streams(seed, self._env_numbers)
        # Simulated joints are padded to the largest robot of the simulation, tables perhaps to more
        self._num_sim_joints = simulation.q.shape[1]
        self.previous_qd = torch.zeros(n, robot_tables.max_joints, device=device)
        self.previous_action = torch.zeros(n, robot_tables.max_links, device=device)
        self._lower, self._upper = robot_tables.lower[index], robot_tables.upper[index]
        self.observation_config = observe or ObservationConfig()
        self.layouts = EpisodeLayouts(self.specs, index, layouts, self.observation_config)
        self._tokens = LinkTokens(robot_tables, index)
        self._tool_positions = FramePositions(robot_tables.tool_chain, index)
        self._joint_targets = JointTargets(robot_tables, index, self.action_mask)
        scenes = [self.specs[i].scene for i in env_robot_index]
        self._constant_entries = {
            "links": robot_tables.link_mask[index],
            "actions": self.action_mask,
            **self.groups.masks,
            **self.layouts.entries,
        }
        if self.observation_config.tree:
            self._constant_entries |= tree_entries(
                robot_tables, index, self.action_mask, self.observation_config.tree_joints
            )
        self._kinematics: KinematicChannels | None = None
        if names := self.observation_config.kinematic_channels:
            has_block = torch.tensor([scene.block is not None for scene in scenes], device=device)
            paths = StraightPaths(self.layouts, index)
            self._kinematics = KinematicChannels(
                robot_tables, index, names, has_block=has_block, first_free=paths
            )
        self._points: PointClouds | None = None
        if self.observation_config.points:
            self._points = PointClouds(scenes, self.observation_config.points, device)
            self._constant_entries["point_mask"] = self._points.mask

    @property
    def num_envs(self) -> int:
        """Number of environments, n."""
        return len(self.env_robot_index)

    @property
    def q(self) -> torch.Tensor:
        """Positions of the independent joints, shape (n, J) [rad or m]; a copy."""
        return self._q.clone()

    def task_mask(self, task: str) -> torch.Tensor:
        """Return which environments are at a task, shape (n,), bool."""
        return self.groups.task_mask(task)

    def field(self, name: str) -> torch.Tensor:
        """Return the current value of an observation field of the tasks, shape (n, size)."""
        return self.groups.fields(self.simulation.block_pose)[name]

    def reset(self, seed: int | None = None, *, spread: bool = False) -> Observation:
        """Begin an episode in every environment.

        Args:
            seed: Seed of all episodes from now on; by default the random streams continue.
            spread: Whether these first episodes begin at random fractions of their time limit, so
                that they do not all end at the same step; for learners.
        """
        if seed is not None:
            self._streams = random_streams(seed, self._env_numbers)
        self._begin(torch.arange(self.num_envs, device=self.device))
        if spread:
            fractions = [stream.random() for stream in self._streams["random"]]
            fraction = torch.tensor(fractions, device=self.device)
            self.episode_step.copy_(fraction * self.max_episode_steps)
        return self.observe()

    def step(self, actions: torch.Tensor) -> Step:
        """Act for one control step.

        Args:
            actions: Shape (n, L); continuous: in [-1, 1], clipped; discrete: indices of ``BINS``.

        Raises:
            TaskError: If the actions are invalid.
            SimulationError: If the simulator failed.
        """
        self._act(actions)
        diverged = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        diverged[self._simulate()] = True
        self.episode_step += 1
        result = self._evaluate(diverged)
        timed_out = self.episode_step >= self.max_episode_steps
        truncated = (timed_out | diverged) & ~result.terminated
        final_observation = self.observe()
        q, block_pose = self.q, self.simulation.block_pose.clone()
        ended = torch.nonzero(truncated | result.terminated)[:, 0]
        if len(ended):
            self._begin(ended)
            observation = self.observe()
        else:
            observation = _copied(final_observation)
        return Step(
            observation=observation,
            reward=result.reward,
            terminated=result.terminated,
            truncated=truncated,
            diverged=diverged,
            final_observation=final_observation,
            success=result.success,
            distance=result.distance,
            score=result.score,
            terms=result.terms,
            q=q,
            block_pose=block_pose,
            angle=result.angle,
        )

    def _simulate(self) -> list[int]:
        """Step the simulation towards the targets; undo the step of environments that diverged.

        Returns:
            The environments that diverged.

        Raises:
            SimulationError: If the simulator failed.
        """
        q, block = self.simulation.q.clone(), self.simulation.block_pose.clone()
        try:
            self.simulation.step(self.targets[:, : self._num_sim_joints].contiguous())
        except DivergedError as error:
            diverged = list(error.reasons)
            envs = torch.tensor(diverged, device=self.device)
            self.simulation.reset(envs, q[envs], block[envs])
            self.previous_qd[envs] = 0
            return diverged
        return []

    def observe(self) -> Observation:
        """Return the current observation, in tensors that the caller owns."""
        return {
            "tokens": self._tokens(self._q),
            **self.groups.fields(self.simulation.block_pose),
            **_copied(self._constant_entries),
            **self.requested_entries(),
        }

    def requested_entries(self) -> Observation:
        """Return the entries of the current observation that the configuration asks for."""
        observation: Observation = {}
        if not self.observation_config.state:
            observation["object"] = torch.zeros(self.num_envs, OBJECT.size, device=self.device)
        if self.observation_config.velocity:
            qd = self._padded(self.simulation.qd)
            observation["velocity"] = joint_to_link(self.robot_tables, self.env_robot_index, qd)
        if self.observation_config.previous_action:
            observation["previous_action"] = self.previous_action.clone()
        if self.observation_config.tool:
            observation["tool"] = self._tool_positions(self._q)
        if self._kinematics is not None:
            block_pose = self.simulation.block_pose
            goals = self.groups.tool_targets(block_pose)
            observation |= self._kinematics(self._q, self.targets, goals, block_pose)
        if self._points is not None:
            observation["points"] = self._points(self.simulation.block_pose)
        return observation

    def advance(self, progress: float) -> None:
        """Advance the curricula of the tasks that have one.

        Args:
            progress: Fraction of the training that is done, 0 to 1. Before the first call,
                curricula are at their end.
        """
        self.groups.advance(progress)

    def state_dict(self) -> dict[str, Any]:
        """Return the state that the next ``reset`` depends on: random streams and tasks' states."""
        states = {
            name: [stream.bit_generator.state for stream in streams]
            for name, streams in self._streams.items()
        }
        return {**states, **self.groups.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned; ``reset`` must follow.

        Raises:
            TaskError: If the state has another number of environments, or is of an older morphgen.
        """
        if len(state["random"]) != self.num_envs:
            raise TaskError(
                f"the state is of {len(state['random'])} environments; expected {self.num_envs}"
            )
        if self._streams.keys() - state.keys():
            raise TaskError("the state is of an older morphgen: points had no stream of their own")
        for name, streams in self._streams.items():
            for stream, saved in zip(streams, state[name], strict=True):
                stream.bit_generator.state = saved
        self.groups.load_state_dict(state)

    def close(self) -> None:
        """Free the simulation."""
        self.simulation.close()

    def _act(self, actions: torch.Tensor) -> None:
        """Advance the joint targets by the decoded actions."""
        shape = (self.num_envs, self.robot_tables.max_links)
        normalized = decode_actions(actions, self.action_kind, shape, self.device)
        self.previous_action.copy_(normalized * self.action_mask)
        self.targets.copy_(self._joint_targets(self.targets, self.previous_action))

    def _evaluate(self, diverged: torch.Tensor) -> BatchResult:
        """Let the tasks evaluate the step that was simulated."""
        q, qd = self._q, self._padded(self.simulation.qd)
        state = TaskState(
            tool=self._tool_positions(q),
            block_pose=self.simulation.block_pose,
            limit_violation=limit_violation(q, self._lower, self._upper),
            acceleration=row_sums((qd - self.previous_qd).abs()) / CONTROL_PERIOD,
            diverged=diverged,
            tool_rotation=self._tool_rotation(q) if self.groups.needs_tool_rotation else None,
        )
        self.previous_qd.copy_(qd)
        return self.groups.evaluate(state)

    def _tool_rotation(self, q: torch.Tensor) -> torch.Tensor:
        """Return the rotation matrices of the tools, shape (n, 3, 3)."""
        T_root_tool = frame_pose(self.robot_tables.tool_chain, self.env_robot_index, q)
        return T_root_tool[:, :3, :3]

    def _begin(self, envs: torch.Tensor) -> None:
        """Begin episodes in the environments with these indices, shape (k,), int64."""
        q = torch.zeros(len(envs), self.robot_tables.max_joints, device=self.device)
        block_pose = torch.zeros(len(envs), 7, device=self.device)
        streams = self._streams["random"]
        self.layouts.draw(envs.tolist(), streams)
        for rows, (task_q, task_block_pose) in self.groups.begin(
            envs, streams, self.layouts.current
        ):
            q[rows], block_pose[rows] = task_q, task_block_pose
        if self._points is not None:
            for env in envs.tolist():
                stream = self._streams["points"][env]
                self._points.begin(env, stream, self.layouts.obstacles(env))
        sim_q = q[:, : self._num_sim_joints].contiguous()
        obstacles = (self.layouts.poses[envs],) if self.layouts.any else ()
        self.simulation.reset(envs, sim_q, block_pose, *obstacles)
        self.targets[envs] = q
        self.episode_step[envs] = 0
        self.previous_qd[envs] = 0
        self.previous_action[envs] = 0
        if self._kinematics is not None:
            self._kinematics.begin(envs)

    @property
    def _q(self) -> torch.Tensor:
        """Joint positions; a view of the simulation's tensor where nothing has to be padded."""
        return self._padded(self.simulation.q)

    def _padded(self, values: torch.Tensor) -> torch.Tensor:
        """Return values of the simulation's joints padded to J columns."""
        missing = self.robot_tables.max_joints - self._num_sim_joints
        return torch.nn.functional.pad(values, (0, missing)) if missing else values


def _copied(observation: Observation) -> Observation:
    return {name: values.clone() for name, values in observation.items()}
