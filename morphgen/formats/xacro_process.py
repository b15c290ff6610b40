"""Expand xacro files from untrusted sources in a child process with resource limits.

The allow-list and the bounds of ``xacro_functions`` and ``xacro_engine`` refuse excessive documents
with a reason. This process is the second line of defence, for what they do not foresee: the
operating system ends it when it exceeds its CPU time or memory, and it cannot write files. It
loads neither NumPy nor a simulator, so it starts in about a tenth of a second.
"""

from __future__ import annotations

import contextlib
import json
import logging
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from morphgen.errors import FormatError
from morphgen.formats.resolve import PackageFinder

CPU_LIMIT = 8
"""Longest computation of an expansion [s of CPU time]."""
WALL_LIMIT = 30
"""Longest wait for an expansion [s]. On Windows, which has no other limit, the only one."""
MEMORY_LIMIT = 2**30
"""Largest address space of an expansion [bytes]; Linux enforces it, macOS only in part."""
MAX_RECORDS = 1000
"""Most warnings of a document that are passed on to the log, and longest of them [characters]."""

_RECURSION_LIMIT = 4000
"""Python frames for nested macros; one level takes about ten."""
_CHILD_CODE = (
    "import json, sys; request = json.load(sys.stdin); sys.path[:] = request['sys_path']; "
    "from morphgen.formats.xacro_process import serve; serve(request)"
)
_log = logging.getLogger("morphgen.formats.xacro")


def run_in_child(
    task: Callable[..., object], path: Path, finder: PackageFinder, **values: Mapping[str, str]
) -> Any:  # noqa: ANN401
    """Run a function in a child process with limits.

    Args:
        task: A function of a module of morphgen; it takes ``path``, ``finder`` and ``values`` and
            returns JSON data.
        path: The xacro file, absolute.
        finder: Finds its packages.
        **values: Arguments of the task.

    Returns:
        The result of the task.

    Raises:
        FormatError: If the task raises it, or exceeds a limit.
    """
    source = str(Path(__file__).parents[2])
    request = {
        "task": [task.__module__, task.__name__],
        "path": str(path),
        "roots": [str(root) for root in finder.roots],
        "packages": [[name, str(folder)] for name, folder in finder.packages],
        "root": None if finder.root is None else str(finder.root),
        "values": {name: dict(given) for name, given in values.items()},
        "limits": {"cpu": CPU_LIMIT, "memory": MEMORY_LIMIT},
        "sys_path": [entry for entry in sys.path if Path(entry).is_absolute()] + [source],
    }
    try:
        # -I: neither the environment nor the current folder decides what the child imports.
        child = subprocess.run(
            [sys.executable, "-I", "-c", _CHILD_CODE],
            input=json.dumps(request).encode(),
            capture_output=True,
            timeout=WALL_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise FormatError(f"{path}: its expansion takes more than {WALL_LIMIT} s") from error
    except OSError as error:
        raise FormatError(f"{path}: no process for its expansion: {error.strerror}") from error
    if child.returncode:
        raise FormatError(f"{path}: {_failure(child.returncode, child.stderr)}")
    answer: dict[str, Any] = json.loads(child.stdout)
    for record in answer["records"]:
        _log.info(record)
    if "error" in answer:
        raise FormatError(answer["error"])
    return answer["result"]


def _failure(code: int, stderr: bytes) -> str:
    """Return why a child ended without an answer."""
    if code < 0:  # minus the signal that ended it; Windows has no signals
        if -code == signal.SIGXCPU:
            return f"its expansion takes more than {CPU_LIMIT} s of CPU time"
        return f"its expansion was ended by signal {-code}, perhaps for lack of memory"
    last = stderr.decode(errors="replace").strip().splitlines()[-1:]
    if any("MemoryError" in line for line in last):
        return f"its expansion needs more than {MEMORY_LIMIT >> 20} MiB of memory"
    return f"its expansion ended with code {code}: {' '.join(last)[:200]}"


def serve(request: Mapping[str, Any]) -> None:
    """Run the parent's task in this process, the child, and print its result as JSON."""
    records: list[str] = []
    _log.addHandler(_Recorder(records))
    _log.setLevel(logging.INFO)
    _log.propagate = False
    finder = PackageFinder(
        tuple(map(Path, request["roots"])),
        tuple((name, Path(folder)) for name, folder in request["packages"]),
        None if request["root"] is None else Path(request["root"]),
    )
    module, name = request["task"]
    task = getattr(import_module(module), name)
    limit_process(**request["limits"])
    answer: dict[str, Any]
    try:
        answer = {"result": task(Path(request["path"]), finder, **request["values"])}
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


def limit_process(cpu: int, memory: int) -> None:
    """Limit CPU time [s] and address space [bytes] of this process, and forbid writing files."""
    global MEMORY_LIMIT
    MEMORY_LIMIT = memory  # errors of the expansion name it
    sys.setrecursionlimit(_RECURSION_LIMIT)
    try:
        import resource
    except ImportError:  # Windows: the parent's WALL_LIMIT remains
        return
    limits = (
        (resource.RLIMIT_CPU, cpu, cpu + 1),
        (resource.RLIMIT_AS, memory, memory),
        (resource.RLIMIT_FSIZE, 0, 0),
        (resource.RLIMIT_CORE, 0, 0),
    )
    for kind, soft, hard in limits:
        # macOS refuses some; the others, the bounds of the expansion and WALL_LIMIT remain.
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (soft, hard))
