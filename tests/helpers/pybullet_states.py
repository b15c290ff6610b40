"""Helpers for PyBullet tests: start states, random walks and contact queries."""

import numpy as np
import pybullet
import torch

from helpers.resets import homes, reset_envs, state

PUSHING = (0.0, -0.2, 0.62, np.pi / 2, 0.0)
"""The gantry's plate upright behind the block, off the ground."""


def starts(simulation):
    """Return start states at home or behind the block, with blocks at their scene poses."""
    q, poses = homes(simulation)
    for env, scene in enumerate(simulation.scenes):
        if scene.block and scene.robot.name == "prims":
            q[env, : len(PUSHING)] = torch.tensor(PUSHING)
    return q, poses


def reset(simulation, q=None, pose=None, envs=None):
    envs = torch.arange(len(simulation.scenes)) if envs is None else envs
    home, blocks = starts(simulation)
    q = home[envs] if q is None else torch.as_tensor(q, dtype=torch.float32).reshape(len(envs), -1)
    pose = blocks[envs] if pose is None else torch.as_tensor(pose, dtype=torch.float32)
    reset_envs(simulation, envs, q, pose.reshape(len(envs), 7))
    return q


def client_of(simulation, env=0):
    """The PyBullet client of an environment."""
    return simulation.batch._loaded[env]


def wander(simulation, q, steps, seed=0, size=0.03, ahead=0.0):
    """Step with targets on a random walk from ``q``, the same for every environment.

    ``ahead`` is added to the second joint's target each step; it is the gantry's y axis.
    """
    generator = torch.Generator().manual_seed(seed)
    seen = []
    for _ in range(steps):
        q = q + size * torch.randn(q.shape[1], generator=generator)
        q[:, 1] += ahead
        simulation.step(q)
        seen.append(state(simulation))
    return torch.stack(seen)


def touching(simulation, env=0):
    """Pairs of (body, link) in contact after the last step."""
    points = pybullet.getContactPoints(physicsClientId=client_of(simulation, env).id)
    return {((p[1], p[3]), (p[2], p[4])) for p in points if p[9] > 0}
