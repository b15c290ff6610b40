"""Read NumPy archives (``.npz``) from untrusted sources: of bounded size, without pickles."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.formats.zip_files import UNREADABLE

MAX_BYTES = 2**30
"""Largest total size of the arrays of an archive [bytes]."""


def read_npz(source: Path | IO[bytes], names: Sequence[str]) -> list[NDArray[Any]]:
    """Return arrays of an archive.

    Args:
        source: The archive.
        names: Names of the arrays.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not such an archive, lacks an array, or is too large; with the reason.
    """
    try:
        with zipfile.ZipFile(source) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                raise ValueError(f"its arrays have more than {MAX_BYTES // 2**20} MB")
        with np.load(source, allow_pickle=False) as data:
            return [data[name] for name in names]
    except FileNotFoundError:
        raise
    except (*UNREADABLE, KeyError, MemoryError) as error:  # a header may claim any shape
        raise ValueError(str(error)) from error
