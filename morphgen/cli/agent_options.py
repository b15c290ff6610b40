"""Options of the agent that ``morphgen train`` trains: its switches and observations."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

from morphgen.cli.command import Option, option
from morphgen.errors import TaskError, nearest
from morphgen.rl.agents import AGENTS
from morphgen.rl.presets import PRESETS
from morphgen.tasks.channels import CHANNELS

if TYPE_CHECKING:
    from morphgen.rl.agent_spec import AgentSpec

AGENT = option(
    "--agent", default="me-graph", help=f"one of {', '.join(AGENTS)} (default: me-graph)"
)
SWITCHES = {
    "symlog": ("the critic predicts the symlog of returns", "on"),
    "slow-critic": ("compute returns with a moving average of the critic", "on"),
    "discrete": ("discrete actions", "on if the task of all robots is reach"),
    "task-reweighting": ("weight the robots randomly", "off"),
    "curriculum": ("push: move the target line from near to far during training", "on"),
    "fixed-deviation": ("keep the initial standard deviation of continuous actions", "off"),
    "mask-morphology": ("hide the robot's morphology from the agent", "off"),
    "tool-position": ("add the tool's position to the observations", "off"),
    "residual": ("add the actions to the steps that the channel ik shows", "off"),
    "normalize": ("normalize the kinematic channels of observations", "off"),
    "robot-advantages": ("normalize advantages robot by robot", "off"),
    "joint-entropy": ("weigh the mean entropy of the joints instead of their sum", "off"),
}
"""Purpose of each switch, and its default without a preset that sets it."""


def switch_help(name: str) -> str:
    """Return the help of a switch, with its default in every preset."""
    purpose, default = SWITCHES[name]
    others = [
        f"{'on' if preset.switches[name] else 'off'} with --preset {label}"
        for label, preset in PRESETS.items()
        if name in preset.switches
    ]
    return f"{purpose} (default: {'; '.join([default, *others])})"


def on_off(name: str, help: str, default: bool | None = None) -> Option:
    """Return an option ``--name`` with its opposite ``--no-name``."""
    return Option(
        (f"--{name}",), {"action": argparse.BooleanOptionalAction, "default": default, "help": help}
    )


OBSERVE = option(
    "--observe",
    metavar="A,B,...",
    default="",
    help="further channels of the observations: "
    + ", ".join(CHANNELS).replace("_", "-")
    + "".join(
        f"; --preset {label} has {', '.join(names)} already, and --agent AGENT-NAME drops one"
        for label, preset in PRESETS.items()
        if (names := [name for name in preset.switches if name.replace("-", "_") in CHANNELS])
    ),
)
AGENT_OPTIONS = (*(on_off(name, switch_help(name)) for name in SWITCHES), OBSERVE)


def agent_spec(args: argparse.Namespace) -> AgentSpec:
    """Return the agent with the switches that were given.

    Raises:
        TaskError: If the agent is unknown.
    """
    from morphgen.rl.agent_spec import OBSERVATION_SWITCHES, parse_agent

    values = {name: getattr(args, name.replace("-", "_")) for name in SWITCHES}
    spec = parse_agent(args.agent)
    switches = {name: value for name, value in values.items() if value is not None}
    observed = [name for name in args.observe.split(",") if name]
    for name in observed:
        if name not in OBSERVATION_SWITCHES:
            raise TaskError(f"--observe {name}{nearest(name, OBSERVATION_SWITCHES)}")
    return replace(spec, switches={**spec.switches, **switches, **dict.fromkeys(observed, True)})
