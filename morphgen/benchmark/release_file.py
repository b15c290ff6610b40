"""The description of a release, ``release.json``, and access to the files of a release.

A release is a split folder (see ``split_folder``) with further files:

release.json       version of the release, evaluation, difficulty
licences.json      every part with its licence and robots; LICENCES.md is the same for readers
difficulty.csv     size, nearest train robots and reference scores of every robot, from version 0.3
croissant.json     description of the dataset for tools (https://docs.mlcommons.org/croissant)
scores.json        reference scores, if there are any
submissions/       the reference submissions that the scores were computed from
goals/             goal sets, see ``morphgen.tasks.goals.split_goals``

An archive is a zip of this folder.
"""

from __future__ import annotations

import datetime
import json
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from morphgen.benchmark.split_file import is_split_name
from morphgen.benchmark.split_folder import require_split_folder
from morphgen.errors import BenchmarkError, FormatError
from morphgen.formats.data_files import read_json
from morphgen.formats.records import Record, read_record
from morphgen.formats.zip_files import ZipLimits, unpack_zip

RELEASE_FILE = "release.json"
LICENCES_FILE, LICENCES_TEXT = "licences.json", "LICENCES.md"
DIFFICULTY_FILE = "difficulty.csv"
CROISSANT_FILE = "croissant.json"
SCORES_FILE = "scores.json"
SUBMISSIONS_DIR = "submissions"
ARCHIVE_SUFFIX = ".zip"

FORMAT = 1
LIMITS = ZipLimits(max_bytes=4 * 2**30, max_files=100_000)
"""Bounds on an archive: a split of 1,000 robots with meshes has 2 GB and 20,000 files."""

_VERSION = re.compile(r"\d{1,6}\.\d{1,6}\.\d{1,6}(?:[-+.]?[0-9A-Za-z]{1,20})?", re.ASCII)
_DATE = re.compile(r"\d{4}-\d{2}-\d{2}", re.ASCII)
_URL = re.compile(r"https?://[^\s\"<>]{1,500}")


class Release(Record, frozen=True):
    """The content of ``release.json``."""

    name: str
    """Name of the split."""
    id: str
    """Id of the split, see ``morphgen.benchmark.split.split_id``."""
    version: str
    """Version of the release, such as ``1.0.0``."""
    morphgen: str
    """Version of morphgen that made it."""
    evaluation: dict[str, Any]
    """How submissions are evaluated, see ``morphgen.tasks.goals.eval_protocol``."""
    format: int = FORMAT
    date: str = ""
    """Date of publication, such as ``2027-01-31``; empty if it is not given."""
    creators: tuple[str, ...] = ()
    url: str = ""
    """Address of the release; empty if it is not given."""
    difficulty: dict[str, Any] = msgspec.field(default_factory=dict)
    """Cosine similarity of test and train robots, and the nearest train robot by each measure."""

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise ValueError(f"format {self.format}; this version reads {FORMAT}")
        if not is_split_name(self.name):
            raise ValueError(f"name {self.name!r}; expected the name of a split")
        if not _VERSION.fullmatch(self.version):
            raise ValueError(f"version {self.version!r}; expected one such as 1.0.0")
        if self.date and not _is_date(self.date):
            raise ValueError(f"date {self.date!r}; expected one such as 2027-01-31")
        for creator in self.creators:
            if not creator or not creator.isprintable():
                raise ValueError(f"creator {creator!r}; expected printable characters")
        if self.url and not _URL.fullmatch(self.url):
            raise ValueError(f"url {self.url!r}; expected an address such as https://example.org")

    @property
    def stem(self) -> str:
        """Name of the archive without its suffix, and of the folder in it."""
        return f"{self.name.replace('/', '-')}-{self.version}"


def _is_date(text: str) -> bool:
    """Return whether a text is a day of the calendar, such as ``2027-01-31``."""
    try:
        return bool(_DATE.fullmatch(text) and datetime.date.fromisoformat(text))
    except ValueError:
        return False


def release_text(release: Release) -> str:
    """Return the text of ``release.json``."""
    data = msgspec.to_builtins(release)
    kept = {key: value for key, value in data.items() if value not in (None, "", (), [])}
    return json.dumps({"format": release.format, **kept}, indent=2) + "\n"


def is_release(folder: Path) -> bool:
    """Return whether a folder is a release."""
    return (folder / RELEASE_FILE).is_file()


def read_release(folder: Path) -> Release:
    """Read the description of a release."""
    path = folder / RELEASE_FILE
    if not is_release(folder):
        raise BenchmarkError(
            f"{folder} is no release: it has no {RELEASE_FILE}; morphgen split release makes one"
        )
    try:
        return read_record(read_json(path), Release, str(path), BenchmarkError)
    except FormatError as error:
        raise BenchmarkError(str(error)) from error


def is_archive(path: Path) -> bool:
    """Return whether a path is named as an archive and is not a folder."""
    return path.suffix == ARCHIVE_SUFFIX and not path.is_dir()


@contextmanager
def opened_folder(path: Path) -> Iterator[Path]:
    """Yield a split folder: the one at a path, or that of an archive in a temporary folder."""
    if not is_archive(path):
        require_split_folder(path)
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="morphgen-") as temporary:
        try:
            unpack_zip(path, Path(temporary), LIMITS)
        except FormatError as error:
            raise BenchmarkError(str(error)) from error
        folders = list(Path(temporary).iterdir())
        if len(folders) != 1 or not folders[0].is_dir():
            raise BenchmarkError(
                f"{path}: {len(folders)} files and folders at its top; expected the one folder of "
                "a release"
            )
        try:
            require_split_folder(folders[0])
        except BenchmarkError as error:
            raise BenchmarkError(f"{path}: {str(error).replace(temporary, '')}") from error
        yield folders[0]
