"""A simulation of a few tensor operations, for batches with blocks and obstacles on any device."""

import torch


class StubSimulation:
    """Joints are at their targets after a step, and blocks move along y.

    Attributes:
        diverges: Environments that diverge in the next step, shape (n,), bool.
    """

    def __init__(self, scenes, speed=0.05):
        self.scenes, self.device, self.speed = tuple(scenes), torch.device("cpu"), speed
        n, joints = len(scenes), max(scene.robot.dof for scene in scenes)
        self.q, self.qd = torch.zeros(n, joints), torch.zeros(n, joints)
        self.object_pose, self.object_velocity = torch.zeros(n, 7), torch.zeros(n, 6)
        num_obstacles = max(len(scene.obstacles) for scene in scenes)
        self.obstacle_poses = torch.zeros(n, num_obstacles, 7)
        self.has_block = torch.tensor([scene.block is not None for scene in scenes])
        self.diverges = torch.zeros(n, dtype=torch.bool)
        self.resets = torch.zeros(n, dtype=torch.int64)

    def reset(self, mask, q, object_pose, obstacle_poses=None):
        self.q.copy_(torch.where(mask[:, None], q, self.q))
        self.qd.masked_fill_(mask[:, None], 0)
        self.object_pose.copy_(torch.where(mask[:, None], object_pose, self.object_pose))
        if obstacle_poses is not None:
            moved = torch.where(mask[:, None, None], obstacle_poses, self.obstacle_poses)
            self.obstacle_poses.copy_(moved)
        self.resets += mask

    def step(self, targets):
        self.qd.copy_(targets - self.q)
        self.q.copy_(torch.where(self.diverges[:, None], torch.nan, targets))
        self.object_pose[:, 1] += self.speed * self.has_block
        diverged = self.diverges.clone()
        self.diverges.zero_()
        return diverged

    def faults(self):
        return {}

    def close(self):
        pass
