"""Stored sets: named arrays in a file, and boxes as rows of one."""

from __future__ import annotations

import tempfile
import warnings
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.model.geometry import Pose
from morphgen.tasks.sim.base import Block

Arrays = Mapping[str, NDArray[Any]]


def keep(path: Path, arrays: Arrays, what: str) -> None:
    """Write arrays at once, or warn that the folder does not take them.

    Args:
        path: Of the file; its folder is made.
        arrays: By name.
        what: What they are, for the warning.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as folder:
            partial = Path(folder) / path.name
            np.savez(partial, allow_pickle=False, **arrays)
            partial.replace(path)
    except OSError as error:
        warnings.warn(f"cannot keep {what} in {path}: {error.strerror}", stacklevel=4)


def load(path: Path, names: Iterable[str], what: str) -> dict[str, NDArray[Any]]:
    """Read arrays.

    Args:
        path: Of the file.
        names: Of the arrays.
        what: What they are, for the error.

    Raises:
        TaskError: If the file is broken, or lacks one.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            return {name: np.asarray(data[name]) for name in names}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise TaskError(f"{path}: no {what}: {error}; delete it") from error


def require_own(shipped: str, wanted: str, robot: str) -> None:
    """Require that a set that came with a split is what would be drawn here, by their keys.

    Raises:
        TaskError: If it is not.
    """
    if shipped != wanted:
        raise TaskError(
            f"robot {robot!r}: the set that is shipped is of another body, seed, ground or other "
            "constants of the task; morphgen split build --goals makes it anew"
        )


def boxes_of(blocks: Iterable[Block]) -> NDArray[np.float64]:
    """Sizes and poses of blocks, shape (n, 10)."""
    rows = [[*block.size, *block.pose.position, *block.pose.quaternion] for block in blocks]
    return np.array(rows, dtype=np.float64).reshape(len(rows), 10)


def blocks_of(boxes: NDArray[np.float64]) -> tuple[Block, ...]:
    """Blocks that do not move, from what ``boxes_of`` gives."""
    return tuple(
        Block((row[0], row[1], row[2]), Pose((row[3], row[4], row[5]), tuple(row[6:])))
        for row in boxes.tolist()
    )
