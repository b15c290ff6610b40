"""A batch of robots at their tasks: actions, physics, rewards and new episodes, in torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from morphgen.errors import TaskError
from morphgen.model.kinematics_torch import frame_pose
from morphgen.tasks.actions import ActionDecoder, ActionKind, JointMotion
from morphgen.tasks.observation import (
    BatchObservation,
    EpisodeLayouts,
    Observation,
    ObservationConfig,
    PhysicsState,
    copied,
)
from morphgen.tasks.random_numbers import EpisodeRandom, EpisodeSequence, Stream
from morphgen.tasks.scenes.obstacles import LayoutSide
from morphgen.tasks.scenes.robot_tables import RobotTables
from morphgen.tasks.sim.base import Simulation, is_host
from morphgen.tasks.task import EnvSpec, StepResult
from morphgen.tasks.task_groups import TaskGroups


@dataclass(eq=False, kw_only=True)  # not frozen, as no dataclass can be whose base is not
class Step(StepResult[torch.Tensor]):
    """Result of a control step for n environments; where an episode ended, the next has begun.

    Terms are zero where the task has no such term, and the angle is nan where it wants no
    orientation. The caller owns all tensors: the batch does not use them again.
    """

    observation: Observation
    """Observation after the action, or at the start of the next episode where one ended."""
    reward: torch.Tensor
    """Sum of the reward terms, shape (n,)."""
    truncated: torch.Tensor
    """Whether the time limit or a diverged simulation ended the episode, shape (n,), bool."""
    diverged: torch.Tensor
    """Whether the simulation diverged, shape (n,), bool. The step is then undone and the episode
    truncated."""
    final_observation: Observation
    """Observation after the action, also where an episode ended: to bootstrap the value there."""
    q: torch.Tensor
    """Joint positions after the action, also where an episode ended, shape (n, J) [rad or m]."""
    object_pose: torch.Tensor
    """Poses of the blocks after the action, also where an episode ended, shape (n, 7)."""


@dataclass(frozen=True, eq=False)
class BeforePhysics:
    """Targets of a control step, and the state of the robots and blocks before it."""

    targets: torch.Tensor  # targets of the joints of the simulation, shape (n, J) [rad or m]
    q: torch.Tensor  # positions of the independent joints, shape (n, J) [rad or m]
    object_pose: torch.Tensor  # poses of the blocks, shape (n, 7)


class TaskBatch:
    """Environments; each has a robot at a task, and its own random numbers.

    Robots stand at the origin of the world. The tensors of targets, actions, velocities and episode
    steps are updated in place, so that NumPy views of them stay valid.

    A step computes all environments as tensors. On a GPU it reads none of them, so it never waits
    for the GPU; the channel ``ik``, which plans on the CPU, is the exception.

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
        is_idle: Environments whose results nobody wants any more, shape (n,), bool: they go on, but
            baselines plan nothing there. Whoever steps the batch sets it.
        decode_actions: Function that decodes actions of a shape (n, L).
        motion: Motion of the joints, of which these are tensors:
        targets: Targets of the independent joints, shape (n, J) [rad or m].
        previous_action: Normalized actions of the last step, shape (n, L); 0 in a new episode.
        layouts: Layouts of the obstacles in the running episodes.
        previous_qd: Velocities of the independent joints after the last step, shape (n, J).
        observation: Function that computes the observations.
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
            seed: Seed of all episodes, 0 to 2^64 - 1.
            first: Number of the first environment. An environment's episodes depend on its number
                and the seed only, whatever batch it is in.
            layouts: Layouts of obstacles that episodes draw from: those of training or of
                evaluation.

        Raises:
            TaskError: If a task is unknown, has different constants, or too few goals of a robot,
                or if the seed is out of range.
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
        self.decode_actions: ActionDecoder[torch.Tensor] = ActionDecoder(kind, device)
        self.motion: JointMotion[torch.Tensor] = JointMotion(robot_tables, index)
        self.targets, self.previous_action = self.motion.targets, self.motion.previous_action
        self.previous_qd = self.motion.previous_qd
        self.episode_step = torch.zeros(n, dtype=torch.int64, device=device)
        self.is_idle = torch.zeros(n, dtype=torch.bool, device=device)
        env_number = torch.arange(first, first + n, device=device)
        self._episodes = EpisodeSequence(seed, env_number)
        # Simulated joints are padded to the largest robot of the simulation, tables perhaps to more
        self._num_sim_joints = simulation.q.shape[1]
        self.observation_config = observe or ObservationConfig()
        self.layouts = EpisodeLayouts(self.specs, index, layouts, self.observation_config)
        self.observation = BatchObservation(
            robot_tables,
            index,
            self.groups,
            self.layouts,
            self.action_mask,
            self.observation_config,
        )

    def __getstate__(self) -> dict[str, Any]:
        """Refuse to be copied: a copy of a simulator's memory would stand still."""
        raise TaskError("environments cannot be copied: make another one")

    @property
    def num_envs(self) -> int:
        """Number of environments, n."""
        return len(self.env_robot_index)

    @property
    def seed(self) -> int | tuple[int, ...]:
        """Seed of the episodes, or a seed of each environment."""
        return self._episodes.seed

    @property
    def q(self) -> torch.Tensor:
        """Positions of the independent joints, shape (n, J) [rad or m]; a copy."""
        return self._padded(self.simulation.q).clone()

    def task_mask(self, task: str) -> torch.Tensor:
        """Return which environments are at a task, shape (n,), bool."""
        return self.groups.task_mask(task)

    def field(self, name: str) -> torch.Tensor:
        """Return the current value of an observation field of the tasks, shape (n, size)."""
        return self.groups.fields(self.simulation.object_pose)[name]

    def reset(
        self, seed: int | Sequence[int] | None = None, *, spread: bool = False
    ) -> Observation:
        """Begin an episode in every environment.

        Args:
            seed: Seed of all episodes from now on, which begin with the first; by default the next
                episodes begin. A list has the seed of each environment, whose episodes are then
                those of environment 0 of a batch with that seed.
            spread: Whether these first episodes begin at random fractions of their time limit, so
                that they do not all end at the same step; for learners.

        Raises:
            TaskError: If a seed is out of range.
        """
        if seed is not None:
            self._episodes.restart(seed, torch.zeros_like(self._episodes.next_episode))
        random = self._begin(torch.ones_like(self.episode_step, dtype=torch.bool))
        if spread:
            self.episode_step.copy_(random.integers(Stream.SPREAD, self.max_episode_steps))
        return self.observe()

    def step(self, actions: torch.Tensor) -> Step:
        """Act for one control step.

        Args:
            actions: Shape (n, L); continuous: in [-1, 1], clipped; discrete: indices of ``BINS``.

        Raises:
            TaskError: If the actions are invalid.
            SimulationError: If the simulator failed.
        """
        before = self.act(actions)
        return self.finish(before, self.simulation.step(before.targets))

    def act(self, actions: torch.Tensor) -> BeforePhysics:
        """Advance the joint targets by the actions: the part of ``step`` before the physics."""
        mask = self.action_mask
        normalized = self.decode_actions(actions.to(self.device), mask.shape)
        self.motion.act(torch.where(mask, normalized, 0.0))
        targets = self.targets[:, : self._num_sim_joints].contiguous()
        return BeforePhysics(targets, self.q, self.simulation.object_pose.clone())

    def finish(self, before: BeforePhysics, diverged: torch.Tensor) -> Step:
        """Evaluate a step and begin new episodes: the part of ``step`` after the physics."""
        state = self._undone(before, diverged)
        self.episode_step += 1
        result, reward = self._evaluate(state, diverged)
        timed_out = self.episode_step >= self.max_episode_steps
        truncated = (timed_out | diverged) & ~result.terminated  # an end wins over the time limit
        final_observation = self._observe(state)  # before new episodes change goals and layouts
        # The simulation overwrites them.
        q, object_pose = state.q.clone(), state.object_pose.clone()
        ended = truncated | result.terminated
        if is_host(self.device) and not ended.any():
            observation = copied(final_observation)
        else:
            self._begin(ended)
            observation = self.observe()
        return Step(
            **vars(result),
            observation=observation,
            reward=reward,
            truncated=truncated,
            diverged=diverged.clone(),
            final_observation=final_observation,
            q=q,
            object_pose=object_pose,
        )

    def _undone(self, before: BeforePhysics, diverged: torch.Tensor) -> PhysicsState:
        """Return the state after the physics, or before it where the simulation diverged."""
        state = self._state
        if is_host(self.device) and not diverged.any():
            return state
        rows = diverged[:, None]
        self.previous_qd.masked_fill_(rows, 0)  # an undone step has no acceleration
        return PhysicsState(
            q=torch.where(rows, before.q, state.q),
            qd=state.qd.masked_fill(rows, 0),
            object_pose=torch.where(rows, before.object_pose, state.object_pose),
        )

    def observe(self) -> Observation:
        """Return the current observation, in tensors that the caller owns."""
        return self._observe(self._state)

    def requested_entries(self) -> Observation:
        """Return the entries of the current observation that the configuration asks for."""
        return self.observation.requested(self._state, self.targets, self.previous_action)

    def advance(self, progress: float) -> None:
        """Advance the curricula of the tasks that have one.

        Args:
            progress: Fraction of the training that is done, 0 to 1. Before the first call,
                curricula are at their end.
        """
        self.groups.advance(progress)

    def state_dict(self) -> dict[str, Any]:
        """Return the state that the next ``reset`` depends on.

        It is the seed, the number of each environment's next episode, and the tasks' states.
        """
        next_episode = self._episodes.next_episode.clone()
        return {"seed": self.seed, "next_episode": next_episode, **self.groups.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned; ``reset`` must follow.

        Raises:
            TaskError: If the state has another number of environments.
        """
        next_episode = state["next_episode"]
        if len(next_episode) != self.num_envs:
            raise TaskError(
                f"the state is of {len(next_episode)} environments; expected {self.num_envs}"
            )
        self._episodes.restart(state["seed"], next_episode)
        self.groups.load_state_dict(state)

    def close(self) -> None:
        """Free the simulation."""
        self.simulation.close()

    def _evaluate(
        self, state: PhysicsState, diverged: torch.Tensor
    ) -> tuple[StepResult[torch.Tensor], torch.Tensor]:
        """Let the tasks evaluate the step that was simulated; return also the rewards, (n,)."""
        q = state.q
        task_state = self.motion.task_state(
            q,
            state.qd,
            tool=self.observation.tool_positions(q),
            object_pose=state.object_pose,
            diverged=diverged,
        )
        if self.groups.needs_tool_rotation:
            T_root_tool = frame_pose(self.robot_tables.tool_chain, self.env_robot_index, q)
            task_state.tool_rotation = T_root_tool[:, :3, :3]
        return self.groups.evaluate(task_state)

    def _begin(self, mask: torch.Tensor) -> EpisodeRandom:
        """Begin episodes in some environments, (n,), bool; return their random numbers."""
        random = self._episodes.begin(mask)
        self.layouts.draw(mask, random)
        layout = self.layouts.current if self.layouts.any else None
        q, object_pose = self.groups.begin(mask, random, layout)
        self.observation.begin(mask, random)
        obstacles = (self.layouts.poses,) if self.layouts.any else ()
        sim_q = q[:, : self._num_sim_joints].contiguous()
        self.simulation.reset(mask, sim_q, object_pose, *obstacles)
        rows = mask[:, None]
        self.targets.copy_(torch.where(rows, q, self.targets))  # motors hold the start
        self.episode_step.masked_fill_(mask, 0)
        self.previous_qd.masked_fill_(rows, 0)
        self.previous_action.masked_fill_(rows, 0)
        return random

    def _observe(self, state: PhysicsState) -> Observation:
        """Return the observation in a state of the simulation."""
        return self.observation(state, self.targets, self.previous_action)

    @property
    def _state(self) -> PhysicsState:
        """State of the simulation; views of its tensors where nothing has to be padded."""
        simulation = self.simulation
        q, qd = self._padded(simulation.q), self._padded(simulation.qd)
        return PhysicsState(q, qd, simulation.object_pose)

    def _padded(self, values: torch.Tensor) -> torch.Tensor:
        """Return values of the simulation's joints padded to J columns."""
        missing = self.robot_tables.max_joints - self._num_sim_joints
        return torch.nn.functional.pad(values, (0, missing)) if missing else values


WARM_UP = 3  # steps before the capture, which load kernels and choose algorithms


class StepGraph:
    """Steps a batch on a GPU; what comes before and after the physics is a CUDA graph each.

    A step is a thousand short operations, and to launch them one by one takes longer than they
    run. The results of a call are overwritten by the next one. Episodes go on where they were, but
    a reset with another seed records the graphs anew.
    """

    def __init__(self, batch: TaskBatch) -> None:
        """Record the graphs; ``reset`` of the batch must follow."""
        self._batch = batch
        shape = (batch.num_envs, batch.robot_tables.max_links)
        kind = torch.int64 if batch.action_kind == "discrete" else torch.float32
        self._actions = torch.zeros(shape, dtype=kind, device=batch.device)
        self._diverged = torch.zeros(batch.num_envs, dtype=torch.bool, device=batch.device)
        self._record()

    def __call__(self, actions: torch.Tensor) -> Step:
        """Act for one control step; see ``TaskBatch.step``. The next call overwrites the result."""
        if self._seed != self._batch.seed:
            self._record()
        self._actions.copy_(actions)
        self._act.replay()
        self._diverged.copy_(self._batch.simulation.step(self._before.targets))
        self._finish.replay()
        return self._step

    def _record(self) -> None:
        """Run the step a few times on a stream of its own, and record it; keep the episodes."""
        batch, state = self._batch, self._batch.state_dict()
        self._seed = batch.seed
        stream = torch.cuda.Stream(batch.device)  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream(batch.device))
        with torch.cuda.stream(stream):
            batch.reset()  # a capture needs tensors that are allocated already
            for _ in range(WARM_UP):
                batch.step(self._actions)
        torch.cuda.current_stream(batch.device).wait_stream(stream)
        self._act, self._finish = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._act):
            self._before = batch.act(self._actions)
        with torch.cuda.graph(self._finish, pool=self._act.pool()):  # reads what the first wrote
            self._step = batch.finish(self._before, self._diverged)
        batch.load_state_dict(state)


def can_record(batch: TaskBatch) -> bool:
    """Return whether a batch is on a GPU and no channel of its observations reads from it."""
    if batch.device.type != "cuda":
        return False
    return "ik" not in batch.observation_config.kinematic_channels
