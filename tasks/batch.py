"""A batch of bodies at their tasks: actions, physics, rewards and new episodes, in torch."""

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
from morphgen.tasks.config import CONTROL_PERIOD, PushConfig, ReachConfig
from morphgen.tasks.episodes import Push, Reach, State, Verdict, chosen
from morphgen.tasks.observation import LinkTokens, box_tokens, of_links
from morphgen.tasks.points import PointClouds
from morphgen.tasks.rewards import Terms, added, beyond_limits
from morphgen.tasks.settings import Setting
from morphgen.tasks.sim.base import Simulation

Observation = dict[str, torch.Tensor]
"""``tokens`` (n, L, 48), ``links`` and ``actions`` (n, L) bool; ``goal`` (n, 7) and ``goal_mask``
(n,) bool for reach; ``object`` (n, 13), ``object_mask`` (n,) bool and ``line`` (n, 1) for push;
``obstacles`` (n, O, 13) and ``obstacle_mask`` (n, O) bool. If asked for, ``velocity`` (n, L),
``previous_action`` (n, L), ``tool`` (n, 3), ``points`` (n, P, 3) and ``point_mask`` (n, P) bool."""


@dataclass(frozen=True)
class Channels:
    """What an observation also has; the paper has none of it but the points."""

    velocity: bool = False
    """Velocities of the links' independent joints, rad/s or m/s."""
    previous_action: bool = False
    """The action before, as shares of the joints' steps."""
    tool: bool = False
    """Where the tool is in the world, metres."""
    points: int = 0
    """Points of a point cloud of block and obstacles."""
    obstacles: int = 0
    """Rows for obstacles, if more than there are: for policies that meet more elsewhere."""


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
    """Whether the tool is near its goal, or the block across the line, shape (n,), bool; never
    where the simulation became unstable."""
    distance: torch.Tensor
    """Metres from success: of tool and goal, or of block and line, shape (n,)."""
    score: torch.Tensor
    """See ``Verdict``, shape (n,)."""
    terms: Terms
    """What the reward is the sum of."""
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
        settings: Sequence[Setting],
        body: Sequence[int],
        simulation: Simulation,
        *,
        reach: ReachConfig | None = None,
        push: PushConfig | None = None,
        kind: ActionKind = "continuous",
        channels: Channels | None = None,
        seed: int = 0,
        first: int = 0,
    ) -> None:
        """Set up; ``reset`` begins.

        Args:
            bodies: The robots.
            settings: Of each of the robots.
            body: Which robot each environment holds.
            simulation: Of the environments, with the settings' scenes.
            reach: Constants of reach.
            push: Constants of push.
            kind: Of actions.
            channels: What is observed besides.
            seed: Of all episodes.
            first: Number of the first environment: the same number and seed give the same episodes,
                in whichever batch.

        Raises:
            TaskError: If a robot has fewer than two goals.
        """
        self.bodies, self.settings, self.kind = bodies, tuple(settings), kind
        self.simulation, self.device = simulation, bodies.device
        reach, push = reach or ReachConfig(), push or PushConfig()
        channels = channels or Channels()
        n, joints, device = len(body), bodies.max_joints, self.device
        self.body = torch.tensor(list(body), device=device)
        own = [self.settings[i] for i in body]
        self.pushes = torch.tensor([each.task == "push" for each in own], device=device)
        fingers = self.pushes[:, None]
        self.mask = torch.where(
            fingers,
            bodies.action_mask(fingers=True)[self.body],
            bodies.action_mask(fingers=False)[self.body],
        )
        self._numbers = range(first, first + n)
        self._streams = _streams(seed, self._numbers)
        self._reach = Reach(self.settings, self.body, reach, joints)
        self._push = Push(self.settings, self.body, push, joints)
        self._tasks: list[tuple[Reach | Push, torch.Tensor]] = [
            (task, does)
            for task, does in ((self._reach, ~self.pushes), (self._push, self.pushes))
            if does.any()
        ]
        self.longest = torch.where(self.pushes, push.steps, reach.steps)
        """Control steps of an episode at most, shape (n,)."""
        self._joints = simulation.q.shape[1]
        self.targets = torch.zeros(n, joints, device=device)
        self.elapsed = torch.zeros(n, dtype=torch.int64, device=device)
        self._qd = torch.zeros(n, joints, device=device)
        self._shares = torch.zeros(n, bodies.max_links, device=device)
        self._lower, self._upper = bodies.lower[self.body], bodies.upper[self.body]
        self._channels = channels
        self._tokens = LinkTokens(bodies, self.body)
        self._tools = FramePositions(bodies.chain, self.body)
        self._moved = Targets(bodies, self.body, self.mask)
        self._fixed = {
            "links": bodies.links[self.body],
            "actions": self.mask,
            "goal_mask": ~self.pushes,
            "object_mask": self.pushes,
            **_obstacles(own, channels.obstacles, device),
        }
        self._points: PointClouds | None = None
        if channels.points:
            self._points = PointClouds([each.scene for each in own], channels.points, device)
            self._fixed["point_mask"] = self._points.mask

    @property
    def num_envs(self) -> int:
        """How many environments, n."""
        return len(self.body)

    @property
    def q(self) -> torch.Tensor:
        """Positions of the independent joints, shape (n, J), rad or m; J is that of ``bodies``."""
        return self._q.clone()

    @property
    def goal(self) -> torch.Tensor:
        """Wanted pose of the tool, shape (n, 7); zeros for push."""
        return self._reach.goal.clone()

    @property
    def witness(self) -> torch.Tensor:
        """Joint positions that bring the tool to its goal, shape (n, J); zeros for push."""
        return self._reach.witness.clone()

    @property
    def line(self) -> torch.Tensor:
        """Where the block must cross now, y of its centre, shape (n,), metres; zeros for reach."""
        return self._push.line.clone()

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
        verdict = self._judge(unstable)
        truncated = ((self.elapsed >= self.longest) | unstable) & ~verdict.terminated
        final = self.observe()
        q, block_pose = self.q, self.simulation.block_pose.clone()
        over = torch.nonzero(truncated | verdict.terminated)[:, 0]
        if len(over):
            self._begin(over)
        return Step(
            observation=self.observe() if len(over) else _copied(final),
            reward=torch.stack(list(verdict.terms.values())).sum(dim=0),
            terminated=verdict.terminated,
            truncated=truncated,
            unstable=unstable,
            final_observation=final,
            success=verdict.success,
            distance=verdict.distance,
            score=verdict.score,
            terms=verdict.terms,
            q=q,
            block_pose=block_pose,
        )

    def observe(self) -> Observation:
        """Return what agents see now, in tensors that belong to the caller."""
        seen = {
            "tokens": self._tokens(self._q),
            "goal": self._reach.goal.clone(),
            "object": box_tokens(self.simulation.block_pose, self._push.size)
            * self.pushes[:, None],
            "line": self._push.line[:, None].clone(),
            **_copied(self._fixed),
        }
        if self._channels.velocity:
            qd = self._widened(self.simulation.qd)
            seen["velocity"] = of_links(self.bodies, self.body, qd)
        if self._channels.previous_action:
            seen["previous_action"] = self._shares.clone()
        if self._channels.tool:
            seen["tool"] = self._tools(self._q)
        if self._points is not None:
            seen["points"] = self._points(self.simulation.block_pose)
        return seen

    def advance(self, progress: float) -> None:
        """Move the line that blocks must cross, as the curriculum of push has it.

        Args:
            progress: Of the training, 0 to 1. Until this is called the line is in its place.
        """
        self._push.advance(progress)

    def state_dict(self) -> dict[str, Any]:
        """What the next ``reset`` follows from: the streams of random numbers, and the line."""
        states = {
            name: [stream.bit_generator.state for stream in streams]
            for name, streams in self._streams.items()
        }
        return {**states, "line": self._push.line.clone()}

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
        self._push.line = state["line"].to(self.device, copy=True)

    def close(self) -> None:
        """Free the simulation."""
        self.simulation.close()

    def _act(self, actions: torch.Tensor) -> None:
        shape = (self.num_envs, self.bodies.max_links)
        self._shares = shares_of(actions, self.kind, shape, self.device) * self.mask
        self.targets = self._moved(self.targets, self._shares)

    def _move(self) -> torch.Tensor:
        """Let physics go on; what became unstable is put back to where it was, (n,) bool."""
        unstable = torch.zeros_like(self.pushes)
        q, block = self.simulation.q.clone(), self.simulation.block_pose.clone()
        try:
            self.simulation.step(self.targets[:, : self._joints].contiguous())
        except UnstableError as error:
            envs = torch.tensor(list(error.reasons), device=self.device)
            unstable[envs] = True
            self.simulation.reset(envs, q[envs], block[envs])
            self._qd[envs] = 0
        return unstable

    def _judge(self, unstable: torch.Tensor) -> Verdict:
        q, qd = self._q, self._widened(self.simulation.qd)
        state = State(
            tool=self._tools(q),
            block=self.simulation.block_pose[:, :3],
            beyond=beyond_limits(q, self._lower, self._upper),
            acceleration=added((qd - self._qd).abs()) / CONTROL_PERIOD,
            unstable=unstable,
        )
        self._qd = qd.clone()
        if len(self._tasks) == 1:
            return self._tasks[0][0].judge(state)
        return chosen(self.pushes, self._reach.judge(state), self._push.judge(state))

    def _begin(self, envs: torch.Tensor) -> None:
        starts = torch.zeros(len(envs), self.bodies.max_joints, device=self.device)
        blocks = torch.zeros(len(envs), 7, device=self.device)
        for task, does in self._tasks:
            rows = torch.nonzero(does[envs])[:, 0]
            if len(rows):
                own = [self._streams["random"][i] for i in envs[rows].tolist()]
                starts[rows], blocks[rows] = task.begin(envs[rows], own)
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


def _obstacles(settings: Sequence[Setting], least: int, device: torch.device) -> Observation:
    """Tokens of every environment's obstacles, (n, O, 13), and which there are, (n, O)."""
    most = max(least, *(len(each.scene.obstacles) for each in settings))
    pose, size = torch.zeros(len(settings), most, 7), torch.zeros(len(settings), most, 3)
    mask = torch.zeros(len(settings), most, dtype=torch.bool)
    for i, each in enumerate(settings):
        for k, block in enumerate(each.scene.obstacles):
            pose[i, k] = torch.tensor([*block.pose.position, *block.pose.quaternion])
            size[i, k] = torch.tensor(block.size)
            mask[i, k] = True
    found = box_tokens(pose, size) * mask[..., None]
    return {"obstacles": found.to(device), "obstacle_mask": mask.to(device)}
