"""Success on real robots against the number of procedural robots that a policy was trained on.

    python benchmarks/robot_curve.py [--robots 10 30 100 300 1000] [--seeds 0 1] [--steps 1e6]
        [--agent me-graph] [--out results/robot-curve] [--report]

Each policy is trained in MuJoCo on reach with robots of the grammar ``serial``, none of which is in
a split, and judged on the test robots of four splits. Robots and training of a seed have this seed.
Finished evaluations are kept; ``--report`` only prints the table of what is there. A cell has the
mean score over the seeds, in brackets the lowest and the highest score, and the mean success.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from statistics import mean

from tabulate import tabulate

SPLITS = (
    "interpolation/arm3/reach",
    "interpolation/panda/reach",
    "composition/ee-arm/reach",
    "extrapolation/arms/reach",
)


def morphgen(*words: str) -> None:
    """Run a command of morphgen, and end the program if it fails."""
    subprocess.run([sys.executable, "-m", "morphgen", *words], check=True)


def file_of(out: Path, robots: int, seed: int, split: str) -> Path:
    """Return the file with the scores of a policy on the test robots of a split."""
    return out / f"serial{robots}-seed{seed}-{split.removesuffix('/reach').replace('/', '-')}.json"


def train_and_judge(robots: int, seed: int, args: argparse.Namespace) -> None:
    """Train one policy and write its scores on each split that has none."""
    files = {split: file_of(args.out, robots, seed, split) for split in SPLITS}
    missing = {split: path for split, path in files.items() if not path.exists()}
    if not missing:
        return
    run = Path("runs/robot-curve") / f"serial{robots}-seed{seed}"
    morphgen(
        *("train", "task=reach", "--robots", f"serial:{robots}", "--robot-seed", str(seed)),
        *("--agent", args.agent, "--seed", str(seed), "--steps", str(args.steps)),
        *("--sim", "mujoco", "--envs", "160", "--train-goals", "50", "--workers", "2"),
        *("--no-tensorboard", "--out", str(run), "--resume"),
    )
    for split, path in missing.items():
        morphgen(
            *("eval", str(run), "--split", split, "--on", "test", "--mode", "deterministic"),
            *("--sim", "mujoco", "--out", str(path)),
        )


def cell(paths: list[Path]) -> str:
    """Return score and success over seeds; nothing if no seed has scores."""
    rows = [json.loads(path.read_text("utf-8"))["deterministic"] for path in paths if path.exists()]
    if not rows:
        return ""
    scores = [mean(row["score"] for row in seed) for seed in rows]
    success = mean(row["success"] for seed in rows for row in seed)
    return f"{mean(scores):.1f} [{min(scores):.1f}, {max(scores):.1f}], {success:.0%}"


def main() -> None:
    """Train and judge what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, nargs="+", default=[10, 30, 100, 300, 1000])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--steps", type=float, default=1e6)
    parser.add_argument("--agent", default="me-graph")
    parser.add_argument("--out", type=Path, default=Path("results/robot-curve"))
    parser.add_argument("--report", action="store_true", help="only print the table")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if not args.report:
        for robots in args.robots:
            for seed in args.seeds:
                train_and_judge(robots, seed, args)
    table = [
        [n, *(cell([file_of(args.out, n, seed, split) for seed in args.seeds]) for split in SPLITS)]
        for n in args.robots
    ]
    print(tabulate(table, headers=["robots", *SPLITS], tablefmt="github"))


if __name__ == "__main__":
    main()
