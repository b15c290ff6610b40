"""Variants of agents: a name, and switches that are on or off, such as ``me-tf-symlog``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from morphgen.benchmark.split import Side
from morphgen.errors import TaskError, nearest
from morphgen.rl.config import AGENTS, AgentName, PolicyConfig, PPOConfig
from morphgen.tasks.registry import TASKS

OF_POLICY = ("discrete", "fixed-deviation", "mask-morphology", "tool-position")
OF_PPO = ("symlog", "slow-critic", "task-reweighting", "curriculum")
SWITCHES = (*OF_PPO, *OF_POLICY)
ABLATION = (
    "se-symlog-slow-critic-discrete",
    "se-symlog-slow-critic-discrete@test",
    "me-mlp-symlog-slow-critic-discrete",
    "me-tf-symlog-slow-critic-discrete",
    "me-tf-discrete",
    "me-tf+discrete",
    "me-tf+discrete+task-reweighting",
)
"""The rows of the paper's table of ablations, which says "symlog" of symlog with slow critic."""

_NAMES = "|".join(re.escape(name) for name in AGENTS)
_SWITCHES = "|".join(re.escape(name) for name in SWITCHES)
_TEXT = re.compile(rf"({_NAMES})((?:[+-](?:{_SWITCHES}))*)")


@dataclass(frozen=True)
class Variant:
    """An agent with switches; those that are not named are as ``settle`` has them."""

    agent: AgentName
    switches: Mapping[str, bool] = field(default_factory=dict)

    def __str__(self) -> str:
        """Such as ``me-tf-symlog+task-reweighting``, in the order of ``SWITCHES``."""
        named = (name for name in SWITCHES if name in self.switches)
        return self.agent + "".join("-+"[self.switches[name]] + name for name in named)


def parse_variant(text: str) -> Variant:
    """Read ``me-tf+discrete-symlog``: an agent, and what is switched on (+) or off (-).

    Raises:
        TaskError: If the agent or a switch is unknown, or a switch is named twice.
    """
    match = _TEXT.fullmatch(text)
    if match is None:
        agent = next((name for name in AGENTS if re.match(rf"{name}[+-]", text)), None)
        if agent is None:
            name = re.split(r"\+", text)[0]
            raise TaskError(f"unknown agent {name!r}{nearest(name, AGENTS)}")
        raise TaskError(
            f"agent {text!r}: after {agent} come switches, each with + for on or - for off; "
            f"valid: {', '.join(SWITCHES)}"
        )
    named = re.findall(rf"([+-])({_SWITCHES})", match[2])
    switches = {name: sign == "+" for sign, name in named}
    if len(switches) < len(named):
        raise TaskError(f"agent {text!r}: a switch is named twice")
    return Variant(match[1], switches)  # type: ignore[arg-type]


def parse_agents(text: str) -> list[tuple[str, Variant, Side]]:
    """Read the agents of a study: what they are called, what they are, and where they are trained.

    Args:
        text: Variants parted by commas, or ``ablation``. One of ``se`` may end in ``@test``: it is
            trained on the test robots themselves, which is what the paper has beside zero-shot.

    Raises:
        TaskError: If one is none, or there twice.
    """
    found: dict[str, tuple[Variant, Side]] = {}
    for each in ABLATION if text == "ablation" else text.split(","):
        name, at, side = each.partition("@")
        variant = parse_variant(name)
        if at and (side != "test" or variant.agent != "se"):
            raise TaskError(f"agent {each!r}: only se may be trained elsewhere, on @test")
        label = f"{variant}{at}{side}"
        if label in found:
            raise TaskError(f"agents {text}: {label} is there twice")
        found[label] = variant, "test" if at else "train"
    return [(label, variant, side) for label, (variant, side) in found.items()]


def settle(
    variant: Variant, tasks: Sequence[str], changes: Mapping[str, Any], transitions: int
) -> tuple[PolicyConfig, PPOConfig]:
    """Networks and algorithm of a variant.

    Actions are discrete if all tasks have it so (reach, in the paper), unless the variant says.

    Args:
        variant: The agent.
        tasks: Of its robots.
        changes: Other constants of ``PolicyConfig`` and ``PPOConfig`` by name.
        transitions: Steps of all environments together.

    Raises:
        TaskError: If a constant is unknown or out of its range.
    """
    policy = PolicyConfig(
        variant.agent, discrete=all(TASKS[task].discrete_actions for task in tasks)
    )
    ppo = PPOConfig(transitions=transitions)
    switches = {name.replace("-", "_"): on for name, on in variant.switches.items()}
    every = {**changes, **switches}
    known = [{each.name for each in fields(config)} for config in (policy, ppo)]
    of_policy, of_ppo = ({k: v for k, v in every.items() if k in names} for names in known)
    return replace(policy, **of_policy), replace(ppo, **of_ppo)


def constants(texts: Sequence[str]) -> dict[str, Any]:
    """Read ``name=value`` for constants of ``PolicyConfig`` and ``PPOConfig``.

    Raises:
        TaskError: If there is no such number, or the value is none.
    """
    valid: dict[str, Any] = {
        each.name: each.default
        for config in (PolicyConfig, PPOConfig)
        for each in fields(config)
        if type(each.default) in (int, float) and each.name != "transitions"
    }
    found: dict[str, Any] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in valid:
            raise TaskError(f"unknown constant {name!r}{nearest(name, valid)}")
        kind = type(valid[name])
        try:
            found[name] = kind(value)
        except ValueError as error:
            raise TaskError(f"{name}={value}: expected a number as {valid[name]}") from error
    return found
