"""Tasks over batches of robots, on interchangeable simulators.

Importing this package registers the tasks, such as ``morphgen/Reach-v0``, with Gymnasium if
Gymnasium has been imported before: to import it here would cost every worker process 0.1 s.
``gymnasium.make("morphgen.tasks.gym.env:morphgen/Reach-v0")`` works in any order.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from morphgen.tasks.scenes.make import make_batch, make_split_batch

__all__ = ["make_batch", "make_split_batch"]

if "gymnasium" in sys.modules:
    from morphgen.tasks.registry import register_gym_envs

    register_gym_envs()


def __getattr__(name: str) -> object:
    if name in __all__:
        from morphgen.tasks.scenes import make

        return getattr(make, name)
    raise AttributeError(f"module 'morphgen.tasks' has no attribute {name!r}")
