"""Film ten arms at five tasks, with one policy a task: docs/images/zero_shot.gif; or other ones.

    python docs/zero_shot_film.py [--robots FILE ...] [--task reach ...] [--seed 3] [--out FILE]

The policy of a task is the one that comes with morphgen, which was trained on none of these arms.
Each arm has two episodes; arms that finish earlier wait for the others. With several tasks, each
task has a row.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import closing
from pathlib import Path

import numpy as np

from morphgen.rl.inference import FPS, make_env_and_controller, play, read_controller
from morphgen.rl.shipped_policies import zero_shot_policy
from morphgen.tasks.renderer import write_video

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
from robot_curve import REAL_ARMS

ROBOTS = tuple(f"arm={arm} ee=stick" for arm in REAL_ARMS)
TASKS = ("reach", "push", "drawer", "door", "dial")
COLUMNS, MANY_COLUMNS = 3, 4
"""Columns of the film, and of one with more than six robots."""
SIZE = (112, 84)
EPISODES = 2
STRIDE = 4
"""Frames of an episode for a frame of the film."""
REST = 25
"""Control steps that an arm stays at its goal."""


def main() -> int:
    """Run the episodes and write the film."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS))
    parser.add_argument("--task", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--seed", type=int, default=3)
    images = Path(__file__).parent / "images"
    parser.add_argument("--out", type=Path, default=images / "zero_shot.gif")
    args = parser.parse_args()
    films = [film(robot, task, args.seed) for task in args.task for robot in args.robots]
    columns = len(args.robots) if len(args.task) > 1 else 0
    frames = (
        tiled([own[min(i, len(own) - 1)] for own in films], columns)
        for i in range(max(map(len, films)))
    )
    write_video(frames, args.out, FPS / STRIDE)
    print(args.out)
    return 0


def film(robot: str, task: str, seed: int) -> np.ndarray:
    """Return the frames of a robot's episodes, shape (n, height, width, 3)."""
    spec = read_controller(zero_shot_policy(task, "position", obstacles=False).name, task)
    env, controller = make_env_and_controller(
        spec, robot, seed, sim="mujoco", render_mode="rgb_array", size=SIZE
    )
    with closing(env):
        frames = play(env, controller, EPISODES, seed, lambda e: print(task, robot, e), REST)
        return np.stack(list(frames)[::STRIDE])


def tiled(tiles: list[np.ndarray], columns: int = 0) -> np.ndarray:
    """Return pictures in rows; the last row is filled up in white. 0 columns: by their number."""
    columns = columns or (COLUMNS if len(tiles) <= 6 else MANY_COLUMNS)
    tiles = tiles + [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[i : i + columns], axis=1) for i in range(0, len(tiles), columns)]
    return np.concatenate(rows)


if __name__ == "__main__":
    sys.exit(main())
