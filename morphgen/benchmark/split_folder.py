"""A split on disk, every robot of it written: its layout, and how it is read.

split.yaml         the split
robots.jsonl       a line a robot, the train robots first
tokens.npz         tokens (n, max_links, 48), mask (n, max_links), names (n,); robots as above
robots/<name>/     a bundle: robot.urdf, robot.xml, meshes/, card.json; a body that is named
                   twice is there once
README.md          what is what
build.json         how it was built
SHA256SUMS         of all these files, written last; ``sha256sum -c`` reads it
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.split import SIDES, Side
from morphgen.benchmark.token_layout import TOKEN_SIZE
from morphgen.errors import BenchmarkError, FormatError
from morphgen.formats.data_files import parse_json, read_text

SPLIT_FILE = "split.yaml"
ROBOTS_FILE = "robots.jsonl"
TOKENS_FILE = "tokens.npz"
ROBOTS_DIR = "robots"
README_FILE = "README.md"
BUILD_FILE = "build.json"
SUMS_FILE = "SHA256SUMS"

FORMAT = 1
"""Of the layout."""

_SUM = re.compile(r"([0-9a-f]{64})  (.+)")

Record = dict[str, Any]
"""A line of ``robots.jsonl``."""


class Robots(Sequence[Record]):
    """Robots as plain dictionaries.

    Keys are those of ``robots.jsonl``, and ``tokens``, shape (max_links, 48), and ``mask``, shape
    (max_links,).
    """

    def __init__(self, records: Sequence[Record]) -> None:
        self._records = tuple(records)

    def __len__(self) -> int:
        return len(self._records)

    def __iter__(self) -> Iterator[Record]:
        return iter(self._records)

    @overload
    def __getitem__(self, index: int) -> Record: ...
    @overload
    def __getitem__(self, index: slice) -> Robots: ...
    def __getitem__(self, index: int | slice) -> Record | Robots:
        """A robot by its number, or several."""
        found = self._records[index]
        return Robots(found) if isinstance(found, tuple) else found


@dataclass(frozen=True, eq=False)
class SplitFolder:
    """A split that was built."""

    folder: Path
    robots: Robots
    """All of them. The bundle of one is ``folder / robot["path"]``."""
    tokens: NDArray[np.float64]
    """At home, in the order of ``robots``, shape (n, max_links, 48)."""
    mask: NDArray[np.bool_]
    """Where there is a link, shape (n, max_links)."""

    @property
    def train(self) -> Robots:
        """The robots to train on."""
        return self._of("train")

    @property
    def test(self) -> Robots:
        """The robots to test on."""
        return self._of("test")

    def _of(self, side: Side) -> Robots:
        return Robots([robot for robot in self.robots if robot["side"] == side])

    def __iter__(self) -> Iterator[Record]:
        return iter(self.robots)

    def __len__(self) -> int:
        return len(self.robots)


def load_split_folder(folder: str | Path) -> SplitFolder:
    """Read a folder that ``morphgen split build`` wrote; bundles are not looked at.

    Args:
        folder: Such as ``data/extrapolation/arms/reach``.

    Raises:
        BenchmarkError: If it is none, or not finished, or its parts do not go together.
    """
    folder = Path(folder)
    require_split_folder(folder)
    records = read_records(folder / ROBOTS_FILE)
    names, tokens, mask = read_tokens(folder / TOKENS_FILE)
    if names != [record["name"] for record in records]:
        raise BenchmarkError(f"{folder}: {TOKENS_FILE} is not of the robots in {ROBOTS_FILE}")
    for record, table, present in zip(records, tokens, mask, strict=True):
        record["tokens"], record["mask"] = table, present
    return SplitFolder(folder, Robots(records), tokens, mask)


def require_split_folder(folder: Path) -> None:
    """Require a finished build.

    Raises:
        BenchmarkError: If the folder is none.
    """
    if not folder.is_dir():
        raise BenchmarkError(f"{folder}: no such folder")
    if not (folder / BUILD_FILE).is_file():
        inside = sorted(path.parent for path in folder.glob(f"**/{BUILD_FILE}"))
        hint = f"; did you mean {inside[0]}?" if inside else "; morphgen split build makes one"
        raise BenchmarkError(f"{folder} is no built split: it has no {BUILD_FILE}{hint}")
    if not (folder / SUMS_FILE).is_file():
        raise BenchmarkError(f"{folder} is not finished: it has no {SUMS_FILE}; build it again")


def read_records(path: Path) -> list[Record]:
    """The lines of ``robots.jsonl``.

    Raises:
        BenchmarkError: If it is missing, or a line is none; the message says which.
    """
    records = []
    for number, line in enumerate(_text(path).splitlines(), 1):
        try:
            record = parse_json(line, f"{path}:{number}")
        except FormatError as error:
            raise BenchmarkError(str(error)) from error
        if not isinstance(record, dict) or "name" not in record or record.get("side") not in SIDES:
            raise BenchmarkError(f"{path}:{number}: expected an object with a name and a side")
        records.append(record)
    return records


def read_tokens(path: Path) -> tuple[list[str], NDArray[np.float64], NDArray[np.bool_]]:
    """Names, tokens and mask of ``tokens.npz``.

    Raises:
        BenchmarkError: If it is missing, cannot be read or does not go together.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            names, tokens, mask = data["names"], data["tokens"], data["mask"]
    except FileNotFoundError as error:
        raise BenchmarkError(f"{path}: no such file") from error
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise BenchmarkError(f"{path}: cannot be read: {error}") from error
    if (
        names.ndim != 1
        or mask.shape != (len(names), *mask.shape[1:2])
        or tokens.shape != (*mask.shape, TOKEN_SIZE)
    ):
        shapes = ", ".join(str(array.shape) for array in (names, tokens, mask))
        raise BenchmarkError(f"{path}: names, tokens and mask are of shapes {shapes}")
    return names.tolist(), tokens, mask


def read_sums(path: Path) -> dict[str, str]:
    """SHA-256 by path, as ``sha256sum`` writes it.

    Raises:
        BenchmarkError: If it is missing, or a line is none; the message says which.
    """
    sums = {}
    for number, line in enumerate(_text(path).splitlines(), 1):
        found = _SUM.fullmatch(line)
        if not found:
            raise BenchmarkError(f"{path}:{number}: expected a hash, two spaces and a path")
        sums[found[2]] = found[1]
    return sums


def read_settings(path: Path) -> tuple[str, bool]:
    """The id of the split that was built, and whether its robots are light, of ``build.json``.

    Raises:
        BenchmarkError: If it is missing or no such file.
    """
    try:
        data = parse_json(_text(path), str(path))
        if data["format"] != FORMAT:
            raise BenchmarkError(f"{path}: format {data['format']!r}; this version reads {FORMAT}")
        return str(data["split"]), bool(data["light"])
    except (ValueError, KeyError, TypeError) as error:
        raise BenchmarkError(f"{path}: does not say how the split was built: {error!r}") from error


def _text(path: Path) -> str:
    try:
        return read_text(path)
    except FormatError as error:
        raise BenchmarkError(str(error)) from error
    except FileNotFoundError as error:
        raise BenchmarkError(f"{path}: no such file") from error
    except OSError as error:
        raise BenchmarkError(f"{path}: cannot be read: {error.strerror}") from error
