"""Functions of tensors as they are called: in bfloat16, by ``torch.compile``, as CUDA graphs."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

from morphgen.errors import TaskError

KINDS = 64
"""Of functions and shapes, that a process may compile."""

P = ParamSpec("P")
T = TypeVar("T")


def prepared(
    function: Callable[P, T], device: torch.device, *, bf16: bool, compiled: bool
) -> Callable[P, T]:
    """A function ready to be called.

    On a GPU what is compiled is a CUDA graph: a gradient step of a small network is hundreds of
    kernels, and starting them one by one takes longer than what they do. What a graph returns is
    overwritten when the next is called; who keeps it copies it.

    Args:
        function: A network, or what calls networks; its tensors are on the device.
        device: Where it is called.
        bf16: Whether products are in bfloat16, by autocast.
        compiled: Whether ``torch.compile`` makes it.
    """
    graphs = compiled and device.type == "cuda"
    inner = _compiled(function, graphs) if compiled else function

    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        if graphs:
            torch.compiler.cudagraph_mark_step_begin()  # type: ignore[no-untyped-call]
        with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
            return inner(*args, **kwargs)

    return call


def _compiled(function: Callable[P, T], graphs: bool) -> Callable[P, T]:
    """By ``torch.compile``, however many kinds of functions a process has compiled before.

    torch gives up after eight kinds and shapes, which four learners of a study are. Calls raise
    TaskError where torch cannot compile, such as without a compiler of C++ on a CPU.
    """
    from torch._dynamo import config  # takes a second to load
    from torch._dynamo.exc import TorchDynamoException

    config.recompile_limit = max(config.recompile_limit, KINDS)
    mode = "reduce-overhead" if graphs else None
    compiled = torch.compile(function, fullgraph=True, dynamic=False, mode=mode)

    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return compiled(*args, **kwargs)
        except TorchDynamoException as error:
            why = next(iter(str(error).strip().splitlines()), type(error).__name__)
            raise TaskError(f"--compile: torch cannot compile here: {why}") from error

    return call
