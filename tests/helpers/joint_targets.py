"""Paths of joint targets for comparisons of simulators."""

import numpy as np
import torch

from morphgen.model.kinematics import joint_limits
from morphgen.tasks.scenes.robot_tables import STEP_SLIDE, STEP_TURN
from morphgen.tasks.sim.base import CONTROL_PERIOD

SECOND = round(1 / CONTROL_PERIOD)
"""A second [control steps]."""


def largest_steps(body):
    """Return the largest target change per step in the benchmark, shape (dof,)."""
    joints = [body.joints[k] for k in body.independent_joints]
    most = [STEP_SLIDE if joint.kind == "prismatic" else STEP_TURN for joint in joints]
    fast = [(joint.velocity or np.inf) * CONTROL_PERIOD for joint in joints]
    return np.minimum(most, fast)


def smooth_walk(body, seed, steps=SECOND):
    """Targets that start at home and drift, slowly turning, as fast as the benchmark lets them."""
    rng = np.random.default_rng(seed)
    action, actions = np.zeros(body.dof), []
    for _ in range(steps):
        action = 0.9 * action + 0.3 * rng.normal(size=body.dof)
        actions.append(action)
    return _integrated(body, actions)


def random_walk(body, seed, steps=SECOND):
    """Targets of independent random actions, as those of a policy that has learned nothing."""
    rng = np.random.default_rng(seed)
    return _integrated(body, rng.uniform(-1, 1, (steps, body.dof)))


def full_speed(body, seed, steps=SECOND):
    """Targets that move from home in one direction as fast as the benchmark lets them."""
    rng = np.random.default_rng(seed)
    return _integrated(body, [rng.choice([-1.0, 1.0], size=body.dof)] * steps)


def _integrated(body, actions):
    """Targets within the joint limits after each action, shape (steps, dof)."""
    target, path = np.array(body.home), []
    for action in actions:
        moved = target + largest_steps(body) * np.clip(action, -1, 1)
        target = np.clip(moved, *joint_limits(body).T)
        path.append(target)
    return np.array(path)


def held(sim, steps):
    q = sim.q.clone()
    for _ in range(steps):
        sim.step(q)
    return sim


def drive(sim, steps=25, seed=0):
    """Step with random targets that do not depend on an environment's index."""
    start = sim.q.clone()
    for k in range(steps):
        change = np.random.default_rng([seed, k]).uniform(-0.3, 0.3, 32)
        sim.step(start + torch.from_numpy(change).float()[: start.shape[1]])
