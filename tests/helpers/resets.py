"""Resets of some environments of a simulation, by their indices."""

import torch


def reset_envs(simulation, envs, q, block_pose=None, obstacle_poses=None):
    """Reset environments with these indices; the other arguments have a row for each of them."""
    n = len(simulation.scenes)
    rows = torch.as_tensor(envs).to(simulation.device)
    mask = torch.zeros(n, dtype=torch.bool, device=simulation.device)
    mask[rows] = True

    def of_all(values):
        filled = torch.full((n, *values.shape[1:]), torch.nan, device=simulation.device)
        filled[rows] = torch.as_tensor(values, dtype=torch.float32).to(simulation.device)
        return filled

    block_pose = torch.zeros(len(rows), 7) if block_pose is None else block_pose
    obstacles = () if obstacle_poses is None else (of_all(obstacle_poses),)
    simulation.reset(mask, of_all(q), of_all(block_pose), *obstacles)
