"""Resets of some environments of a simulation, and its state."""

import torch


def reset_envs(simulation, envs, q, object_pose=None, obstacle_poses=None):
    """Reset environments with these indices; the other arguments have a row for each of them."""
    n = len(simulation.scenes)
    rows = torch.as_tensor(envs).to(simulation.device)
    mask = torch.zeros(n, dtype=torch.bool, device=simulation.device)
    mask[rows] = True

    def of_all(values):
        filled = torch.full((n, *values.shape[1:]), torch.nan, device=simulation.device)
        filled[rows] = torch.as_tensor(values, dtype=torch.float32).to(simulation.device)
        return filled

    object_pose = torch.zeros(len(rows), 7) if object_pose is None else object_pose
    obstacles = () if obstacle_poses is None else (of_all(obstacle_poses),)
    simulation.reset(mask, of_all(q), of_all(object_pose), *obstacles)


def homes(simulation):
    """Return the joint positions at home and the poses of the blocks, (n, J) and (n, 7)."""
    q, poses = torch.zeros_like(simulation.q), torch.zeros_like(simulation.object_pose)
    for env, scene in enumerate(simulation.scenes):
        q[env, : scene.robot.dof] = torch.tensor(scene.robot.home)
        if scene.block is not None:
            poses[env] = torch.tensor((*scene.block.pose.position, *scene.block.pose.quaternion))
    return q, poses


def put_home(simulation, envs=None):
    """Reset all environments, or some of them, to their homes."""
    envs = list(range(len(simulation.scenes)) if envs is None else envs)
    q, poses = homes(simulation)
    reset_envs(simulation, envs, q[envs], poses[envs])


def state(simulation):
    """Return copies of all reported state, a row for each environment."""
    parts = (simulation.q, simulation.qd, simulation.object_pose, simulation.object_velocity)
    return torch.cat(parts, dim=1).clone()
