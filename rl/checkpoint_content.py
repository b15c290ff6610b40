"""Check the content of a checkpoint before anything is built from it."""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import torch

from morphgen.errors import TaskError
from morphgen.rl.agents import AGENTS
from morphgen.rl.config import PolicyConfig, PPOConfig, policy_from
from morphgen.rl.observation_layout import Layout, layout_from
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


def require_fields(made: type, data: object, where: str) -> None:
    """Require that stored values fit the fields of a dataclass.

    Args:
        made: The dataclass; its fields that are dataclasses themselves are not checked.
        data: The stored values.
        where: Place of the values, for messages.

    Raises:
        TaskError: If a field is unknown or missing, or its value of another type.
    """
    if not isinstance(data, Mapping):
        raise TaskError(f"{where}: {_short(data)}: expected a table")
    hints = get_type_hints(made)
    known = {each.name: each for each in fields(made)}
    for name, value in data.items():
        if name not in known:
            raise TaskError(f"{where}: unknown entry {_short(name)}")
        if not _fits(value, hints[name]):
            kind = getattr(hints[name], "__name__", None) or str(hints[name])
            expected = str(hints[name]) if get_args(hints[name]) else kind
            raise TaskError(
                f"{where}: {name} {_short(value)}: expected {expected.replace('typing.', '')}"
            )
    for name, each in known.items():
        if name not in data and each.default is MISSING and each.default_factory is MISSING:
            raise TaskError(f"{where}: no {name}")


def require_policy(data: object, where: str) -> None:
    """Require that stored values fit a policy config, and the sizes of its agent's networks.

    Raises:
        TaskError: If the agent is unknown, or as ``require_fields``.
    """
    require_fields(PolicyConfig, data, where)
    assert isinstance(data, Mapping)
    try:
        network = AGENTS[data.get("agent", PolicyConfig.agent)].config
    except TaskError as error:
        raise TaskError(f"{where}: {error}") from error
    if data.get("network") is not None:
        require_fields(network, data["network"], where)


def require_learner(learner: object, where: str) -> None:
    """Require that the state of a learner is complete, and its weights have the right shapes.

    Args:
        learner: The state, as a checkpoint has it.
        where: The checkpoint, for messages.

    Raises:
        TaskError: If an entry is missing, or of another type, shape or number format.
    """
    if not isinstance(learner, dict):
        raise TaskError(f"{where}: {_short(learner)}: expected a learner")
    for name, kind in _KINDS.items():
        if name not in learner:
            raise TaskError(f"{where}: its learner has no {name}")
        if not isinstance(learner[name], kind) or isinstance(learner[name], bool):
            raise TaskError(f"{where}: {name} of its learner is {_short(learner[name])}")
    require_policy(learner["policy"], f"{where}: policy")
    require_fields(PPOConfig, learner["config"], f"{where}: config")
    layout = _layout(learner["layout"], f"{where}: layout")
    try:
        PPOConfig(**learner["config"])
        with torch.device("meta"):  # shapes alone: nothing is allocated
            actor, critic = make_networks(policy_from(learner["policy"]), layout, 0)
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
    stored = {**stored}
    if isinstance(stored.get("channels"), list):
        stored["channels"] = tuple(stored["channels"])
    require_fields(Layout, stored, where)
    layout = layout_from(stored)
    sizes = {name: getattr(layout, name) for name in ("links", "token", "obstacles", "points")}
    for name, size in [*sizes.items(), *(field[:2] for field in layout.fields)]:
        if not 0 <= size <= MAX_ROWS:
            raise TaskError(f"{where}: {name} {size}: expected 0 to {MAX_ROWS:,}")
    return layout


def _require_network(stored: object, wanted: Mapping[str, torch.Tensor], where: str) -> None:
    if not isinstance(stored, dict):
        raise TaskError(f"{where} is {_short(stored)}; expected weights")
    for name in wanted:
        if name not in stored:
            raise TaskError(f"{where} has no {name}")
    for name, tensor in stored.items():
        if name not in wanted:
            raise TaskError(f"{where} has {_short(name)}, which its sizes do not ask for")
        if not isinstance(tensor, torch.Tensor):
            raise TaskError(f"{where}: {name} is {_short(tensor)}; expected a tensor")
        found = (tuple(tensor.shape), tensor.dtype)
        expected = (tuple(wanted[name].shape), wanted[name].dtype)
        if found != expected:
            raise TaskError(
                f"{where}: {name} has shape {found[0]} of {found[1]}; expected {expected[0]} of "
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
            raise TaskError(f"{where}: state of an unknown parameter {_short(number)}")
        if not isinstance(moments, dict):
            raise TaskError(f"{where}: state {number} is {_short(moments)}")
        for name in ("exp_avg", "exp_avg_sq"):
            moment = moments.get(name)
            shape = tuple(parameters[number].shape)
            if not isinstance(moment, torch.Tensor) or tuple(moment.shape) != shape:
                raise TaskError(f"{where}: {name} of parameter {number} is not of shape {shape}")


def _fits(value: object, hint: object) -> bool:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return isinstance(value, str) and value in arguments
    if origin in (Union, types.UnionType):
        return any(_fits(value, each) for each in arguments)
    if origin is tuple:
        if not isinstance(value, tuple | list):
            return False
        kinds = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        return len(kinds) == len(value) and all(map(_fits, value, kinds))
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if is_dataclass(hint):
        return isinstance(value, Mapping)
    return isinstance(hint, type) and isinstance(value, hint)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}..."
