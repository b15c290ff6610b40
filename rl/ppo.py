"""Proximal policy optimisation over a batch of robots: the whole algorithm, top to bottom.

An update (``Learner.iterate``) collects a rollout into preallocated buffers, estimates advantages
and returns (GAE), and then takes gradient steps on minibatches of the rollout.

Shapes: T control steps of n environments with R robots; m transitions in a minibatch.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ParamSpec, TypeVar

import numpy as np
import torch
from torch import nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from morphgen.errors import TaskError
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.observation_layout import (
    fields_of,
    joint_entropy,
    layout_of,
    pad_links,
    truncate_links,
    with_fields,
)
from morphgen.rl.policies import entries_unneeded, make_networks, rows_needed
from morphgen.tasks.batch import StepGraph, TaskBatch, can_record
from morphgen.tasks.observation import Observation
from morphgen.tasks.sim.base import is_host


def gae(
    rewards: torch.Tensor,
    values: torch.Tensor,
    next_values: torch.Tensor,
    terminated: torch.Tensor,
    truncated: torch.Tensor,
    *,
    gamma: float,
    gae_lambda: float,
) -> torch.Tensor:
    """Return advantages by generalised estimation (Schulman et al. 2016, equation 16).

    After a termination the return is zero. After a truncation it is the value of the episode's last
    observation (Pardo et al. 2018), and the sum stops there. The critic learns advantages plus
    values. All tensors have the shape (T, n).
    """
    delta = rewards + gamma * torch.where(terminated, 0.0, next_values) - values
    carry = gamma * gae_lambda * (~(terminated | truncated)).to(delta.dtype)
    advantages = torch.empty_like(delta)
    advantage = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        advantage = delta[t] + carry[t] * advantage
        advantages[t] = advantage
    return advantages


def normalized_advantages(
    advantages: torch.Tensor, robots: torch.Tensor | None = None
) -> torch.Tensor:
    """Return advantages (T, n) with mean 0 and deviation 1, over all or by robot (T, n)."""
    if robots is None:
        return (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    index, values = robots.flatten(), advantages.flatten()
    count = torch.bincount(index)
    mean = torch.zeros_like(count, dtype=values.dtype).index_add_(0, index, values) / count
    centred = values - mean[index]
    squares = torch.zeros_like(mean).index_add_(0, index, centred.square())
    deviation = (squares / (count - 1).clamp(min=1)).sqrt()
    return (centred / (deviation[index] + 1e-8)).reshape(advantages.shape)


def symlog(x: torch.Tensor) -> torch.Tensor:
    """Return ``sign(x) ln(1 + |x|)`` (Hafner et al. 2023, DreamerV3, equation 9)."""
    return torch.sign(x) * torch.log1p(torch.abs(x))


def symexp(x: torch.Tensor) -> torch.Tensor:
    """Return ``sign(x) (exp |x| - 1)``, the inverse of ``symlog``."""
    return torch.sign(x) * torch.expm1(torch.abs(x))


def matching_loss(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Return the loss of predictions ``x`` of ``symlog(y)``: 0 if ``symexp(x)`` is ``y``.

    Its derivative in ``x`` is ``symexp(x) - y``. It is convex; for many ``y`` its minimum is the
    symlog of their mean. The squared error of symlogs would learn the mean of the symlogs,
    which is nearer to zero. This is the matching loss of the transfer function ``symexp`` (Auer,
    Herbster and Warmuth 1996, "Exponentially many local minima for single neurons").
    """
    best = symlog(y)
    return _potential(x) - _potential(best) - y * (x - best)


def half_square(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Return half the squared error, the ``matching_loss`` of a critic without symlog."""
    return 0.5 * (x - y).square()


def _potential(x: torch.Tensor) -> torch.Tensor:
    """Return the integral of ``symexp`` from 0 to x."""
    return torch.expm1(torch.abs(x)) - torch.abs(x)


def explained_variance(values: torch.Tensor, returns: torch.Tensor) -> torch.Tensor:
    """Return 1 if values predict the returns, and 0 if no better than the returns' mean."""
    spread = returns.var()
    return torch.where(spread > 0, 1 - (returns - values).var() / spread.clamp(min=1e-12), 0.0)


KL_FACTOR = 1.2
"""Factor by which the actor's learning rate changes per update to follow ``desired_kl``."""
MIN_ACTOR_LR_SCALE = 0.01
"""Smallest factor on the actor's learning rate, so that it rises again soon (rsl_rl: 1e-5/1e-3)."""
FINETUNING_ACTOR_LR_SCALE = 0.1  # factor with which fine-tuning begins if it has a `desired_kl`


def next_actor_lr_scale(config: PPOConfig, scale: float, kl: float) -> float:
    """Return the factor on the actor's learning rate after an update of a divergence [nats]."""
    if not config.desired_kl:
        return 1.0
    if kl > config.desired_kl:
        return max(scale / KL_FACTOR, MIN_ACTOR_LR_SCALE)
    return min(scale * KL_FACTOR, 1.0)


MAX_COMPILED = 64  # functions and input shapes that a process may compile

LossOf = Callable[[Observation, Mapping[str, torch.Tensor], torch.Tensor], tuple[torch.Tensor, ...]]
P = ParamSpec("P")
T = TypeVar("T")


def prepared(
    function: Callable[P, T], device: torch.device, *, bf16: bool, compiled: bool
) -> Callable[P, T]:
    """Return a function that runs another one in bfloat16, or compiled by ``torch.compile``.

    On a GPU the compiled function is a CUDA graph: a gradient step of a small network is hundreds
    of kernels, and to launch them one by one takes longer than they run. The next call of any graph
    overwrites what a graph returned; copy results that you keep. Calls raise TaskError if torch
    cannot compile, for example without a C++ compiler.
    """
    graphs = compiled and device.type == "cuda"
    failures: tuple[type[Exception], ...] = ()
    if compiled:
        from torch._dynamo import config  # takes a second to load
        from torch._dynamo.exc import TorchDynamoException

        # By default torch stops after eight functions and shapes; four learners have as many.
        config.recompile_limit = max(config.recompile_limit, MAX_COMPILED)
        mode = "reduce-overhead" if graphs else None
        function = torch.compile(function, fullgraph=True, dynamic=False, mode=mode)
        failures = (TorchDynamoException,)

    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        if graphs:
            torch.compiler.cudagraph_mark_step_begin()  # type: ignore[no-untyped-call]
        try:
            with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
                return function(*args, **kwargs)
        except failures as error:
            why = next(iter(str(error).strip().splitlines()), type(error).__name__)
            raise TaskError(f"--compile: torch cannot compile here: {why}") from error

    return call


ACTOR_METRICS = ("policy_loss", "entropy", "kl", "clip_fraction")
LEARN_METRICS = (
    *ACTOR_METRICS,
    "value_loss",
    "actor_gradient",
    "critic_gradient",
    "explained_variance",
)
"""Metrics of the gradient steps of an update; see ``UpdateMetrics``."""


@dataclass(frozen=True, kw_only=True)
class UpdateMetrics:
    """Metrics of one update; means over its transitions unless said otherwise.

    Those with a default need environments: cloning has none.
    """

    update: int  # number of updates so far, this one included
    transitions: int  # control steps of all environments so far
    reward: float  # mean reward of a control step
    score: float = math.nan  # mean task score of a control step
    scores: tuple[float, ...] = ()
    """Mean score of each robot, nan for one without an environment; none are recorded of drawn
    robots."""
    success: float = math.nan
    """Share of successes among the episodes that ended in the rollout; nan if none did."""
    episodes: int = 0  # number of episodes that ended in the rollout
    unstable: int = 0  # number of episodes that ended because the simulation diverged
    terms: dict[str, float] = field(default_factory=dict)  # mean of each reward term
    policy_loss: float  # clipped policy loss
    value_loss: float  # half the squared error, or `matching_loss` if the critic predicts symlogs
    entropy: float  # entropy of a robot's actions, or mean of its joints' [nats]
    kl: float = math.nan
    """Divergence of the updated policy from the one that acted [nats] (Schulman 2020, k3)."""
    clip_fraction: float = math.nan  # share of the probability ratios outside of the clip range
    actor_gradient: float  # norm of the actor's gradient before clipping
    critic_gradient: float  # norm of the critic's gradient before clipping
    explained_variance: float
    """Share of the returns' variance that the values before the update explain."""
    learning_rate: float  # learning rate of the actor
    collect_seconds: float = 0.0  # time to collect the rollout [s]
    learn_seconds: float  # time to learn from it [s]
    steps_per_second: float  # transitions per second, collection and learning together


class Learner:
    """Networks, optimiser and rollout of a training run; call ``iterate`` until ``done``."""

    def __init__(
        self,
        batch: TaskBatch,
        policy: PolicyConfig,
        config: PPOConfig,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
        least_links: int = 0,
        tasks: Collection[str] = (),
    ) -> None:
        """Build networks, optimiser and buffers, and begin episodes in the batch."""
        self.policy, self.config, self.device = policy, config, torch.device(device)
        self.update, self.num_updates = 0, config.num_updates(batch.num_envs)
        self.minibatch_size = config.minibatch_size(batch.num_envs)
        self.use(batch)
        tasks = {*tasks, *(spec.task for spec in batch.specs)}
        self._fields = fields_of(tasks)
        observation = with_fields(self._current_observation(), self._fields)
        self.layout = layout_of(observation)
        self.num_link_rows = max(rows_needed(policy, observation), least_links)
        self._unneeded = entries_unneeded(policy, tasks)

        network_seed, *streams = np.random.SeedSequence(seed).generate_state(4).tolist()
        actor, critic = make_networks(policy, self.layout, network_seed)
        self.actor, self.critic = actor.to(self.device), critic.to(self.device)
        self.target_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.optimiser = torch.optim.Adam(
            [{"params": [*net.parameters()]} for net in (self.actor, self.critic)],
            eps=config.adam_epsilon,
            fused=True,
        )
        self._helper = ThreadPoolExecutor(1, "critic")
        self.actor_lr_scale = 1.0
        self.generators = {
            name: torch.Generator(self.device).manual_seed(stream)
            for name, stream in zip(("actions", "minibatches", "weights"), streams, strict=True)
        }
        # In bfloat16 or compiled if the config says so.
        ready = partial(prepared, device=self.device, bf16=config.bf16, compiled=config.compile)
        self._run_actor = ready(self.actor)
        self._run_critic = ready(self.target_critic if config.slow_critic else self.critic)
        # The networks share nothing, so on a CPU each has a loss, in a thread of its own. A second
        # CUDA graph would overwrite the results of the first, and torch compiles in one thread.
        apart = is_host(self.device) and not config.compile
        losses = (self._actor_loss, self._critic_loss) if apart else (self._loss,)
        self._run_losses = tuple(map(ready, losses))

        # The rollout, (T, n, ...). What the networks read and write is on the learner's device.
        obs, T, n = self._network_input(observation), config.num_steps, batch.num_envs
        self.observations = {k: v.new_empty(T, *v.shape) for k, v in obs.items()}
        self.actions = torch.zeros(
            (T, *obs["actions"].shape),
            dtype=torch.int64 if policy.discrete else torch.float32,
            device=self.device,
        )
        self.log_probs = torch.zeros(T, n, device=self.device)
        # Results of the control steps stay on the batch's device: no transfer in the loop.
        self.rewards, self.scores = torch.zeros(2, T, n, device=batch.device)
        self.successes, self.terminated, self.truncated, self.diverged = torch.zeros(
            4, T, n, dtype=torch.bool, device=batch.device
        )
        # The observation after the rollout (n, ...), and the last ones of the k truncated episodes,
        # tensors (k, ...) in the order of torch.nonzero(truncated).
        self.next_observation: Observation = {}
        self.final_observations: Observation = {}

    @property
    def done(self) -> bool:
        """Whether all updates have been made."""
        return self.update >= self.num_updates

    def iterate(self) -> UpdateMetrics:
        """Collect a rollout and learn from it."""
        started = time.perf_counter()
        rollout_metrics = self._collect_rollout()
        collected = time.perf_counter()
        learn_metrics = self._learn()
        self.update += 1
        lost = [name for name, value in learn_metrics.items() if not math.isfinite(value)]
        if lost:
            hint = "look at rewards and observations, or lower the learning rate"
            raise TaskError(f"update {self.update}: not finite: {', '.join(lost)}; {hint}")
        ended = time.perf_counter()
        timesteps = self.config.num_steps * self.batch.num_envs
        return UpdateMetrics(
            update=self.update,
            transitions=self.update * timesteps,
            collect_seconds=collected - started,
            learn_seconds=ended - collected,
            steps_per_second=timesteps / (ended - started),
            **rollout_metrics,
            **learn_metrics,
        )

    def use(self, batch: TaskBatch) -> None:
        """Continue in the environments of a batch, where all begin new episodes."""
        self.batch = batch
        self.env_robot_index = batch.env_robot_index.to(self.device)
        self.num_robots = len(batch.specs)
        self._step_graph = StepGraph(batch) if can_record(batch) else None
        self.restart_episodes()

    def restart_episodes(self) -> None:
        """Begin new episodes in all environments at the next ``iterate``."""
        self._observation: Observation | None = None

    def _current_observation(self) -> Observation:
        """Advance the curriculum, begin episodes if none are under way; return the observation."""
        if self.config.curriculum:
            self.batch.advance(self.update / self.num_updates)
        if self._observation is None:
            # Spread over the length of an episode: they shall not all end in the same rollout.
            self._observation = self.batch.reset(spread=True)
        elif self.config.curriculum:
            self._observation = self.batch.observe()
        return self._observation

    def _needed(self, observation: Observation) -> Observation:
        """Return the entries and the rows of links that the networks need."""
        observation = with_fields(observation, self._fields)
        entries = {name: observation[name] for name in observation if name not in self._unneeded}
        return truncate_links(entries, self.num_link_rows)

    def _network_input(self, observation: Observation) -> Observation:
        """Return what the networks need of an observation, on their device."""
        return {name: value.to(self.device) for name, value in self._needed(observation).items()}

    @torch.no_grad()
    def _collect_rollout(self) -> dict[str, Any]:
        """Act for ``num_steps`` control steps and fill the buffers; return rollout metrics."""
        obs = self._network_input(self._current_observation())
        reward_terms: list[dict[str, torch.Tensor]] = []
        final_rows: list[Observation] = []
        for step in range(self.config.num_steps):
            for name, buffer in self.observations.items():
                buffer[step].copy_(obs[name])
            # A CUDA graph reads its inputs in place, from the buffer: nothing is copied again.
            obs = {name: buffer[step] for name, buffer in self.observations.items()}
            head = self.actor.head(self._run_actor(obs), obs["actions"])
            action = head.sample(self.generators["actions"])
            self.actions[step] = action
            self.log_probs[step] = head.log_prob(action)

            padded = pad_links(action, self.layout.links).to(self.batch.device)
            result = (self._step_graph or self.batch.step)(padded)
            self.rewards[step], self.scores[step] = result.reward, result.score
            self.successes[step], self.diverged[step] = result.success, result.diverged
            self.terminated[step], self.truncated[step] = result.terminated, result.truncated
            reward_terms.append({name: term.mean() for name, term in result.terms.items()})
            final_rows.append(self._rows_to_keep(result.final_observation, result.truncated))
            self._observation = result.observation
            obs = self._network_input(result.observation)
        # The batch may reuse the tensors of its observation in the next step.
        self.next_observation = {name: value.clone() for name, value in obs.items()}
        self.final_observations = self._network_input(self._truncated_rows(final_rows))
        terms = {
            name: torch.stack([means[name] for means in reward_terms]).mean()
            for name in reward_terms[0]
        }
        return self._rollout_metrics(terms)

    def _rows_to_keep(self, observation: Observation, truncated: torch.Tensor) -> Observation:
        """Return a copy of the rows of truncated episodes; on a GPU all rows, to read nothing."""
        rows = truncated if is_host(truncated.device) else slice(None)
        needed = self._needed(observation)
        return {name: value[rows].clone() for name, value in needed.items()}

    def _truncated_rows(self, kept: Sequence[Observation]) -> Observation:
        """Return the rows of the truncated episodes, (k, ...), of those that a rollout kept."""
        if is_host(self.batch.device):
            return {name: torch.cat([step[name] for step in kept]) for name in kept[0]}
        return {n: torch.stack([step[n] for step in kept])[self.truncated] for n in kept[0]}

    def _rollout_metrics(self, terms: Mapping[str, torch.Tensor]) -> dict[str, Any]:
        """Return the metrics of the rollout; terms are means, shape ()."""
        ended = self.terminated | self.truncated
        env_scores, robots = self.scores.mean(dim=0), self.batch.env_robot_index
        robot_scores = torch.zeros(self.num_robots, device=env_scores.device)
        robot_scores.index_add_(0, robots, env_scores)
        robot_envs = torch.bincount(robots, minlength=self.num_robots)
        counts = (self.successes & ended).sum(), ended.sum(), self.diverged.sum()
        means = torch.stack([*counts, self.rewards.mean(), env_scores.mean(), *terms.values()])
        # One copy from the device instead of one for each number.
        sums = torch.cat([means.double(), robot_scores.double(), robot_envs.double()])
        sizes = [len(means), self.num_robots, self.num_robots]
        of_rollout, scores, envs = torch.split(sums.cpu(), sizes)
        successes, episodes, unstable = of_rollout[:3].tolist()
        reward, score, *term_means = of_rollout[3:].tolist()
        return {
            "reward": reward,
            "score": score,
            "scores": tuple((scores / envs).tolist()),
            "success": successes / episodes if episodes else math.nan,
            "episodes": int(episodes),
            "unstable": int(unstable),
            "terms": dict(zip(terms, term_means, strict=True)),
        }

    @torch.no_grad()
    def _compute_returns(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return values, advantages and returns of the rollout, each (T, n)."""
        rewards = self.rewards.to(self.device)
        terminated, truncated = self.terminated.to(self.device), self.truncated.to(self.device)
        flat = {name: buffer.flatten(0, 1) for name, buffer in self.observations.items()}
        values = self._values(flat).reshape(rewards.shape)
        # Values of the observations that the actions led to: where time ended an episode, that of
        # its last observation; where the task did, the next episode's, which ``gae`` ignores.
        next_values = torch.cat([values[1:], self._values(self.next_observation)[None]])
        next_values[truncated] = self._values(self.final_observations)
        gamma, gae_lambda = self.config.gamma, self.config.gae_lambda
        advantages = gae(
            rewards, values, next_values, terminated, truncated, gamma=gamma, gae_lambda=gae_lambda
        )
        return values, advantages, advantages + values

    def _values(self, observation: Observation) -> torch.Tensor:
        """Return expected returns, shape (n,), in chunks of one shape: they compile once."""
        count, size = len(observation["tokens"]), self.minibatch_size
        chunks = [torch.zeros(0, device=self.device)]
        for start in range(0, count, size):
            # The last chunk repeats the last row up to the common shape.
            rows = torch.arange(start, start + size, device=self.device).clamp(max=count - 1)
            chunk = {name: value[rows] for name, value in observation.items()}
            # The next call of a CUDA graph overwrites its output.
            chunks.append(self._run_critic(chunk).clone())
        values = torch.cat(chunks)[:count]
        return symexp(values) if self.config.symlog else values

    def _learn(self) -> dict[str, Any]:
        """Improve actor and critic on the rollout; return the means of ``LEARN_METRICS``."""
        config = self.config
        learning_rate = config.learning_rate * (1 - self.update / self.num_updates)
        actor_group, critic_group = self.optimiser.param_groups
        actor_group["lr"], critic_group["lr"] = learning_rate * self.actor_lr_scale, learning_rate

        values, advantages, returns = self._compute_returns()
        robots = self.env_robot_index.expand_as(advantages) if config.robot_advantages else None
        advantages = normalized_advantages(advantages, robots)
        observations = {name: buffer.flatten(0, 1) for name, buffer in self.observations.items()}
        transitions = {
            "action": self.actions.flatten(0, 1),
            "log_prob": self.log_probs.flatten(),
            "advantage": advantages.flatten(),
            "return": returns.flatten(),
            "robot": self.env_robot_index.repeat(config.num_steps),
        }
        metrics = []
        for _ in range(config.epochs):
            order = torch.randperm(
                returns.numel(), generator=self.generators["minibatches"], device=self.device
            )
            for rows in order.reshape(-1, self.minibatch_size):
                obs = {name: value[rows] for name, value in observations.items()}
                minibatch = {name: value[rows] for name, value in transitions.items()}
                self.optimiser.zero_grad(set_to_none=True)
                losses = self._add_gradients(obs, minibatch, self._robot_weights())
                # Apart: a large gradient of the critic shall not shrink the actor's.
                norms = [
                    nn.utils.clip_grad_norm_(network.parameters(), config.max_grad_norm)
                    for network in (self.actor, self.critic)
                ]
                self.optimiser.step()
                ema_update(self.target_critic, self.critic, config.slow_decay)
                metrics.append(torch.stack([*losses, *norms]))

        self._update_normalizers(observations)
        explained = explained_variance(values, returns)
        mean_metrics = torch.cat([torch.stack(metrics).mean(dim=0), explained[None]])
        means = dict(zip(LEARN_METRICS, mean_metrics.tolist(), strict=True))
        self.actor_lr_scale = next_actor_lr_scale(config, self.actor_lr_scale, means["kl"])
        return {**means, "learning_rate": actor_group["lr"]}

    def _update_normalizers(self, observations: Observation) -> None:
        """Include observations (m, ...) in the statistics, which all networks share."""
        if self.actor.normalizer is None:
            return
        self.actor.normalizer.update(observations)
        for network in (self.critic, self.target_critic):
            assert network.normalizer is not None
            network.normalizer.load_state_dict(self.actor.normalizer.state_dict())

    def _add_gradients(
        self, obs: Observation, minibatch: Mapping[str, torch.Tensor], robot_weights: torch.Tensor
    ) -> torch.Tensor:
        """Add the gradients of a minibatch; return ``ACTOR_METRICS`` and the value loss, (5,).

        Observations and the other facts of the transitions have the shape (m, ...), weights (R,).
        """
        weights = robot_weights[minibatch["robot"]]

        def add(loss_of: LossOf) -> torch.Tensor:
            loss, metrics = loss_of(obs, minibatch, weights)
            loss.backward()  # type: ignore[no-untyped-call]
            return metrics

        first, *others = self._run_losses
        running = [self._helper.submit(add, loss_of) for loss_of in others]
        return torch.cat([add(first), *(each.result() for each in running)])

    def _loss(
        self, obs: Observation, minibatch: Mapping[str, torch.Tensor], weights: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the sum of both losses, shape (), and the metrics of both, shape (5,)."""
        (actor, of_actor), (critic, of_critic) = (
            loss_of(obs, minibatch, weights) for loss_of in (self._actor_loss, self._critic_loss)
        )
        return actor + critic, torch.cat([of_actor, of_critic])

    def _actor_loss(
        self, obs: Observation, minibatch: Mapping[str, torch.Tensor], weights: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the actor's loss, shape (), and ``ACTOR_METRICS``, shape (4,)."""
        head = self.actor.distribution(obs)
        log_ratio = head.log_prob(minibatch["action"]) - minibatch["log_prob"]
        policy = policy_loss(log_ratio, minibatch["advantage"], self.config.clip_coef)
        entropy = joint_entropy(head) if self.config.joint_entropy else head.entropy()
        loss = (weights * (policy - self.config.ent_coef * entropy)).mean()
        ratio = log_ratio.exp()
        kl = ratio - 1 - log_ratio  # Schulman 2020, estimator k3
        clipped = ((ratio - 1).abs() > self.config.clip_coef).float()
        metrics = (policy, entropy, kl, clipped)
        return loss, torch.stack([metric.mean() for metric in metrics]).detach()

    def _critic_loss(
        self, obs: Observation, minibatch: Mapping[str, torch.Tensor], weights: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the critic's loss, shape (), and its mean without weights, shape (1,)."""
        error_of = matching_loss if self.config.symlog else half_square
        error = error_of(self.critic(obs), minibatch["return"])
        return (weights * error).mean(), error.mean()[None].detach()

    def _robot_weights(self) -> torch.Tensor:
        """Return the weight of each robot's transitions, shape (R,), mean 1."""
        if not self.config.task_reweighting:
            return torch.ones(self.num_robots, device=self.device)
        # New ones for each gradient step (Lin et al. 2022, "Reasonable effectiveness of random
        # weighting").
        normal = torch.empty(self.num_robots, device=self.device)
        normal.normal_(generator=self.generators["weights"])
        return self.num_robots * torch.softmax(normal, dim=0)


def policy_loss(log_ratio: torch.Tensor, advantage: torch.Tensor, clip_coef: float) -> torch.Tensor:
    """Return the negative clipped objective (Schulman et al. 2017, equation 7), shape (m,)."""
    ratio = log_ratio.exp()
    clipped_ratio = ratio.clamp(1 - clip_coef, 1 + clip_coef)
    return -torch.minimum(ratio * advantage, clipped_ratio * advantage)


@torch.no_grad()
def ema_update(target: nn.Module, source: nn.Module, decay: float) -> None:
    """Set a network's weights to ``decay * target + (1 - decay) * source``."""
    average = get_ema_multi_avg_fn(decay)  # type: ignore[no-untyped-call]
    average([*target.parameters()], [*source.parameters()], 0)
