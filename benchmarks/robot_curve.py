"""Success on unseen robots against the number of procedural robots that a policy was trained on.

    python benchmarks/robot_curve.py [--variants reach obstacles pose push push-long]
        [--robots 10 30 100 300 1000] [--seeds 0 1] [--steps N] [--agent me-graph]
        [--out results/robot-curve.json] [--report]

Each policy is trained in MuJoCo with robots of the grammar ``serial``, none of which is in a split,
on one variant of a task: reach, reach among obstacles, reach with a goal pose, or push. It is
judged on the test robots of splits, and on ten real arms with a stick, 20 episodes each. Robots and
training of a seed have this seed. Finished evaluations are kept in one file, by policy; tables are
of all seeds that are there, and ``--report`` only prints them. A cell has the mean score over the
seeds, in brackets the lowest and the highest score, and the mean success; push, whose score is the
success, has the latter alone.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from tabulate import tabulate

from morphgen.files import write_atomic
from morphgen.rl.runs.checkpoint import CHECKPOINT, read_checkpoint

REAL_ARMS = (
    *("ur5", "panda", "kinova_gen3", "xarm7", "iiwa14"),
    *("jaco2", "lwr", "widowx", "z1", "ur10"),
)
REAL_EPISODES = 20
AGENT, OUT = "me-graph", Path("results/robot-curve.json")


@dataclass(frozen=True)
class Variant:
    """A variant of a task, and what its policies are judged on."""

    task: str
    options: tuple[str, ...]
    """Options of ``morphgen train`` that make the variant; those of one arm's evaluation too."""
    splits: tuple[str, ...]
    steps: float
    """Default number of transitions."""


PUSH_SPLITS = (
    "interpolation/arm3/push",
    "interpolation/panda/push",
    "composition/ee-arm/push",
    "extrapolation/primitives/push",
    "extrapolation/arms/push",
)
VARIANTS = {
    "reach": Variant(
        "reach",
        (),
        (
            "interpolation/arm3/reach",
            "interpolation/panda/reach",
            "composition/ee-arm/reach",
            "extrapolation/arms/reach",
        ),
        1e6,
    ),
    "obstacles": Variant("reach", ("--obstacles",), ("interpolation/arm3/reach-obstacles",), 1e6),
    "pose": Variant(
        "reach",
        ("--goal", "pose"),
        ("interpolation/arm3/reach", "extrapolation/primitives/reach"),
        1e6,
    ),
    "push": Variant("push", (), PUSH_SPLITS, 1.5e6),
    "push-long": Variant("push", (), PUSH_SPLITS, 4e6),
}


def morphgen(*words: str) -> None:
    """Run a command of morphgen, and end the program if it fails."""
    subprocess.run([sys.executable, "-m", "morphgen", *words], check=True)


def tests_of(variant: Variant) -> dict[str, tuple[str, ...]]:
    """Return the options of ``morphgen eval`` for each split and real arm."""
    tests: dict[str, tuple[str, ...]] = {
        split: ("--split", split, "--on", "test") for split in variant.splits
    }
    obstacles = [word for word in variant.options if word == "--obstacles"]
    for arm in REAL_ARMS:
        words = ("--split", f"arm={arm}", "ee=stick", f"task={variant.task}")
        tests[f"{arm}-stick"] = (*words, *obstacles, "--episodes", str(REAL_EPISODES))
    return tests


def policy_name(name: str, robots: int, seed: int) -> str:
    """Return the name of a policy in the file of scores."""
    return f"{name}-serial{robots}-seed{seed}"


def read_scores(out: Path) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Return the rows of all robots by policy and test."""
    scores: dict[str, dict[str, list[dict[str, Any]]]] = {}
    if out.exists():
        scores = json.loads(out.read_text("utf-8"))
    return scores


def train_and_judge(name: str, robots: int, seed: int, args: argparse.Namespace) -> None:
    """Train one policy, and write its scores on each split and real arm that has none."""
    variant, policy = VARIANTS[name], policy_name(name, robots, seed)
    scores = read_scores(args.out).get(policy, {})
    missing = {test: words for test, words in tests_of(variant).items() if test not in scores}
    if not missing:
        return
    own = "" if args.agent == AGENT else f"-{args.agent}"
    own += f"-{args.steps}" if args.steps else ""
    run = Path("runs/robot-curve") / f"{policy}{own}"
    if not is_trained(run):  # else train would draw the robots again before it finds that out
        morphgen(
            *("train", f"task={variant.task}", *variant.options),
            *("--robots", f"serial:{robots}", "--robot-seed", str(seed)),
            *("--agent", args.agent, "--seed", str(seed)),
            *("--steps", str(args.steps or variant.steps)),
            *("--sim", "mujoco", "--envs", "160", "--train-goals", "50", "--workers", "2"),
            *("--no-tensorboard", "--out", str(run), "--resume"),
        )
    for test, words in missing.items():
        with tempfile.TemporaryDirectory() as folder:
            rows = Path(folder) / "rows.json"
            morphgen(
                *("eval", str(run), *words, "--mode", "deterministic", "--sim", "mujoco"),
                *("--out", str(rows)),
            )
            scores[test] = json.loads(rows.read_text("utf-8"))["deterministic"]
        everything = read_scores(args.out) | {policy: scores}
        write_atomic(args.out, json.dumps(dict(sorted(everything.items())), indent=1) + "\n")


def is_trained(run: Path) -> bool:
    """Return whether the training of a run has ended."""
    if not (run / CHECKPOINT).is_file():
        return False
    config, state = read_checkpoint(run)
    return bool(state["update"] >= config.num_updates)


def cell(seeds: list[list[dict[str, Any]]]) -> str:
    """Return score and success over seeds from the rows of robots; nothing if no seed has rows."""
    if not seeds:
        return ""
    scores = [mean(row["score"] for row in rows) for rows in seeds]
    success = mean(row["success"] for rows in seeds for row in rows)
    if seeds[0][0]["task"] == "push":
        return f"{success:.0%} [{min(scores):.0%}, {max(scores):.0%}]"
    return f"{mean(scores):.1f} [{min(scores):.1f}, {max(scores):.1f}], {success:.0%}"


def stored_scores(name: str, robots: int, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of each test, for each seed that has scores."""
    prefix = policy_name(name, robots, 0).removesuffix("0")
    return [rows for policy, rows in read_scores(args.out).items() if policy.startswith(prefix)]


def real_arm_rows(stored: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Return the rows of the real arms, for each seed that has all of them."""
    arms = [f"{arm}-stick" for arm in REAL_ARMS]
    complete = [rows for rows in stored if all(arm in rows for arm in arms)]
    return [[row for arm in arms for row in rows[arm]] for rows in complete]


def table(name: str, args: argparse.Namespace) -> str:
    """Return the table of a variant: a row for each number of robots."""
    splits, lines = VARIANTS[name].splits, []
    for robots in args.robots:
        if not (stored := stored_scores(name, robots, args)):
            continue
        cells = [cell([rows[split] for rows in stored if split in rows]) for split in splits]
        lines.append([robots, *cells, cell(real_arm_rows(stored))])
    return tabulate(lines, headers=["robots", *splits, "ten real arms"], tablefmt="github")


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Return the options of the command line, or of other words."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--robots", type=int, nargs="+", default=[10, 30, 100, 300, 1000])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument(
        "--steps", type=float, help="transitions (default: 1e6, push: 1.5e6, push-long: 4e6)"
    )
    parser.add_argument("--agent", default=AGENT)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--report", action="store_true", help="only print the tables")
    args = parser.parse_args(words)
    if args.out == OUT and (args.agent != AGENT or args.steps):
        parser.error("--agent and --steps: name another --out, which has the scores of such runs")
    return args


def main() -> None:
    """Train and judge what is missing, and print the tables."""
    args = arguments()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    for name in args.variants:
        if not args.report:
            for robots in args.robots:
                for seed in args.seeds:
                    train_and_judge(name, robots, seed, args)
        print(f"\n{name}\n{table(name, args)}")


if __name__ == "__main__":
    main()
