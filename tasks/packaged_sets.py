"""Goal sets of the benchmark's scenarios that come with the package, verified by hash when read.

They are the sets that would be sampled, number by number, in double precision: a set of lower
precision would give other episodes than the same set sampled anew. ``package_sets`` makes them.
"""

from __future__ import annotations

import hashlib
import json
import lzma
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from morphgen.errors import TaskError

FOLDER = Path(__file__).with_name("goal_set_files")
"""Folder of the compressed sets and of their index."""
INDEX = "index.json"


@cache
def packaged_index() -> Mapping[str, Mapping[str, Any]]:
    """Return a record of each packaged set by the set's key.

    A record has ``file`` with its ``sha256`` and ``bytes``, ``task``, ``obstacles``, and
    ``robot``, the hash of the robot in splits.
    """
    records: dict[str, dict[str, Any]] = json.loads((FOLDER / INDEX).read_text(encoding="utf-8"))
    return records


def packaged_set(key: str) -> bytes | None:
    """Return the content of the packaged set with a key, as ``set_npz`` returns it, or None.

    Raises:
        TaskError: If the file is missing, or is not the one that the index lists.
    """
    record = packaged_index().get(key)
    if record is None:
        return None
    path = FOLDER / record["file"]
    try:
        content = path.read_bytes()
    except OSError as error:
        raise TaskError(f"{path}: {error.strerror}; install morphgen again") from error
    if hashlib.sha256(content).hexdigest() != record["sha256"]:
        raise TaskError(f"{path}: not the file that {INDEX} lists; install morphgen again")
    return lzma.decompress(content)
