"""Start-up time of commands, compared with importing NumPy and MuJoCo in the same run.

    python benchmarks/startup.py [--repeats 5]

Prints the median wall and CPU time of whole processes, and their ratios to
`python -c "import numpy, mujoco"`, whose runs alternate with those of the commands. On a busy
machine the CPU time is the better figure. One run of each command comes before, which is not
counted: it fills morphgen's cache and compiles the modules, as the first use does. `cold` runs
begin with an empty cache.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tabulate import tabulate

BASELINE = 'python -c "import numpy, mujoco"'
COMPOSE = ["-m", "morphgen", "compose", "arm=ur5", "ee=plane"]
COMMANDS = {
    BASELINE: ["-c", "import numpy, mujoco"],
    'python -c "import morphgen"': ["-c", "import morphgen"],
    "morphgen --help": ["-m", "morphgen", "--help"],
    "morphgen list": ["-m", "morphgen", "list"],
    "morphgen compose arm=ur5 ee=plane --no-picture": [*COMPOSE, "--no-picture"],
    "morphgen compose arm=ur5 ee=plane": COMPOSE,
    "morphgen check ur5-plane": ["-m", "morphgen", "check", "ur5-plane"],
    "cold: morphgen compose arm=ur5 ee=plane --no-picture": [*COMPOSE, "--no-picture"],
}


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as kept:
        times = [
            {name: _time(name, Path(kept)) for name in COMMANDS} for _ in range(args.repeats + 1)
        ]
    medians = {
        name: [statistics.median(run[name][i] for run in times[1:]) for i in (0, 1)]
        for name in COMMANDS
    }
    base = medians[BASELINE]
    rows = [(name, w, w / base[0], cpu, cpu / base[1]) for name, (w, cpu) in medians.items()]
    print(tabulate(rows, ["command", "wall [s]", "ratio", "CPU [s]", "ratio"], floatfmt=".2f"))
    return 0


def _time(name: str, kept: Path) -> tuple[float, float]:
    """Run a command in an empty folder; return wall and CPU time [s]."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(__file__).resolve().parents[1]
        environment = {
            **os.environ,
            "XDG_CACHE_HOME": folder if name.startswith("cold") else str(kept / "cache"),
            "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")]),
            # As those of an installed package, modules are compiled once.
            "PYTHONPYCACHEPREFIX": str(kept / "bytecode"),
            "PYTHONDONTWRITEBYTECODE": "",
        }
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        command = [sys.executable, *COMMANDS[name]]
        subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, cpu


if __name__ == "__main__":
    raise SystemExit(main())
