"""Devices whose tensors the processor reads without waiting.

Reading a tensor of a GPU waits for all of its work. Steps of a batch therefore read none, but on
a host device they may look at a tensor to skip work that changes nothing.
"""

from __future__ import annotations

import torch

HOST_DEVICES = ("cpu",)
"""Types of these devices, as of ``torch.device.type``."""


def is_host(device: torch.device) -> bool:
    """Return whether the processor reads tensors of a device without waiting."""
    return device.type in HOST_DEVICES
