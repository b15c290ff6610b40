"""Write folders atomically, and lock folders against concurrent runs."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from morphgen.errors import FormatError, MorphgenError, shortened
from morphgen.files import file_sha256, write_atomic
from morphgen.formats.data_files import read_json
from morphgen.formats.records import dotted_values

SYSTEM_FILES = frozenset({".DS_Store", "Thumbs.db", "desktop.ini"})
"""Files that file managers write into the folders that they show."""
LOCK = ".lock"  # name of the lock file in a folder


def folder_hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file in a folder, hexadecimal, by its path, sorted."""
    return {
        path.relative_to(folder).as_posix(): file_sha256(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def require_unedited(
    folder: Path, hashes: Mapping[str, object], generated: Collection[str], kind: str, choice: str
) -> None:
    """Require that a folder, such as a bundle, holds no work of the user.

    Missing files and ``SYSTEM_FILES`` do not count. ``generated`` may differ from their hashes;
    ``choice`` is what the user can choose instead, for the error.
    """
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        is_entry = path.is_symlink() or not path.is_dir()
        if not is_entry or name in generated or path.name in SYSTEM_FILES:
            continue
        if hashes.get(name) != (file_sha256(path) if path.is_file() else ""):
            why = "was changed since" if name in hashes else f"is not of the {kind}"
            raise FormatError(
                f"{folder} is not replaced: {name} {why}; move the folder away, or choose another "
                f"{choice}"
            )


def require_writable_file(path: Path, name: str = "", suffix: str = "") -> None:
    """Require, before long work, that a file can be written."""
    if path.suffix.lower() != suffix and suffix:
        why = f"expected a name that ends in {suffix}"
    elif path.is_dir():
        why = "it is a folder"
    elif not path.parent.is_dir():
        why = f"there is no folder {path.parent}"
    elif not os.access(path.parent, os.W_OK):
        why = f"folder {path.parent} cannot be written"
    else:
        return
    raise FormatError(f"{name} {path}: {why}".lstrip())


def require_writable_folder(folder: Path) -> None:
    """Require, before long work, that a folder can be written, or created with its parents."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise FormatError(f"cannot write to {folder}: {existing} is a file")
    if not os.access(existing, os.W_OK):
        raise FormatError(f"cannot write to {folder}: {existing} cannot be written")


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let an ``OSError`` without a file name, such as that of a full disk, name this file."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


@contextmanager
def writing(what: object, error_type: type[MorphgenError] = FormatError) -> Iterator[None]:
    """Turn an ``OSError`` into the error that something cannot be written."""
    try:
        yield
    except OSError as error:
        raise error_type(f"cannot write {what}: {error.strerror}") from error


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file that the user named."""
    with writing(path):
        write_atomic(path, content)


def leftovers(path: Path) -> set[Path]:
    """Return the temporary folders of writes of a file that were interrupted."""
    return {*path.parent.glob(f".{path.name}.*")}


def begin_folder(
    path: Path,
    settings: Mapping[str, object],
    kind: str,
    error_type: type[MorphgenError] = FormatError,
    *,
    first: Mapping[str, str] | None = None,
) -> None:
    """Begin a folder with a JSON file of its settings, or require the same in it.

    So an interrupted run is only continued with equal settings. Traces of one that was killed at
    its start do not count. ``kind`` is for errors, ``first`` are texts of files written before.
    """
    folder, text = path.parent, json.dumps(settings, indent=2) + "\n"
    texts = {**(first or {}), path.name: text}
    if not path.is_file():
        traces = {file for name in texts for file in leftovers(folder / name)}
        traces |= {
            file
            for name, content in texts.items()
            if (file := folder / name).is_file() and file.read_bytes() == content.encode()
        }
        if folder.exists() and not (folder.is_dir() and traces >= set(folder.iterdir())):
            raise error_type(
                f"{folder} exists and is not a {kind} (no {path.name}); name another folder"
            )
        with writing(f"to {folder}", error_type):
            folder.mkdir(parents=True, exist_ok=True)
            for name, content in texts.items():
                write_atomic(folder / name, content)
    stored, wanted = read_json(path), json.loads(text)
    if not isinstance(stored, dict) or not stored.keys() >= wanted.keys():
        raise FormatError(f"{path}: expected the settings of a {kind}: {', '.join(wanted)}")
    old, new = (dotted_values({key: data[key] for key in wanted}) for data in (stored, wanted))
    for name in {**old, **new}:
        was, is_now = (shortened(repr(each.get(name, "(none)"))) for each in (old, new))
        if old.get(name, "(none)") != new.get(name, "(none)"):
            raise error_type(
                f"{folder} holds another {kind}: its {name} is {was}, not {is_now}; name another "
                "folder"
            )


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Lock a folder against other runs; the lock ends with its process."""
    lock = FileLock(folder / LOCK)
    with writing(f"to {folder}"):
        try:
            lock.acquire(timeout=0)
        except Timeout as error:  # an OSError, too, which `writing` would report otherwise
            why = "is being written by another run; wait until it ends"
            raise FormatError(f"{folder} {why}") from error
    try:
        yield
    finally:
        # Before the release, when no other run can have locked it.
        (folder / LOCK).unlink(missing_ok=True)
        lock.release()


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder that replaces ``folder`` if the block succeeds.

    If it fails, folders above that were made for it are removed.
    """
    with _parents(folder):
        with writing(f"to {folder.parent}"):
            partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            partial.chmod(0o755)  # mkdtemp makes a folder that only its owner may open
            yield partial
            if folder.exists():
                _swap(folder, partial)
            else:
                partial.rename(folder)
        except OSError as error:
            name = Path(error.filename or partial)
            is_read = not name.is_relative_to(partial)
            what = name if is_read else f"cannot write {folder / name.relative_to(partial)}"
            raise FormatError(f"{what}: {error.strerror or error}") from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def _parents(folder: Path) -> Iterator[None]:
    """Make the folders above; those that were not there and end empty are removed."""
    made: list[Path] = []
    try:
        with writing(f"to {folder.parent}"):
            made = [each for each in folder.parents if not each.exists()]
            folder.parent.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for each in made:
            with suppress(OSError):  # one with something in it stays
                each.rmdir()


def _swap(folder: Path, partial: Path) -> None:
    """Replace ``folder`` by ``partial``; if that fails, ``folder`` stays."""
    # A folder cannot be renamed onto one that is not empty.
    backup = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    old = backup / folder.name
    try:
        folder.rename(old)
        partial.rename(folder)
    except BaseException:
        if old.exists() and not folder.exists():
            old.rename(folder)
        shutil.rmtree(backup)
        raise
    shutil.rmtree(backup)


MANIFEST = "export.json"  # file that lists the other files of an exported folder with their SHA-256


@contextmanager
def writing_export(folder: Path, format_name: str, robot_name: str) -> Iterator[Path]:
    """Yield a temporary folder that replaces ``folder``, with a manifest, if the block succeeds.

    A folder with anything else than an unchanged export may have work of the user and stays.
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
    require_unedited(folder, written, {MANIFEST}, "export", "--out")
