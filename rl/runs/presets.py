"""Presets: constants and switches that training begins with, unless options say otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from morphgen.errors import TaskError, nearest
from morphgen.rl.agents import AGENTS


@dataclass(frozen=True)
class Preset:
    """Defaults of a training."""

    summary: str
    """Purpose, for the help."""
    total_timesteps: int
    """Control steps of all environments together."""
    num_envs: int
    """Number of environments."""
    switches: Mapping[str, bool] = field(default_factory=dict)
    """Switches of ``morphgen.rl.runs.agent_spec.SWITCHES``."""
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
PRESETS: Mapping[str, Preset] = {"fast": FAST, "paper": PAPER}
"""Presets by name."""


def preset_of(name: str | None, agent: str) -> Preset:
    """Return a preset by its name, or the one that an agent has by default."""
    if name is None:
        name = AGENTS[agent].preset
    if name not in PRESETS:
        raise TaskError(f"unknown preset {name!r}{nearest(name, PRESETS)}")
    return PRESETS[name]
