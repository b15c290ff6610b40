"""Registry of agents, and presets of their training.

An agent is one module with its networks, and one row of ``AGENTS``. The registry imports nothing
heavy, so that the command line lists agents at once. A module of an agent has two names:
``Config``, a ``NetworkConfig`` with the sizes of its networks, and ``Network``, an
``encoder.Network`` that is built for the actor and for the critic.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from decimal import Decimal
from importlib import import_module
from typing import Any

from morphgen.errors import TaskError, nearest
from morphgen.tasks.registry import Registry

MAX_WIDTH = 8192  # largest width of a layer; the weights between two such layers take 256 MiB
MAX_LAYERS = 100  # largest number of layers of a network


def require_numbers(
    config: object, *names: str, low: float = 0, high: float = math.inf, above: bool = False
) -> None:
    """Require that fields are between two numbers, or ``above`` the lower one."""
    for name in names:
        value = getattr(config, name)
        if not low <= value <= high or (above and value == low):
            expected = f"{low} or more" if high == math.inf else f"{low} to {high}"
            expected = f"more than {low}" if above else expected
            # Whole numbers may be larger than the largest float.
            shown = Decimal(value) if isinstance(value, int) else value
            raise TaskError(f"{name} {shown:.15g}: expected {expected}")


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of an agent's networks: the base class, whose subclasses add the fields."""

    def __post_init__(self) -> None:
        """Check the sizes.

        Raises:
            TaskError: If a size is out of its range.
        """
        for size in fields(self):
            if isinstance(size.default, int):
                most = MAX_LAYERS if size.name.endswith("layers") else MAX_WIDTH
                require_numbers(self, size.name, low=1, high=most)
            else:
                require_numbers(self, size.name, above=True)


@dataclass(frozen=True)
class Agent:
    """A row of the registry: how an agent is trained, and the module that has its networks."""

    name: str
    """Name in ``AGENTS``."""
    module: str
    """Import path of the module; it is imported when the agent is used."""
    per_robot: bool = False
    """Train one policy for each robot of a split, instead of one policy for all of them."""
    proprioceptive_only: bool = False
    """Hide the robot's morphology from the networks; joint positions stay visible."""
    preset: str = "paper"
    """Name of the preset that training begins with, in ``PRESETS``."""
    any_size: bool = False
    """Whether no weight belongs to the number of a link, so that a policy acts on larger robots."""
    channels: tuple[str, ...] = ()
    """Observation channels that the networks need, of ``morphgen.tasks.registry.CHANNELS``."""

    @property
    def config(self) -> type[NetworkConfig]:
        """Class with the sizes of the networks."""
        config: type[NetworkConfig] = import_module(self.module).Config
        return config

    @property
    def network(self) -> Any:  # noqa: ANN401
        """Class of the torch module, a subclass of ``encoder.Network``."""
        return import_module(self.module).Network


SE = Agent("se", "morphgen.rl.agents.mlp", per_robot=True, proprioceptive_only=True)
ME_MLP = Agent("me-mlp", "morphgen.rl.agents.mlp")
ME_TF = Agent("me-tf", "morphgen.rl.agents.transformer")
ME_GRAPH = Agent(
    "me-graph", "morphgen.rl.agents.graph", preset="fast", any_size=True, channels=("tree",)
)

AGENTS: Registry[Agent] = Registry(
    "agent", "morphgen.agents", {each.name: each for each in (SE, ME_MLP, ME_TF, ME_GRAPH)}
)
"""Agents by name: ``se`` (single embodiment) learns one robot, ``me-...`` (multi) learn many."""


def network_fields() -> Iterator[tuple[str, float, tuple[str, ...]]]:
    """Yield every size of every agent's networks: its name, its default, and its agents."""
    defaults: dict[str, float] = {}
    owners: dict[str, list[str]] = {}
    for name in AGENTS:
        for size in fields(AGENTS[name].config):
            defaults.setdefault(size.name, size.default)  # type: ignore[arg-type]
            owners.setdefault(size.name, []).append(name)
    for field_name, agents in owners.items():
        yield field_name, defaults[field_name], tuple(agents)


@dataclass(frozen=True)
class Preset:
    """Defaults of a training."""

    summary: str  # purpose, for the help
    total_timesteps: int  # control steps of all environments together
    num_envs: int  # number of environments
    switches: Mapping[str, bool] = field(default_factory=dict)
    """Switches of ``morphgen.rl.config.SWITCHES``."""
    constants: Mapping[str, float] = field(default_factory=dict)
    """Numbers of ``PPOConfig`` and of the networks; those of other agents have no effect."""


FAST = Preset(
    "a policy within minutes on a CPU; constants tuned on reach with a UR5 and with ten arm3",
    total_timesteps=500_000,
    num_envs=64,
    switches={
        **dict.fromkeys(("lag", "joint", "jacobian", "dls", "normalize"), True),
        **dict.fromkeys(("symlog", "slow-critic", "discrete"), False),
    },
    constants={
        "num_steps": 32,
        "epochs": 2,
        "minibatches": 4,
        "gamma": 0.99,
        "learning_rate": 1e-3,
        "graph_layers": 1,
        "graph_hidden": 32,
    },
)
PAPER = Preset(
    "constants and switches of AnyBody; its budget is --steps 1.28e9 --envs 1280",
    total_timesteps=2_000_000,
    num_envs=128,
)
PRESETS: Mapping[str, Preset] = {"fast": FAST, "paper": PAPER}  # presets by name


def preset_of(name: str | None, agent: str) -> Preset:
    """Return a preset by its name, or the one that an agent has by default."""
    if name is None:
        name = AGENTS[agent].preset
    if name not in PRESETS:
        raise TaskError(f"unknown preset {name!r}{nearest(name, PRESETS)}")
    return PRESETS[name]
