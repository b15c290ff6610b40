"""What a checkpoint says of its learner: checked before anything is made of it."""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import torch

from morphgen.errors import TaskError
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.policies import Layout, layout_from, make_networks

MAX_ROWS = 100_000
"""Links, obstacles or points of an observation; numbers of a token."""
_KINDS: Mapping[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("actor", "critic", "optimiser", "generators", "batch"), dict),
    **dict.fromkeys(("layout", "policy", "config"), dict),
    **dict.fromkeys(("update", "updates"), int),
    "share": (int, float),
    "device": str,
}
"""Entries of every learner, and of which kind they are."""


def require_fields(made: type, data: object, where: str) -> None:
    """Require that stored values fit the fields of a dataclass.

    Args:
        made: The dataclass; its fields that are dataclasses are not looked into.
        data: What is stored of it.
        where: Its place, for messages.

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


def require_learner(learner: object, where: str) -> None:
    """Require that a learner is whole: its networks are those that its sizes ask for.

    Args:
        learner: What a checkpoint holds of it.
        where: The checkpoint, for messages.

    Raises:
        TaskError: If something is missing, of another type, shape or number format.
    """
    if not isinstance(learner, dict):
        raise TaskError(f"{where}: {_short(learner)}: expected a learner")
    for name, kind in _KINDS.items():
        if name not in learner:
            raise TaskError(f"{where}: its learner has no {name}")
        if not isinstance(learner[name], kind) or isinstance(learner[name], bool):
            raise TaskError(f"{where}: {name} of its learner is {_short(learner[name])}")
    require_fields(PolicyConfig, learner["policy"], f"{where}: policy")
    require_fields(PPOConfig, learner["config"], f"{where}: config")
    layout = _layout(learner["layout"], f"{where}: layout")
    try:
        PPOConfig(**learner["config"])
        with torch.device("meta"):  # shapes alone: nothing is allocated
            actor, critic = make_networks(PolicyConfig(**learner["policy"]), layout, 0)
    except TaskError as error:
        raise TaskError(f"{where}: {error}") from error
    wanted = {"actor": actor.state_dict(), "critic": critic.state_dict()}
    for name in ("actor", "critic", "slow"):
        if name in learner:
            _require_network(
                learner[name], wanted["actor" if name == "actor" else "critic"], f"{where}: {name}"
            )
    parameters = [*actor.parameters(), *critic.parameters()]
    _require_optimiser(learner["optimiser"], parameters, f"{where}: optimiser")


def _layout(stored: Mapping[str, Any], where: str) -> Layout:
    """The layout that is stored, if it is one."""
    stored = {**stored}
    if isinstance(stored.get("channels"), list):
        stored["channels"] = tuple(stored["channels"])
    require_fields(Layout, stored, where)
    layout = layout_from(stored)
    for name in ("links", "token", "obstacles", "points"):
        if not 0 <= getattr(layout, name) <= MAX_ROWS:
            raise TaskError(f"{where}: {name} {getattr(layout, name)}: expected 0 to {MAX_ROWS:,}")
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
