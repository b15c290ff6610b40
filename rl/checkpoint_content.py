"""Check the content of a checkpoint before anything is built from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from morphgen.errors import TaskError
from morphgen.rl.config import PPOConfig, policy_from, read_fields, shown
from morphgen.rl.observation_layout import Layout
from morphgen.rl.policies import make_networks

MAX_ROWS = 100_000
"""Largest number of links, obstacles or points of an observation, and of numbers of a token."""
_KINDS: Mapping[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("actor", "critic", "optimiser", "generators", "batch"), dict),
    **dict.fromkeys(("layout", "policy", "config"), dict),
    **dict.fromkeys(("update", "updates"), int),
    "actor_lr_scale": (int, float),
    "device": str,
}
"""Entries of every learner, and their types."""


def require_learner(learner: object, where: str) -> None:
    """Require that the state of a learner is complete, and its weights have the right shapes.

    Args:
        learner: The state, as a checkpoint has it.
        where: The checkpoint, for messages.

    Raises:
        TaskError: If an entry is missing, or of another type, shape or number format.
    """
    if not isinstance(learner, dict):
        raise TaskError(f"{where}: {shown(learner)}: expected a learner")
    for name, kind in _KINDS.items():
        if name not in learner:
            raise TaskError(f"{where}: its learner has no {name}")
        if not isinstance(learner[name], kind) or isinstance(learner[name], bool):
            raise TaskError(f"{where}: {name} of its learner is {shown(learner[name])}")
    layout = _layout(learner["layout"], f"{where}: layout")
    try:
        PPOConfig(**read_fields(learner["config"], PPOConfig, "config"))
        policy = policy_from(learner["policy"])
        with torch.device("meta"):  # shapes alone: nothing is allocated
            actor, critic = make_networks(policy, layout, 0)
    except TaskError as error:
        raise TaskError(f"{where}: {error}") from error
    wanted = {"actor": actor.state_dict(), "critic": critic.state_dict()}
    for name in ("actor", "critic", "target_critic"):
        if name in learner:
            _require_network(
                learner[name], wanted["actor" if name == "actor" else "critic"], f"{where}: {name}"
            )
    parameters = [*actor.parameters(), *critic.parameters()]
    _require_optimiser(learner["optimiser"], parameters, f"{where}: optimiser")


def _layout(stored: Mapping[str, Any], where: str) -> Layout:
    """Return the stored layout, if it is valid."""
    layout = Layout(**read_fields(stored, Layout, where))
    sizes = {name: getattr(layout, name) for name in ("links", "token", "obstacles", "points")}
    named = [*sizes.items(), *(field[:2] for field in layout.fields), *layout.vectors]
    for name, size in named:
        if not 0 <= size <= MAX_ROWS:
            raise TaskError(f"{where}: {name} {size}: expected 0 to {MAX_ROWS:,}")
    return layout


def _require_network(stored: object, wanted: Mapping[str, torch.Tensor], where: str) -> None:
    if not isinstance(stored, dict):
        raise TaskError(f"{where} is {shown(stored)}; expected weights")
    for name in wanted:
        if name not in stored:
            raise TaskError(f"{where} has no {name}")
    for name, tensor in stored.items():
        if name not in wanted:
            raise TaskError(f"{where} has {shown(name)}, which its sizes do not ask for")
        if not isinstance(tensor, torch.Tensor):
            raise TaskError(f"{where}: {name} is {shown(tensor)}; expected a tensor")
        actual = (tuple(tensor.shape), tensor.dtype)
        expected = (tuple(wanted[name].shape), wanted[name].dtype)
        if actual != expected:
            raise TaskError(
                f"{where}: {name} has shape {actual[0]} of {actual[1]}; expected {expected[0]} of "
                f"{expected[1]}"
            )


def _require_optimiser(
    stored: dict[str, Any], parameters: list[torch.nn.Parameter], where: str
) -> None:
    state, groups = stored.get("state"), stored.get("param_groups")
    if not isinstance(state, dict) or not isinstance(groups, list):
        raise TaskError(f"{where} has no state or no param_groups")
    for number, moments in state.items():
        if not isinstance(number, int) or not 0 <= number < len(parameters):
            raise TaskError(f"{where}: state of an unknown parameter {shown(number)}")
        if not isinstance(moments, dict):
            raise TaskError(f"{where}: state {number} is {shown(moments)}")
        for name in ("exp_avg", "exp_avg_sq"):
            moment = moments.get(name)
            shape = tuple(parameters[number].shape)
            if not isinstance(moment, torch.Tensor) or tuple(moment.shape) != shape:
                raise TaskError(f"{where}: {name} of parameter {number} is not of shape {shape}")
