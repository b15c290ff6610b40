"""Checks of the constants that every task has."""

from __future__ import annotations

from dataclasses import fields
from math import isfinite

from morphgen.errors import TaskError
from morphgen.tasks.task import TaskConfig


def require_task_config(config: TaskConfig) -> None:
    """Require valid values of the constants that every task has, and only finite numbers or text.

    Raises:
        TaskError: If a constant is out of its range.
    """
    name = type(config).__name__
    for field in fields(config):
        value = getattr(config, field.name)
        if isinstance(value, str) and isinstance(field.default, str):
            continue
        numbers = value if isinstance(value, tuple) else (value,)
        if not all(isinstance(number, int | float) and isfinite(number) for number in numbers):
            raise TaskError(f"{name}: {field.name} {value!r}: expected finite numbers")
    # The largest are far above all uses: a file from elsewhere shall not fill the memory.
    for field_name, minimum, maximum in (
        ("max_episode_steps", 1, 1_000_000),
        ("num_goals", 1, 1_000_000),
        ("obstacles", 0, 1_000),
        ("train_layouts", 1, 1_000_000),
        ("eval_layouts", 1, 1_000_000),
    ):
        value = getattr(config, field_name)
        if not isinstance(value, int) or not minimum <= value <= maximum:
            raise TaskError(
                f"{name}: {field_name} {value!r}: expected an integer >= {minimum} and "
                f"<= {maximum:,}"
            )
    low, high = config.obstacle_size
    if not 0 < low <= high:
        raise TaskError(
            f"{name}: obstacle_size {config.obstacle_size}: expected 0 < lowest <= highest"
        )
