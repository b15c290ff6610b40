"""Sets of starts and goals as files: an array a field, and the same set gives the same bytes."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.formats.files import keep
from morphgen.model.geometry import Pose
from morphgen.tasks.sim.base import Block

if TYPE_CHECKING:
    from dataclasses import Field


class StoredSet(Protocol):
    """A frozen dataclass of arrays, blocks, numbers and names."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def robot(self) -> str:
        """Whose it is."""

    @property
    def key(self) -> str:
        """Hash of all that the set follows from."""


S = TypeVar("S", bound=StoredSet)


def set_npz(made: StoredSet) -> bytes:
    """A set as a file.

    Blocks are rows of 12: edges, pose (x, y, z, qw, qx, qy, qz), mass and friction.
    """
    content = io.BytesIO()
    np.savez(content, **arrays_of(made))  # type: ignore[arg-type]  # they are not allow_pickle
    return content.getvalue()


def set_from_npz(content: bytes, kind: type[S]) -> S:
    """Read what ``set_npz`` wrote.

    Raises:
        ValueError: If it is no such set; says why.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as data:
            return kind(**{each.name: _value(each.name, data[each.name]) for each in fields(kind)})
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise ValueError(str(error)) from error


def arrays_of(made: StoredSet) -> dict[str, NDArray[Any]]:
    """The fields of a set as arrays, by name; see ``set_npz``."""
    return {each.name: _array(getattr(made, each.name)) for each in fields(made)}


def cached(kind: type[S], path: Path, robot: str, make: Callable[[str], S]) -> S:
    """A set from a cache, or made and kept there; a warning if the folder does not take it.

    Args:
        kind: Of the set.
        path: Of its file, which is named by the set's key.
        robot: Whose it is to be called.
        make: Makes it, from the key.

    Raises:
        TaskError: If the file is broken, or of another set.
    """
    key = path.stem
    if path.is_file():
        try:
            found = set_from_npz(path.read_bytes(), kind)
        except (OSError, ValueError) as error:
            raise TaskError(f"{path}: no {kind.__name__}: {error}; delete it") from error
        if found.key != key:
            raise TaskError(f"{path}: a set of key {found.key}, not what its name says; delete it")
        return replace(found, robot=robot)
    made = make(key)
    try:
        keep(path, set_npz(made))
    except OSError as error:
        warnings.warn(f"cannot keep a {kind.__name__} in {path}: {error.strerror}", stacklevel=3)
    return made


def require_own(shipped: StoredSet, wanted: str, robot: str) -> None:
    """Require that a set that came with a split is what would be drawn here, by its key.

    Raises:
        TaskError: If it is not.
    """
    if shipped.key != wanted:
        raise TaskError(
            f"robot {robot!r}: the set that is shipped is of another body, seed, ground or other "
            "constants of the task; morphgen split build --goals makes it anew"
        )


def _array(value: object) -> NDArray[Any]:
    if isinstance(value, Block):
        return np.array(_row(value))
    if isinstance(value, tuple):
        return np.array([_row(block) for block in value], dtype=np.float64).reshape(-1, 12)
    return np.asarray(value)


def _value(name: str, array: NDArray[Any]) -> object:
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name} has a number that is not finite")
    if name == "block":
        return _block(array.tolist())
    if name == "obstacles":
        return tuple(_block(row) for row in array.tolist())
    return array if array.ndim else array.item()


def _row(block: Block) -> list[float]:
    return [*block.size, *block.pose.position, *block.pose.quaternion, block.mass, block.friction]


def _block(row: list[float]) -> Block:
    a, b, c, x, y, z, qw, qx, qy, qz, mass, friction = row
    return Block((a, b, c), Pose((x, y, z), (qw, qx, qy, qz)), mass, friction)
