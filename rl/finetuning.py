"""The config of a run that trains a policy further."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from morphgen.rl.robot_source import RobotSource
from morphgen.rl.runs import RunConfig

NUM_ENVS = 64
"""Default number of environments."""
CONSTANTS: Mapping[str, Any] = {
    "num_steps": 32,
    "minibatches": 4,
    "learning_rate": 3e-4,
    "desired_kl": 0.01,
    "curriculum": False,
}
"""Default hyperparameters that differ from those of the training. A new optimiser has no moments of
the gradient, so that its first steps are large: without a bound of the policy's change they undo
what the training taught (docs/results.md, "Fine-tuning")."""


def finetuning_config(
    initial: RunConfig, source: RobotSource, checkpoint: str, changes: Mapping[str, Any]
) -> RunConfig:
    """Return the config of a run that begins with the networks of another run.

    Agent and hyperparameters are those of the other run, besides ``CONSTANTS`` and ``NUM_ENVS``.

    Args:
        initial: Config of the other run.
        source: The robots to train on.
        checkpoint: Path of the other run's checkpoint; relative to the folder of the new run.
        changes: Hyperparameters of PPO that differ, such as ``total_timesteps``.
    """
    return replace(
        initial,
        source=source,
        ppo=replace(initial.ppo, **{**CONSTANTS, **changes}),
        num_envs=NUM_ENVS,
        initial_checkpoint=checkpoint,
        slice_updates=0,
    )
