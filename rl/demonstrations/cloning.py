"""Behaviour cloning: learn the actions of demonstrations, with the networks and files of PPO.

A run of cloning is a run of training whose update is one gradient step on a minibatch of recorded
steps, in place of a rollout. So it is shown, stopped, resumed, stored and evaluated as any other.
``RunConfig.num_envs`` is the number of steps in a minibatch, and ``PPOConfig.total_timesteps`` that
of all minibatches together.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from morphgen.errors import TaskError
from morphgen.rl.config import PPOConfig
from morphgen.rl.demonstrations.lerobot import data_files
from morphgen.rl.demonstrations.reader import Demonstrations
from morphgen.rl.ppo import (
    Learner,
    UpdateMetrics,
    ema_update,
    explained_variance,
    half_square,
    matching_loss,
    symlog,
)
from morphgen.rl.runs.checkpoint import RunConfig
from morphgen.rl.runs.robot_source import RecordedSource, num_actuated
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.observation import Observation

CHUNK = 4096  # steps whose observations are computed at once
EPISODES = 256  # episodes that are observed at once, step by step, where earlier steps matter
MAX_GIB = 24
"""Most memory that the observations of all steps may take [GiB]; they are computed once."""


def recorded_source(data: Sequence[Demonstrations]) -> RecordedSource:
    """Return the robots and tasks of data sets as the source of a run."""
    folders = [str(each.folder.resolve()) for each in data]
    obstacles = {bool(spec.scene.obstacles) for each in data for spec in each.specs.values()}
    if len(obstacles) > 1:
        raise TaskError("demonstrations among obstacles and without: clone them apart")
    tasks = dict.fromkeys(episode.task for each in data for episode in each.episodes)
    return RecordedSource(
        name=", ".join(each.folder.name for each in data),
        task=",".join(tasks),
        obstacles=obstacles.pop(),
        demonstrations=tuple(folders),
        content=tuple(map(_content, data)),
    )


def _content(data: Demonstrations) -> str:
    """Return the hash of the steps of a data set."""
    digest = hashlib.sha256()
    for path in data_files(data.folder):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def returns_of(data: Demonstrations, gamma: float) -> torch.Tensor:
    """Return the discounted rewards from each step to the end of its episode, shape (n,).

    What would follow a time limit is left out.
    """
    rewards = data.columns["next.reward"].flatten().tolist()
    returns = [0.0] * len(rewards)
    for episode in data.episodes:
        total = 0.0
        for frame in reversed(episode.frames):
            total = returns[frame] = rewards[frame] + gamma * total
    return torch.tensor(returns)


class DemonstrationBatches:
    """The data sets of a run, in place of the environments of ``training.TrainingBatches``."""

    drawn = None

    def __init__(self, config: RunConfig) -> None:
        """Read the data sets, which must be those that the run began with."""
        source = config.source
        assert isinstance(source, RecordedSource)
        self._config = config
        self.data = [Demonstrations(folder) for folder in source.demonstrations]
        for data, content in zip(self.data, source.content, strict=True):
            if _content(data) != content:
                raise TaskError(f"{data.folder} has changed since the run began")
        self.most_links = max(len(robot.links) for data in self.data for robot in data.robots)
        self.tasks = set(source.task.split(","))
        joints = max(
            num_actuated(spec.robot, spec.task)
            for data in self.data
            for spec in data.specs.values()
        )
        self._channels = replace(config.interface.observe, tree_joints=joints)

    def batch(
        self, number: int, frames: Sequence[int] | torch.Tensor
    ) -> tuple[TaskBatch, torch.Tensor]:
        """Return environments in the states of steps of a data set, and the actions there."""
        kind, links = self._config.interface.kind, self._config.max_links
        return self.data[number].batch(frames, self._channels, kind=kind, max_links=links)

    def observed(self, number: int) -> Iterator[tuple[torch.Tensor, Observation, torch.Tensor]]:
        """Yield steps of a data set, their observations and actions, until it has none left."""
        data = self.data[number]
        if not self._channels.ik:
            for start in range(0, len(data), CHUNK):
                frames = torch.arange(start, min(start + CHUNK, len(data)))
                states, action = self.batch(number, frames)
                yield frames, states.observe(), action
            return
        kind, links = self._config.interface.kind, self._config.max_links
        for start in range(0, len(data.episodes), EPISODES):
            episodes = range(start, min(start + EPISODES, len(data.episodes)))
            yield from data.observe_episodes(episodes, self._channels, kind=kind, max_links=links)

    def make(self, update: int) -> TaskBatch:
        """Return environments in as many states as a minibatch has."""
        frames = [i % len(self.data[0]) for i in range(self._config.num_envs)]
        return self.batch(0, frames)[0]

    def close(self) -> None:
        """Do nothing: there is no simulator."""

    def changes_at(self, update: int) -> bool:
        """Return False: all steps are there at all times."""
        return False


class Cloner(Learner):
    """A learner whose actor learns the recorded actions, and whose critic their returns."""

    def __init__(
        self,
        batches: DemonstrationBatches,
        batch: TaskBatch,
        *args: Any,  # noqa: ANN401
        **kwargs: Any,  # noqa: ANN401
    ) -> None:
        """Compute what the policy observes in all steps; the rest is that of ``Learner``."""
        super().__init__(batch, *args, **kwargs)
        parts: list[dict[str, torch.Tensor]] = []
        total = sum(map(len, batches.data))
        returns: list[torch.Tensor] = []
        for number, data in enumerate(batches.data):
            of_frame = returns_of(data, self.config.gamma)
            for frames, observation, action in batches.observed(number):
                seen = {k: v.clone() for k, v in self._needed(observation).items()}
                parts.append(seen | {"label": action[:, : self.num_link_rows].clone()})
                returns.append(of_frame[frames])
                place = self._place(parts[0], total)
        joined = {name: torch.cat([part.pop(name) for part in parts]) for name in [*parts[0]]}
        self._seen = {name: joined.pop(name).to(place) for name in [*joined]}
        self._labels = self._seen.pop("label")
        self._returns = torch.cat(returns).to(place)
        for start in range(0, total, CHUNK):
            chunk = {name: value[start : start + CHUNK] for name, value in self._seen.items()}
            self._update_normalizers({name: each.to(self.device) for name, each in chunk.items()})

    def _place(self, part: dict[str, torch.Tensor], total: int) -> torch.device:
        """Return the device that keeps all steps: a GPU if half of its memory holds them."""
        size = sum(value[0].numel() * value.element_size() for value in part.values())
        if (need := size * total / 2**30) > MAX_GIB:
            raise TaskError(
                f"the observations of {total:,} steps take {need:.0f} GiB; at most {MAX_GIB} are "
                "used: record fewer episodes"
            )
        if self.device.type != "cuda":
            return self.device
        free, _ = torch.cuda.mem_get_info(self.device)
        return self.device if size * total < free / 2 else torch.device("cpu")

    def iterate(self) -> UpdateMetrics:
        """Take a gradient step on random steps of the demonstrations."""
        started = time.perf_counter()
        config: PPOConfig = self.config
        learning_rate = config.learning_rate * (1 - self.update / self.num_updates)
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate
        rows = torch.randint(
            len(self._returns),
            (self.batch.num_envs,),
            generator=self.generators["minibatches"],
            device=self.device,
        ).to(self._returns.device)
        obs = {name: value[rows].to(self.device) for name, value in self._seen.items()}
        head = self.actor.distribution(obs)
        log_prob = head.log_prob(self._labels[rows].to(self.device))
        returns = self._returns[rows].to(self.device)
        values = self.critic(obs)
        error = (matching_loss if config.symlog else half_square)(values, returns)
        self.optimiser.zero_grad(set_to_none=True)
        (error.mean() - log_prob.mean()).backward()  # type: ignore[no-untyped-call]
        norms = [
            nn.utils.clip_grad_norm_(network.parameters(), config.max_grad_norm)
            for network in (self.actor, self.critic)
        ]
        self.optimiser.step()
        ema_update(self.target_critic, self.critic, config.slow_decay)
        self.update += 1
        wanted = symlog(returns) if config.symlog else returns
        explained = explained_variance(values.detach(), wanted)
        numbers = [-log_prob.mean(), error.mean(), head.entropy().mean(), returns.mean()]
        # One transfer: each number that is read alone would wait for the GPU.
        measured = torch.stack([*numbers, explained, *norms])
        loss, value_loss, entropy, mean_return, share, *gradients = measured.detach().tolist()
        if not math.isfinite(loss):
            raise TaskError(f"update {self.update}: the loss is not finite; lower learning_rate")
        seconds = time.perf_counter() - started
        return UpdateMetrics(
            update=self.update,
            transitions=self.update * self.batch.num_envs,
            reward=mean_return,
            policy_loss=loss,
            value_loss=value_loss,
            entropy=entropy,
            actor_gradient=gradients[0],
            critic_gradient=gradients[1],
            explained_variance=share,
            learning_rate=learning_rate,
            learn_seconds=seconds,
            steps_per_second=self.batch.num_envs / seconds,
        )


def data_sets(folders: Sequence[str | Path]) -> list[Demonstrations]:
    """Read data sets whose steps are learned together: their tasks must have the same constants."""
    data = [Demonstrations(folder) for folder in folders]
    for each in data[1:]:
        for task, constants in each.settings["constants"].items():
            first = data[0].settings["constants"].get(task, constants)
            if first != constants:
                raise TaskError(
                    f"{each.folder} has other constants of {task} than {data[0].folder}: clone "
                    "them apart"
                )
    return data
