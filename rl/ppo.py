"""Proximal policy optimisation over a batch of bodies: the whole algorithm, top to bottom."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from morphgen.errors import TaskError
from morphgen.rl.compiled import prepared
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.gae import gae, next_values
from morphgen.rl.learning_rates import learning_rate, next_share
from morphgen.rl.policies import (
    layout_from,
    layout_of,
    make_networks,
    require_layout,
    rows_needed,
    with_all_rows,
    with_rows,
)
from morphgen.rl.report import Numbers, Report, explained_variance, outcome
from morphgen.rl.symlog import half_square, matching_loss, symexp
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.observation import Observation

TOLD = ("reward", "score", "success", "terminated", "truncated", "unstable")
"""What of every step is kept besides observations and actions."""
LOSSES = ("policy_loss", "value_loss", "entropy", "kl", "clip_fraction")
LEARNED = (*LOSSES, "actor_gradient", "critic_gradient")
"""What is reported of gradient steps; see ``Report``."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """T steps of n environments, on the learner's device; of links the rows that are needed."""

    observation: Observation
    """What was acted upon, tensors (T, n, ...)."""
    last: Observation
    """What came after, tensors (n, ...)."""
    final: Observation
    """Where time ended an episode, its last; tensors (k, ...), in the order of ``nonzero``."""
    actions: torch.Tensor
    """Shape (T, n, rows of links)."""
    log_prob: torch.Tensor
    rewards: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    """These four of shape (T, n)."""


class Learner:
    """A policy in training. Once made, ``iterate`` until ``done``."""

    def __init__(
        self,
        batch: TaskBatch,
        policy: PolicyConfig,
        config: PPOConfig,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        """Set up; the batch begins its episodes.

        Args:
            batch: Environments; their actions are of the policy's kind.
            policy: The networks.
            config: The algorithm.
            seed: Of weights, actions, minibatches and weights of robots.
            device: Where networks and rollouts are; the batch may be elsewhere.

        Raises:
            TaskError: If the batch takes other actions, or cannot be split into minibatches.
        """
        if batch.kind != policy.kind:
            raise TaskError(f"the policy's actions are {policy.kind}, the batch's {batch.kind}")
        self.batch, self.policy, self.config = batch, policy, config
        self.device = torch.device(device)
        self.update, self.updates = 0, config.updates(batch.num_envs)
        self._size = config.minibatch(batch.num_envs)
        self._body = batch.body.to(self.device)
        self._bodies = int(batch.body.max()) + 1
        self._observation: Observation | None = None
        self._buffer: Observation = {}
        first = self._begin()
        self.layout, self._rows = layout_of(first), rows_needed(policy, first)
        weights, *streams = np.random.SeedSequence(seed).generate_state(4).tolist()
        actor, critic = make_networks(policy, self.layout, weights)
        self.actor, self.critic = actor.to(self.device), critic.to(self.device)
        self.slow = copy.deepcopy(self.critic).requires_grad_(False)
        self.optimiser = torch.optim.Adam(
            [{"params": [*net.parameters()]} for net in (self.actor, self.critic)],
            eps=config.adam_epsilon,
            fused=True,
        )
        self._share = 1.0
        self._generators = {
            name: torch.Generator(self.device).manual_seed(stream)
            for name, stream in zip(("actions", "minibatches", "weights"), streams, strict=True)
        }
        ready = partial(prepared, device=self.device, bf16=config.bf16, compiled=config.compile)
        self._act = ready(self.actor)
        self._value = ready(self.slow if config.slow_critic else self.critic)
        self._losses = ready(self._objective)

    @property
    def done(self) -> bool:
        """Whether all updates have been made."""
        return self.update >= self.updates

    def iterate(self) -> Report:
        """Collect a rollout and learn from it.

        Raises:
            TaskError: If a number is no longer finite.
            SimulationError: If the simulator failed.
        """
        began = time.perf_counter()
        rollout, seen = self._collect(self._begin())
        collected = time.perf_counter()
        learned = self._learn(rollout)
        self.update += 1
        lost = [name for name, value in learned.items() if not math.isfinite(value)]
        if lost:
            raise TaskError(f"update {self.update}: {', '.join(lost)} is not finite any more")
        ended = time.perf_counter()
        made = self.config.steps * self.batch.num_envs
        return Report(
            update=self.update,
            transitions=self.update * made,
            collect_seconds=collected - began,
            learn_seconds=ended - collected,
            steps_per_second=made / (ended - began),
            **seen,
            **learned,
        )

    def checkpoint(self) -> dict[str, Any]:
        """Return the state of training; ``torch.load`` reads it with ``weights_only``.

        The learner does not change. The state of the simulator is not part of a checkpoint, so
        that a resumed run begins new episodes. A run that continues equals a resumed one only if it
        calls ``restart_episodes`` after the checkpoint.
        """
        learned = {name: net.state_dict() for name, net in self._networks().items()}
        return {
            **copy.deepcopy({**learned, "optimiser": self.optimiser.state_dict()}),
            "generators": {name: each.get_state() for name, each in self._generators.items()},
            "batch": self.batch.state_dict(),
            "share": self._share,
            "update": self.update,
            "updates": self.updates,
            "device": self.device.type,
            "layout": asdict(self.layout),
            "policy": asdict(self.policy),
            "config": asdict(self.config),
        }

    def restart_episodes(self) -> None:
        """Begin new episodes in all environments at the next ``iterate``."""
        self._observation = None

    def resume(self, checkpoint: Mapping[str, Any]) -> None:
        """Go on where another learner of the same batch, configuration and device stopped.

        All environments begin new episodes.

        Raises:
            TaskError: If these are not the same; nothing is changed then.
        """
        self._require_policy(checkpoint)
        here = {**asdict(self.config), "updates": self.updates, "device": self.device.type}
        config = asdict(PPOConfig(**checkpoint["config"]))
        _require_same({**config, **{k: checkpoint[k] for k in ("updates", "device")}}, here)
        self.batch.load_state_dict(checkpoint["batch"])
        for name, network in self._networks().items():
            network.load_state_dict(checkpoint[name])
        self.optimiser.load_state_dict(checkpoint["optimiser"])
        for name, generator in self._generators.items():
            generator.set_state(checkpoint["generators"][name].cpu())
        self.update, self._share = checkpoint["update"], checkpoint["share"]
        self.restart_episodes()

    def adopt(self, checkpoint: Mapping[str, Any]) -> None:
        """Begin with the networks of a checkpoint, and nothing else of it: to fine-tune.

        Raises:
            TaskError: If they are other networks, or for other observations.
        """
        self._require_policy(checkpoint)
        for name, network in self._networks().items():
            network.load_state_dict(checkpoint[name])

    def _networks(self) -> dict[str, nn.Module]:
        return {"actor": self.actor, "critic": self.critic, "slow": self.slow}

    def _require_policy(self, checkpoint: Mapping[str, Any]) -> None:
        require_layout(layout_from(checkpoint["layout"]), self.layout, "the checkpoint")
        _require_same(asdict(PolicyConfig(**checkpoint["policy"])), asdict(self.policy))

    def _begin(self) -> Observation:
        """Move the curriculum, begin episodes if none are under way; what is seen now."""
        if self.config.curriculum:
            self.batch.advance(self.update / self.updates)
        if self._observation is None:
            self._observation = self.batch.reset(spread=True)
        elif self.config.curriculum:
            self._observation = self.batch.observe()
        return self._observation

    def _here(self, observation: Observation) -> Observation:
        """What networks see of an observation, on their device."""
        return {k: v.to(self.device) for k, v in with_rows(observation, self._rows).items()}

    @torch.no_grad()
    def _collect(self, first: Observation) -> tuple[Rollout, Numbers]:
        """Act for ``steps`` control steps; returns them, and what the report says of them."""
        now = self._here(first)
        if not self._buffer:
            self._buffer = {
                name: each.new_empty(self.config.steps, *each.shape) for name, each in now.items()
            }
        acted, told, terms, finals = [], [], [], []
        for t in range(self.config.steps):
            for name, rows in self._buffer.items():
                rows[t].copy_(now[name])
            seen = {name: rows[t] for name, rows in self._buffer.items()}
            head = self.actor.head(self._act(seen), seen["actions"])
            actions = head.sample(self._generators["actions"])
            step = self.batch.step(with_all_rows(actions, self.layout.links).to(self.batch.device))
            acted.append((actions, head.log_prob(actions)))
            told.append([getattr(step, name) for name in TOLD])
            terms.append({name: each.mean() for name, each in step.terms.items()})
            finals.append({k: v[step.truncated] for k, v in step.final_observation.items()})
            self._observation = step.observation
            now = self._here(step.observation)
        tallied = dict(zip(TOLD, map(torch.stack, zip(*told, strict=True)), strict=True))
        means = {k: float(torch.stack([each[k] for each in terms]).mean()) for k in terms[0]}
        actions, log_prob = (torch.stack(each) for each in zip(*acted, strict=True))
        rollout = Rollout(
            observation=self._buffer,
            last={name: each.clone() for name, each in now.items()},
            final=self._here({k: torch.cat([each[k] for each in finals]) for k in now}),
            actions=actions,
            log_prob=log_prob,
            rewards=tallied["reward"].to(self.device),
            terminated=tallied["terminated"].to(self.device),
            truncated=tallied["truncated"].to(self.device),
        )
        return rollout, {**outcome(tallied, self.batch.body, self._bodies), "terms": means}

    @torch.no_grad()
    def _targets(self, rollout: Rollout) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Values, advantages and returns, each (T, n)."""
        flat = {name: each.flatten(0, 1) for name, each in rollout.observation.items()}
        values = self._values(flat).reshape(rollout.rewards.shape)
        ahead = next_values(
            values, self._values(rollout.last), rollout.truncated, self._values(rollout.final)
        )
        advantages = gae(
            rollout.rewards,
            values,
            ahead,
            rollout.terminated,
            rollout.truncated,
            gamma=self.config.gamma,
            lam=self.config.lam,
        )
        return values, advantages, advantages + values

    def _values(self, observation: Observation) -> torch.Tensor:
        """Expected returns by the critic whose word counts, in chunks of one shape, (n,)."""
        count, found = len(observation["goal"]), []
        for start in range(0, count, self._size):
            rows = torch.arange(start, start + self._size, device=self.device)
            rows = rows.clamp(max=count - 1)
            chunk = {name: each[rows] for name, each in observation.items()}
            found.append(self._value(chunk).clone())
        every = torch.cat([torch.zeros(0, device=self.device), *found])[:count]
        return symexp(every) if self.config.symlog else every

    def _learn(self, rollout: Rollout) -> Numbers:
        """Improve the policy and the critic; returns what the report says of it."""
        rate = learning_rate(self.config, self.update, self.updates)
        actor, critic = self.optimiser.param_groups
        actor["lr"], critic["lr"] = rate * self._share, rate
        values, advantages, returns = self._targets(rollout)
        normal = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        seen = {name: each.flatten(0, 1) for name, each in rollout.observation.items()}
        data = {
            "actions": rollout.actions.flatten(0, 1),
            "log_prob": rollout.log_prob.flatten(),
            "advantage": normal.flatten(),
            "return": returns.flatten(),
            "body": self._body.repeat(self.config.steps),
        }
        found = []
        for _ in range(self.config.epochs):
            order = torch.randperm(
                len(data["body"]), generator=self._generators["minibatches"], device=self.device
            )
            for rows in order.reshape(-1, self._size):
                here = {name: each[rows] for name, each in seen.items()}
                found.append(self._descend(here, {k: v[rows] for k, v in data.items()}))
        means = dict(zip(LEARNED, torch.stack(found).mean(dim=0).tolist(), strict=True))
        self._share = next_share(self.config, self._share, means["kl"])
        explained = float(explained_variance(values, returns))
        return {**means, "explained_variance": explained, "learning_rate": actor["lr"]}

    def _descend(self, seen: Observation, data: Observation) -> torch.Tensor:
        """One gradient step on a minibatch, actor and critic clipped apart; ``LEARNED``, (7,)."""
        self.optimiser.zero_grad(set_to_none=True)
        loss, told = self._losses(seen, data, self._weights())
        loss.backward()  # type: ignore[no-untyped-call]
        clip, nets = self.config.gradient_clip, (self.actor, self.critic)
        norms = [nn.utils.clip_grad_norm_(net.parameters(), clip) for net in nets]
        self.optimiser.step()
        follow(self.slow, self.critic, self.config.slow_decay)
        return torch.stack([*told, *norms])

    def _objective(
        self, seen: Observation, data: Observation, weights: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What is to become smaller on a minibatch, shape (), and its ``LOSSES``, (5,).

        Args:
            seen: Observations, tensors (m, ...).
            data: What was done and what came of it, tensors (m, ...).
            weights: How much each robot's transitions count, shape (R,).
        """
        head = self.actor.head(self.actor(seen), seen["actions"])
        log_ratio = head.log_prob(data["actions"]) - data["log_prob"]
        policy = policy_loss(log_ratio, data["advantage"], self.config.clip)
        entropy = head.entropy()
        error = matching_loss if self.config.symlog else half_square
        value = error(self.critic(seen), data["return"])
        loss = (weights[data["body"]] * (policy - self.config.entropy * entropy + value)).mean()
        ratio = log_ratio.exp()
        clipped = ((ratio - 1).abs() > self.config.clip).float()
        told = (policy, value, entropy, ratio - 1 - log_ratio, clipped)
        return loss, torch.stack([each.mean() for each in told]).detach()

    def _weights(self) -> torch.Tensor:
        """How much each robot's transitions count, (R,), mean 1.

        With reweighting they are drawn anew: a softmax of normal numbers (Lin et al. 2022,
        "Reasonable effectiveness of random weighting").
        """
        if not self.config.task_reweighting:
            return torch.ones(self._bodies, device=self.device)
        drawn = torch.empty(self._bodies, device=self.device)
        drawn.normal_(generator=self._generators["weights"])
        return self._bodies * torch.softmax(drawn, dim=0)


def policy_loss(log_ratio: torch.Tensor, advantage: torch.Tensor, clip: float) -> torch.Tensor:
    """The clipped objective (Schulman et al. 2017, equation 7), negative; all shapes (m,)."""
    ratio = log_ratio.exp()
    return -torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)


@torch.no_grad()
def follow(slow: nn.Module, fast: nn.Module, decay: float) -> None:
    """Move the weights of one network towards another's: ``decay`` of its own remain."""
    average = get_ema_multi_avg_fn(decay)  # type: ignore[no-untyped-call]
    average([*slow.parameters()], [*fast.parameters()], 0)


def _require_same(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> None:
    wrong = [f"{k} {theirs.get(k)}, here {ours[k]}" for k in ours if theirs.get(k) != ours[k]]
    if wrong:
        raise TaskError(f"the checkpoint is of another run: {'; '.join(wrong)}")
