"""Agents with switches that are on or off, as the command line has them: ``me-tf-symlog``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from morphgen.benchmark.split import Side
from morphgen.errors import TaskError, nearest
from morphgen.rl.agents import AGENTS, NetworkConfig, network_fields
from morphgen.rl.config import NUMBERS, PolicyConfig, PPOConfig
from morphgen.tasks.registry import CHANNELS, TASKS

OBSERVATION_SWITCHES = tuple(name.replace("_", "-") for name in CHANNELS)
"""Names of observation channels on the command line."""
SWITCHES = (
    *("symlog", "slow-critic", "task-reweighting", "robot-advantages", "joint-entropy"),
    *("curriculum", "discrete", "fixed-deviation", "mask-morphology", "tool-position"),
    "residual",
    *("normalize", *OBSERVATION_SWITCHES),
)
"""Names of switches on the command line, in the order in which a spec prints them: first those of
``PPOConfig``, then those of ``PolicyConfig``, then observation channels."""
_FIELDS = {"fixed-deviation": "fixed_std", "mask-morphology": "proprioceptive_only"}
"""Fields of ``PolicyConfig`` of switches that have the paper's names; others have the field's."""
ABLATION = (
    "se-symlog-slow-critic-discrete",
    "se-symlog-slow-critic-discrete@test",
    "me-mlp-symlog-slow-critic-discrete",
    "me-tf-symlog-slow-critic-discrete",
    "me-tf-discrete",
    "me-tf+discrete",
    "me-tf+discrete+task-reweighting",
)
"""Rows of the paper's ablation table, where "symlog" stands for symlog with the slow critic."""


@dataclass(frozen=True)
class AgentSpec:
    """An agent with switches; ``configs_of`` decides those that are not named."""

    agent: str  # name of the agent
    switches: Mapping[str, bool] = field(default_factory=dict)
    """Whether a switch is on, by its name."""

    def __str__(self) -> str:
        """Return text such as ``me-tf-symlog+task-reweighting``, in the order of ``SWITCHES``."""
        named = (name for name in SWITCHES if name in self.switches)
        return self.agent + "".join("-+"[self.switches[name]] + name for name in named)


def parse_agent(text: str) -> AgentSpec:
    """Read ``me-tf+discrete-symlog``: an agent, and switches that are on (+) or off (-)."""
    agent = next((name for name in AGENTS if re.match(rf"{re.escape(name)}([+-]|$)", text)), None)
    if agent is None:
        AGENTS[text.partition("+")[0]]  # raises
        raise AssertionError(text)  # an agent's name alone is matched above
    switch = rf"([+-])({'|'.join(SWITCHES)})"
    rest = text[len(agent) :]
    if not re.fullmatch(rf"({switch})*", rest):
        raise TaskError(
            f"agent {text!r}: after {agent} come switches, each with + for on or - for off; "
            f"valid: {', '.join(SWITCHES)}"
        )
    named = re.findall(switch, rest)
    switches = {name: sign == "+" for sign, name in named}
    if len(switches) < len(named):
        raise TaskError(f"agent {text!r}: a switch is named twice")
    return AgentSpec(agent, switches)


def parse_agents(text: str) -> list[tuple[str, AgentSpec, Side]]:
    """Read the agents of a study: their labels, their specs, and the side they are trained on."""
    agents: dict[str, tuple[AgentSpec, Side]] = {}
    for part in ABLATION if text == "ablation" else text.split(","):
        name, at, side = part.partition("@")
        spec = parse_agent(name)
        if at and (side != "test" or not AGENTS[spec.agent].per_robot):
            valid = " and ".join(name for name in AGENTS if AGENTS[name].per_robot)
            raise TaskError(f"agent {part!r}: only {valid} may be trained elsewhere, on @test")
        label = f"{spec}{at}{side}"
        if label in agents:
            raise TaskError(f"agents {text}: {label} is there twice")
        agents[label] = spec, "test" if at else "train"
    return [(label, spec, side) for label, (spec, side) in agents.items()]


def configs_of(
    spec: AgentSpec, tasks: Sequence[str], changes: Mapping[str, Any], total_timesteps: int
) -> tuple[PolicyConfig, PPOConfig]:
    """Return the policy and the algorithm of a spec.

    Actions are discrete if all tasks prefer it (reach, in the paper), unless the spec says so.
    """
    network = AGENTS[spec.agent].config
    values = dict(changes)
    for name, on in spec.switches.items():
        if name not in OBSERVATION_SWITCHES:
            values[_FIELDS.get(name) or name.replace("-", "_")] = on
    values["observe"] = tuple(
        channel
        for channel, name in zip(CHANNELS, OBSERVATION_SWITCHES, strict=True)
        if spec.switches.get(name, False)
    )

    def values_for(config: type[PolicyConfig | PPOConfig | NetworkConfig]) -> dict[str, Any]:
        names = {field.name for field in fields(config)}
        return {name: value for name, value in values.items() if name in names}

    policy = PolicyConfig(
        spec.agent,
        discrete=all(TASKS[task].discrete_actions for task in tasks),
        network=network(**values_for(network)),
    )
    ppo = PPOConfig(total_timesteps=total_timesteps)
    return replace(policy, **values_for(PolicyConfig)), replace(ppo, **values_for(PPOConfig))


def parse_constants(texts: Sequence[str]) -> dict[str, Any]:
    """Read ``name=value`` for numbers of ``PPOConfig`` and of the networks of any agent."""
    valid = {**{name: default for name, default, _ in network_fields()}, **NUMBERS}
    values: dict[str, Any] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in valid:
            raise TaskError(f"unknown constant {name!r}{nearest(name, valid)}")
        try:
            values[name] = type(valid[name])(value)
        except ValueError as error:
            raise TaskError(f"{text}: expected a number as {valid[name]}") from error
    return values


def owners_of(name: str) -> tuple[str, ...]:
    """Return the agents whose networks have a number of a name; all agents for other numbers."""
    return next((agents for size, _, agents in network_fields() if size == name), tuple(AGENTS))
