"""Folders of exported robots: written atomically, and replaced only while nobody edited them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from morphgen.errors import FormatError
from morphgen.formats.data_files import read_json
from morphgen.formats.files import first_edit, folder_hashes, replacing_folder

MANIFEST = "export.json"
"""File that lists the other files of an exported folder with their SHA-256."""


@contextmanager
def writing_export(folder: Path, format_name: str, robot_name: str) -> Iterator[Path]:
    """Yield a temporary folder that replaces ``folder`` if the block succeeds.

    The manifest is added at the end. A folder that holds anything else than an unchanged export is
    never replaced, because it may contain work of the user.

    Args:
        folder: The folder to write.
        format_name: Name of the export format, for the manifest.
        robot_name: Name of the robot, for the manifest.

    Raises:
        FormatError: If the folder cannot be written, or exists with files that are not of an
            export of this robot or were changed since.
    """
    _require_replaceable(folder, robot_name)
    with replacing_folder(folder) as partial:
        yield partial
        manifest = {"format": format_name, "robot": robot_name, "files": folder_hashes(partial)}
        text = json.dumps(manifest, indent=2, ensure_ascii=False) + "\n"
        (partial / MANIFEST).write_text(text, encoding="utf-8")


def _require_replaceable(folder: Path, robot_name: str) -> None:
    if not folder.exists() and not folder.is_symlink():
        return
    manifest = folder / MANIFEST
    if folder.is_symlink() or not manifest.is_file():
        raise FormatError(
            f"{folder} exists and is not an export (no {MANIFEST}); move it away, or choose "
            "another --out"
        )
    data = read_json(manifest)
    written = data.get("files") if isinstance(data, dict) else None
    if not isinstance(written, dict):
        raise FormatError(f"{manifest}: files: expected an object with the SHA-256 of every file")
    if data.get("robot") != robot_name:
        raise FormatError(
            f"{folder} is an export of robot {data.get('robot')!r}, not of {robot_name!r}; move it "
            "away, or choose another --out"
        )
    if edit := first_edit(folder, written, {MANIFEST}):
        name, is_changed = edit
        why = "was changed after the export" if is_changed else "is not of the export"
        raise FormatError(
            f"{folder} is not replaced: {name} {why}; move the folder away, or choose another --out"
        )
