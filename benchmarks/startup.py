"""Start-up time of commands, compared with importing NumPy and MuJoCo in the same run.

    python benchmarks/startup.py [--repeats 5]

Prints the smallest wall time and CPU time of each command over several runs, and the ratios to
`python -c "import numpy, mujoco"`, whose runs alternate with those of the commands. On a busy
machine the CPU time is the better figure. `compose` is cold: its user cache is an empty folder.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tabulate import tabulate

BASELINE = 'python -c "import numpy, mujoco"'
COMMANDS = {
    BASELINE: ["-c", "import numpy, mujoco"],
    'python -c "import morphgen"': ["-c", "import morphgen"],
    "morphgen --help": ["-m", "morphgen", "--help"],
    "morphgen list": ["-m", "morphgen", "list"],
    "morphgen compose arm=ur5 ee=plane": ["-m", "morphgen", "compose", "arm=ur5", "ee=plane"],
}


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    times = [{name: _time(words) for name, words in COMMANDS.items()} for _ in range(args.repeats)]
    best = {name: [min(run[name][i] for run in times) for i in (0, 1)] for name in COMMANDS}
    base = best[BASELINE]
    rows = [(name, wall, wall / base[0], cpu, cpu / base[1]) for name, (wall, cpu) in best.items()]
    print(tabulate(rows, ["command", "wall [s]", "ratio", "CPU [s]", "ratio"], floatfmt=".2f"))
    return 0


def _time(words: list[str]) -> tuple[float, float]:
    """Run Python in an empty folder without caches; return wall and CPU time [s]."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(__file__).resolve().parents[1]
        environment = {
            **os.environ,
            "XDG_CACHE_HOME": folder,
            "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")]),
        }
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run(
            [sys.executable, *words], cwd=folder, env=environment, check=True, capture_output=True
        )
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, cpu


if __name__ == "__main__":
    raise SystemExit(main())
