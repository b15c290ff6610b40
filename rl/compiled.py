"""Run functions of tensors in bfloat16, by ``torch.compile``, and as CUDA graphs."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

from morphgen.errors import TaskError

MAX_COMPILED = 64
"""Functions and input shapes that a process may compile."""

P = ParamSpec("P")
T = TypeVar("T")


def prepared(
    function: Callable[P, T], device: torch.device, *, bf16: bool, compiled: bool
) -> Callable[P, T]:
    """Return a function that runs another one in bfloat16, or compiled.

    On a GPU the compiled function is a CUDA graph: a gradient step of a small network is hundreds
    of kernels, and to launch them one by one takes longer than they run. The next call of any graph
    overwrites what a graph returned; copy results that you keep.

    Args:
        function: A network, or a function that calls networks.
        device: Device of the function's tensors.
        bf16: Compute matrix products in bfloat16, by autocast.
        compiled: Compile the function by ``torch.compile``.
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
    """Return the function compiled by ``torch.compile``.

    By default torch stops compiling after eight functions and shapes; four learners of a study have
    as many. Calls raise TaskError if torch cannot compile, for example without a C++ compiler.
    """
    from torch._dynamo import config  # takes a second to load
    from torch._dynamo.exc import TorchDynamoException

    config.recompile_limit = max(config.recompile_limit, MAX_COMPILED)
    mode = "reduce-overhead" if graphs else None
    compiled = torch.compile(function, fullgraph=True, dynamic=False, mode=mode)

    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return compiled(*args, **kwargs)
        except TorchDynamoException as error:
            why = next(iter(str(error).strip().splitlines()), type(error).__name__)
            raise TaskError(f"--compile: torch cannot compile here: {why}") from error

    return call
