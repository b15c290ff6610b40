"""A private test side: robots drawn with a secret, committed to now and revealed later.

The release has a commitment, which is the SHA-256 of this JSON text without spaces, keys sorted::

    {"description": {...}, "hashes": [...], "secret": "..."}

``secret`` is the 64 hexadecimal digits of the secret file, ``description`` what the release says
about its private robots (see ``_description``), and ``hashes`` the hashes of the robots in order.
The secret has 256 random bits, so that nobody can find it by trying; whoever publishes the
commitment cannot choose other robots later.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import stat
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from morphgen.benchmark.generate import RobotStream, SplitRequest, TestRobotSearch
from morphgen.benchmark.private_source import PrivateSource, private_source
from morphgen.benchmark.release_file import PrivateTest, Release
from morphgen.benchmark.robot_factory import RobotFactory, members
from morphgen.benchmark.split import Member, Split, split_id
from morphgen.errors import BenchmarkError, FormatError
from morphgen.formats.data_files import read_text
from morphgen.grammar.library import Library

SECRET_BYTES = 32
"""Length of a secret: 256 bits."""
MAX_ROBOTS = 1000
"""Largest number of private robots."""
PRIVATE_KEY = "private_test"
"""Key in ``provenance`` of a revealed split: the release that committed to its test robots."""
_SECRET = re.compile(rf"[0-9a-f]{{{2 * SECRET_BYTES}}}")
_MAX_FILE_BYTES = 1024
_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def make_secret(path: Path) -> str:
    """Return the secret of a file, which is made with a new one if it does not exist.

    Only the owner can read the new file.

    Raises:
        BenchmarkError: If the file holds no secret, others can read it, or it cannot be written.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        if os.name == "posix" and path.is_file() and path.stat().st_mode & _OTHERS:
            raise BenchmarkError(
                f"{path}: others can read this secret; allow only its owner: chmod 600 {path}"
            ) from None
        return read_secret(path)
    except OSError as error:
        raise BenchmarkError(f"cannot write {path}: {error.strerror}") from error
    secret = secrets.token_hex(SECRET_BYTES)
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(f"{secret}\n")
    return secret


def read_secret(path: Path) -> str:
    """Read a secret; errors do not quote the file.

    Raises:
        BenchmarkError: If the file is missing, or holds something else.
    """
    try:
        text = read_text(path, _MAX_FILE_BYTES).strip()
    except FormatError as error:
        raise BenchmarkError(str(error)) from error
    except OSError as error:
        raise BenchmarkError(f"{path}: cannot be read: {error.strerror}") from error
    if not _SECRET.fullmatch(text):
        raise BenchmarkError(
            f"{path}: not a secret of a private test side; expected {2 * SECRET_BYTES} hexadecimal "
            "digits, as --private-test writes them"
        )
    return text


def draw_private_test(
    split: Split, version: str, robots: int, secret: str, library: Library
) -> tuple[Split, PrivateTest]:
    """Draw the private robots of a release.

    They follow the rules of the split's regime, and none is a train or public test robot, or nearly
    the same as one (see ``morphgen.benchmark.audit``).

    Args:
        split: The split of the release.
        version: Version of the release.
        robots: Number of private robots.
        secret: The secret, 64 hexadecimal digits.
        library: The library of parts.

    Returns:
        The split with the private robots as its test side, and their public description.

    Raises:
        BenchmarkError: If the split's test robots are not drawn from grammars, or there are too few
            different robots.
        MorphgenError: If a robot cannot be composed.
    """
    if not 1 <= robots <= MAX_ROBOTS:
        raise BenchmarkError(f"--private-test {robots}: expected 1 to {MAX_ROBOTS} robots")
    source = private_source(split, library)
    test = _draw(split, source, version, robots, secret, library)
    grammars = {grammar.name: grammar.digest for grammar in source.grammars}
    description = _description(split, version, robots, grammars)
    hashes = list(dict.fromkeys(member.robot_hash for member in test))
    public = PrivateTest(robots, grammars, _commitment(secret, description, hashes))
    private = replace(
        split,
        name=f"{split.name}-private",
        summary=f"{split.summary} (private test side of version {version})",
        test=test,
        provenance={
            **split.provenance,
            PRIVATE_KEY: {**description, "commitment": public.commitment},
        },
        statistics={},
    )
    return private, public


def reveal(split: Split, release: Release, secret: str, library: Library) -> Split:
    """Draw the private robots of a release again, and verify the commitment.

    Returns:
        The split with the private robots as its test side.

    Raises:
        BenchmarkError: If the release has no private test side, or the secret does not give the
            robots that it committed to.
    """
    if release.private_test is None:
        raise BenchmarkError(f"{release.stem}: the release has no private test side")
    promised = release.private_test
    private, drawn = draw_private_test(split, release.version, promised.robots, secret, library)
    if drawn.grammars != promised.grammars:
        changed = [
            name
            for name in promised.grammars
            if drawn.grammars.get(name) != promised.grammars[name]
        ]
        raise BenchmarkError(
            f"{release.stem}: grammar {', '.join(changed)} is not the one of the release, which "
            f"morphgen {release.morphgen} made"
        )
    if drawn.commitment != promised.commitment:
        raise BenchmarkError(
            f"{release.stem}: this secret does not give the robots that the release committed to: "
            f"it is of another release, or a part has changed since morphgen {release.morphgen}"
        )
    return private


def _draw(
    split: Split,
    source: PrivateSource,
    version: str,
    robots: int,
    secret: str,
    library: Library,
) -> tuple[Member, ...]:
    tasks = tuple(dict.fromkeys(member.task for member in split.test))
    scenes = {member.obstacles for member in split.test}
    if len(scenes) > 1:
        raise BenchmarkError(
            f"split {split.name!r}: some test robots have obstacles and others not; a private test "
            "side needs the same scene for all"
        )
    request = SplitRequest(
        split.name, (len(split.train),), robots, tasks, max_links=split.max_links
    )
    streams = [
        RobotStream(grammar, prefix, _seed(split, version, secret, prefix))
        for grammar in source.grammars
        for prefix in (f"{grammar.name}-private",)
    ]
    factory = RobotFactory(library.folders, with_features=True, max_links=split.max_links)
    search = TestRobotSearch(request, source.public, factory, lambda done: None, skip_unfit=True)
    if not search.find(streams, source.reject_derivation, source.reject_robot):
        raise BenchmarkError(
            f"--private-test {robots}: {search.failure()}; ask for fewer private robots"
        )
    return members(search.robots, tasks, scenes.pop())


def _seed(split: Split, version: str, secret: str, prefix: str) -> int:
    """Return the seed of a stream: 256 bits that cannot be computed without the secret."""
    text = json.dumps(["morphgen private test", secret, split_id(split), version, prefix])
    return int.from_bytes(hashlib.sha256(text.encode()).digest(), "big")


def _description(
    split: Split, version: str, robots: int, grammars: dict[str, str]
) -> dict[str, Any]:
    """Return what the commitment covers besides secret and robots."""
    return {"split": split_id(split), "version": version, "robots": robots, "grammars": grammars}


def _commitment(secret: str, description: dict[str, Any], hashes: Sequence[str]) -> str:
    data = {"secret": secret, "description": description, "hashes": list(hashes)}
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
