"""Expand what may come from a stranger in a process of its own, with limits that it cannot pass.

The allow-list and the bounds of ``xacro_functions`` and ``xacro_engine`` refuse what is too large
with a reason. This process is for what they do not foresee: the operating system ends it. It
writes no files, and it loads neither NumPy nor a simulator: it starts in about a tenth of a second.
"""

from __future__ import annotations

import contextlib
import json
import logging
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import morphgen
from morphgen.errors import FormatError
from morphgen.formats.resolve import PackageFinder

CPU_LIMIT = 8
"""Longest computation of an expansion [s of CPU time]."""
WALL_LIMIT = 30
"""Longest wait for an expansion [s]. On Windows, which has no other limit, the only one."""
MEMORY_LIMIT = 2**30
"""Largest address space of an expansion [bytes]; heeded by Linux, by macOS only in part."""
MAX_RECORDS = 1000
"""Most warnings of a document that are passed on to the log."""

_RECURSION = 4000
"""Python frames that macros within macros may take; a level takes about ten."""
_START = (
    "import json, sys; request = json.load(sys.stdin); sys.path[:] = request['sys_path']; "
    "from morphgen.formats.xacro_child import serve; serve(request)"
)
_log = logging.getLogger("morphgen.formats.xacro")


def run_in_child(
    task: str, path: Path, finder: PackageFinder, **values: Mapping[str, str]
) -> dict[str, Any]:
    """Do a task of ``serve`` in another process.

    Args:
        task: ``expand`` or ``trace``.
        path: The xacro file, absolute.
        finder: Where its packages may lie.
        **values: Arguments of the task.

    Returns:
        The task's result.

    Raises:
        FormatError: If the document cannot be expanded, or takes more than the limits allow.
    """
    source = str(Path(morphgen.__file__).parents[1])
    request = {
        "task": task,
        "path": str(path),
        "roots": [str(root) for root in finder.roots],
        "packages": [[name, str(folder)] for name, folder in finder.packages],
        "root": None if finder.root is None else str(finder.root),
        "values": {name: dict(given) for name, given in values.items()},
        "limits": {"cpu": CPU_LIMIT, "memory": MEMORY_LIMIT},
        "sys_path": [entry for entry in sys.path if Path(entry).is_absolute()] + [source],
    }
    try:
        done = subprocess.run(
            [sys.executable, "-I", "-c", _START],
            input=json.dumps(request).encode(),
            capture_output=True,
            timeout=WALL_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise FormatError(f"{path}: its expansion takes more than {WALL_LIMIT} s") from error
    except OSError as error:
        raise FormatError(f"{path}: no process for its expansion: {error.strerror}") from error
    if done.returncode:
        raise FormatError(f"{path}: {_reason(done.returncode, done.stderr)}")
    answer: dict[str, Any] = json.loads(done.stdout)
    for record in answer.pop("records"):
        _log.info(record)
    if "error" in answer:
        raise FormatError(answer["error"])
    return answer


def _reason(code: int, complaint: bytes) -> str:
    """Why the process ended without an answer."""
    if code < 0:  # the signal that ended it, which no process of Windows has
        if -code == signal.SIGXCPU:
            return f"its expansion takes more than {CPU_LIMIT} s of CPU time"
        return f"its expansion was ended by signal {-code}, perhaps for want of memory"
    last = complaint.decode(errors="replace").strip().splitlines()[-1:]
    if any("MemoryError" in line for line in last):
        return f"its expansion needs more than {MEMORY_LIMIT >> 20} MiB of memory"
    return f"its expansion ended with code {code}: {' '.join(last)[:200]}"


def serve(request: Mapping[str, Any]) -> None:
    """Do the task that the parent asks for, in this process; print its result as JSON."""
    from morphgen.formats.xacro import Expansion
    from morphgen.formats.xacro_compile import trace

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
