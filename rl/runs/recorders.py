"""Record the metrics of a run: JSON lines, TensorBoard events, Weights & Biases."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from morphgen.errors import FormatError, MissingDependencyError, TaskError
from morphgen.formats.data_files import parse_json, read_text
from morphgen.formats.files import naming, write_atomic
from morphgen.rl.distributed import UpdateMetrics
from morphgen.rl.runs.checkpoint import RunConfig
from morphgen.rl.scores.scores import finite_or_none

METRICS, EVENTS = "metrics.jsonl", "events"

Recorder = Callable[[UpdateMetrics], None]  # function that records the metrics of an update


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


@contextmanager
def recording(
    folder: Path, config: RunConfig, update: int, *, tensorboard: bool, wandb: bool
) -> Iterator[Recorder]:
    """Yield the recorder of a run that continues after an update; it is closed at the end."""
    with ExitStack() as stack:
        recorders = [stack.enter_context(_json_lines(folder, update))]
        if tensorboard:
            recorders.append(stack.enter_context(_tensorboard(folder, update)))
        if wandb:
            recorders.append(stack.enter_context(_weights_and_biases(folder, config)))

        def record(report: UpdateMetrics) -> None:
            for each in recorders:
                each(report)

        yield record


@contextmanager
def _json_lines(folder: Path, update: int) -> Iterator[Recorder]:
    """Write a line per update, with null for numbers not finite; remove those of later updates."""
    kept = [report for report in read_metrics(folder) if report["update"] <= update]
    path = folder / METRICS
    write_atomic(path, "".join(json.dumps(report) + "\n" for report in kept))
    with path.open("a", encoding="utf-8") as file:

        def record(report: UpdateMetrics) -> None:
            with naming(path):
                file.write(json.dumps(finite_or_none(asdict(report))) + "\n")
                file.flush()  # a killed run keeps its lines

        yield record


@contextmanager
def _tensorboard(folder: Path, update: int) -> Iterator[Recorder]:
    """Write events for ``tensorboard --logdir``."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise MissingDependencyError(
            "TensorBoard is not installed: pip install tensorboard, or say --no-tensorboard"
        ) from error
    # Events of later updates, which a killed run has written, are hidden from then on.
    with closing(SummaryWriter(str(folder / EVENTS), purge_step=update + 1)) as writer:

        def record(report: UpdateMetrics) -> None:
            for name, value in _scalars(report):
                writer.add_scalar(name, value, report.update)

        yield record


@contextmanager
def _weights_and_biases(folder: Path, config: RunConfig) -> Iterator[Recorder]:
    """Begin a run of Weights & Biases, or continue that of the folder."""
    wandb = require_wandb()
    try:
        run = wandb.init(
            project="morphgen",
            name=str(folder),
            # The same folder continues the same run; an id has at most 64 characters.
            id=hashlib.sha256(folder.resolve().as_posix().encode()).hexdigest()[:32],
            resume="allow",
            dir=folder,
            config=config.as_data(),
        )
    except wandb.errors.Error as error:
        raise TaskError(f"--wandb: {error}") from error
    try:
        yield lambda report: run.log(dict(_scalars(report)), step=report.update)
    finally:
        run.finish()


def require_wandb() -> ModuleType:
    """Return the module of Weights & Biases."""
    try:
        return import_module("wandb")
    except ImportError as error:
        raise MissingDependencyError(
            "--wandb needs the package wandb: pip install wandb"
        ) from error


def _scalars(report: UpdateMetrics) -> Iterator[tuple[str, float]]:
    """Yield names and values of a report's numbers; those of robots and terms as ``name/key``."""
    for name, value in asdict(report).items():
        if isinstance(value, Mapping):
            yield from ((f"{name}/{key}", float(each)) for key, each in value.items())
        elif isinstance(value, tuple):
            yield from ((f"{name}/{i}", float(each)) for i, each in enumerate(value))
        elif math.isfinite(value):
            yield name, float(value)
