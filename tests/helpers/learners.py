"""Small learners on a one-dimensional task, and comparisons of their weights."""

import io
from dataclasses import asdict, replace

import torch

from helpers.line_batch import OnALine
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.ppo import Learner

SMALL = PPOConfig(total_timesteps=4 * 8 * 8, num_steps=8, epochs=2, minibatches=4, desired_kl=0)
"""Four updates of eight environments."""


def learner(batch=None, *, agent="me-mlp", seed=0, discrete=True, device="cpu", **changes):
    kind = "discrete" if discrete else "continuous"
    batch = batch or OnALine(8, kind=kind, tree=agent == "me-graph")
    policy = PolicyConfig(agent=agent, discrete=discrete)
    return Learner(batch, policy, replace(SMALL, **changes), seed=seed, device=device)


def weights(agent):
    networks = {"actor": agent.actor, "critic": agent.critic, "target_critic": agent.target_critic}
    return {
        f"{name}.{key}": each.clone()
        for name, network in networks.items()
        for key, each in network.state_dict().items()
    }


def equal(a, b):
    return all(a[name].equal(b[name]) for name in a)


def untimed(report):
    """Return the report without timings, as repr because nan != nan."""
    timed = ("collect_seconds", "learn_seconds", "steps_per_second")
    return repr({name: value for name, value in asdict(report).items() if name not in timed})


def stored(checkpoint):
    """Return a checkpoint after a round trip through a file."""
    file = io.BytesIO()
    torch.save(checkpoint, file)
    file.seek(0)
    return torch.load(file, weights_only=True)
