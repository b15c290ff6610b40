"""Speed of physics and training on a GPU, beside MuJoCo Warp alone in the same run.

    python benchmarks/gpu_speed.py physics [--splits A B] [--envs 1024 4096]
    python benchmarks/gpu_speed.py training [--agents me-tf] [--epochs 2] [--envs 16384]
    python benchmarks/gpu_speed.py robots [--grammar serial] [--numbers 10 300] [--envs 16384]
    python benchmarks/gpu_speed.py copies [--split SPLIT] [--envs 1024]

``physics`` steps the train robots of splits with random actions: a batch of environments with
observations, rewards and new episodes; the simulation alone, with its control law; and the
library alone, with the same models, the same starts and the same joint targets, but without
control law and without reading the state. The last column is the batch's share of the library.

``training`` measures updates of a learner: seconds of the rollout and of learning.

``robots`` compares a batch of many different robots of a grammar with one of few.

``copies`` counts copies from the device to the host in a rollout, by torch's profiler.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco_warp
import torch
import warp as wp
from tabulate import tabulate

from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.ppo import Learner
from morphgen.splits.split import read_split
from morphgen.tasks.batch import StepGraph, TaskBatch
from morphgen.tasks.observation import observation_config
from morphgen.tasks.scenes.make import make_batch, make_split_batch
from morphgen.tasks.sim.base import SUBSTEPS
from morphgen.tasks.sim.warp_kernels import Joints
from morphgen.tasks.sim.warp_sim import Group, WarpSimulation

SPLITS = (
    "interpolation/arm3/reach",
    "interpolation/arm3/push",
    "composition/ee-arm/push",
    "extrapolation/arms/push",
)
ENVS = (1024, 4096, 16384, 32768)
AGENTS = ("se", "me-mlp", "me-tf", "me-graph")
STEPS, WARM_UP = 50, 10
"""Measured control steps, fewer than the shortest episode has; and steps before."""
Row = dict[str, str | int | float]


def main() -> int:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("physics", "training", "robots", "copies"))
    parser.add_argument("--splits", nargs="+", default=SPLITS)
    parser.add_argument("--split", default=SPLITS[0])
    parser.add_argument("--grammar", default="serial")
    parser.add_argument("--numbers", type=int, nargs="+", default=(10, 300))
    parser.add_argument("--envs", type=int, nargs="+", default=None)
    parser.add_argument("--agents", nargs="+", default=AGENTS)
    parser.add_argument("--epochs", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--no-compile", action="store_true")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    args = parser.parse_args()
    rows = list(_rows(args))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    print(tabulate(rows, headers="keys", floatfmt=",.3f", intfmt=","))
    return 0


def _rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield the rows of the requested table."""
    if args.what == "physics":
        for split in args.splits:
            for envs in args.envs or ENVS:
                yield _physics(split, envs, args.device)
    elif args.what == "training":
        for agent in args.agents:
            for envs in args.envs or (16384,):
                yield _training(agent, args.split, envs, args)
    elif args.what == "robots":
        for number in args.numbers:
            for envs in args.envs or (16384,):
                yield _robots(args.grammar, number, envs, args.device)
    else:
        yield _copies(args.split, (args.envs or (1024,))[0], args.device)


@wp.kernel  # type: ignore[untyped-decorator]
def targets_as_controls(
    joints: Joints, targets: wp.array2d[float], control: wp.array2d[float]
) -> None:
    """Copy the targets of the independent joints to the actuators. Threads: (worlds, J)."""
    world, joint = wp.tid()  # type: ignore[misc]  # Warp has several signatures
    control[world, joint] = targets[joints.env[world], joint]


class RawGroup(Group):
    """The library alone: physics steps towards joint targets."""

    def step(self) -> None:
        """Launch the library's kernels of a control step, without control law and reading.

        Targets are the controls of the actuators, without the forces of inverse dynamics.
        """
        wp.launch(
            targets_as_controls,
            self.data.ctrl.shape,
            [self._joints, self._buffers["targets"]],
            [self.data.ctrl],
        )
        for _ in range(SUBSTEPS):
            mujoco_warp.step(self.model, self.data)


class RawSimulation(WarpSimulation):
    """A simulation of groups that step the library alone."""

    group_type = RawGroup


def _physics(split: str, envs: int, device: str) -> Row:
    """Return control steps per second of a batch, of its simulation, and of the library."""
    torch.cuda.reset_peak_memory_stats()
    began = time.perf_counter()
    batch = make_split_batch(read_split(split), "train", envs, sim="warp", device=device)
    simulation = batch.simulation
    assert isinstance(simulation, WarpSimulation)
    start_up = time.perf_counter() - began
    actions = _actions(batch)
    graph = StepGraph(batch)  # as the learner steps
    batch.reset()
    q, block = simulation.q.clone(), simulation.object_pose.clone()
    poses = batch.layouts.poses if batch.layouts.any else None
    targets: list[torch.Tensor] = []

    def act(step: int) -> None:
        graph(actions[step])

    for step in range(STEPS + WARM_UP):
        act(step)
        targets.append(batch.targets[:, : simulation.q.shape[1]].clone())
    batch.reset(seed=0)
    row: Row = {
        "split": split,
        "environments": envs,
        "structures": len(simulation.counts),
    }
    everything = torch.ones(envs, dtype=torch.bool, device=device)
    found = {"batch": _steps_per_second(act, envs)}
    counts = simulation.counts.sum(dim=0).tolist()
    simulation.reset(everything, q, block, poses)
    found["simulation"] = _steps_per_second(lambda step: simulation.step(targets[step]), envs)
    free, total = torch.cuda.mem_get_info()
    scenes = simulation.scenes
    batch.close()
    raw = RawSimulation(scenes, device=device)
    raw.reset(everything, q, block, poses)
    found["library"] = _steps_per_second(lambda step: raw.step(targets[step]), envs)
    raw.close()
    return {
        **row,
        **{f"{name}, steps/s": value for name, value in found.items()},
        "share": found["batch"] / found["library"],
        "start, s": start_up,
        "device memory, GB": (total - free) / 1e9,
        "diverged": counts[0],
        "overflowed": counts[1],
    }


def _actions(batch: TaskBatch) -> torch.Tensor:
    """Return random actions of all steps, (steps, n, L)."""
    generator = torch.Generator(batch.device).manual_seed(0)
    shape = (STEPS + WARM_UP, batch.num_envs, batch.robot_tables.max_links)
    return torch.rand(shape, generator=generator, device=batch.device) * 2 - 1


def _steps_per_second(step: Callable[[int], object], envs: int) -> float:
    """Return control steps per second of all environments, after a warm-up."""
    for i in range(WARM_UP):
        step(i)
    wp.synchronize()
    began = time.perf_counter()
    for i in range(WARM_UP, WARM_UP + STEPS):
        step(i)
    wp.synchronize()
    return envs * STEPS / (time.perf_counter() - began)


def _learner(
    agent: str, split: str, envs: int, *, epochs: int, device: str, compiled: bool
) -> Learner:
    """Return a learner on the train robots of a split."""
    policy = PolicyConfig(agent, discrete=False)
    config = PPOConfig(
        total_timesteps=10**12,
        num_steps=16,
        epochs=epochs,
        minibatches=max(16 * envs // 32768, 1),
        symlog=False,
        slow_critic=False,
        bf16=compiled,
        compile=compiled,
    )
    batch = make_split_batch(
        read_split(split),
        "train",
        envs,
        sim="warp",
        device=device,
        kind=policy.kind,
        observe=observation_config(policy.channels),
    )
    return Learner(batch, policy, config, device=device)


def _training(agent: str, split: str, envs: int, args: argparse.Namespace) -> Row:
    """Return transitions per second of training, and where the time goes."""
    learner = _learner(
        agent,
        split,
        envs,
        epochs=args.epochs,
        device=args.device,
        compiled=not args.no_compile,
    )
    for _ in range(2):
        learner.iterate()
    updates = [learner.iterate() for _ in range(args.rounds)]
    collect, learn = (
        statistics.median(getattr(update, name) for update in updates)
        for name in ("collect_seconds", "learn_seconds")
    )
    learner.batch.close()
    transitions = envs * learner.config.num_steps
    parameters = sum(p.numel() for net in (learner.actor, learner.critic) for p in net.parameters())
    return {
        "agent": agent,
        "split": split,
        "environments": envs,
        "epochs": learner.config.epochs,
        "parameters": parameters,
        "collected/s": transitions / collect,
        "learned/s": transitions / learn,
        "transitions/s": transitions / (collect + learn),
        "share of learning": learn / (collect + learn),
        "device memory, GB": torch.cuda.max_memory_allocated() / 1e9,
    }


def _robots(grammar: str, number: int, envs: int, device: str) -> Row:
    """Return the cost of a batch of many different robots."""
    from morphgen import sample

    began = time.perf_counter()
    robots = list(sample(grammar, number))
    composed = time.perf_counter()
    batch = make_batch("reach", robots, envs, sim="warp", device=device)
    ready = time.perf_counter()
    simulation = batch.simulation
    assert isinstance(simulation, WarpSimulation)
    actions = _actions(batch)
    graph = StepGraph(batch)
    batch.reset()
    speed = _steps_per_second(lambda step: graph(actions[step]), envs)
    free, total = torch.cuda.mem_get_info()
    batch.close()
    return {
        "grammar": grammar,
        "robots": number,
        "environments": envs,
        "structures": len(simulation.counts),
        "compose, s": composed - began,
        "goals and models, s": ready - composed,
        "batch, steps/s": speed,
        "device memory, GB": (total - free) / 1e9,
    }


def _copies(split: str, envs: int, device: str) -> Row:
    """Return the number of copies between device and host in a rollout."""
    learner = _learner("me-mlp", split, envs, epochs=1, device=device, compiled=False)
    for _ in range(2):
        learner.iterate()
    activities = [torch.profiler.ProfilerActivity.CUDA, torch.profiler.ProfilerActivity.CPU]
    with torch.profiler.profile(activities=activities) as profile:
        learner._collect_rollout()
        torch.cuda.synchronize()
    events: Sequence[Any] = profile.key_averages()
    counts = {event.key: event.count for event in events}
    return {
        "split": split,
        "environments": envs,
        "steps": learner.config.num_steps,
        "device to host": sum(n for name, n in counts.items() if "DtoH" in name),
        "host to device": sum(n for name, n in counts.items() if "HtoD" in name),
        "synchronisations": counts.get("cudaStreamSynchronize", 0),
    }


if __name__ == "__main__":
    raise SystemExit(main())
