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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from morphgen.benchmark.generate import (
    RejectDerivation,
    RejectRobot,
    RobotStream,
    SimilarityBound,
    SplitRequest,
    StructureAndHull,
    TestRobotSearch,
    UntrainedStructure,
    parse_bound,
)
from morphgen.benchmark.near_duplicates import NearReason
from morphgen.benchmark.release_file import PrivateTest, Release
from morphgen.benchmark.robot_factory import (
    Candidate,
    DerivedRecipe,
    RobotFactory,
    make_robots,
    members,
)
from morphgen.benchmark.split import SIDES, Member, Side, Split, split_id
from morphgen.errors import BenchmarkError, FormatError
from morphgen.formats.data_files import read_text
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.grammar_file import Grammar, find_grammar, load_grammar
from morphgen.grammar.library import Library
from morphgen.grammar.request import pin

_GRAMMAR_NAME = re.compile(r"[A-Za-z0-9][\w-]*")


@dataclass(frozen=True, eq=False)
class PrivateSource:
    """Grammars of private robots, and the public robots that they must differ from."""

    grammars: tuple[Grammar, ...]
    public: tuple[Candidate, ...]
    """Robots of both public sides, with their features; no private robot equals one of them."""
    reject_derivation: RejectDerivation
    reject_robot: RejectRobot


def private_source(split: Split, library: Library) -> PrivateSource:
    """Return the source of private test robots that follow the rules of a split's public ones."""
    grammars = test_grammars(split, library)
    made = split.provenance
    train, test = (_candidates(split, side, library) for side in SIDES)
    public = (*train, *test)
    if split.regime == "interpolation":
        hull = str(made.get("hull", "any"))
        return PrivateSource(
            grammars,
            public,
            StructureAndHull(train, len(train), hull, library),
            NearReason(public),
        )
    bound = parse_bound(str(made["similarity"])) if "similarity" in made else None
    violates_bound, is_near_public = SimilarityBound(train, len(train), bound), NearReason(public)
    return PrivateSource(
        grammars,
        public,
        UntrainedStructure(train, library),
        lambda robot: violates_bound(robot) or is_near_public(robot),
    )


def test_grammars(split: Split, library: Library) -> tuple[Grammar, ...]:
    """Return the grammars of the test robots, as the split's provenance names them."""
    refusal = BenchmarkError(
        f"split {split.name!r}: its test robots are not drawn from grammars ({split.regime}); a "
        "private test side is for splits of morphgen split new interpolation or extrapolation, and "
        "for scenarios whose test robots are sampled"
    )
    made = split.provenance
    if split.regime not in ("interpolation", "extrapolation"):
        raise refusal
    hashes = made.get("grammar" if split.regime == "interpolation" else "test_categories")
    if isinstance(hashes, Mapping) and hashes:
        loaded = [_load(str(name), (), library) for name in hashes]
        for grammar in loaded:
            if grammar.digest != hashes[grammar.name]:
                raise BenchmarkError(
                    f"split {split.name!r}: grammar {grammar.name} has changed since the split was "
                    "made; make the split again"
                )
        return tuple(loaded)
    rows = made.get("test")  # of a scenario, see morphgen.benchmark.scenarios
    if not isinstance(rows, Sequence) or isinstance(rows, str) or not rows:
        raise refusal
    pins_by_name: dict[str, str] = {}
    for row in rows:
        if not isinstance(row, Mapping) or "grammar" not in row:
            raise refusal
        name, pins = str(row["grammar"]), str(row.get("pinned", ""))
        if pins_by_name.setdefault(name, pins) != pins:
            raise BenchmarkError(
                f"split {split.name!r}: its test robots are drawn from {name} with different "
                "pinned choices; a private test side needs one grammar of a name"
            )
    return tuple(_load(name, pins.split(), library) for name, pins in pins_by_name.items())


def _load(name: str, pins: Sequence[str], library: Library) -> Grammar:
    """Return a grammar of the library; a split may be a stranger's, so a path is refused."""
    if not _GRAMMAR_NAME.fullmatch(name):
        raise BenchmarkError(f"grammar {name!r}: expected the name of a grammar in the library")
    grammar = load_grammar(find_grammar(name, library.folders), library.folders)
    return pin(grammar, list(pins), library) if pins else grammar


def _candidates(split: Split, side: Side, library: Library) -> list[Candidate]:
    """Return the robots of a side with the features that similarity measures need."""
    factory = RobotFactory(library.folders, with_features=True, max_links=split.max_links)
    recipes = [
        DerivedRecipe(
            parse_derivation(member.derivation, f"derivation of {member.name!r}"),
            member.name,
            member.category,
        )
        for member in split.side(side)
    ]
    return make_robots(recipes, factory)


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
    """Read a secret; errors do not quote the file."""
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

    Returns:
        The split with the private robots as its test side, and their public description.
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
