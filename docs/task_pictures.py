"""Draw reach and push of three robots: docs/images/tasks/{reach,push}.png, a row for each robot.

    python docs/task_pictures.py [--seed 2]

A row shows five frames of an episode of the task's first baseline, in the default simulator.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
from PIL import Image

from morphgen.rl.baselines import baselines_for
from morphgen.rl.inference import make_env_and_controller, play, read_controller
from morphgen.tasks.registry import TASKS

ROBOTS = ("ur5-plane", "prims", "chain beads=3")
FRAMES = 5
SIZE = (320, 240)


def main() -> int:
    """Draw the pictures of all tasks."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "images" / "tasks", help="folder"
    )
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for task in TASKS.builtin:
        rows = [_row(task, robot, args.seed) for robot in ROBOTS]
        path = args.out / f"{task}.png"
        Image.fromarray(np.concatenate(rows)).save(path)
        print(path)
    return 0


def _row(task: str, robot: str, seed: int) -> np.ndarray:
    spec = read_controller(baselines_for(task)[0], task)
    env, controller = make_env_and_controller(spec, robot, seed, render_mode="rgb_array", size=SIZE)
    with closing(env):
        frames = list(play(env, controller, 1, seed, lambda episode: print(robot, episode)))
    # A push ends with success; a reach is stationary after a quarter of its time.
    last = len(frames) if TASKS[task].target == "line" else len(frames) // 4
    chosen = np.linspace(0, last - 1, FRAMES).round().astype(int)
    return np.concatenate([frames[i] for i in chosen], axis=1)


if __name__ == "__main__":
    sys.exit(main())
