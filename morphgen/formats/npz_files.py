"""Read NumPy archives (``.npz``) from untrusted sources: of bounded size, without pickles."""

from __future__ import annotations

import tokenize
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.formats.zip_files import UNREADABLE as UNREADABLE_ZIP

UNREADABLE = (*UNREADABLE_ZIP, tokenize.TokenError, KeyError, MemoryError, OverflowError)
"""Errors of NumPy for malformed archives; a header may claim any shape."""
MAX_BYTES = 2**30
"""Largest total size of the arrays of an archive [bytes]."""


def read_npz(source: Path | IO[bytes], names: Sequence[str]) -> list[NDArray[Any]]:
    """Return arrays of an archive by their names; see ``read_all``.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not such an archive, lacks an array, or is too large; with the reason.
    """
    return [*_read(source, names).values()]


def read_all(source: Path | IO[bytes]) -> dict[str, NDArray[Any]]:
    """Return all arrays of an archive.

    Args:
        source: The archive.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not such an archive, or is too large; with the reason.
    """
    return _read(source, None)


def _read(source: Path | IO[bytes], names: Sequence[str] | None) -> dict[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(source) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                raise ValueError(f"its arrays have more than {MAX_BYTES // 2**20} MB")
        with np.load(source, allow_pickle=False) as data:
            return {name: data[name] for name in (data.files if names is None else names)}
    except FileNotFoundError:
        raise
    except UNREADABLE as error:
        raise ValueError(str(error)) from error
