"""Observations and actions of a batch as Gymnasium spaces and NumPy arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from morphgen.tasks.config import BINS
from morphgen.tasks.observation import Observation

BOUND = 1000.0
"""Largest number in an observation, in m, rad, m/s or rad/s; nothing gets there in an episode."""

NumpyObservation = dict[str, NDArray[Any]]


def arrays(observation: Observation) -> NumpyObservation:
    """An observation of n environments in NumPy: own memory, float32, masks as int8.

    What has one number or none an environment gets an axis, so that every space is a vector; what
    is empty, such as obstacles where there are none, is left out.
    """
    found = {}
    for name, values in observation.items():
        wide = values.reshape(len(values), -1) if values.dim() == 1 else values
        if wide[0].numel():
            dtype = np.int8 if values.dtype == torch.bool else np.float32
            found[name] = np.array(wide.cpu().numpy(), dtype=dtype)
    return found


def observation_space(observation: NumpyObservation) -> spaces.Dict:
    """The space of one environment of a batch that is observed so: boxes, and masks."""
    made: dict[str, spaces.Space[Any]] = {}
    for name, values in sorted(observation.items()):
        shape = values.shape[1:]
        if values.dtype == np.int8:
            made[name] = spaces.MultiBinary(shape)
        else:
            made[name] = spaces.Box(-BOUND, BOUND, shape, np.float32)
    return spaces.Dict(made)


def action_space(kind: str, actions: int) -> spaces.Box | spaces.MultiDiscrete:
    """The space of one environment's actions: shares of the joints' steps, or indices of bins."""
    if kind == "continuous":
        return spaces.Box(-1.0, 1.0, (actions,), np.float32)
    return spaces.MultiDiscrete([len(BINS)] * actions)
