"""Act with a trained policy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from msgspec import structs

from morphgen.errors import TaskError, nearest
from morphgen.formats.records import read_record
from morphgen.rl.agents import AGENTS
from morphgen.rl.config import policy_from
from morphgen.rl.observation_layout import (
    Layout,
    layout_of,
    pad_links,
    require_layout,
    truncate_links,
)
from morphgen.rl.policies import make_networks, rows_needed
from morphgen.rl.runs.checkpoint import policy_interface, read_checkpoint
from morphgen.rl.shipped_policies import checkpoint_path
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.observation import Observation
from morphgen.tasks.registry import require_device
from morphgen.tasks.task import TaskConfig

Mode = Literal["deterministic", "stochastic"]
MODES: tuple[Mode, ...] = ("deterministic", "stochastic")
"""How a policy acts: by the mean of its actions, or by sampling."""


class Policy:
    """A trained policy, from observations to actions.

    Its observations are those of environments that are made with its ``batch_options``::

        policy = load_policy("zero-shot")
        batch = make_batch("reach", ["arm=ur5 ee=stick"], 4, **policy.batch_options)
        actions = policy.act(batch.reset())
    """

    def __init__(
        self,
        learner: dict[str, Any],
        mode: Mode,
        seed: int,
        device: str = "cpu",
        tasks: Sequence[TaskConfig] = (),
    ) -> None:
        """Build the actor of a learner.

        Args:
            learner: State of a learner, as a checkpoint has it.
            mode: Whether the policy acts by the mean of its actions, or samples them.
            seed: Seed of the samples.
            device: Device of the network.
            tasks: Configs of the tasks that the policy is for, as for goals that are poses.

        Raises:
            TaskError: If the state is of an agent that is unknown here.
        """
        self._tasks = tuple(tasks)
        self.layout = read_record(learner["layout"], Layout, "layout", TaskError)
        """Layout of the observations that the policy was trained with."""
        self.config = policy_from(learner["policy"])
        self._device = torch.device(device)
        actor, _ = make_networks(self.config, self.layout, 0)
        actor.load_state_dict(learner["actor"])
        self._actor = actor.to(self._device).eval()
        self._deterministic = mode == "deterministic"
        self._generator = torch.Generator(self._device).manual_seed(seed)

    @property
    def batch_options(self) -> dict[str, Any]:
        """Arguments of ``make_batch`` for environments with the policy's observations and actions.

        They are continuous or discrete actions, the observation channels, the number of links that
        an agent for robots of one size needs, and the configs of the tasks.
        """
        links, obstacles = self.layout.links, self.layout.obstacles
        interface = policy_interface(self.config, max_links=links, obstacles=obstacles)
        return vars(interface) | {"configs": self._tasks}

    def require(self, observation: Observation) -> None:
        """Require that an observation has the layout that the policy was trained with.

        Raises:
            TaskError: If it has another one.
        """
        layout = layout_of(observation)
        if AGENTS[self.config.agent].any_size:
            layout = structs.replace(layout, links=self.layout.links)
        require_layout(self.layout, layout, "the checkpoint")

    @torch.no_grad()
    def act(self, observation: Observation) -> torch.Tensor:
        """Return actions for observations, shape (n, L), on the device of the observations.

        Args:
            observation: Channels by name, tensors (n, ...), as ``TaskBatch`` returns them.

        Raises:
            TaskError: If the observations have another layout than those of the training.
        """
        self.require(observation)
        needed = truncate_links(observation, rows_needed(self.config, observation))
        head = self._actor.distribution({k: v.to(self._device) for k, v in needed.items()})
        actions = head.mode() if self._deterministic else head.sample(self._generator)
        return pad_links(actions, observation["links"].shape[1]).to(observation["links"].device)


def load_policy(
    path: Path | str, mode: Mode = "deterministic", seed: int = 0, device: str = "cpu"
) -> Policy:
    """Load a policy. Nothing in its checkpoint is executed.

    Args:
        path: A checkpoint, the folder of a run, or the name of a shipped policy, such as
            ``zero-shot``.
        mode: Whether the policy acts by the mean of its actions, or samples them.
        seed: Seed of the samples.
        device: Device of the network.

    Raises:
        TaskError: If the checkpoint is missing, damaged or of another version, or the mode or
            device is unknown.
    """
    if mode not in MODES:
        raise TaskError(f"unknown mode {mode!r}{nearest(str(mode), MODES)}")
    require_device(device)
    run, learner = read_checkpoint(checkpoint_path(path))
    return Policy(learner, mode, seed, device, run.evaluation_tasks)


class PolicyController:
    """Let a policy act in a batch as baselines do: it observes the batch, and acts on that."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions of all environments, shape (n, L).

        Raises:
            TaskError: If the batch has other observations than those of the training.
        """
        return self.policy.act(task.observe())
