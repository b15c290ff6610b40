"""The library: every part that can be named, from the package and from users' folders."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from functools import cached_property, lru_cache
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import TypeAlias

from morphgen.errors import PartError, nearest, one_line, path_argument
from morphgen.files import cached_until_changed
from morphgen.grammar.manifest import PART_KINDS, Manifest, PartKind, read_manifest
from morphgen.progress import note

LIBRARY_VARIABLE = "MORPHGEN_LIBRARY"
"""Environment variable with folders of a user's own parts, separated as in ``PATH``."""
_manifest = cached_until_changed(read_manifest)


LibraryFolders: TypeAlias = str | PathLike[str] | Iterable[str | PathLike[str]]
"""A folder of a user's own parts and grammars, or several."""


class Library:
    """Manifests of parts by name. Names are unique over all folders."""

    def __init__(self, folders: Iterable[Path]) -> None:
        self.folders = tuple(folders)

    @cached_property
    def paths(self) -> dict[str, Path]:
        """The YAML file of every part, sorted by name."""
        paths: dict[str, Path] = {}
        for folder in self.folders:
            if not folder.is_dir():
                why = "is a file" if folder.exists() else "does not exist"
                raise PartError(f"library folder {folder} {why}")
            for path in sorted([*folder.rglob("*.yaml"), *folder.rglob("*.yml")]):
                if paths.get(path.stem, path) != path:
                    raise PartError(f"part {path.stem!r} is in {paths[path.stem]} and in {path}")
                paths[path.stem] = path
        return dict(sorted(paths.items()))

    def nearest_part(self, name: str, valid: Iterable[str]) -> str:
        """Return the hint for an unknown name of a part, with what own parts need."""
        hint = nearest(name, valid)
        if self.folders != shipped_folders():
            return hint
        return f"{hint}{'' if hint.endswith('?') else ';'} your own parts need --library DIR"

    def manifest(self, name: str, kind: PartKind | None = None) -> Manifest:
        """Return the manifest of a part."""
        if name not in self.paths:
            valid = self.names(kind) if kind else self.paths
            raise PartError(f"unknown {kind or 'part'} {name!r}{self.nearest_part(name, valid)}")
        manifest = _manifest(self.paths[name])
        if kind is not None and manifest.kind != kind:
            raise PartError(
                f"{name!r} is of kind {manifest.kind}, not {kind}{nearest(name, self.names(kind))}"
            )
        return manifest

    def names(self, kind: PartKind | None = None) -> list[str]:
        """Return the names of all sound parts, or of those of one kind, sorted."""
        return [manifest.name for manifest in self._sound() if kind in (None, manifest.kind)]

    def manifests(self, kind: PartKind | None = None) -> list[Manifest]:
        """Return the manifests of all sound parts, or of those of one kind, by kind and name."""
        of_kind = [manifest for manifest in self._sound() if kind in (None, manifest.kind)]
        return sorted(of_kind, key=lambda part: (PART_KINDS.index(part.kind), part.name))

    def _sound(self) -> Iterator[Manifest]:
        """Yield the manifests of parts that can be read; a line names each other file."""
        for path in self.paths.values():
            try:
                yield _manifest(path)
            except PartError as error:
                note_left_out(str(error))


@lru_cache(maxsize=1024)
def note_left_out(fault: str) -> None:
    """Show a line that a part is left out of a list; once, although a command lists them often."""
    note(f"left out: {one_line(fault)}")


def default_library(extra: LibraryFolders = ()) -> Library:
    """Return the library of morphgen's parts and those of users."""
    entries = os.environ.get(LIBRARY_VARIABLE, "").split(os.pathsep)
    users = (*(Path(entry) for entry in entries if entry), *library_folders(extra))
    return Library(dict.fromkeys((*shipped_folders(), *(path.absolute() for path in users))))


def library_folders(folders: LibraryFolders) -> tuple[Path, ...]:
    """Return the folders of an argument ``library``."""
    several = [folders] if isinstance(folders, str | PathLike) else folders
    if not isinstance(several, Iterable):
        raise PartError(f"library {folders!r}: expected a folder, or several")
    return tuple(path_argument("library", folder, PartError) for folder in several)


def shipped_folders() -> tuple[Path, ...]:
    """Return the folders of the parts that come with morphgen."""
    return tuple(Path(str(files(f"morphgen.{name}"))) for name in ("templates", "robots_real"))
