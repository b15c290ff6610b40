"""Storage of one rollout of PPO, allocated once."""

from __future__ import annotations

import torch

from morphgen.rl.metrics import Metrics
from morphgen.tasks.observation import Observation

STEP_KEYS = ("reward", "score", "success", "terminated", "truncated", "diverged")
"""Fields of a control step's result that a rollout keeps, besides observations and actions."""


class RolloutBuffer:
    """Storage of one rollout: T control steps of n environments, allocated once.

    The observations have only those rows of links that the networks need.
    """

    def __init__(
        self, observation: Observation, num_steps: int, *, discrete: bool, device: torch.device
    ) -> None:
        """Allocate the buffers on the learner's device; those of the steps on the batch's.

        Args:
            observation: An observation as the networks get it, tensors (n, ...), on their device.
            num_steps: Rollout length T [control steps].
            discrete: Whether actions are bins.
            device: Device of the batch.
        """
        n, rows = observation["actions"].shape
        on = observation["actions"].device
        self.observations = {
            name: value.new_empty(num_steps, *value.shape) for name, value in observation.items()
        }
        kind = torch.int64 if discrete else torch.float32
        self.actions = torch.zeros(num_steps, n, rows, dtype=kind, device=on)
        self.log_probs = torch.zeros(num_steps, n, device=on)
        self.reward = torch.zeros(num_steps, n, device=device)
        self.score = torch.zeros(num_steps, n, device=device)
        self.success = torch.zeros(num_steps, n, dtype=torch.bool, device=device)
        self.terminated = torch.zeros(num_steps, n, dtype=torch.bool, device=device)
        self.truncated = torch.zeros(num_steps, n, dtype=torch.bool, device=device)
        self.diverged = torch.zeros(num_steps, n, dtype=torch.bool, device=device)
        self.last_observation: Observation = {}
        """The observation after the rollout, tensors (n, ...)."""
        self.final_observations: Observation = {}
        """The last observations of the truncated episodes, tensors (k, ...), in the order of
        ``torch.nonzero(truncated)``."""

    def metrics(self, env_robot_index: torch.Tensor, num_robots: int) -> Metrics:
        """Return rewards and scores of the rollout, and the episodes that ended in it.

        Args:
            env_robot_index: Index of each environment's robot, shape (n,), int64.
            num_robots: Number of robots.
        """
        ended = self.terminated | self.truncated
        score = self.score.mean(dim=0)
        count = torch.bincount(env_robot_index, minlength=num_robots)
        scores = torch.zeros(num_robots, device=score.device).index_add_(0, env_robot_index, score)
        return {
            "reward": float(self.reward.mean()),
            "score": float(score.mean()),
            "scores": tuple((scores / count).tolist()),
            "success": float(self.success[ended].float().mean()),
            "episodes": int(ended.sum()),
            "unstable": int(self.diverged.sum()),
        }
