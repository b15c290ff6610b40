"""A push that is not learned: plan a way behind the block, then go straight on and steer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from morphgen.model.inverse_kinematics_torch import pose_ik_step
from morphgen.model.kinematics_torch import frame_positions
from morphgen.rl.baselines.path_planner import Routes, shares_to
from morphgen.rl.baselines.push_planner import SPEED, Plan, PushPlanner
from morphgen.tasks.actions import encode_actions
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.push.starts import PushStartSet
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.task import EnvSpec

PLANS = 8
"""Plans of an episode at most."""
GAIN = 0.2
"""Share of the distance aside of tool and block that is made good in a control step."""
LEAD, MORE_LEAD, MOST_LEAD = 0.05, 0.004, 0.3
"""How far the commanded tool may be ahead of the tool at first, how much farther with every control
step in which the block does not move, and at most, metres: a slender body gives way by as much."""
MOVES = 0.03
"""Speed of a block that moves, m/s."""
ARRIVED = 0.02
"""Distance of joints from their targets that counts as there, rad or m."""
SETTLE = 15
"""Control steps in which joints may get there."""
PATIENCE = 40
"""Control steps in which the block has to get on before a new plan is made."""
PROGRESS = MOVES * PATIENCE * CONTROL_PERIOD
"""How far that is at least, metres."""
LOST = 0.7
"""Distance aside of tool and block from which it is lost, in edges of the block."""
ASTRAY = 1.5
"""Distance aside of the block from where the push began from which it goes astray, in its edges."""
UNDERWAY = 10
"""Control steps of a push before which it is not."""
RISE = 0.003
"""How much higher the tool goes in a control step in which the arm would be in the ground, or in
whatever else is in its way, metres. Where a block goes aside, it soon is."""


class ScriptedPush:
    """Gets behind the block, pushes it along y, and plans again where that fails.

    The plan (``PushPlanner``) is made of collision tests and kinematics alone; the push is closed
    loop: the tool goes along y, its rotation held, and its height where there is room, and follows
    the block aside. Environments that do not push stand still.
    """

    def __init__(self, seed: int) -> None:
        """Prepare.

        Args:
            seed: Of the configurations that are tried. Plans depend on nothing else but the robot,
                its push set, and where robot and block are.
        """
        self._seed = seed
        self._specs: Sequence[EnvSpec] = ()
        self._planners: dict[int, PushPlanner] = {}
        self._state: _State | None = None

    def act(self, task: TaskBatch) -> torch.Tensor:
        """A step along the way behind the block, or of the push; shape (n, L)."""
        if self._specs is not task.specs:
            self._specs, self._planners, self._state = task.specs, {}, None
        state = self._state
        if state is None or state.task is not task:
            state = self._state = _no_state(task)
        block = task.simulation.block_pose
        tool = frame_positions(task.robot_tables.tool_chain, task.env_robot_index, task.q)
        pushes = task.task_mask("push")
        new = pushes & (task.episode_step == 0)
        state.plans[new] = 0
        failed = _watched(state, task, block, tool) | (pushes & ~state.active)
        for env in torch.nonzero(new | (failed & (state.plans < PLANS)))[:, 0].tolist():
            self._plan(state, task, env, block[env])
        state.height += torch.where(self._blocked(state, task), RISE, 0.0)
        pushed = _pushed(state, task, block, tool)
        wanted = torch.where(state.pushing[:, None], pushed, state.routes.wanted)
        wanted = torch.where(state.active[:, None], wanted, task.targets)
        return encode_actions(shares_to(task, wanted), task.action_kind)

    def _blocked(self, state: _State, task: TaskBatch) -> torch.Tensor:
        """Whether arms that push are to be where something is in their way, shape (n,), bool."""
        found = torch.zeros_like(state.active)
        for index, planner in self._planners.items():
            rows = torch.nonzero(state.active & state.pushing & (task.env_robot_index == index))[
                :, 0
            ]
            dof = task.specs[index].robot.dof
            q = task.targets[rows, :dof].double().cpu().numpy()
            found[rows] = ~torch.from_numpy(planner.free(q)).to(found.device)
        return found

    def _plan(self, state: _State, task: TaskBatch, env: int, block: torch.Tensor) -> None:
        index = int(task.env_robot_index[env])
        if index not in self._planners:
            rng = np.random.default_rng([self._seed, index])
            self._planners[index] = PushPlanner(task.specs[index], task.robot_tables, index, rng)
        q = task.targets[env, : task.specs[index].robot.dof].double().cpu().numpy()
        attempt = int(state.plans[env])
        left = int(task.max_episode_steps[env] - task.episode_step[env])
        plan = self._planners[index].plan(q, block.double().cpu().numpy(), attempt, left)
        state.plans[env] += 1
        state.active[env] = plan is not None
        state.pushing[env] = False
        if plan is not None:
            state.take(env, plan, block)


@dataclass(eq=False)
class _State:
    """How far environments are with their plans; a row each."""

    task: TaskBatch
    routes: Routes
    """Ways behind the block."""
    plans: torch.Tensor
    """Plans made in the episode."""
    active: torch.Tensor
    """Whether there is one."""
    pushing: torch.Tensor
    """Whether the tool is behind the block already."""
    settled: torch.Tensor
    """Control steps since the targets got to the end of the way."""
    still: torch.Tensor
    """Control steps of the push since the block got on."""
    stuck: torch.Tensor
    """Control steps since the arm could go on."""
    best: torch.Tensor
    """How far the block had got then, y."""
    begun: torch.Tensor
    """Where the block was before the push, x."""
    lead: torch.Tensor
    """How far the commanded tool may be ahead now, metres."""
    rotation: torch.Tensor
    height: torch.Tensor
    aside: torch.Tensor
    gap: torch.Tensor
    edge: torch.Tensor
    """Of the block, metres."""

    def take(self, env: int, plan: Plan, block: torch.Tensor) -> None:
        """Begin a plan; the pose of the block is of shape (7,)."""
        self.routes.take(env, plan.way)
        self.rotation[env] = plan.rotation
        self.height[env], self.aside[env], self.gap[env] = plan.height, plan.aside, plan.gap
        self.begun[env], self.best[env], self.lead[env] = block[0], block[1], LEAD
        self.settled[env], self.still[env], self.stuck[env] = 0, 0, 0


def _no_state(task: TaskBatch) -> _State:
    """No plans."""
    n, device = task.num_envs, task.device
    sets = [task.specs[i].goals for i in task.env_robot_index.tolist()]
    edges = [each.block.size[0] if isinstance(each, PushStartSet) else 1.0 for each in sets]

    def count() -> torch.Tensor:
        return torch.zeros(n, dtype=torch.int64, device=device)

    def flag() -> torch.Tensor:
        return torch.zeros(n, dtype=torch.bool, device=device)

    def zero(*shape: int) -> torch.Tensor:
        return torch.zeros(n, *shape, device=device)

    return _State(
        task=task,
        routes=Routes(task),
        plans=count(),
        active=flag(),
        pushing=flag(),
        settled=count(),
        still=count(),
        stuck=count(),
        best=zero(),
        begun=zero(),
        lead=zero(),
        rotation=zero(3, 3),
        height=zero(),
        aside=zero(),
        gap=zero(),
        edge=torch.tensor(edges, device=device),
    )


def _watched(
    state: _State, task: TaskBatch, block: torch.Tensor, tool: torch.Tensor
) -> torch.Tensor:
    """Go from leg to leg, from the way to the push; whether the push fails, shape (n,), bool."""
    final = state.active & ~state.pushing & state.routes.go_on()
    state.settled = torch.where(final, state.settled + 1, state.settled)
    arrived = (task.q - task.targets).abs().amax(dim=1) < ARRIVED
    state.pushing = state.pushing | (final & (arrived | (state.settled > SETTLE)))
    ahead = block[:, 1] > state.best + PROGRESS
    state.best = torch.where(ahead, block[:, 1], state.best)
    state.still = torch.where(ahead | ~state.pushing, 0, state.still + 1)
    off = (tool[:, 0] - block[:, 0] - state.aside).abs()
    lost = (off > LOST * state.edge) & (state.still > UNDERWAY)
    slow = state.still > PATIENCE + state.gap / SPEED
    astray = (block[:, 0] - state.begun).abs() > ASTRAY * state.edge
    return state.active & state.pushing & (slow | lost | astray | (state.stuck > UNDERWAY))


def _pushed(
    state: _State, task: TaskBatch, block: torch.Tensor, tool: torch.Tensor
) -> torch.Tensor:
    """Targets whose tools are a bit farther on, and aside where the blocks are."""
    goal = frame_positions(task.robot_tables.tool_chain, task.env_robot_index, task.targets)
    lead = goal[:, 1] - tool[:, 1]
    stands = task.simulation.block_velocity[:, 1] < MOVES
    more = state.pushing & stands & (lead > state.lead - SPEED)
    state.lead = torch.where(more, state.lead + MORE_LEAD, state.lead).clamp(max=MOST_LEAD)
    aside = GAIN * (block[:, 0] + state.aside - tool[:, 0])
    on = torch.where(lead < state.lead, SPEED, 0.0)
    goal += torch.stack([aside.clamp(-SPEED, SPEED), on, torch.zeros_like(on)], dim=1)
    goal[:, 2] = state.height
    wanted = pose_ik_step(
        task.robot_tables.tool_chain,
        task.env_robot_index,
        task.targets,
        goal,
        state.rotation,
        (
            task.robot_tables.lower[task.env_robot_index],
            task.robot_tables.upper[task.env_robot_index],
        ),
        rotation_budget=task.robot_tables.max_step[task.env_robot_index],
    )
    missed = (
        goal[:, 1]
        - frame_positions(task.robot_tables.tool_chain, task.env_robot_index, wanted)[:, 1]
    )
    stands = state.pushing & (on > 0) & (missed > 0.8 * SPEED)
    state.stuck = torch.where(stands, state.stuck + 1, 0)
    return wanted
