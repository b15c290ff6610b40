"""Reach over a batch of bodies: actions, physics, rewards and new episodes, in torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from morphgen.errors import TaskError
from morphgen.tasks.actions import ActionKind, next_targets, shares_of
from morphgen.tasks.bodies import Bodies
from morphgen.tasks.config import CONTROL_PERIOD, ReachConfig
from morphgen.tasks.goals import GoalSet
from morphgen.tasks.kinematics import tool_poses
from morphgen.tasks.observation import box_tokens, link_tokens
from morphgen.tasks.rewards import Terms, anybody_score, beyond_limits, reach_terms
from morphgen.tasks.sim.base import Simulation

Observation = dict[str, torch.Tensor]
"""``tokens`` (n, L, 48), ``links`` and ``actions`` (n, L) bool, ``goal`` (n, 7), ``obstacles``
(n, O, 13) and ``obstacle_mask`` (n, O) bool."""


@dataclass(frozen=True, eq=False)
class Step:
    """What an action led to; where an episode ended, the next one has begun."""

    observation: Observation
    """After the action, or of the next episode's start."""
    reward: torch.Tensor
    """Shape (n,)."""
    terminated: torch.Tensor
    """Whether the task ended the episode, shape (n,), bool."""
    truncated: torch.Tensor
    """Whether time did, shape (n,), bool."""
    final_observation: Observation
    """After the action, whatever followed: to bootstrap from where time ran out."""
    success: torch.Tensor
    """Whether the tool is near its goal, shape (n,), bool."""
    distance: torch.Tensor
    """Of the tool and its goal, shape (n,), metres."""
    score: torch.Tensor
    """See ``anybody_score``, shape (n,)."""
    terms: Terms


class ReachBatch:
    """Environments of reach; each has a body, its goals, and a stream of random numbers.

    Robots stand at the origin of the world.
    """

    def __init__(
        self,
        bodies: Bodies,
        body: Sequence[int],
        goals: Mapping[int, GoalSet],
        simulation: Simulation,
        *,
        config: ReachConfig,
        kind: ActionKind = "continuous",
        seed: int = 0,
        first: int = 0,
    ) -> None:
        """Set up; ``reset`` begins.

        Args:
            bodies: The robots.
            body: Which of them each environment holds.
            goals: By robot.
            simulation: Of the same environments, with the obstacles of the goal sets.
            config: The task.
            kind: Of actions.
            seed: Of all episodes.
            first: Number of the first environment: the same number and seed give the same episodes,
                in whichever batch.

        Raises:
            TaskError: If a robot has fewer than two goals.
        """
        for i in sorted(set(body)):
            if len(goals[i].q) < 2:
                raise TaskError(f"robot {bodies.robots[i].name!r}: a goal set needs two goals")
        self.bodies, self.config, self.kind = bodies, config, kind
        self.simulation = simulation
        self.device = bodies.device
        self.body = torch.tensor(list(body), device=self.device)
        self.mask = bodies.action_mask(fingers=False)[self.body]
        self._sets = [goals[i] for i in body]
        self._random = [
            np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(first + i,)))
            for i in range(len(body))
        ]
        n = len(body)
        self.targets = torch.zeros(n, bodies.max_joints, device=self.device)
        self.goal = torch.zeros(n, 7, device=self.device)
        self.witness = torch.zeros(n, bodies.max_joints, device=self.device)
        self.elapsed = torch.zeros(n, dtype=torch.int64, device=self.device)
        self._joints = simulation.q.shape[1]
        self._qd = torch.zeros(n, self._joints, device=self.device)
        self._obstacles, self._obstacle_mask = _obstacle_tokens(self._sets, self.device)

    @property
    def num_envs(self) -> int:
        """How many environments."""
        return len(self.body)

    @property
    def q(self) -> torch.Tensor:
        """Positions of the independent joints, shape (n, J); J is that of ``bodies``."""
        found = self.simulation.q
        return torch.nn.functional.pad(found, (0, self.bodies.max_joints - self._joints))

    def reset(self) -> Observation:
        """Begin an episode everywhere."""
        self._begin(torch.arange(self.num_envs, device=self.device))
        return self.observe()

    def step(self, actions: torch.Tensor) -> Step:
        """Act for one control step.

        Args:
            actions: Shape (n, L); continuous: in [-1, 1], clipped; discrete: indices of ``BINS``.

        Raises:
            TaskError: If the actions are none.
            SimulationError: If a simulation became unstable.
        """
        shape = (self.num_envs, self.bodies.max_links)
        shares = shares_of(actions, self.kind, shape, self.device)
        self.targets = next_targets(self.bodies, self.body, self.targets, shares, self.mask)
        self.simulation.step(self.targets[:, : self._joints].contiguous())
        self.elapsed += 1
        distance = self.distances()
        terms = self._terms(distance)
        truncated = self.elapsed >= self.config.steps
        final = self.observe()
        over = torch.nonzero(truncated)[:, 0]
        if len(over):
            self._begin(over)
        return Step(
            observation=self.observe() if len(over) else final,
            reward=torch.stack(list(terms.values())).sum(dim=0),
            terminated=torch.zeros_like(truncated),
            truncated=truncated,
            final_observation=final,
            success=distance < self.config.near,
            distance=distance,
            score=anybody_score(self.config, distance),
            terms=terms,
        )

    def observe(self) -> Observation:
        """What agents see now."""
        return {
            "tokens": link_tokens(self.bodies, self.body, self.q),
            "links": self.bodies.links[self.body],
            "actions": self.mask,
            "goal": self.goal.clone(),
            "obstacles": self._obstacles,
            "obstacle_mask": self._obstacle_mask,
        }

    def distances(self) -> torch.Tensor:
        """Of tools and goals, shape (n,), metres."""
        tool = tool_poses(self.bodies.chain, self.body, self.q)
        apart: torch.Tensor = torch.linalg.vector_norm(tool[:, :3] - self.goal[:, :3], dim=1)
        return apart

    def close(self) -> None:
        """Free the simulation."""
        self.simulation.close()

    def _terms(self, distance: torch.Tensor) -> Terms:
        qd = self.simulation.qd
        acceleration = (qd - self._qd).abs().sum(dim=1) / CONTROL_PERIOD
        self._qd = qd.clone()
        lower, upper = self.bodies.lower[self.body], self.bodies.upper[self.body]
        return reach_terms(self.config, distance, beyond_limits(self.q, lower, upper), acceleration)

    def _begin(self, envs: torch.Tensor) -> None:
        """Begin episodes: a start and a goal of the robot's set, never the same."""
        starts = torch.zeros(len(envs), self.bodies.max_joints)
        witnesses, goals = torch.zeros_like(starts), torch.zeros(len(envs), 7)
        for row, env in enumerate(envs.tolist()):
            found = self._sets[env]
            start, goal = self._random[env].choice(len(found.q), size=2, replace=False)
            dof = found.q.shape[1]
            starts[row, :dof] = torch.from_numpy(found.q[start])
            witnesses[row, :dof] = torch.from_numpy(found.q[goal])
            goals[row] = torch.from_numpy(found.poses[goal])
        starts = starts.to(self.device)
        no_blocks = torch.zeros(len(envs), 7, device=self.device)
        self.simulation.reset(envs, starts[:, : self._joints].contiguous(), no_blocks)
        self.targets[envs] = starts
        self.goal[envs] = goals.to(self.device)
        self.witness[envs] = witnesses.to(self.device)
        self.elapsed[envs] = 0
        self._qd[envs] = 0


def _obstacle_tokens(
    sets: Sequence[GoalSet], device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tokens of every environment's obstacles, (n, O, 13), and which there are, (n, O)."""
    most = max(len(each.obstacles) for each in sets)
    pose, size = torch.zeros(len(sets), most, 7), torch.zeros(len(sets), most, 3)
    mask = torch.zeros(len(sets), most, dtype=torch.bool)
    for i, each in enumerate(sets):
        for k, block in enumerate(each.obstacles):
            pose[i, k] = torch.tensor([*block.pose.position, *block.pose.quaternion])
            size[i, k] = torch.tensor(block.size)
            mask[i, k] = True
    found = box_tokens(pose, size) * mask[..., None]
    return found.to(device), mask.to(device)
