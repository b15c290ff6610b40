"""Find a split by its name, its file or the folder where it was built."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from morphgen.benchmark.release_file import is_archive
from morphgen.benchmark.split import Split
from morphgen.benchmark.split_file import read_split
from morphgen.benchmark.split_folder import SPLIT_FILE, require_split_folder
from morphgen.errors import BenchmarkError


def read_split_or_folder(name: str | PathLike[str]) -> tuple[Split, Path | None]:
    """Return a split by its name, its file or its built folder; and that folder."""
    folder = Path(name)
    if is_archive(folder):
        raise BenchmarkError(f"{folder}: the archive of a release; unpack it, and name the folder")
    if not folder.is_dir():
        return read_split(str(name)), None
    require_split_folder(folder)
    return read_split(folder / SPLIT_FILE), folder
