"""The content of the files of a split folder, except those of single robots.

``split_build`` writes them; ``verify`` compares them.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.split import Member, Split, sided_members, split_id
from morphgen.benchmark.split_folder import (
    BUILD_FILE,
    FORMAT,
    ROBOTS_DIR,
    ROBOTS_FILE,
    SPLIT_FILE,
    SUMS_FILE,
    TOKENS_FILE,
    Record,
)
from morphgen.benchmark.survey import robot_stats
from morphgen.benchmark.token_layout import LAYOUT, pad_tokens
from morphgen.benchmark.tokens import tokens
from morphgen.errors import BenchmarkError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.model.robot import Robot
from morphgen.typing import Array

_README = """\
# {name}

{summary}

A split of robots for cross-embodiment learning ({regime}): {train} robots to train on, {test} to
test on. `{split}` says how they were chosen; its id is `{id}`.

- `{robots}`: a line of JSON a robot: name, side (train or test), task, obstacles, category,
  derivation (parts and parameters), hash of the body, links, movable joints, those between root and
  tool, degrees of freedom, reach (m), mass (kg), and path of its folder
- `{tokens}`: tokens (n, max_links, 48) at home, mask (n, max_links), names (n,), in the order of
  `{robots}`; layout and columns say what the 48 numbers are
- `{bundles}/`: {bundle}
- `{settings}`: how this folder was built
- `{sums}`: of every file, for `sha256sum -c {sums}`; `morphgen split verify .` also tests that the
  robots are those of `{split}`

```python
from morphgen.benchmark.split_folder import load_split_folder

split = load_split_folder(".")
for robot in split.train:
    print(robot["name"], robot["tokens"].shape, split.folder / robot["path"] / "robot.urdf")
```

Without morphgen: `datasets.load_dataset("json", data_files="{robots}")` and
`numpy.load("{tokens}")`.
"""
_BUNDLE = (
    "a folder a body: `robot.urdf`, `robot.xml` (MJCF), `meshes/`, and `card.json` with the\n"
    "  sources and licences of its parts"
)
_LIGHT = (
    "a folder a body: `robot.urdf`, whose meshes are named where their data packages have\n"
    "  them, and `derivation.txt`"
)


@dataclass(frozen=True)
class BuildSettings:
    """Settings of a build."""

    light: bool = False
    """Write only URDF and derivation; the URDF refers to the meshes of the data packages."""
    picture: bool = False
    """Add ``preview.png`` to the bundles."""

    def __post_init__(self) -> None:
        """Check that both can be done.

        Raises:
            BenchmarkError: If a light build is to have pictures.
        """
        if self.light and self.picture:
            raise BenchmarkError("a light build has no pictures; choose one of light and picture")


BUNDLED = BuildSettings()


@dataclass(frozen=True, eq=False)
class RobotData:
    """The measurements and tokens of a robot."""

    facts: Mapping[str, object]
    """Numbers of links and joints, reach and mass, see ``survey.RobotStats``."""
    tokens: Array
    """Tokens, shape (n_links, 48)."""


def robot_data(robot: Robot, folders: Sequence[Path], max_links: int) -> RobotData:
    """Measure a robot.

    Args:
        robot: The robot.
        folders: Folders of parts, for their stored fits.
        max_links: Largest number of links in the split.

    Raises:
        BenchmarkError: If the robot has more links.
    """
    table = tokens(robot, token_shapes(robot, folders), max_links=max_links)
    return RobotData(robot_stats(robot).as_dict(), table)


def unique_robots(split: Split) -> list[Member]:
    """Return the first member of each robot, train first; its name is that of the folder.

    Raises:
        BenchmarkError: If two different robots have the same name.
    """
    firsts: dict[str, Member] = {}
    hash_by_name: dict[str, str] = {}
    for _, member in sided_members(split):
        firsts.setdefault(member.robot_hash, member)
        if hash_by_name.setdefault(member.name, member.robot_hash) != member.robot_hash:
            raise BenchmarkError(
                f"split {split.name!r}: a train and a test robot of different bodies are both "
                f"named {member.name!r}; rename one"
            )
    return list(firsts.values())


def robot_paths(split: Split) -> dict[str, str]:
    """Return the path of each robot's folder in the split folder, by the robot's hash."""
    return {member.robot_hash: f"{ROBOTS_DIR}/{member.name}" for member in unique_robots(split)}


def records(split: Split, known: Mapping[str, RobotData]) -> list[Record]:
    """Return the lines of ``robots.jsonl``.

    Args:
        split: The split.
        known: Data of each robot by its hash.
    """
    paths = robot_paths(split)
    return [
        {
            "name": member.name,
            "side": side,
            "task": member.task,
            "obstacles": member.obstacles,
            "category": member.category,
            "derivation": member.derivation,
            "hash": member.robot_hash,
            **known[member.robot_hash].facts,
            "path": paths[member.robot_hash],
        }
        for side, member in sided_members(split)
    ]


def records_text(split: Split, known: Mapping[str, RobotData]) -> str:
    """Return the text of ``robots.jsonl``."""
    lines = (json.dumps(record, ensure_ascii=False) for record in records(split, known))
    return "".join(f"{line}\n" for line in lines)


def token_tables(split: Split, known: Mapping[str, RobotData]) -> tuple[Array, NDArray[np.bool_]]:
    """Return tokens (n, max_links, 48) and mask (n, max_links) of all members."""
    tables = [known[member.robot_hash].tokens for _, member in sided_members(split)]
    padded = [pad_tokens(table, split.max_links) for table in tables]
    return np.array([table for table, _ in padded]), np.array([mask for _, mask in padded])


def tokens_npz(split: Split, known: Mapping[str, RobotData]) -> bytes:
    """Return the bytes of ``tokens.npz``."""
    tables, mask = token_tables(split, known)
    content = io.BytesIO()
    np.savez(
        content,
        tokens=tables,
        mask=mask,
        names=np.array([member.name for _, member in sided_members(split)]),
        layout=np.array([field.name for field in LAYOUT]),
        columns=np.array([(field.start, field.columns.stop) for field in LAYOUT]),
    )
    return content.getvalue()


def settings_text(split: Split, settings: BuildSettings) -> str:
    """Return the text of ``build.json``; a build is continued only with the same settings."""
    data = {
        "format": FORMAT,
        "split": split_id(split),
        "light": settings.light,
        "picture": settings.picture,
    }
    return json.dumps(data, indent=2) + "\n"


def readme_text(split: Split, settings: BuildSettings) -> str:
    """Return the text of ``README.md``."""
    return _README.format(
        name=split.name,
        summary=split.summary or "(no summary)",
        regime=split.regime,
        train=len(split.train),
        test=len(split.test),
        id=split_id(split),
        bundle=_LIGHT if settings.light else _BUNDLE,
        split=SPLIT_FILE,
        robots=ROBOTS_FILE,
        tokens=TOKENS_FILE,
        bundles=ROBOTS_DIR,
        settings=BUILD_FILE,
        sums=SUMS_FILE,
    )


def sums_text(sums: Mapping[str, str]) -> str:
    """Return the text of ``SHA256SUMS`` for hexadecimal hashes by path."""
    return "".join(f"{sums[name]}  {name}\n" for name in sorted(sums))
