"""What MuJoCo warns of; left alone, it writes that to a file in the working folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def caught() -> Iterator[list[str]]:
    """Collect warnings while this lasts; they are MuJoCo's own, of all threads."""
    told: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(told.append)
    try:
        yield told
    finally:
        mujoco.set_mju_user_warning(before)
