"""Tests on the CPU that code would never wait for a GPU: no tensor is read or copied to it."""

from contextlib import contextmanager

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from morphgen.tasks.sim import base

READS = (
    "aten::_local_scalar_dense",  # item, int, float, bool
    "aten::equal",
    "aten::is_nonzero",
    "aten::masked_select",
    "aten::nonzero",
    "aten::_unique2",
    "aten::unique_dim",
    "aten::unique_consecutive",
    "aten::bincount",
    "aten::repeat_interleave.Tensor",
    "aten::_linalg_check_errors",  # solve, inv; not solve_ex, inv_ex
    "aten::_linalg_eigh",
    "aten::_linalg_svd",
)
"""Operators whose result, or its shape, the processor waits for."""
COPIES = ("aten::lift_fresh", "aten::_pin_memory")
"""Operators that make a tensor of Python data."""
INDEXING = ("aten::index.Tensor", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")
METHODS = ("numpy", "tolist", "cpu", "__array__")
"""Methods of tensors that read them without an operator."""


class DeviceReads(TorchDispatchMode):
    """Records what would wait for a GPU within a ``with`` block."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.name()
        if name.startswith(READS) or name in COPIES:
            self.found.append(name)
        if name.startswith(INDEXING):
            masks = [each for each in args[1] if each is not None and each.dtype == torch.bool]
            self.found += [f"{name} with a mask"] * len(masks)
        return func(*args, **(kwargs or {}))


@contextmanager
def device_reads():
    """Yield a record of what would wait for a GPU, and treat the CPU as one."""
    with pytest.MonkeyPatch.context() as patch, DeviceReads() as reads:
        patch.setattr(base, "HOST_DEVICES", ())

        def recorded(name, method):
            def call(*args, **kwargs):
                reads.found.append(f"Tensor.{name}")
                return method(*args, **kwargs)

            return call

        for name in METHODS:
            patch.setattr(torch.Tensor, name, recorded(name, getattr(torch.Tensor, name)))
        for name in ("from_numpy", "tensor", "as_tensor"):
            patch.setattr(torch, name, recorded(name, getattr(torch, name)))
        yield reads
