"""The smallest batch to learn from, a point on a line, and small learners on it."""

import io
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import torch

from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.ppo import Learner
from morphgen.tasks.actions import BINS
from morphgen.tasks.batch import Step
from morphgen.tasks.observation import tree_entries

LINKS = 4
STRIDE = 0.25
NEAR = 0.15


class OnALine:
    """Even environments are reach tasks, whose episodes end by time. Odd environments are push
    tasks: the robot moves in the opposite direction, another link is actuated, the goal is the
    line, and reaching it ends the episode.
    """

    def __init__(self, num_envs, *, kind="discrete", seed=0, horizon=12, tree=False):
        self.tree = tree
        self.specs = [SimpleNamespace(task=task) for task in ("reach", "push")]
        self.num_envs, self.action_kind, self.horizon = num_envs, kind, horizon
        self.device = torch.device("cpu")
        self.env_robot_index = torch.arange(num_envs) % 2
        self.pushes = self.env_robot_index == 1
        self.action_mask = torch.zeros(num_envs, LINKS, dtype=torch.bool)
        self.action_mask[torch.arange(num_envs), 1 + self.env_robot_index] = True
        self.episode_step = torch.zeros(num_envs, dtype=torch.int64)
        self.q, self.goal = torch.zeros(num_envs), torch.zeros(num_envs)
        self.progress = []
        self._random = np.random.default_rng(seed)

    def reset(self, *, spread=False):
        self.spread = spread
        self._begin(torch.ones(self.num_envs, dtype=torch.bool))
        return self.observe()

    def step(self, actions):
        shares = (
            torch.tensor(BINS)[actions] if self.action_kind == "discrete" else actions.clamp(-1, 1)
        )
        way = torch.where(self.pushes, -1.0, 1.0)
        self.q = self.q + STRIDE * way * (shares * self.action_mask).sum(dim=1)
        self.episode_step += 1
        distance = (self.q - self.goal).abs()
        near = distance < NEAR
        terminated = near & self.pushes
        truncated = (self.episode_step >= self.horizon) & ~terminated
        final, q = self.observe(), self.q
        self._begin(terminated | truncated)
        terms = {"distance": -distance, "near": near.float()}
        return Step(
            observation=self.observe(),
            reward=terms["distance"] + terms["near"],
            terminated=terminated,
            truncated=truncated,
            diverged=torch.zeros_like(truncated),
            final_observation=final,
            success=near,
            distance=distance,
            score=-distance,
            terms=terms,
            q=q[:, None],
            object_pose=torch.zeros(self.num_envs, 7),
        )

    def observe(self):
        n = self.num_envs
        tokens = torch.zeros(n, LINKS, 48)
        rows = torch.arange(n)
        tokens[rows, 1 + self.env_robot_index, 20] = torch.where(self.pushes, -1.0, 1.0)
        tokens[rows, 1 + self.env_robot_index, 32] = self.q
        links = torch.zeros(n, LINKS, dtype=torch.bool)
        links[:, :3] = True
        goal, thing = torch.zeros(n, 7), torch.zeros(n, 13)
        goal[:, 0] = torch.where(self.pushes, 0.0, self.goal)
        thing[:, 1] = torch.where(self.pushes, self.q, 0.0)
        return {
            "tokens": tokens,
            "links": links,
            "actions": self.action_mask,
            "goal": goal,
            "goal_mask": ~self.pushes,
            "object": thing,
            "object_mask": self.pushes,
            "line": torch.where(self.pushes, self.goal, 0.0)[:, None],
            "obstacles": torch.zeros(n, 0, 13),
            "obstacle_mask": torch.zeros(n, 0, dtype=torch.bool),
            **(self._tree_entries() if self.tree else {}),
        }

    def _tree_entries(self):
        """The one joint that actions move has no other above it."""
        tables = SimpleNamespace(ancestors=torch.eye(LINKS, dtype=torch.bool).expand(2, -1, -1))
        return tree_entries(tables, self.env_robot_index, self.action_mask)

    def advance(self, progress):
        self.progress.append(progress)

    def state_dict(self):
        return {"random": self._random.bit_generator.state}

    def load_state_dict(self, state):
        self._random.bit_generator.state = state["random"]

    def _begin(self, envs):
        drawn = torch.from_numpy(self._random.uniform(-1, 1, (2, int(envs.sum())))).float()
        self.q, self.goal = self.q.clone(), self.goal.clone()
        self.q[envs], self.goal[envs] = drawn
        self.episode_step[envs] = 0


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
