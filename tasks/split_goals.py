"""Goal sets that ship with a built split, and how they are read back.

goals/index.json             seed and constants of all sets, and a record a set
goals/<side>/<name>.npz      the fields of a goal set; its class is that of the task
goals/README.md              what is what
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from morphgen.benchmark.split import Side
from morphgen.benchmark.split_folder import README_FILE, SUMS_FILE, read_sums
from morphgen.benchmark.split_folder_files import sums_text
from morphgen.errors import BenchmarkError, FormatError
from morphgen.formats.data_files import read_json
from morphgen.formats.files import alone, replacing_folder, write_atomic
from morphgen.tasks.env_specs import GoalConfig, task_configs
from morphgen.tasks.goal_making import Made, SplitGoals, gathered
from morphgen.tasks.goal_sets import goals_from_npz, set_npz
from morphgen.tasks.registry import TASKS
from morphgen.tasks.task import GoalSet

GOALS = "goals"
"""The folder in a built split."""
INDEX = "index.json"
FORMAT = 1

_README = """\
# Goal sets

`{index}` says how the sets were made (seed and constants of the tasks) and lists them: robot, side,
task, obstacles, hash of the body with fitted primitives as its collision shapes, key (a hash of all
that the set follows from), seed, number of goals, configurations tried and accepted, SHA-256 of the
file.

{tasks}- `obstacles` (m, 12) and `block` (12,): edges, pose, mass and friction of boxes

Poses are x, y, z, qw, qx, qy, qz in the world, whose origin is the robot's root; metres and rad.

```python
from morphgen.tasks.split_goals import read_goals

for name, goals in read_goals("..", "test").items():
    print(name, goals.q.shape)
```
"""


def write_goals(home: Path, made: Sequence[Made], config: GoalConfig) -> Path:
    """Write the goal sets of a split into the folder where it is built, and their sums.

    The same sets give the same bytes. What was there before is replaced.

    Args:
        home: The built split.
        made: A set for every member.
        config: Seed and constants that they were made with.

    Returns:
        The folder of the sets.

    Raises:
        BenchmarkError: If a member has no set, or the folder is not built or cannot be written.
        FormatError: If another run writes to it.
    """
    require_all(made)
    folder = home / GOALS
    files = dict(_files(made, config))
    read_sums(home / SUMS_FILE)  # refuses a folder that is not built, before anything is locked
    try:
        with alone(home):
            sums = read_sums(home / SUMS_FILE)
            (home / SUMS_FILE).unlink()
            for leftover in home.glob(f".{GOALS}.*"):
                shutil.rmtree(leftover, ignore_errors=True)
            with replacing_folder(folder) as partial:
                for name, content in files.items():
                    (partial / name).parent.mkdir(exist_ok=True)
                    (partial / name).write_bytes(content)
            kept = {name: value for name, value in sums.items() if not name.startswith(f"{GOALS}/")}
            added = {f"{GOALS}/{name}": _sha256(content) for name, content in files.items()}
            write_atomic(home / SUMS_FILE, sums_text(kept | added))
    except OSError as error:
        place = error.filename or home
        raise BenchmarkError(f"cannot write {place}: {error.strerror}") from error
    return folder


def require_all(made: Sequence[Made]) -> None:
    """Require that every robot has a set.

    Raises:
        BenchmarkError: If not; it says why the first has none, and names the others.
    """
    failed = [one for one in made if one.goals is None]
    if failed:
        first, *others = failed
        more = f"; nor has {', '.join(one.robot for one in others)}" if others else ""
        raise BenchmarkError(f"{first.side} robot {first.robot} has no goal set: {first.why}{more}")


def has_goals(folder: Path) -> bool:
    """Whether a built split ships goal sets."""
    return (folder / GOALS).is_dir()


def read_goals(folder: str | Path, side: Side) -> dict[str, GoalSet]:
    """The goal sets of one side of a built split, by the names of its members.

    Args:
        folder: The built split, such as ``data/extrapolation/arms/reach``.
        side: ``train`` or ``test``; a name may be on both, at different tasks.

    Raises:
        BenchmarkError: If it was built without goals, or a file is broken; the message names it.
    """
    sets = read_split_goals(folder).sets
    return {name: made.goals for (of, name), made in sets.items() if of == side and made.goals}


def shipped_set(
    sets: Mapping[str, GoalSet] | None, robot: str, folder: str | Path | None
) -> GoalSet | None:
    """The set of a robot among those that a folder ships; None if no folder does.

    Raises:
        BenchmarkError: If there is none: the folder is of another split, or of the other side.
    """
    if sets is None:
        return None
    if robot not in sets:
        raise BenchmarkError(
            f"{folder}: ships no goal set for robot {robot!r}; it is of another split"
        )
    return sets[robot]


def read_split_goals(folder: str | Path) -> SplitGoals:
    """All goal sets of a built split, and how they were made; see ``read_goals``."""
    folder = Path(folder) / GOALS
    path = folder / INDEX
    try:
        return _parsed(read_json(path), folder)
    except FileNotFoundError as error:
        raise BenchmarkError(
            f"{error.filename}: no such file; morphgen split build --goals makes goal sets"
        ) from error
    except OSError as error:
        raise BenchmarkError(f"{error.filename}: cannot be read: {error.strerror}") from error
    except FormatError as error:
        raise BenchmarkError(str(error)) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BenchmarkError(f"{path}: no index of goal sets: {error!r}") from error


def _parsed(index: Mapping[str, Any], folder: Path) -> SplitGoals:
    if index["format"] != FORMAT:
        raise BenchmarkError(
            f"{folder / INDEX}: format {index['format']!r}; this version reads {FORMAT}"
        )
    for task in TASKS.builtin:
        index[task]  # a KeyError if it is missing
    constants = {key: index[key] for key in index if key not in ("format", "seed", "sets")}
    config = GoalConfig(int(index["seed"]), task_configs(constants))
    return gathered([_read_set(folder, record) for record in index["sets"]], config)


def _read_set(folder: Path, record: Mapping[str, Any]) -> Made:
    path = folder / record["file"]
    content = path.read_bytes()
    if _sha256(content) != record["sha256"]:
        raise BenchmarkError(f"{path} is not the file that {INDEX} was written for")
    goals = goals_from_npz(content, record["task"], path)
    facts = {key: record[key] for key in ("robot", "side", "task", "obstacles", "body")}
    return Made(**facts, goals=goals)


def _files(made: Sequence[Made], config: GoalConfig) -> Iterator[tuple[str, bytes]]:
    """Paths in the folder of the sets, and what is there."""
    records = []
    for one in made:
        if one.goals is None:
            raise ValueError(f"{one.robot} has no goals")
        name = f"{one.side}/{one.robot}.npz"
        content = set_npz(one.goals)
        records.append(record_of(one) | {"file": name, "sha256": _sha256(content)})
        yield name, content
    used = [one.task for one in made]
    constants = {"format": FORMAT, "seed": config.seed, **config.as_data(used)}
    head = json.dumps(constants, indent=2).removesuffix("\n}")
    lines = ",\n".join(f"    {json.dumps(record)}" for record in records)
    yield INDEX, f'{head},\n  "sets": [\n{lines}\n  ]\n}}\n'.encode()
    yield README_FILE, _README.format(index=INDEX, tasks=_readme_of(used)).encode()


def record_of(one: Made) -> dict[str, object]:
    """What is said of a set, as plain data for JSON."""
    record: dict[str, object] = {
        "robot": one.robot,
        "side": one.side,
        "task": one.task,
        "obstacles": one.obstacles,
    }
    if one.goals is None:
        return record
    return record | {
        "body": one.body,
        "key": one.goals.key,
        "seed": one.goals.seed,
        "goals": len(one.goals.q),
        "tried": one.goals.tried,
        "accepted": one.goals.accepted,
        "acceptance": one.acceptance,
    }


def _readme_of(used: Sequence[str]) -> str:
    """Return what is written of the arrays of morphgen's own tasks and of those that are used."""
    names = dict.fromkeys((*TASKS.builtin, *used))
    return "".join(TASKS[name].goal_files_readme for name in names)


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
