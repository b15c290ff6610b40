"""The baseline ``path`` of push, drawer, door and dial: along a path behind the object, then on."""

from __future__ import annotations

import torch

from morphgen.model.kinematics_torch import dls_step_within, frame_jacobian
from morphgen.rl.baselines.path_planner import fractions_of
from morphgen.tasks.actions import encode_actions
from morphgen.tasks.articulated.task import ArticulatedStartSet
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.kinematic_channels import AWAY, DAMPING, NEAR, IkSolutions
from morphgen.tasks.push.envs import GAP
from morphgen.tasks.push.task import PushStartSet
from morphgen.tasks.task import GoalSet

# Lengths are in half edges of the block, or of the articulated object's size.
ASIDE, HIGH = 0.8, 1.1
"""Largest distance of the pushing tool from the middle of the surface, to the side and in height.
"""
HEIGHT = 0.6  # height within which the tool is not corrected
THROUGH, AHEAD = 1.0, 2.0  # how far the tool, and the commanded tool, may be beyond the surface
SLACK = 0.03  # distance of the tool behind the path's end from which it pushes [m]
STEP = 0.06  # step of the tool along the motion that is asked for; joints limit it [m]


class PathPush:
    """Goes along the path of ``IkSolutions`` behind the object, and pushes along its motion there.

    It has no plan of its own: what it does follows from the state and the solution that the channel
    ``ik`` shows, so that a policy with this channel can learn it from demonstrations.
    """

    def __init__(self, seed: int) -> None:
        """Ignore the seed: nothing is random."""
        self._task: TaskBatch | None = None

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions, shape (n, L); tasks without object have actions towards their path."""
        if self._task is not task:
            self._begin(task)
        tables, robots = task.robot_tables, task.env_robot_index
        pose, solutions, half = task.simulation.object_pose, self._solutions, self._half
        goals = task.groups.tool_targets(pose, least=2)
        solutions.forget(task.episode_step == 0)
        solutions.update(task.targets, goals, pose)

        contact = goals.points[:, 1]
        axes = _axes(contact - goals.points[:, 0])
        tool = task.observation.tool_positions(task.q) - contact
        T_root_commanded, J = frame_jacobian(tables.tool_chain, robots, task.targets)
        ahead = ((T_root_commanded[:, :3, 3] - contact) * axes[:, 1]).sum(dim=1)
        x, y, z = (axes @ tool[..., None])[..., 0].unbind(1)
        surface = -self._depth  # of the object, along the motion
        beside = (x.abs() < ASIDE * half) & (z.abs() < HIGH * half)
        behind = (y < surface + THROUGH * half) & (y > surface - (GAP + AWAY + SLACK))
        pushes = beside & behind & (ahead < surface + AHEAD * half)
        height = z.clamp(-HEIGHT * half, HEIGHT * half) - z
        error = torch.stack([-x, torch.full_like(y, STEP), height], dim=1)
        error = (axes.transpose(1, 2) @ error[..., None])[..., 0]
        limits = tables.lower[robots], tables.upper[robots]
        step = dls_step_within(J[:, :3], error, DAMPING, task.targets, limits)
        change = torch.where(pushes[:, None], step, solutions.waypoint - task.targets)
        return encode_actions(fractions_of(task, change), task.action_kind)

    def _begin(self, task: TaskBatch) -> None:
        """Gather the objects of a batch's environments."""
        index = task.env_robot_index
        sizes = torch.tensor([_sizes(spec.goals) for spec in task.specs], device=task.device)
        self._half, self._depth = sizes[index].unbind(1)
        self._solutions = IkSolutions(task.robot_tables, index, task.layouts.space, self._half > 0)
        self._task = task


def _sizes(starts: GoalSet) -> tuple[float, float]:
    """Return half of the object's edge, and how far in it the point is where tools shall be [m]."""
    match starts:
        case PushStartSet():
            return starts.block.size[1] / 2, starts.block.size[1] / 2
        case ArticulatedStartSet():
            return starts.edge / 2, 0.0
    return 0.0, 0.0


def _axes(motion: torch.Tensor) -> torch.Tensor:
    """Return vectors to the side, along motions (n, 3), and up, shape (n, 3, 3)."""
    along = motion / torch.linalg.vector_norm(motion, dim=1, keepdim=True).clamp(min=NEAR)
    up = torch.zeros_like(along)
    up[:, 2] = 1
    # The side of a motion that is nearly vertical is that of x, which is not quite normal to it.
    side = torch.linalg.cross(along, up)
    length = torch.linalg.vector_norm(side, dim=1, keepdim=True)
    side = torch.where(length > 0.1, side / length.clamp(min=NEAR), up.roll(1, dims=1))
    return torch.stack([side, along, torch.linalg.cross(side, along)], dim=1)
