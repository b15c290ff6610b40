"""The config of a run that trains a policy further."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from morphgen.rl.robot_source import RobotSource
from morphgen.rl.runs import RunConfig

NUM_ENVS = 16
"""Default number of environments."""


def finetuning_config(
    initial: RunConfig, source: RobotSource, checkpoint: str, changes: Mapping[str, Any]
) -> RunConfig:
    """Return the config of a run that begins with the networks of another run.

    Agent and hyperparameters are those of the other run, but the curriculum is off and the number
    of environments is ``NUM_ENVS``.

    Args:
        initial: Config of the other run.
        source: The robots to train on.
        checkpoint: Path of the other run's checkpoint; relative to the folder of the new run.
        changes: Hyperparameters of PPO that differ, such as ``total_timesteps``.
    """
    return replace(
        initial,
        source=source,
        ppo=replace(initial.ppo, **{"curriculum": False, **changes}),
        num_envs=NUM_ENVS,
        initial_checkpoint=checkpoint,
        slice_updates=0,
    )
