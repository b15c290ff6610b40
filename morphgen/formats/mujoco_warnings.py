"""Capture of the warnings of MuJoCo."""

from __future__ import annotations

import mujoco


class MujocoWarnings:
    """Collects MuJoCo's warnings, of all threads, instead of writing them to ``MUJOCO_LOG.TXT``.

    A class, because simulations enter it in every step: a generator takes twice as long.
    """

    def __enter__(self) -> list[str]:
        """Begin; return the list that receives the warnings."""
        warnings: list[str] = []
        self._previous = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(warnings.append)
        return warnings

    def __exit__(self, *error: object) -> None:
        """Restore what was done with warnings before."""
        mujoco.set_mju_user_warning(self._previous)
