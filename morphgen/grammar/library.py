"""The library: every part that can be named, from the package and from users' folders."""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import cached_property, lru_cache
from importlib.resources import files
from pathlib import Path

from morphgen.errors import PartError, nearest
from morphgen.formats.resolve import file_stamp
from morphgen.grammar.manifest import PART_KINDS, Manifest, PartKind, read_manifest

LIBRARY_VARIABLE = "MORPHGEN_LIBRARY"
"""Environment variable: folders of a user's own parts, separated like ``PATH``."""


class Library:
    """Manifests by name. A user's part may not take the name of another one."""

    def __init__(self, folders: Iterable[Path]) -> None:
        self.folders = tuple(folders)

    @cached_property
    def paths(self) -> dict[str, Path]:
        """The YAML file of every part, sorted by name.

        Raises:
            PartError: If a folder is missing or two files have the same name.
        """
        found: dict[str, Path] = {}
        for folder in self.folders:
            if not folder.is_dir():
                raise PartError(f"library folder {folder} does not exist")
            for path in sorted(folder.rglob("*.yaml")):
                if found.get(path.stem, path) != path:
                    raise PartError(f"part {path.stem!r} is in {found[path.stem]} and in {path}")
                found[path.stem] = path
        return dict(sorted(found.items()))

    def manifest(self, name: str, kind: PartKind | None = None) -> Manifest:
        """The manifest of a part.

        Args:
            name: The part.
            kind: What it must be, if that matters.

        Raises:
            PartError: If there is no such part, or it is of another kind.
        """
        if name not in self.paths:
            valid = self.names(kind) if kind else self.paths
            raise PartError(f"unknown {kind or 'part'} {name!r}{nearest(name, valid)}")
        manifest = _manifest(self.paths[name])
        if kind is not None and manifest.kind != kind:
            raise PartError(
                f"{name!r} is of kind {manifest.kind}, not {kind}{nearest(name, self.names(kind))}"
            )
        return manifest

    def names(self, kind: PartKind | None = None) -> list[str]:
        """Names of all parts, or of one kind, sorted."""
        return [name for name, path in self.paths.items() if kind in (None, _manifest(path).kind)]

    def manifests(self, kind: PartKind | None = None) -> list[Manifest]:
        """Manifests of all parts, or of one kind: by kind, then name."""
        found = [_manifest(path) for path in self.paths.values()]
        chosen = [manifest for manifest in found if kind in (None, manifest.kind)]
        return sorted(chosen, key=lambda manifest: (PART_KINDS.index(manifest.kind), manifest.name))


def default_library(extra: Iterable[Path] = ()) -> Library:
    """The package's parts, those of ``MORPHGEN_LIBRARY``, and those of ``extra`` folders."""
    environment = os.environ.get(LIBRARY_VARIABLE, "")
    users = [Path(entry) for entry in environment.split(os.pathsep) if entry]
    given = (folder.absolute() for folder in (*users, *extra))
    own = [Path(str(files(package))) for package in ("morphgen.templates", "morphgen.robots_real")]
    return Library(dict.fromkeys((*own, *given)))


def _manifest(path: Path) -> Manifest:
    return _read(path, file_stamp(path))


@lru_cache(maxsize=1024)
def _read(path: Path, stamp: tuple[int, int]) -> Manifest:
    """The manifest of a file as it is at its stamp."""
    del stamp
    return read_manifest(path)
