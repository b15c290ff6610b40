"""A study: agents times seeds times splits, a run's folder each, and reference controllers."""

from __future__ import annotations

import json
import math
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from morphgen.benchmark.split import Side
from morphgen.errors import FormatError, MorphgenError, TaskError
from morphgen.formats.data_files import read_json
from morphgen.formats.files import LOCK, write_atomic
from morphgen.processes import ray_cluster, require_ray
from morphgen.rl.evaluation import (
    Count,
    Exam,
    Score,
    as_data,
    evaluate_reference,
    evaluate_run,
    uncounted,
)
from morphgen.rl.names import REFERENCES, is_for
from morphgen.rl.runs import RunConfig, require_open
from morphgen.rl.sources import Source, members, other_side, tasks_of
from morphgen.rl.trained import MODES, Mode
from morphgen.rl.training import Part, Show, Way, train

SCORES = "scores.json"
POLL = 2.0
"""Seconds between two looks at cells that another process works on."""


@dataclass(frozen=True)
class Cell:
    """One agent, seed and split, or a reference controller; done when its scores are there."""

    folder: Path
    split: str
    agent: str
    seed: int | None
    """None for a reference."""
    source: Source
    exam: Exam
    config: RunConfig | None = None
    """None for a reference."""

    @property
    def sides(self) -> tuple[Side, ...]:
        """On which it is evaluated: the test side alone, if it is trained there."""
        return ("test",) if self.source.side == "test" else ("train", "test")


@dataclass(frozen=True)
class Outcome:
    """What became of a cell."""

    cell: Cell
    why: str = ""
    """Why it failed; empty if it did not."""


Work = Callable[[Sequence[Cell], Way], Iterator[Outcome]]
"""Does cells, and tells as each is done."""


def reference_cells(folder: Path, source: Source, exam: Exam) -> list[Cell]:
    """The reference controllers for the tasks of a split."""
    tasks = {task for side in ("train", "test") for task in tasks_of(other_side(source, side))}
    return [
        Cell(folder / source.name / name, source.name, name, None, source, _plain(exam))
        for name in REFERENCES
        if is_for(name, tasks)
    ]


def agent_cell(folder: Path, agent: str, config: RunConfig, exam: Exam) -> Cell:
    """The cell of a run."""
    source = config.source
    place = folder / source.name / agent / f"seed{config.seed}"
    return Cell(place, source.name, agent, config.seed, source, _plain(exam), config)


def matched_budget(config: RunConfig) -> RunConfig:
    """A run on a split's test robots with as much of each as a run on its train robots has.

    Others are as they are, and so are all that give each robot the whole.
    """
    if config.source.side == "train" or config.whole:
        return config
    own, trained = len(members(config.source)), len(members(other_side(config.source, "train")))
    transitions = -(-config.ppo.transitions * own // trained)
    ppo = replace(config.ppo, transitions=transitions)
    return replace(config, ppo=ppo, envs=-(-config.envs * own // trained))


def read_scores(cell: Cell) -> dict[str, list[Score]] | None:
    """Scores by mode, or by the reference's name; None if the cell is not done.

    Raises:
        TaskError: If they are of another evaluation, or of other robots or goals.
        FormatError: If they are malformed.
    """
    path = cell.folder / SCORES
    if not path.is_file():
        return None
    try:
        data = read_json(path)
        found = {mode: [_score(each) for each in own] for mode, own in data["scores"].items()}
        made_with = data["exam"], data["source"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise FormatError(f"{path}: not the scores of a cell: {error}") from error
    wanted = json.loads(json.dumps([cell.exam.as_data(), asdict(cell.source)]))
    for what, theirs, ours in zip(("evaluation", "set of robots"), made_with, wanted, strict=True):
        if theirs != ours:
            raise TaskError(f"{path}: of another {what}; delete it, or name another --out")
    return found


def require_cells(cells: Sequence[Cell]) -> None:
    """Require that what is there of cells is of these, before anything is done.

    Raises:
        TaskError: If a cell's folder has another run or evaluation.
        FormatError: If scores are malformed.
    """
    for cell in cells:
        if cell.config is not None:
            require_open(cell.folder, cell.config, resume=True)
        read_scores(cell)


def do(
    cell: Cell,
    way: Way,
    show: Callable[[Part], Show] | None = None,
    count: Count = uncounted,
) -> None:
    """Train and evaluate what is not there yet. Nobody else may work on the cell.

    Raises:
        MorphgenError: As ``train`` and ``evaluate``.
    """
    if read_scores(cell) is not None:
        return
    exam = replace(cell.exam, workers=way.workers)
    if cell.config is None:
        found = {cell.agent: _reference(cell, exam, count)}
    else:
        train(cell.folder, cell.config, resume=True, way=way, show=show, hold=_held)
        found = {mode: _trained(cell, cell.config, exam, mode, count) for mode in MODES}
    data = {
        "exam": cell.exam.as_data(),
        "source": asdict(cell.source),
        "scores": {mode: as_data(scores) for mode, scores in found.items()},
    }
    write_atomic(cell.folder / SCORES, json.dumps(data, indent=2) + "\n")


def work_here(
    cells: Sequence[Cell],
    way: Way,
    show: Callable[[Part], Show] | None = None,
    count: Count = uncounted,
) -> Iterator[Outcome]:
    """Do cells one after another.

    Other processes may do the same: each cell is done by one, and those that others work on are
    waited for at the end.
    """
    waiting = deque(cells)
    passed = 0
    while waiting:
        cell = waiting.popleft()
        outcome = _alone(cell, way, show, count)
        if outcome is not None:
            passed = 0
            yield outcome
            continue
        waiting.append(cell)
        passed += 1
        if passed >= len(waiting):
            time.sleep(POLL)
            passed = 0


def work_on_ray(address: str | None, *, gpus: float = 0.0) -> Work:
    """Do cells on the Ray cluster at an address, a task each; without one, on a local Ray.

    Its machines have morphgen installed and share the study's folder.

    Args:
        address: Of the cluster.
        gpus: Of a cell; a share if below 1.

    Raises:
        MissingDependencyError: If ray is not installed.
    """
    ray = require_ray()

    def work(cells: Sequence[Cell], way: Way) -> Iterator[Outcome]:
        with ray_cluster(address):
            remote = ray.remote(num_cpus=way.workers, num_gpus=gpus, max_retries=0)(_on_ray)
            running = {
                remote.remote(replace(cell, folder=cell.folder.resolve()), way): cell
                for cell in cells
            }
            while running:
                (done, *_), _ = ray.wait(list(running))
                cell = running.pop(done)
                try:
                    yield Outcome(cell, ray.get(done))
                except ray.exceptions.RayError as error:
                    yield Outcome(cell, f"its Ray task failed: {type(error).__name__}: {error}")

    return work


def _on_ray(cell: Cell, way: Way) -> str:
    (outcome,) = work_here([cell], way)
    return outcome.why


def _alone(
    cell: Cell, way: Way, show: Callable[[Part], Show] | None, count: Count
) -> Outcome | None:
    """Do a cell; None if another process works on it."""
    try:
        cell.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(cell.folder / LOCK, timeout=0):
            do(cell, way, show, count)
    except Timeout:
        return None
    except MorphgenError as error:
        return Outcome(cell, str(error))
    except OSError as error:
        return Outcome(cell, f"{error.filename or cell.folder}: {error.strerror}")
    except Exception as error:  # such as a GPU without memory: the other cells may do without
        traceback.print_exc(file=sys.stderr)
        return Outcome(cell, f"{type(error).__name__}: {error}")
    return Outcome(cell)


def _held(folder: Path) -> AbstractContextManager[None]:
    """The cell's lock is held already."""
    return nullcontext()


def _score(data: Mapping[str, Any]) -> Score:
    """A score from what ``as_data`` made of it."""
    whole: dict[str, Any] = {k: math.nan if v is None else v for k, v in data.items()}
    return Score(**whole)


def _trained(cell: Cell, config: RunConfig, exam: Exam, mode: Mode, count: Count) -> list[Score]:
    """Of the sides that the cell is scored on."""
    found = []
    for side in cell.sides:
        tell = count(f"{cell.agent} {mode} on {side}")
        found += evaluate_run(cell.folder, side, exam, mode, device=config.device, tell=tell)
    return found


def _reference(cell: Cell, exam: Exam, count: Count) -> list[Score]:
    """Of both sides; those whose robots are at other tasks have none."""
    found = []
    for side in cell.sides:
        source = other_side(cell.source, side)
        if is_for(cell.agent, tasks_of(source)):
            tell = count(f"{cell.agent} on {side}")
            found += evaluate_reference(cell.agent, source, exam, tell=tell)
    return found


def _plain(exam: Exam) -> Exam:
    """Without what scores do not depend on."""
    return replace(exam, workers=1)


def as_record(cell: Cell) -> dict[str, Any]:
    """What a cell is, for tables."""
    return {"split": cell.split, "agent": cell.agent, "seed": cell.seed}
