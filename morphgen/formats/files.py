"""Files and folders that are never half there, and folders that one run has to itself."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from morphgen.errors import FormatError

LOCK = ".lock"
"""The file that a run holds in its folder."""


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file by way of ``partial_path`` it, so that it is never half there.

    Raises:
        OSError: If it cannot be written; then nothing is left behind.
    """
    partial = partial_path(path)
    try:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        partial.replace(path)
    except BaseException:
        with suppress(OSError):
            partial.unlink()
        raise


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file that the user named; several processes may at once.

    Raises:
        FormatError: If it cannot be written; then nothing is left behind.
    """
    try:
        _replace(path, content)
    except OSError as error:
        raise FormatError(f"cannot write {path}: {error.strerror}") from error


def partial_path(path: Path) -> Path:
    """Where a file is written before it takes its place."""
    return path.with_name(f".{path.name}.partial")


@contextmanager
def replacing_file(path: Path) -> Iterator[Path]:
    """A file in a temporary folder beside ``path`` that takes its place if the block succeeds.

    Other processes may do the same at once, which ``write_atomic`` does not bear: its partial file
    has a name by which a run knows its own.

    Raises:
        OSError: If it cannot be written; then nothing is left behind.
    """
    with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as folder:
        partial = Path(folder) / path.name
        yield partial
        partial.replace(path)


def write_cache_file(path: Path, content: str | bytes) -> None:
    """Write a file of a cache, which several processes may do at once; makes its folder.

    Raises:
        OSError: If it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _replace(path, content)


def _replace(path: Path, content: str | bytes) -> None:
    with replacing_file(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold a folder against a second run; a killed one holds nothing.

    Raises:
        FormatError: If another run holds it, or it cannot be written.
    """
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise FormatError(f"{folder} is being written by another run; wait for its end") from error
    except OSError as error:
        raise FormatError(f"cannot write to {folder}: {error.strerror}") from error
    try:
        yield
    finally:
        (folder / LOCK).unlink(missing_ok=True)  # before the release: nobody holds it meanwhile
        lock.release()


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder beside ``folder`` that takes its place if the block succeeds."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    except OSError as error:
        raise FormatError(f"cannot write to {folder.parent}: {error.strerror}") from error
    try:
        partial.chmod(0o755)
        yield partial
        if folder.exists():
            _swap(folder, partial)
        else:
            partial.rename(folder)
    except OSError as error:
        raise FormatError(f"cannot write {folder}: {error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _swap(folder: Path, partial: Path) -> None:
    """Put ``partial`` in the place of ``folder``, which stays if that fails."""
    aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    old = aside / folder.name
    try:
        folder.rename(old)
        partial.rename(folder)
    except BaseException:
        if old.exists() and not folder.exists():
            old.rename(folder)
        shutil.rmtree(aside)
        raise
    shutil.rmtree(aside)
