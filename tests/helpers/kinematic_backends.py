"""The NumPy and torch kinematics behind one interface."""

from dataclasses import dataclass

import torch

from morphgen.model import kinematics, kinematics_torch
from morphgen.model import kinematics_torch as batched
from morphgen.model.kinematics import DAMPING, MAX_STEP, frame_positions, joint_limits

BACKENDS = ("numpy", "float64", "float32")


class NumpyBackend:
    """NumPy kinematics, one robot at a time."""

    tolerance = 1e-9

    def __init__(self, robots):
        self.robots = robots

    def link_poses(self, index, q):
        return kinematics.forward_kinematics(self.robots[index], q)

    def joint_axes(self, index, q):
        return kinematics.joint_axes(self.robots[index], self.link_poses(index, q))

    def frame_pose(self, index, q):
        return kinematics.frame_pose(self.robots[index], q)

    def frame_jacobian(self, index, q):
        return kinematics.frame_jacobian(self.robots[index], q)

    def frame_positions(self, index, q):
        return frame_positions(self.robots[index], q.T).T

    def dls_step(self, J, error, damping):
        return kinematics.dls_step(J, error, damping)

    def solve_position_ik(self, index, q, positions, **options):
        robot = self.robots[index]
        return kinematics.solve_position_ik(robot, q, positions, **options)


@dataclass
class TorchBackend:
    """Torch kinematics, with all robots in one padded batch."""

    robots: list
    dtype: torch.dtype

    def __post_init__(self):
        self.tolerance = 1e-9 if self.dtype == torch.float64 else 2e-5
        self.tree = batched.compile_tree(self.robots, dtype=self.dtype)
        self.chain = batched.compile_chain(self.robots, dtype=self.dtype)
        self.joints = max(robot.dof for robot in self.robots)

    def rows(self, index, q):
        """Return ``robot_index`` and ``q``, padded with ones, which must not matter."""
        padded = torch.ones(len(q), self.joints, dtype=self.dtype)
        padded[:, : q.shape[1]] = torch.from_numpy(q)
        return torch.full((len(q),), index), padded

    def link_poses(self, index, q):
        T = batched.forward_kinematics(self.tree, *self.rows(index, q))
        assert T.dtype == self.dtype
        padding = T[:, ~self.tree.is_link[index]]
        assert (padding == torch.eye(4)).all()
        return T[:, self.tree.is_link[index]].numpy()

    def joint_axes(self, index, q):
        rows = self.rows(index, q)
        found = batched.joint_axes(self.tree, rows[0], batched.forward_kinematics(self.tree, *rows))
        return [each[:, self.tree.is_link[index]].numpy() for each in found]

    def frame_pose(self, index, q):
        return batched.frame_pose(self.chain, *self.rows(index, q)).numpy()

    def frame_jacobian(self, index, q):
        T, J = batched.frame_jacobian(self.chain, *self.rows(index, q))
        assert T.dtype == J.dtype == self.dtype
        dof = self.robots[index].dof
        assert (J[..., dof:] == 0).all()
        return T.numpy(), J[..., :dof].numpy()

    def frame_positions(self, index, q):
        return batched.frame_positions(self.chain, *self.rows(index, q)).numpy()

    def dls_step(self, J, error, damping):
        tensors = (torch.from_numpy(each).to(self.dtype) for each in (J, error))
        return kinematics_torch.dls_step(*tensors, damping).numpy()

    def solve_position_ik(self, index, q, positions, **options):
        options = {"damping": DAMPING, "max_step": MAX_STEP} | options
        robot_index, padded = self.rows(index, q)
        goals = torch.from_numpy(positions).to(self.dtype)
        limits = self.limits(robot_index)
        found, error = kinematics_torch.solve_ik(
            self.chain, robot_index, padded[None], goals, None, limits, **options
        )
        return found[0, :, : q.shape[1]].double().numpy(), error[0].numpy()

    def limits(self, robot_index):
        """Return lower and upper limits of every row, each (n, J)."""
        both = torch.zeros(2, len(self.robots), self.joints, dtype=self.dtype)
        for r, robot in enumerate(self.robots):
            both[:, r, : robot.dof] = torch.from_numpy(joint_limits(robot).T)
        return both[0, robot_index], both[1, robot_index]


def backend(name, robots):
    """Return a backend of ``BACKENDS`` for some robots."""
    if name == "numpy":
        return NumpyBackend(robots)
    return TorchBackend(robots, getattr(torch, name))
