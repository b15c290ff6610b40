"""The baseline ``path`` of push: along the path of the channel ``ik``, then straight on."""

from __future__ import annotations

import torch

from morphgen.model.kinematics_torch import dls_step_within, frame_jacobian
from morphgen.rl.baselines.path_planner import fractions_of
from morphgen.tasks.actions import encode_actions
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.kinematic_channels import AWAY, DAMPING, IkSolutions
from morphgen.tasks.push.envs import GAP
from morphgen.tasks.push.task import PushStartSet

ASIDE, HIGH = 0.8, 1.1
"""Largest distance of the pushing tool from the block's centre along x and z, in half edges."""
HEIGHT = 0.6  # height within which the tool is not corrected, in half edges
SLACK = 0.03  # distance of the tool behind the path's end from which it pushes [m]
AHEAD = 1.0  # half edges beyond the block's centre that the commanded tool is at most
STEP = 0.06  # step of the tool along y that is asked for; joints limit it [m]


class PathPush:
    """Goes along the path of ``IkSolutions`` behind the block, and moves the tool along y there.

    It has no plan of its own: what it does follows from the state and the solution that the channel
    ``ik`` shows, so that a policy with this channel can learn it from demonstrations.
    """

    def __init__(self, seed: int) -> None:
        """Ignore the seed: nothing is random."""
        self._task: TaskBatch | None = None

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions, shape (n, L); other tasks than push have actions towards their path."""
        if self._task is not task:
            self._begin(task)
        tables, robots = task.robot_tables, task.env_robot_index
        block, solutions, half = task.simulation.object_pose, self._solutions, self._half
        solutions.forget(task.episode_step == 0)
        solutions.update(task.targets, task.groups.tool_targets(block), block)

        tool = task.observation.tool_positions(task.q) - block[:, :3]
        T_root_commanded, J = frame_jacobian(tables.tool_chain, robots, task.targets)
        ahead = T_root_commanded[:, 1, 3] - block[:, 1]
        x, y, z = tool.unbind(1)
        beside = (x.abs() < ASIDE * half) & (z.abs() < HIGH * half)
        behind = (y < 0) & (y > -(half + GAP + AWAY + SLACK)) & (ahead < AHEAD * half)
        height = z.clamp(-HEIGHT * half, HEIGHT * half) - z
        error = torch.stack([-x, torch.full_like(y, STEP), height], dim=1)
        limits = tables.lower[robots], tables.upper[robots]
        step = dls_step_within(J[:, :3], error, DAMPING, task.targets, limits)
        change = torch.where((beside & behind)[:, None], step, solutions.waypoint - task.targets)
        return encode_actions(fractions_of(task, change), task.action_kind)

    def _begin(self, task: TaskBatch) -> None:
        """Gather the blocks of a batch's environments."""
        index = task.env_robot_index
        sets = [spec.goals for spec in task.specs]
        edges = [each.block.size[1] if isinstance(each, PushStartSet) else 0.0 for each in sets]
        self._half = torch.tensor(edges, device=task.device)[index] / 2
        self._solutions = IkSolutions(
            task.robot_tables, index, task.layouts.space, task.task_mask("push")
        )
        self._task = task
