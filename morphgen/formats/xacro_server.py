"""The process that expands a foreign xacro: it limits itself, then does what the parent asks."""

from __future__ import annotations

import contextlib
import json
import logging
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from morphgen.errors import FormatError
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.xacro import Expansion
from morphgen.formats.xacro_compile import trace

MAX_RECORDS = 1000
"""Most warnings of a document that are passed on to the log."""
_RECURSION = 4000
"""Python frames that macros within macros may take; a level takes about ten."""
_log = logging.getLogger("morphgen.formats.xacro")


def serve(request: Mapping[str, Any]) -> None:
    """Do the task that the parent asks for, in this process; print its result as JSON."""
    records: list[str] = []
    _log.addHandler(_Recorder(records))
    _log.setLevel(logging.INFO)
    _log.propagate = False
    path, values = Path(request["path"]), request["values"]
    finder = PackageFinder(
        tuple(map(Path, request["roots"])),
        tuple((name, Path(folder)) for name, folder in request["packages"]),
        None if request["root"] is None else Path(request["root"]),
    )
    _limit(**request["limits"])
    answer: dict[str, Any]
    try:
        if request["task"] == "trace":
            answer = {"traced": trace(path, values["constants"], values["numbers"], finder)}
        else:
            answer = {"document": Expansion(values["args"], path, finder).run_file().decode()}
    except FormatError as error:
        answer = {"error": str(error)}
    sys.stdout.write(json.dumps(answer | {"records": records}))


class _Recorder(logging.Handler):
    """Keeps the first messages."""

    def __init__(self, records: list[str]) -> None:
        super().__init__()
        self.records = records

    def emit(self, record: logging.LogRecord) -> None:
        if len(self.records) < MAX_RECORDS:
            self.records.append(record.getMessage()[:MAX_RECORDS])


def _limit(cpu: int, memory: int) -> None:
    """Bound this process from here on: CPU time [s] and address space [bytes]."""
    sys.setrecursionlimit(_RECURSION)
    try:
        import resource
    except ImportError:  # Windows: the parent's clock remains
        return
    limits = (
        (resource.RLIMIT_CPU, cpu, cpu + 1),
        (resource.RLIMIT_AS, memory, memory),
        (resource.RLIMIT_FSIZE, 0, 0),
        (resource.RLIMIT_CORE, 0, 0),
    )
    for kind, soft, hard in limits:
        # macOS refuses some; the others, the bounds of the expansion and the clock remain.
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (soft, hard))
