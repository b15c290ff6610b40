"""The baseline ``scripted`` of push: follow a planned path behind the block, push, and steer."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import torch

from morphgen.model.kinematics_torch import frame_positions, pose_ik_step
from morphgen.rl.baselines.path_planner import PathFollower, fractions_towards
from morphgen.rl.baselines.push_planner import SPEED, PushPlanner
from morphgen.tasks.actions import encode_actions
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.push.starts import PushStartSet
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.task import EnvSpec

MAX_PLANS = 8  # maximum number of plans per episode
GAIN = 0.2
"""Fraction of the lateral error between tool and block that is corrected in a control step."""
LEAD, LEAD_STEP, MAX_LEAD = 0.05, 0.004, 0.3
"""Lead of the commanded tool before the actual one: initial value, growth per control step in which
the block does not move, and maximum [m]. A slender arm needs it to build up force."""
MOVING = 0.03  # speed of the block from which it counts as moving [m/s]
ARRIVED, SETTLE_STEPS = 0.02, 15
"""A push begins when the joints are ``ARRIVED`` from their targets [rad or m], or ``SETTLE_STEPS``
control steps after the last waypoint."""
PATIENCE = 40
"""Time in which the block must move by ``PROGRESS``; else a new plan is made [control steps]."""
PROGRESS = MOVING * PATIENCE * CONTROL_PERIOD
"""Distance that the block must move within ``PATIENCE`` [m]."""
LOST, ASTRAY = 0.7, 1.5
"""Lateral distances that lead to a new plan: of the tool from the block, and of the block from its
position at the start of the push [edges of the block]."""
MIN_PUSH_STEPS = 10
"""Time of a push before its block can count as lost or its arm as stuck [control steps]."""
RISE = 0.003
"""Rise of the tool in a control step in which the arm collides with anything but the block [m]."""


class ScriptedPush:
    """Moves behind the block, pushes it along y, and plans again where that fails.

    ``PushPlanner`` plans from collision tests and kinematics alone. The push is closed-loop: the
    tool moves along y with a constant rotation, follows the block along x, and rises where the arm
    has no room. Environments of other tasks stand still.
    """

    def __init__(self, seed: int) -> None:
        """Set up; plans depend on the seed, the robot, its starts and the state of the episode."""
        self._seed = seed
        self._specs: Sequence[EnvSpec] = ()
        self._planners: dict[tuple[int, int | None], PushPlanner] = {}
        self._task: TaskBatch | None = None

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return a step along the path behind the block, or of the push; shape (n, L)."""
        if self._specs is not task.specs:
            self._specs, self._planners = task.specs, {}
        if self._task is not task:
            self._begin(task)
        block = task.simulation.block_pose
        tool = frame_positions(task.robot_tables.tool_chain, task.env_robot_index, task.q)
        is_push = task.task_mask("push")
        new = is_push & (task.episode_step == 0)
        self._num_plans[new] = 0
        failed = self._advance(task, block, tool) | (is_push & ~self._active)
        for env in torch.nonzero(new | (failed & (self._num_plans < MAX_PLANS)))[:, 0].tolist():
            self._plan(task, env, block[env])
        self._height += torch.where(self._blocked(task), RISE, 0.0)
        pushed = self._push(task, block, tool)
        targets = torch.where(self.pushing[:, None], pushed, self._follower.waypoint)
        targets = torch.where(self._active[:, None], targets, task.targets)
        return encode_actions(fractions_towards(task, targets), task.action_kind)

    def _begin(self, task: TaskBatch) -> None:
        """Allocate the state of a batch: a row per environment, without plans."""
        self._task, self._follower = task, PathFollower(task)
        n, device = task.num_envs, task.device
        starts = [task.specs[i].goals for i in task.env_robot_index.tolist()]
        edges = [
            start.block.size[0] if isinstance(start, PushStartSet) else 1.0 for start in starts
        ]
        self._edge = torch.tensor(edges, device=device)
        # A plan is active; its path is done, and the tool pushes.
        self._active, self.pushing = torch.zeros(2, n, dtype=torch.bool, device=device)
        # Plans in the episode; control steps since the end of the path, since the block made
        # progress, and in which the arm could not move on.
        self._num_plans, self._settling, self._still, self._stuck = torch.zeros(
            4, n, dtype=torch.int64, device=device
        )
        # The farthest y of the block; its x before the push; how far the commanded tool may lead;
        # height, offset and gap of the plan.
        self._best, self._begun, self._lead, self._height, self._offset, self._gap = torch.zeros(
            6, n, device=device
        )
        self._rotation = torch.zeros(n, 3, 3, device=device)

    def _plan(self, task: TaskBatch, env: int, block: torch.Tensor) -> None:
        """Make a plan in one environment; block is the pose of its block, shape (7,)."""
        robot, _ = key = _robot_and_layout(task, env)
        if key not in self._planners:
            rng = np.random.default_rng([self._seed, robot])
            self._planners[key] = PushPlanner(
                task.specs[robot], task.layouts.scene(env), task.robot_tables, robot, rng
            )
        q = task.targets[env, : task.specs[robot].robot.dof].double().cpu().numpy()
        steps_left = int(task.max_episode_steps[env] - task.episode_step[env])
        plan = self._planners[key].plan(
            q, block.double().cpu().numpy(), int(self._num_plans[env]), steps_left
        )
        self._num_plans[env] += 1
        self._active[env], self.pushing[env] = plan is not None, False
        if plan is None:
            return
        self._follower.follow(env, plan.path)
        self._rotation[env], self._height[env] = plan.rotation, plan.height
        self._offset[env], self._gap[env] = plan.offset, plan.gap
        self._begun[env], self._best[env], self._lead[env] = block[0], block[1], LEAD
        self._settling[env], self._still[env], self._stuck[env] = 0, 0, 0

    def _advance(self, task: TaskBatch, block: torch.Tensor, tool: torch.Tensor) -> torch.Tensor:
        """Switch to the next waypoint or to the push; return where pushes failed, (n,), bool."""
        at_end = self._active & ~self.pushing & self._follower.advance()
        self._settling = torch.where(at_end, self._settling + 1, self._settling)
        arrived = (task.q - task.targets).abs().amax(dim=1) < ARRIVED
        self.pushing = self.pushing | (at_end & (arrived | (self._settling > SETTLE_STEPS)))
        progress = block[:, 1] > self._best + PROGRESS
        self._best = torch.where(progress, block[:, 1], self._best)
        self._still = torch.where(progress | ~self.pushing, 0, self._still + 1)
        error = (tool[:, 0] - block[:, 0] - self._offset).abs()
        lost = (error > LOST * self._edge) & (self._still > MIN_PUSH_STEPS)
        slow = self._still > PATIENCE + self._gap / SPEED
        astray = (block[:, 0] - self._begun).abs() > ASTRAY * self._edge
        failed = slow | lost | astray | (self._stuck > MIN_PUSH_STEPS)
        failing: torch.Tensor = failed & self._active & self.pushing
        return failing

    def _blocked(self, task: TaskBatch) -> torch.Tensor:
        """Return where a pushing arm's targets collide with anything but the block, (n,), bool."""
        blocked = torch.zeros_like(self._active)
        envs_of = defaultdict[tuple[int, int | None], list[int]](list)
        for env in torch.nonzero(self._active & self.pushing)[:, 0].tolist():
            envs_of[_robot_and_layout(task, env)].append(env)
        for (robot, layout), envs in envs_of.items():
            q = task.targets[envs, : task.specs[robot].robot.dof].double().cpu().numpy()
            free = self._planners[robot, layout].free(q)
            blocked[envs] = ~torch.from_numpy(free).to(blocked.device)
        return blocked

    def _push(self, task: TaskBatch, block: torch.Tensor, tool: torch.Tensor) -> torch.Tensor:
        """Return targets (n, J) with the tool farther along y, and nearer to the block along x."""
        goal = frame_positions(task.robot_tables.tool_chain, task.env_robot_index, task.targets)
        lead = goal[:, 1] - tool[:, 1]
        stands = task.simulation.block_velocity[:, 1] < MOVING
        grow = self.pushing & stands & (lead > self._lead - SPEED)
        self._lead = torch.where(grow, self._lead + LEAD_STEP, self._lead).clamp(max=MAX_LEAD)
        dx = GAIN * (block[:, 0] + self._offset - tool[:, 0])
        dy = torch.where(lead < self._lead, SPEED, 0.0)
        goal += torch.stack([dx.clamp(-SPEED, SPEED), dy, torch.zeros_like(dy)], dim=1)
        goal[:, 2] = self._height
        targets = pose_ik_step(
            task.robot_tables.tool_chain,
            task.env_robot_index,
            task.targets,
            goal,
            self._rotation,
            (
                task.robot_tables.lower[task.env_robot_index],
                task.robot_tables.upper[task.env_robot_index],
            ),
            rotation_budget=task.robot_tables.max_step[task.env_robot_index],
        )
        short = (
            goal[:, 1]
            - frame_positions(task.robot_tables.tool_chain, task.env_robot_index, targets)[:, 1]
        )
        stuck = self.pushing & (dy > 0) & (short > 0.8 * SPEED)
        self._stuck = torch.where(stuck, self._stuck + 1, 0)
        return targets


def _robot_and_layout(task: TaskBatch, env: int) -> tuple[int, int]:
    """Return the indices of an environment's robot and of the layout of its obstacles."""
    return int(task.env_robot_index[env]), int(task.layouts.current[env])
