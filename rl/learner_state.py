"""Save the state of a learner, resume it, and begin with the networks of another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from torch import nn

from morphgen.errors import TaskError
from morphgen.rl.checkpoint_file import in_main_memory
from morphgen.rl.config import PPOConfig, policy_from
from morphgen.rl.learning_rate import FINETUNING_ACTOR_LR_SCALE
from morphgen.rl.observation_layout import last_link, layout_from, layout_of, require_layout
from morphgen.rl.ppo import Learner
from morphgen.tasks.batch import TaskBatch


def state_of(learner: Learner) -> dict[str, Any]:
    """Return the state of training; ``torch.load`` reads it with ``weights_only``.

    The learner does not change. The state of the simulator is not part of it: a resumed run begins
    new episodes, and equals one that continued only if that one calls ``restart_episodes`` when the
    state is saved.
    """
    states = {name: net.state_dict() for name, net in _networks(learner).items()}
    states["optimiser"] = learner.optimiser.state_dict()
    batch: Any = in_main_memory(learner.batch.state_dict())
    return {
        **{name: in_main_memory(state) for name, state in states.items()},
        "generators": {
            name: learner.processes.joined(each.get_state()[None])
            for name, each in learner.generators.items()
        },
        "batch": {
            name: learner.processes.joined(value) if isinstance(value, torch.Tensor) else value
            for name, value in batch.items()
        },
        "actor_lr_scale": learner.actor_lr_scale,
        "update": learner.update,
        "updates": learner.num_updates,
        "device": learner.device.type,
        "layout": learner.layout.as_data(),
        "policy": asdict(learner.policy),
        "config": asdict(learner.config),
    }


def resume(learner: Learner, state: Mapping[str, Any]) -> None:
    """Continue where a learner of the same batch, configuration and device stopped.

    All environments begin new episodes.

    Raises:
        TaskError: If these are not the same; nothing is changed then.
    """
    _require_networks(learner, state)
    ours = {
        **asdict(learner.config),
        "updates": learner.num_updates,
        "device": learner.device.type,
        "processes": learner.processes.size,
    }
    stored = asdict(PPOConfig(**state["config"]))
    processes = len(_states(state["generators"]["actions"]))
    run = {"updates": state["updates"], "device": state["device"], "processes": processes}
    _require_same({**stored, **run}, ours)
    _resume_batch(learner, state["batch"])
    for name, network in _networks(learner).items():
        network.load_state_dict(state[name])
    learner.optimiser.load_state_dict(state["optimiser"])
    for name, generator in learner.generators.items():
        generator.set_state(_states(state["generators"][name])[learner.processes.rank].cpu())
    learner.update, learner.actor_lr_scale = state["update"], state["actor_lr_scale"]
    learner.restart_episodes()


def _states(generators: torch.Tensor) -> torch.Tensor:
    """Return the state of a generator in each process, a row each; older files have one."""
    return generators if generators.ndim > 1 else generators[None]


def _resume_batch(learner: Learner, state: Mapping[str, Any]) -> None:
    """Restore the part of the state of all environments that belongs to this process."""
    n, processes = learner.batch.num_envs, learner.processes
    own = slice(processes.rank * n, (processes.rank + 1) * n)
    if processes.size > 1:
        state = {k: v[own] if isinstance(v, torch.Tensor) else v for k, v in state.items()}
    learner.batch.load_state_dict(state)


def load_networks(learner: Learner, state: Mapping[str, Any]) -> None:
    """Load the networks of a learner's state and nothing else of it, to fine-tune them.

    With a ``desired_kl``, the actor's learning rate begins at ``FINETUNING_ACTOR_LR_SCALE``.

    Raises:
        TaskError: If they are other networks, or for other observations.
    """
    _require_networks(learner, state)
    for name, network in _networks(learner).items():
        network.load_state_dict(state[name])
    if learner.config.desired_kl:
        learner.actor_lr_scale = FINETUNING_ACTOR_LR_SCALE


def use_batch(learner: Learner, batch: TaskBatch) -> None:
    """Continue with other environments; all of them begin new episodes.

    Raises:
        TaskError: If there are more or fewer environments, or their actions or observations differ.
    """
    observation = batch.observe()
    require_layout(learner.layout, layout_of(observation), "the learner")
    if (batch.num_envs, batch.action_kind) != (learner.batch.num_envs, learner.policy.kind):
        raise TaskError(
            f"{batch.num_envs} environments with {batch.action_kind} actions; expected "
            f"{learner.batch.num_envs} with {learner.policy.kind} actions"
        )
    if (links := last_link(observation)) > learner.num_link_rows:
        raise TaskError(
            f"a robot has {links} links; the learner has room for {learner.num_link_rows}"
        )
    learner.use(batch)


def _networks(learner: Learner) -> dict[str, nn.Module]:
    return {
        "actor": learner.actor,
        "critic": learner.critic,
        "target_critic": learner.target_critic,
    }


def _require_networks(learner: Learner, state: Mapping[str, Any]) -> None:
    require_layout(layout_from(state["layout"]), learner.layout, "the checkpoint")
    _require_same(asdict(policy_from(state["policy"])), asdict(learner.policy))


def _require_same(stored: Mapping[str, Any], ours: Mapping[str, Any]) -> None:
    wrong = [f"{k} {stored.get(k)}, here {ours[k]}" for k in ours if stored.get(k) != ours[k]]
    if wrong:
        raise TaskError(f"the checkpoint is of another run: {'; '.join(wrong)}")
