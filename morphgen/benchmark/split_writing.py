"""Write the files of new splits, without replacing others."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from morphgen.benchmark.split import Split
from morphgen.benchmark.split_file import SUFFIX, split_text, write_split
from morphgen.errors import BenchmarkError

_VERSION = re.compile(r"(?m)^morphgen: .*\n")


def split_paths(out: Path, splits: Sequence[Split]) -> list[Path]:
    """Return the path of each split's file.

    Args:
        out: A file that ends in ``.yaml``, or a folder for ``<name>.yaml``.
        splits: Splits of several sizes, or one.
    """
    if out.suffix != SUFFIX:
        return [out / f"{split.name}{SUFFIX}" for split in splits]
    if len(splits) == 1:
        return [out]
    return [out.with_stem(f"{out.stem}-train{split.provenance['train']}") for split in splits]


def write_new_splits(splits: Sequence[Split], paths: Sequence[Path]) -> None:
    """Write all files, or none if one of them exists with another content.

    A file of the same content that another version of morphgen wrote is kept.

    Raises:
        BenchmarkError: If a file exists with another content, or cannot be written.
    """
    missing = []
    for split, path in zip(splits, paths, strict=True):
        if not path.is_file():
            missing.append((split, path))
        elif _without_version(path.read_bytes()) != _without_version(split_text(split).encode()):
            raise BenchmarkError(f"{path} exists with another content; choose another name or path")
    for split, path in missing:
        write_split(split, path)


def _without_version(content: bytes) -> str:
    return _VERSION.sub("", content.decode("utf-8", "replace"), count=1)
