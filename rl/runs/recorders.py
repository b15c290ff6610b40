"""Record the metrics of a run: JSON lines, TensorBoard events, Weights & Biases."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

from morphgen.errors import FormatError, MissingDependencyError, TaskError
from morphgen.formats.data_files import parse_json, read_text
from morphgen.formats.files import naming, write_atomic
from morphgen.rl.distributed import UpdateMetrics
from morphgen.rl.runs.checkpoint import RunConfig
from morphgen.rl.scores.scores import finite_or_none

METRICS, EVENTS = "metrics.jsonl", "events"


class Recorder(Protocol):
    """Destination of the metrics of a run."""

    def record(self, report: UpdateMetrics) -> None:
        """Record the metrics of an update."""

    def close(self) -> None:
        """Write what is buffered, and close the destination."""


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Return the recorded metrics of a run, a dictionary per update, oldest first.

    An unfinished last line of a killed run is ignored.
    """
    path = folder / METRICS
    if not path.is_file():
        return []
    lines = read_text(path).split("\n")[:-1]
    reports = []
    for number, line in enumerate(lines, 1):
        try:
            report = parse_json(line, f"{path}:{number}")
            report["update"], report["transitions"], report["score"]
        except (FormatError, KeyError, TypeError) as error:
            raise FormatError(f"{path}, line {number}: not the report of an update") from error
        reports.append(report)
    return reports


class Metrics:
    """Recorder to ``metrics.jsonl``: a line per update, with null for numbers not finite."""

    def __init__(self, folder: Path, update: int) -> None:
        """Open the file to continue after an update; lines of later updates are removed."""
        kept = [report for report in read_metrics(folder) if report["update"] <= update]
        path = folder / METRICS
        write_atomic(path, "".join(json.dumps(report) + "\n" for report in kept))
        self._file = path.open("a", encoding="utf-8")

    def record(self, report: UpdateMetrics) -> None:
        """Write a line."""
        with naming(Path(self._file.name)):
            self._file.write(json.dumps(finite_or_none(asdict(report))) + "\n")
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class TensorBoard:
    """Events for ``tensorboard --logdir``."""

    def __init__(self, folder: Path, update: int) -> None:
        """Continue after an update."""
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise MissingDependencyError(
                "TensorBoard is not installed: pip install tensorboard, or say --no-tensorboard"
            ) from error
        self._writer = SummaryWriter(str(folder / EVENTS), purge_step=update + 1)

    def record(self, report: UpdateMetrics) -> None:
        """Write scalars, by update."""
        for name, value in scalars(report):
            self._writer.add_scalar(name, value, report.update)

    def close(self) -> None:
        """Write the remaining events."""
        self._writer.close()


class WeightsAndBiases:
    """A run of Weights & Biases."""

    def __init__(self, folder: Path, config: RunConfig) -> None:
        """Begin, or continue the run of this folder."""
        wandb = require_wandb()
        try:
            self._run = wandb.init(
                project="morphgen",
                name=str(folder),
                id=hashlib.sha256(folder.resolve().as_posix().encode()).hexdigest()[:32],
                resume="allow",
                dir=folder,
                config=config.as_data(),
            )
        except wandb.errors.Error as error:
            raise TaskError(f"--wandb: {error}") from error

    def record(self, report: UpdateMetrics) -> None:
        """Send scalars, by update."""
        self._run.log(dict(scalars(report)), step=report.update)

    def close(self) -> None:
        """Finish."""
        self._run.finish()


def require_wandb() -> ModuleType:
    """Return the module of Weights & Biases."""
    try:
        return import_module("wandb")
    except ImportError as error:
        raise MissingDependencyError(
            "--wandb needs the package wandb: pip install wandb"
        ) from error


@contextmanager
def recording(
    folder: Path, config: RunConfig, update: int, *, tensorboard: bool, wandb: bool
) -> Iterator[list[Recorder]]:
    """Open the recorders of a run that continues after an update."""
    with ExitStack() as stack:
        kept: list[Recorder] = [Metrics(folder, update)]
        stack.callback(kept[0].close)
        if tensorboard:
            kept.append(TensorBoard(folder, update))
            stack.callback(kept[-1].close)
        if wandb:
            kept.append(WeightsAndBiases(folder, config))
            stack.callback(kept[-1].close)
        yield kept


def scalars(report: UpdateMetrics) -> Iterator[tuple[str, float]]:
    """Yield names and values of a report's numbers; those of robots and terms as ``name/key``."""
    for name, value in asdict(report).items():
        if isinstance(value, Mapping):
            yield from ((f"{name}/{key}", float(each)) for key, each in value.items())
        elif isinstance(value, tuple):
            yield from ((f"{name}/{i}", float(each)) for i, each in enumerate(value))
        elif math.isfinite(value):
            yield name, float(value)
