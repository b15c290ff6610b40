"""Save the state of a learner, resume it, and begin with the networks of another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from torch import nn

from morphgen.errors import TaskError
from morphgen.rl.checkpoint_file import in_main_memory
from morphgen.rl.config import PPOConfig, policy_from
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
    return {
        **{name: in_main_memory(state) for name, state in states.items()},
        "generators": {name: each.get_state() for name, each in learner.generators.items()},
        "batch": learner.batch.state_dict(),
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
    }
    stored = asdict(PPOConfig(**state["config"]))
    _require_same({**stored, **{k: state[k] for k in ("updates", "device")}}, ours)
    learner.batch.load_state_dict(state["batch"])
    for name, network in _networks(learner).items():
        network.load_state_dict(state[name])
    learner.optimiser.load_state_dict(state["optimiser"])
    for name, generator in learner.generators.items():
        generator.set_state(state["generators"][name].cpu())
    learner.update, learner.actor_lr_scale = state["update"], state["actor_lr_scale"]
    learner.restart_episodes()


def load_networks(learner: Learner, state: Mapping[str, Any]) -> None:
    """Load the networks of a learner's state and nothing else of it, to fine-tune them.

    Raises:
        TaskError: If they are other networks, or for other observations.
    """
    _require_networks(learner, state)
    for name, network in _networks(learner).items():
        network.load_state_dict(state[name])


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
    learner.batch = batch
    learner.env_robot_index = batch.env_robot_index.to(learner.device)
    learner.num_robots = int(batch.env_robot_index.max()) + 1
    learner.restart_episodes()


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
