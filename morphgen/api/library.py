"""The argument ``library`` of the public functions."""

from __future__ import annotations

from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import TypeAlias

from morphgen.grammar.library import Library, default_library

LibraryFolders: TypeAlias = str | PathLike[str] | Iterable[str | PathLike[str]]
"""A folder of your own parts and grammars, or several."""


def open_library(folders: LibraryFolders = ()) -> Library:
    """Return the library of morphgen's parts and those of further folders.

    Raises:
        PartError: If a folder does not exist.
    """
    return default_library(library_folders(folders))


def library_folders(folders: LibraryFolders) -> tuple[Path, ...]:
    """Return the folders of the argument ``library``."""
    several = [folders] if isinstance(folders, str | PathLike) else folders
    return tuple(Path(folder) for folder in several)
