"""Devices of a batch's tensors: names that are valid, and simulators that can use them."""

from __future__ import annotations

import torch

from morphgen.errors import TaskError
from morphgen.tasks.registry import SIMULATORS, installed_simulators


def require_device(name: str) -> None:
    """Require a device that torch can use: ``cpu``, ``cuda``, or such as ``cuda:1``."""
    kind, _, number = name.partition(":")
    if name != "cpu" and (kind != "cuda" or not (number or "0").isdecimal()):
        raise TaskError(f"unknown device {name!r}; valid: cpu, cuda, or such as cuda:1")
    if kind == "cuda" and not torch.cuda.is_available():
        raise TaskError(f"device {name!r}: this machine has no CUDA device")
    if kind == "cuda" and int(number or 0) >= torch.cuda.device_count():
        raise TaskError(f"device {name!r}: there are {torch.cuda.device_count()} CUDA devices")


def batch_device(sim: str, learner_device: str) -> str:
    """Return the device for the batch of a learner: the learner's if the simulator can use it."""
    kind, _, _ = learner_device.partition(":")
    return learner_device if kind in SIMULATORS[sim].devices else "cpu"


def require_simulator_device(sim: str, device: str) -> None:
    """Require a device that this machine has and on which a simulator's tensors can be."""
    require_device(device)
    kind, _, _ = device.partition(":")
    valid = SIMULATORS[sim].devices
    if kind not in valid:
        others = installed_simulators(lambda simulator: kind in simulator.devices)
        raise TaskError(
            f"simulator {sim!r} on device {device!r}; expected device {' or '.join(valid)}, or "
            f"simulator {' or '.join(others)}"
        )
