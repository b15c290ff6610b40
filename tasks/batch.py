"""A batch of robots at their tasks: actions, physics, rewards and new episodes, in torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from morphgen.errors import TaskError, UnstableError
from morphgen.model.kinematics_torch import FramePositions
from morphgen.tasks.actions import ActionKind, Targets, shares_of
from morphgen.tasks.bodies import Bodies
from morphgen.tasks.config import CONTROL_PERIOD
from morphgen.tasks.observation import (
    LinkTokens,
    Observation,
    ObservationConfig,
    obstacle_tokens,
    of_links,
)
from morphgen.tasks.points import PointClouds
from morphgen.tasks.rows import limit_violation, row_sums
from morphgen.tasks.sim.base import Simulation
from morphgen.tasks.task import EnvSpec, TaskState
from morphgen.tasks.task_groups import StepRows, TaskGroups


@dataclass(frozen=True, eq=False)
class Step:
    """What an action led to; where an episode ended, the next one has begun.

    All tensors belong to the caller: the batch does not use them again.
    """

    observation: Observation
    """After the action, or of the next episode's start."""
    reward: torch.Tensor
    """Shape (n,)."""
    terminated: torch.Tensor
    """Whether the task ended the episode, shape (n,), bool."""
    truncated: torch.Tensor
    """Whether time did, or physics (see ``unstable``), shape (n,), bool."""
    unstable: torch.Tensor
    """Whether its simulation became unstable, shape (n,), bool; the step is then as if robot and
    block had stopped where they were before."""
    final_observation: Observation
    """After the action, whatever followed: to bootstrap from where time ran out."""
    success: torch.Tensor
    """Whether the task is fulfilled now, shape (n,), bool; never where the simulation became
    unstable."""
    distance: torch.Tensor
    """Distance from success, such as of tool and goal, shape (n,), metres."""
    score: torch.Tensor
    """Score of the step, shape (n,); see ``Task.episode_score``."""
    terms: dict[str, torch.Tensor]
    """Reward terms by name, each of shape (n,), zero where a task has no such term."""
    q: torch.Tensor
    """Joint positions after the action, whatever followed, shape (n, J)."""
    block_pose: torch.Tensor
    """Poses of the blocks likewise, shape (n, 7)."""


class TaskBatch:
    """Environments; each has a robot at a task, and a stream of random numbers.

    Robots stand at the origin of the world.
    """

    def __init__(
        self,
        bodies: Bodies,
        specs: Sequence[EnvSpec],
        body: Sequence[int],
        simulation: Simulation,
        *,
        kind: ActionKind = "continuous",
        observe: ObservationConfig | None = None,
        seed: int = 0,
        first: int = 0,
    ) -> None:
        """Set up; ``reset`` begins.

        Args:
            bodies: The robots.
            specs: Specification of each of the robots' environments.
            body: Index of each environment's robot and specification.
            simulation: Simulation of the environments, with the scenes of their specifications.
            kind: Kind of the actions.
            observe: Entries of observations that are not there by default.
            seed: Seed of all episodes.
            first: Number of the first environment: the same number and seed give the same episodes,
                in whichever batch.

        Raises:
            TaskError: If a task is unknown, has different constants, or too few goals of a robot.
        """
        self.bodies, self.specs, self.kind = bodies, tuple(specs), kind
        self.simulation, self.device = simulation, bodies.device
        observe = observe or ObservationConfig()
        n, joints, device = len(body), bodies.max_joints, self.device
        self.body = torch.tensor(list(body), device=device)
        self.groups = TaskGroups(self.specs, self.body, joints)
        own = [self.specs[i] for i in body]
        self.mask = torch.where(
            self.groups.moves_fingers[:, None],
            bodies.action_mask(fingers=True)[self.body],
            bodies.action_mask(fingers=False)[self.body],
        )
        self._numbers = range(first, first + n)
        self._streams = _streams(seed, self._numbers)
        self.longest = self.groups.longest
        """Control steps of an episode at most, shape (n,)."""
        self._joints = simulation.q.shape[1]
        self.targets = torch.zeros(n, joints, device=device)
        self.elapsed = torch.zeros(n, dtype=torch.int64, device=device)
        self._qd = torch.zeros(n, joints, device=device)
        self._shares = torch.zeros(n, bodies.max_links, device=device)
        self._lower, self._upper = bodies.lower[self.body], bodies.upper[self.body]
        self._config = observe
        self._tokens = LinkTokens(bodies, self.body)
        self._tools = FramePositions(bodies.chain, self.body)
        self._moved = Targets(bodies, self.body, self.mask)
        self._fixed = {
            "links": bodies.links[self.body],
            "actions": self.mask,
            **self.groups.masks,
            **obstacle_tokens([each.scene for each in own], observe.obstacles, device),
        }
        self._points: PointClouds | None = None
        if observe.points:
            self._points = PointClouds([each.scene for each in own], observe.points, device)
            self._fixed["point_mask"] = self._points.mask

    @property
    def num_envs(self) -> int:
        """How many environments, n."""
        return len(self.body)

    @property
    def q(self) -> torch.Tensor:
        """Positions of the independent joints, shape (n, J), rad or m; J is that of ``bodies``."""
        return self._q.clone()

    def does(self, task: str) -> torch.Tensor:
        """Return which environments are at a task, shape (n,), bool."""
        return self.groups.does(task)

    def field(self, name: str) -> torch.Tensor:
        """Return an observation field of the tasks as it is now, shape (n, size); see ``Task``."""
        return self.groups.fields(self.simulation.block_pose)[name]

    def reset(self, seed: int | None = None, *, spread: bool = False) -> Observation:
        """Begin an episode everywhere.

        Args:
            seed: Of all episodes from now on; by default they go on.
            spread: Whether these first episodes are as if some of their time had passed, another
                share in each environment: learners want episodes that do not end all at once.
        """
        if seed is not None:
            self._streams = _streams(seed, self._numbers)
        self._begin(torch.arange(self.num_envs, device=self.device))
        if spread:
            passed = [stream.random() for stream in self._streams["random"]]
            shares = torch.tensor(passed, device=self.device)
            self.elapsed = (shares * self.longest).long()
        return self.observe()

    def step(self, actions: torch.Tensor) -> Step:
        """Act for one control step.

        Args:
            actions: Shape (n, L); continuous: in [-1, 1], clipped; discrete: indices of ``BINS``.

        Raises:
            TaskError: If the actions are none.
            SimulationError: If the simulator failed.
        """
        self._act(actions)
        unstable = self._move()
        self.elapsed += 1
        result = self._evaluate(unstable)
        truncated = ((self.elapsed >= self.longest) | unstable) & ~result.terminated
        final = self.observe()
        q, block_pose = self.q, self.simulation.block_pose.clone()
        over = torch.nonzero(truncated | result.terminated)[:, 0]
        if len(over):
            self._begin(over)
        return Step(
            observation=self.observe() if len(over) else _copied(final),
            reward=result.reward,
            terminated=result.terminated,
            truncated=truncated,
            unstable=unstable,
            final_observation=final,
            success=result.success,
            distance=result.distance,
            score=result.score,
            terms=result.terms,
            q=q,
            block_pose=block_pose,
        )

    def observe(self) -> Observation:
        """Return what agents see now, in tensors that belong to the caller."""
        seen = {
            "tokens": self._tokens(self._q),
            **self.groups.fields(self.simulation.block_pose),
            **_copied(self._fixed),
        }
        if self._config.velocity:
            qd = self._widened(self.simulation.qd)
            seen["velocity"] = of_links(self.bodies, self.body, qd)
        if self._config.previous_action:
            seen["previous_action"] = self._shares.clone()
        if self._config.tool:
            seen["tool"] = self._tools(self._q)
        if self._points is not None:
            seen["points"] = self._points(self.simulation.block_pose)
        return seen

    def advance(self, progress: float) -> None:
        """Follow the curricula of the tasks that have one.

        Args:
            progress: Progress of the training, 0 to 1. Until this is called, all is as at the end.
        """
        self.groups.advance(progress)

    def state_dict(self) -> dict[str, Any]:
        """Return what the next ``reset`` follows from: random streams, and states of the tasks."""
        states = {
            name: [stream.bit_generator.state for stream in streams]
            for name, streams in self._streams.items()
        }
        return {**states, **self.groups.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on as a batch of the same environments would; ``reset`` must follow.

        Raises:
            TaskError: If the state is of another number of environments, or of an older morphgen.
        """
        if len(state["random"]) != self.num_envs:
            raise TaskError(
                f"the state is of {len(state['random'])} environments; there are {self.num_envs}"
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
        shape = (self.num_envs, self.bodies.max_links)
        self._shares = shares_of(actions, self.kind, shape, self.device) * self.mask
        self.targets = self._moved(self.targets, self._shares)

    def _move(self) -> torch.Tensor:
        """Let physics go on; what became unstable is put back to where it was, (n,) bool."""
        unstable = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        q, block = self.simulation.q.clone(), self.simulation.block_pose.clone()
        try:
            self.simulation.step(self.targets[:, : self._joints].contiguous())
        except UnstableError as error:
            envs = torch.tensor(list(error.reasons), device=self.device)
            unstable[envs] = True
            self.simulation.reset(envs, q[envs], block[envs])
            self._qd[envs] = 0
        return unstable

    def _evaluate(self, unstable: torch.Tensor) -> StepRows:
        q, qd = self._q, self._widened(self.simulation.qd)
        state = TaskState(
            tool=self._tools(q),
            block_pose=self.simulation.block_pose,
            limit_violation=limit_violation(q, self._lower, self._upper),
            acceleration=row_sums((qd - self._qd).abs()) / CONTROL_PERIOD,
            unstable=unstable,
        )
        self._qd = qd.clone()
        return self.groups.evaluate(state)

    def _begin(self, envs: torch.Tensor) -> None:
        starts = torch.zeros(len(envs), self.bodies.max_joints, device=self.device)
        blocks = torch.zeros(len(envs), 7, device=self.device)
        for rows, (q, block) in self.groups.begin(envs, self._streams["random"]):
            starts[rows], blocks[rows] = q, block
        if self._points is not None:
            for env in envs.tolist():
                self._points.begin(env, self._streams["points"][env])
        self.simulation.reset(envs, starts[:, : self._joints].contiguous(), blocks)
        self.targets[envs] = starts
        self.elapsed[envs] = 0
        self._qd[envs] = 0
        self._shares[envs] = 0

    @property
    def _q(self) -> torch.Tensor:
        """``q``, or a view of the simulation's own."""
        return self._widened(self.simulation.q)

    def _widened(self, values: torch.Tensor) -> torch.Tensor:
        """Values of the simulation's joints, padded to those of ``bodies``."""
        more = self.bodies.max_joints - self._joints
        return torch.nn.functional.pad(values, (0, more)) if more else values


def _copied(observation: Observation) -> Observation:
    return {name: values.clone() for name, values in observation.items()}


def _streams(seed: int, numbers: Sequence[int]) -> dict[str, list[np.random.Generator]]:
    """What environments draw episodes and points from: by number, whatever else is in the batch."""

    def drawn(*of: int) -> list[np.random.Generator]:
        own = (np.random.SeedSequence(seed, spawn_key=(number, *of)) for number in numbers)
        return [np.random.default_rng(sequence) for sequence in own]

    return {"random": drawn(), "points": drawn(0)}
