"""Read a split folder: a split with the files of all its robots, see ``split_build``.

split.yaml         the split
robots.jsonl       one line per robot, train robots first
tokens.npz         tokens (n, max_links, 48), mask (n, max_links), names (n,), in the same order
robots/<name>/     a bundle: robot.urdf, robot.xml, meshes/, card.json; members with the same robot
                   share one
README.md          description of the files
build.json         settings of the build
SHA256SUMS         hashes of all these files, written last, for ``sha256sum -c``
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.split import SIDES, Side
from morphgen.benchmark.token_layout import TOKEN_SIZE
from morphgen.errors import BenchmarkError, FormatError
from morphgen.formats.data_files import parse_json, read_text
from morphgen.formats.npz_files import read_npz

SPLIT_FILE = "split.yaml"
ROBOTS_FILE = "robots.jsonl"
TOKENS_FILE = "tokens.npz"
ROBOTS_DIR = "robots"
README_FILE = "README.md"
BUILD_FILE = "build.json"
SUMS_FILE = "SHA256SUMS"

FORMAT = 1
"""Version of the folder's layout."""

_SUM = re.compile(r"([0-9a-f]{64})  (.+)")

Record = dict[str, Any]
"""A line of ``robots.jsonl``."""


class Robots(Sequence[Record]):
    """Robots as dictionaries.

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
        """Return one robot, or the robots of a slice."""
        records = self._records[index]
        return Robots(records) if isinstance(records, tuple) else records


@dataclass(frozen=True, eq=False)
class SplitFolder:
    """The content of a split folder."""

    folder: Path
    robots: Robots
    """All robots, train robots first. The bundle of a robot is ``folder / robot["path"]``."""
    tokens: NDArray[np.float64]
    """Tokens at home, in the order of ``robots``, shape (n, max_links, 48)."""
    mask: NDArray[np.bool_]
    """True for the rows of tokens that are links, shape (n, max_links)."""

    @property
    def train(self) -> Robots:
        """The train robots."""
        return self._side("train")

    @property
    def test(self) -> Robots:
        """The test robots."""
        return self._side("test")

    def _side(self, side: Side) -> Robots:
        return Robots([robot for robot in self.robots if robot["side"] == side])

    def __iter__(self) -> Iterator[Record]:
        return iter(self.robots)

    def __len__(self) -> int:
        return len(self.robots)


def load_split_folder(folder: str | Path) -> SplitFolder:
    """Read a folder that ``morphgen split build`` wrote, without its bundles.

    Args:
        folder: The folder, such as ``data/extrapolation/arms/reach``.

    Raises:
        BenchmarkError: If it is not a split folder, is not finished, or its files disagree.
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
    """Check that a folder is a finished split folder.

    Raises:
        BenchmarkError: If it is not.
    """
    if not folder.is_dir():
        raise BenchmarkError(f"{folder}: no such folder")
    if not (folder / BUILD_FILE).is_file():
        # A build is at most three folders deep; a search of all would take long in a large folder.
        depths = ("*", "*/*", "*/*/*")
        inside = sorted(path.parent for n in depths for path in folder.glob(f"{n}/{BUILD_FILE}"))
        hint = f"; did you mean {inside[0]}?" if inside else "; morphgen split build makes one"
        raise BenchmarkError(f"{folder} is no built split: it has no {BUILD_FILE}{hint}")
    if not (folder / SUMS_FILE).is_file():
        raise BenchmarkError(f"{folder} is not finished: it has no {SUMS_FILE}; build it again")


def read_records(path: Path) -> list[Record]:
    """Read the lines of ``robots.jsonl``.

    Raises:
        BenchmarkError: If the file is missing or a line is malformed; the message has its number.
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
    """Read names, tokens and mask of ``tokens.npz``.

    Raises:
        BenchmarkError: If it is missing or cannot be read, or the shapes of its arrays disagree.
    """
    try:
        names, tokens, mask = read_npz(path, ("names", "tokens", "mask"))
    except FileNotFoundError as error:
        raise BenchmarkError(f"{path}: no such file") from error
    except ValueError as error:
        raise BenchmarkError(f"{path}: cannot be read: {error}") from error
    types = ", ".join(array.dtype.name for array in (names, tokens, mask))
    if names.dtype.kind != "U" or tokens.dtype != np.float64 or mask.dtype != np.bool_:
        raise BenchmarkError(
            f"{path}: names, tokens and mask are of types {types}; expected str, float64 and bool"
        )
    if (
        names.ndim != 1
        or mask.shape != (len(names), *mask.shape[1:2])
        or tokens.shape != (*mask.shape, TOKEN_SIZE)
    ):
        shapes = ", ".join(str(array.shape) for array in (names, tokens, mask))
        raise BenchmarkError(f"{path}: names, tokens and mask are of shapes {shapes}")
    return names.tolist(), tokens, mask


def read_sums(path: Path) -> dict[str, str]:
    """Read SHA-256 hashes by path, as ``sha256sum`` writes them.

    Raises:
        BenchmarkError: If the file is missing or a line is malformed; the message has its number.
    """
    sums = {}
    for number, line in enumerate(_text(path).splitlines(), 1):
        match = _SUM.fullmatch(line)
        if not match:
            raise BenchmarkError(f"{path}:{number}: expected a hash, two spaces and a path")
        sums[match[2]] = match[1]
    return sums


def read_settings(path: Path) -> tuple[str, bool]:
    """Read the id of the split, and if its robots were built light, from ``build.json``.

    Raises:
        BenchmarkError: If the file is missing or malformed.
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
