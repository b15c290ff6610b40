"""Environment steps per second of raw PyBullet, panda-gym and morphgen's simulators in one run.

    python benchmarks/env_speed.py [--envs 128] [--seconds 4] [--rounds 3] [--json rows.json]
        [--only TEXT]

Reach and push of a Panda with its hand, and reach of a UR5 with a plate, with collision shapes of
fitted primitives. All rows of morphgen use the same random actions and whole episodes. A control
step has four physics steps of 5 ms. Rows of a task:

- raw PyBullet: the same scenes and actions, counting only the time inside `stepSimulation`.
  Targets, states, observations and rewards cost nothing here. With two processes, each steps half
  of the environments; this is the physical limit of the machine.
- morphgen with PyBullet, and with MuJoCo in one and two threads, with observations, rewards and
  resets.
- two independent processes of morphgen with PyBullet. MuJoCo in a scene without contacts: the limit
  without collision detection.
- morphgen with PyBullet without self-collision, which panda-gym lacks, and with panda-gym's 50
  solver iterations (morphgen uses 200 if the scene has a block).
- panda-gym with its own scene and observation, joint control and the same physics steps: one
  environment in one process, and one in each of two processes (Gymnasium's vector environments).

Then one environment of `gymnasium.make` at a time, in one thread and CPU time (`--only single`
measures these alone): panda-gym with its own episodes of 50 steps and with morphgen's of 300, in
which random actions bring the arm to its limits and into contacts more often, and morphgen's
environment with each simulator.

Then reach of the ten arm3 of `interpolation/arm3/reach`, on which agents train, with 160 and 4,096
environments (`--only arm3` measures these alone): MuJoCo in one thread, the same in a scene without
contacts, and the simulator `kinematic`. These rows have one thread and count CPU time.

Every round measures all rows in turn, so that other load on the machine affects all rows. The
figures are medians over the rounds. "of first" is the ratio to the first row of the same case: raw
PyBullet, panda-gym for single environments, or MuJoCo for the ten arm3.

panda-gym comes with `pip install morphgen[bench]`; without it its rows are missing.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pybullet
import torch
from tabulate import tabulate
from tqdm import tqdm

from morphgen.processes import one_torch_thread
from morphgen.splits.split import read_split
from morphgen.tasks.actions import BINS
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.scenes.make import make_batch, make_split_batch
from morphgen.tasks.sim import bullet
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP, Contacts

Rate = Callable[[float], float]
"""Measure environment steps per second over at least the given number of seconds."""
CASES: tuple[tuple[str, str, str], ...] = (
    ("reach", "arm=panda ee=panda_hand", "PandaReachJoints-v3"),
    ("push", "arm=panda ee=panda_hand", "PandaPushJoints-v3"),
    ("reach", "arm=ur5 ee=plane", ""),
)
"""Task, robot, and the panda-gym environment of the same task."""
RAW = "raw PyBullet"
TEN_ARMS = "interpolation/arm3/reach"
"""Split whose ten robots to train on are stepped together."""
TEN_ARMS_ENVS = (160, 4096)
SINGLE_EPISODES = 3
"""Number of episodes of different actions that rows of single environments repeat."""
NOTHING_TOUCHES = Contacts(scene=False, self_collision=False)
EPISODE = ReachConfig.max_episode_steps
"""Episode length [control steps]; every row runs whole episodes."""


@dataclass(frozen=True)
class Row:
    """One way to step the environments of a task."""

    case: str
    name: str
    rate: Rate


def main() -> int:
    """Measure all rows and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--envs", type=int, default=128)
    parser.add_argument("--seconds", type=float, default=4.0, help="of every row in every round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path, help="also write the rows here")
    parser.add_argument("--only", default="", help="text in the names of the cases to measure")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = [row for case in CASES for row in _rows(*case, args.envs)]
    rows += [row for case in CASES for row in _single_rows(*case)]
    rows += [row for envs in TEN_ARMS_ENVS for row in _ten_arms_rows(envs)]
    rows = [row for row in rows if args.only in row.case]
    if not rows:
        parser.error(f"--only {args.only}: no case has this text in its name")
    first = {row.case: row.name for row in reversed(rows)}
    found: dict[tuple[str, str], list[float]] = {(row.case, row.name): [] for row in rows}
    for _ in range(args.rounds):
        for row in tqdm(rows, unit="row"):
            found[row.case, row.name].append(row.rate(args.seconds))
    medians = {key: statistics.median(rates) for key, rates in found.items()}
    table = [
        (case, name, rate, rate / medians[case, first[case]])
        for (case, name), rate in medians.items()
    ]
    if args.json:
        text = json.dumps(
            [dict(zip(("case", "name", "rate", "of_first"), row, strict=True)) for row in table],
            indent=1,
        )
        args.json.write_text(text + "\n", encoding="utf-8")
    headers = ("task", "with", "env-steps/s", "of first")
    print(tabulate(table, headers, floatfmt=("", "", ",.0f", ".2f")))
    if find_spec("panda_gym") is None:
        print("panda-gym is not installed: no peer in this run (pip install 'morphgen[bench]')")
    return 0


def _rows(task: str, robot: str, peer: str, envs: int) -> list[Row]:
    case = f"{task} {robot}"
    ours: list[tuple[str, str, int]] = [
        ("morphgen, PyBullet, 1 process", "pybullet", 1),
        ("morphgen, MuJoCo, 1 thread", "mujoco", 1),
        ("morphgen, MuJoCo, 2 threads", "mujoco", 2),
    ]
    rows = [
        Row(case, RAW, partial(_raw, task, robot, envs)),
        Row(case, f"{RAW}, 2 processes", partial(_twice, _raw, task, robot, envs)),
    ]
    for name, sim, workers in ours:
        one = partial(_ours, task, robot, envs, sim=sim, workers=workers)
        rows.append(Row(case, name, one))
    rows += [
        Row(
            case, "morphgen, PyBullet, 2 processes apart", partial(_twice, _ours, task, robot, envs)
        ),
        Row(
            case,
            "morphgen, MuJoCo, 1 thread, nothing touches",
            partial(_ours, task, robot, envs, sim="mujoco", contacts=NOTHING_TOUCHES),
        ),
    ]
    if peer:
        alone = partial(_ours, task, robot, envs, contacts=Contacts(self_collision=False))
        rows.append(Row(case, "the same, 1 process, links pass through each other", alone))
        if task == "push":
            rows.append(Row(case, "the same, and 50 iterations", partial(_hasty, alone)))
    if peer and find_spec("panda_gym") is not None:
        for count in (1, 2):
            name = f"panda-gym, {count} process" + ("es" if count > 1 else "")
            rows.append(Row(case, name, partial(_peer, peer, count)))
    return rows


def _single_rows(task: str, robot: str, peer: str) -> list[Row]:
    if not peer:
        return []
    case = f"single {task} {robot}"
    makes = {}
    if find_spec("panda_gym") is not None:
        makes["panda-gym"] = partial(_panda, peer)
        makes[f"panda-gym, episodes of {EPISODE} steps"] = partial(_panda, peer, EPISODE)
    for name, sim in (("PyBullet", "pybullet"), ("MuJoCo", "mujoco")):
        env_id = f"morphgen.tasks.gym.env:morphgen/{task.capitalize()}-v0"
        makes[f"morphgen, {name}"] = partial(gymnasium.make, env_id, robot=robot, sim=sim)
    return [Row(case, name, partial(_single, make)) for name, make in makes.items()]


def _single(make: Callable[[], Any], seconds: float) -> float:
    """Return the steps per second of CPU time of one Gymnasium environment, with its resets."""
    with closing(make()) as env:
        rng = np.random.default_rng(0)
        shape = SINGLE_EPISODES, EPISODE, *env.action_space.shape
        episodes = rng.uniform(-1, 1, shape).astype(np.float32)
        env.reset(seed=0)
        start, rounds = 0.0, -1
        while rounds < 1 or time.process_time() - start < seconds:
            for action in episodes.reshape(-1, *shape[2:]):
                *_, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    env.reset()
            rounds += 1
            if rounds == 0:  # the first round warms up
                start = time.process_time()
        return rounds * SINGLE_EPISODES * EPISODE / (time.process_time() - start)


def _ten_arms_rows(envs: int) -> list[Row]:
    case = f"reach, ten arm3, {envs} environments"
    rates = {
        "MuJoCo, 1 thread": partial(_ten_arms, envs, sim="mujoco"),
        "MuJoCo, 1 thread, nothing touches": partial(
            _ten_arms, envs, sim="mujoco", contacts=NOTHING_TOUCHES
        ),
        "kinematic": partial(_ten_arms, envs, sim="kinematic"),
    }
    return [Row(case, f"morphgen, {name}", rate) for name, rate in rates.items()]


def _ten_arms(envs: int, seconds: float, sim: str, contacts: Contacts | None = None) -> float:
    split = read_split(TEN_ARMS)
    with closing(make_split_batch(split, "train", envs, sim=sim, contacts=contacts)) as batch:
        return measure_speed(batch, seconds, clock=time.process_time)


def _ours(
    task: str,
    robot: str,
    envs: int,
    seconds: float,
    sim: str = "pybullet",
    workers: int = 1,
    contacts: Contacts | None = None,
) -> float:
    batch = make_batch(task, [robot], envs, sim=sim, workers=workers, contacts=contacts)
    with closing(batch):
        return measure_speed(batch, seconds)


def _hasty(rate: Rate, seconds: float) -> float:
    """Use PyBullet's default number of solver iterations, which panda-gym uses too."""
    iterations = bullet.ITERATIONS
    bullet.ITERATIONS = 50
    try:
        return rate(seconds)
    finally:
        bullet.ITERATIONS = iterations


def _raw(task: str, robot: str, envs: int, seconds: float) -> float:
    """Return the steps per second of PyBullet alone, stepped as the environments step it."""
    spent, calls = 0.0, 0
    with closing(make_batch(task, [robot], envs, sim="pybullet")) as batch:
        batch.reset(seed=0)
        step = pybullet.stepSimulation

        def timed(**client: int) -> None:
            nonlocal spent, calls
            start = time.perf_counter()
            step(**client)
            spent += time.perf_counter() - start
            calls += 1

        pybullet.stepSimulation = timed
        try:
            end = time.perf_counter() + seconds
            actions = random_actions(batch, EPISODE, seed=0)
            while time.perf_counter() < end:
                for action in actions:
                    batch.step(action)
        finally:
            pybullet.stepSimulation = step
    return calls / spent


def _twice(
    one: Callable[[str, str, int, float], float],
    task: str,
    robot: str,
    envs: int,
    seconds: float,
) -> float:
    """Return the steps per second of two processes, each with half of the environments."""
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        for size in (1, envs // 2):  # both have loaded everything before the clock starts
            found = [pool.submit(one, task, robot, size, seconds) for _ in range(2)]
            rates = [each.result() for each in found]
    return sum(rates)


def _peer(name: str, count: int, seconds: float) -> float:
    """Return the steps per second of panda-gym, with the control period of morphgen."""
    make = [partial(_panda, name)] * count
    vector = gymnasium.vector.SyncVectorEnv if count == 1 else gymnasium.vector.AsyncVectorEnv
    with closing(vector(make)) as envs:
        envs.reset(seed=0)
        rng = np.random.default_rng(0)
        actions = rng.uniform(-1, 1, (EPISODE, *(envs.action_space.shape or ()))).astype(np.float32)
        for action in actions:
            envs.step(action)
        start, steps = time.perf_counter(), 0
        while steps % EPISODE or time.perf_counter() - start < seconds:
            envs.step(actions[steps % EPISODE])
            steps += 1
        return steps * count / (time.perf_counter() - start)


def _panda(name: str, steps: int | None = None) -> Any:  # noqa: ANN401 - its environments are untyped
    """Return an environment of panda-gym with the control period of morphgen.

    Args:
        name: Name of the environment.
        steps: Time limit of episodes [control steps]; None for its own.
    """
    import panda_gym

    assert panda_gym is not None
    env = gymnasium.make(name, max_episode_steps=steps)
    sim = env.get_wrapper_attr("sim")
    sim.n_substeps, sim.timestep = SUBSTEPS, TIMESTEP
    sim.physics_client.setTimeStep(TIMESTEP)
    return env


def random_actions(batch: TaskBatch, count: int, seed: int) -> list[torch.Tensor]:
    """Return uniformly random actions, shape (n, L) each."""
    generator = torch.Generator().manual_seed(seed)
    shape = (count, *batch.action_mask.shape)
    if batch.action_kind == "discrete":
        drawn = torch.randint(len(BINS), shape, generator=generator)
    else:
        drawn = 2 * torch.rand(shape, generator=generator) - 1
    return list(drawn.to(batch.device).unbind(0))


@one_torch_thread()
def measure_speed(
    batch: TaskBatch,
    seconds: float,
    *,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Return the control steps per second of all environments under random actions, with resets.

    The measurement covers whole episodes: the cost of contacts depends on the time since they
    began, and a faster simulator would otherwise get further into them. One seed gives
    all simulators the same episodes, since some cost a tenth more than others.

    seconds: Least duration [s]; an episode that began is finished.
    """
    episode = int(batch.max_episode_steps.max())
    actions = random_actions(batch, episode, 0)
    batch.reset()
    for action in actions[:20]:
        batch.step(action)
    batch.reset(0)  # after the warm-up, for the same episodes in all simulators
    steps = 0
    start = clock()
    while steps % episode or clock() - start < seconds:  # whole episodes
        batch.step(actions[steps % episode])
        steps += 1
    return steps * batch.num_envs / (clock() - start)


if __name__ == "__main__":
    sys.exit(main())
