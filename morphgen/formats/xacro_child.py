"""Expand what may come from a stranger in a process of its own, with limits that it cannot pass.

The allow-list and the bounds of ``xacro_functions`` and ``xacro_engine`` refuse what is too large
with a reason. This process is for what they do not foresee: the operating system ends it. It
writes no files, and it loads neither NumPy nor a simulator: it starts in about a tenth of a second.
"""

from __future__ import annotations

import json
import logging
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from morphgen.errors import FormatError
from morphgen.formats.resolve import PackageFinder

CPU_LIMIT = 8
"""Longest computation of an expansion [s of CPU time]."""
WALL_LIMIT = 30
"""Longest wait for an expansion [s]. On Windows, which has no other limit, the only one."""
MEMORY_LIMIT = 2**30
"""Largest address space of an expansion [bytes]; heeded by Linux, by macOS only in part."""

_START = (
    "import json, sys; request = json.load(sys.stdin); sys.path[:] = request['sys_path']; "
    "from morphgen.formats.xacro_server import serve; serve(request)"
)
_log = logging.getLogger("morphgen.formats.xacro")


def run_in_child(
    task: str, path: Path, finder: PackageFinder, **values: Mapping[str, str]
) -> dict[str, Any]:
    """Do a task of ``xacro_server.serve`` in another process.

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
    source = str(Path(__file__).parents[2])
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
