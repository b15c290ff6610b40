"""Transitions per second of PPO in morphgen and in stable-baselines3.

    python benchmarks/ppo_speed.py [--robot ur5-plane] [--envs 64] [--rounds 3] [--threads 1,2]
        [--sims pybullet,mujoco] [--json rows.json]
    python benchmarks/ppo_speed.py --device cuda [--envs 128] [--rounds 3] [--json rows.json]
    python benchmarks/ppo_speed.py --cores 1,2,4 [--agents me-graph] [--sims mujoco] [--rounds 5]

A row is one update: a rollout of 128 control steps in every environment, and four epochs of 16
minibatches. Within a simulator and number of threads all rows share:

- the environments: reach of one robot, a new batch without padding; stable-baselines3 gets it
  through ``morphgen.tasks.gym.sb3.SB3Vector``. Continuous actions.
- rollout length, environments, epochs, minibatches and minibatch size, and thus gradient steps;
  clip range, discount, GAE lambda, entropy weight, Adam; separate value and policy networks.
- torch threads, and in MuJoCo as many threads of the simulator; PyBullet has one.

"same network" uses our MLP of ``se`` as features extractor of stable-baselines3, one for the policy
and one for values, each with a linear layer; the script checks that the number of parameters before
it is equal. "own MLP" is the default of stable-baselines3: the flattened observation and as many
tanh layers of the same width. "Gymnasium" also has that network, and as many ``morphgen/Reach-v0``
environments in a ``DummyVecEnv``: the usual way without our batch, and without workers.

Differences that remain: morphgen staggers the episodes of a batch, computes values again over the
whole rollout before learning, keeps an exponential moving average of the critic, and clips the
gradients of policy and values separately. The paper's symlog and slow critic are off.

Every round measures all rows in turn, after one update that is not counted. Figures are medians.

With ``--device`` the script measures only the learner: ``me-tf`` learns from random rollouts, with
bfloat16 and ``torch.compile`` on and off. Samples per second are transitions times epochs divided
by the learning time. No simulator is needed.

With ``--cores`` the script compares the threads that ``morphgen train`` uses by default with
others: torch threads and workers of the simulator, one or one for each core, on the first cores
that it may use, idle and beside a process on each core that computes without end. Each figure is
the median of the updates of a process of its own, in transitions per second; its rollouts have a
quarter of the steps and of the minibatches.

stable-baselines3 comes with `pip install morphgen[bench]`; without it its rows are missing.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from functools import partial
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, cast

import torch
from tabulate import tabulate
from tqdm import tqdm

from morphgen.encoding.tokens import MAX_LINKS, TOKEN_SIZE
from morphgen.model.robot import Robot
from morphgen.rl.agents import mlp
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.observation_layout import INITIAL_LOG_STD, layout_of
from morphgen.rl.ppo import Learner
from morphgen.tasks.actions import BINS
from morphgen.tasks.batch import Step, TaskBatch
from morphgen.tasks.observation import Observation, observation_config
from morphgen.tasks.registry import SIMULATORS

Update = Callable[[], tuple[float, float]]
"""Run one update; return the seconds of collection and of learning."""
Row = dict[str, str | int | float]

SE = PolicyConfig("se", discrete=False)
SIZES = mlp.Config()
PLAIN = PPOConfig(total_timesteps=10**9, symlog=False, slow_critic=False)
SHORT = PPOConfig(total_timesteps=10**9, num_steps=32, minibatches=4)
"""A quarter of the default rollout, in minibatches of the same size: to compare threads on one and
two cores takes 14 processes."""
ROBOTS, OBSTACLES = 10, 3
"""Numbers of robots and of obstacles in the random rollouts."""


def main() -> int:
    """Measure all rows and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    cores = os.cpu_count() or 1
    parser.add_argument("--robot", default="ur5-plane")
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", default=f"1,{cores}", help="numbers, parted by commas")
    parser.add_argument("--sims", default="pybullet,mujoco")
    parser.add_argument("--device", help="measure the learner alone, on cuda or cpu")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    parser.add_argument("--cores", help="numbers of cores, parted by commas: compare threads")
    parser.add_argument("--agents", default="me-graph,se", help="agents of --cores")
    parser.add_argument("--one", nargs=4, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        agent, sim, *numbers = args.one
        print(_speed(args.robot, agent, sim, args.envs, args.rounds, *map(int, numbers)))
        return 0
    if args.cores:
        counts = [int(text) for text in args.cores.split(",")]
        cases = product(args.agents.split(","), args.sims.split(","), counts, (False, True))
        rows = [_shown(_threads(args, *case)) for case in tqdm(list(cases), unit="case")]
    elif args.device:
        rows = _learners(args.device, args.envs, args.rounds)
    else:
        threads = dict.fromkeys(int(text) for text in args.threads.split(","))
        rows = [
            _shown(row)
            for sim, count in product(args.sims.split(","), threads)
            for row in _beside(args.robot, sim, args.envs, count, args.rounds)
        ]
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    print(tabulate(rows, headers="keys", floatfmt=",.2f"))
    if not (args.device or args.cores) and find_spec("stable_baselines3") is None:
        print("stable-baselines3 is not installed: no peer (pip install 'morphgen[bench]')")
    return 0


def _shown(row: Row) -> Row:
    """Print a row on stderr as soon as it is measured: a run may be stopped before its table."""
    tqdm.write(json.dumps(row), file=sys.stderr)
    return row


def _threads(args: argparse.Namespace, agent: str, sim: str, count: int, loaded: bool) -> Row:
    """Return the speed with the threads of ``morphgen train`` and with the best of others."""
    cores = sorted(os.sched_getaffinity(0))[:count]
    workers = (1, count) if SIMULATORS[sim].takes_workers else (1,)
    pairs = [(0, 0), *dict.fromkeys(product((1, count), workers))]
    speeds: dict[tuple[int, int], float] = {}
    with ExitStack() as stack:
        for core in cores if loaded else ():
            busy = subprocess.Popen(
                [sys.executable, "-c", "while True: pass"],
                preexec_fn=partial(os.sched_setaffinity, 0, [core]),
            )
            stack.callback(busy.wait)
            stack.callback(busy.kill)
        for pair in pairs:
            words = map(str, ("--one", agent, sim, *pair, "--robot", args.robot))
            sizes = map(str, ("--envs", args.envs, "--rounds", args.rounds))
            done = subprocess.run(
                [sys.executable, __file__, *words, *sizes],
                preexec_fn=partial(os.sched_setaffinity, 0, cores),
                check=True,
                text=True,
                stdout=subprocess.PIPE,
            )
            speeds[pair] = float(done.stdout)
    default = speeds.pop((0, 0))
    best = max(speeds, key=speeds.__getitem__)
    return {
        "agent": agent,
        "sim": sim,
        "cores": count,
        "other load": "one process a core" if loaded else "none",
        "default": default,
        "best": speeds[best],
        "torch threads": best[0],
        "workers": best[1],
        "default / best": default / max(speeds.values()),
    }


def _speed(
    robot: str,
    agent: str,
    sim: Any,  # noqa: ANN401
    envs: int,
    rounds: int,
    torch_threads: int,
    workers: int,
) -> float:
    """Return transitions per second of a learner; 0 stands for the threads of ``train``."""
    from morphgen.tasks.scenes.env_specs import load_robot
    from morphgen.tasks.scenes.make import make_batch

    torch.set_num_threads(torch_threads or 1)
    policy = PolicyConfig(agent, discrete=False)
    batch = make_batch(
        "reach",
        [load_robot(robot)],
        envs,
        sim=sim,
        kind=policy.kind,
        observe=observation_config(policy.channels),
        workers=workers or None,
    )
    with closing(batch):
        learner = Learner(batch, policy, SHORT)
        learner.iterate()
        return statistics.median(learner.iterate().steps_per_second for _ in range(rounds))


def _beside(robot: str, sim: Any, envs: int, threads: int, rounds: int) -> Iterator[Row]:  # noqa: ANN401
    """Return the rows of a simulator and a number of threads."""
    from morphgen.tasks.scenes.env_specs import load_robot
    from morphgen.tasks.scenes.make import make_batch

    body = load_robot(robot)
    workers = threads if SIMULATORS[sim].takes_workers else 1
    torch.set_num_threads(threads)
    with ExitStack() as stack:

        def batch() -> TaskBatch:
            # Without padding, which SB3Vector leaves out.
            links = len(body.links)
            made = make_batch("reach", [body], envs, sim=sim, workers=workers, max_links=links)
            stack.callback(made.close)
            return made

        learner = Learner(batch(), SE, PLAIN)
        updates: dict[str, Update] = {"morphgen": partial(_own_update, learner)}
        if find_spec("stable_baselines3") is not None:
            from morphgen.tasks.gym.sb3 import SB3Vector
            from morphgen.tasks.gym.vector import TaskVector

            for name, like in (("same network", learner), ("own MLP", None)):
                updates[f"stable-baselines3, {name}"] = _peer(SB3Vector(TaskVector(batch())), like)
            single = _single(body, sim, envs)
            stack.callback(single.close)
            updates["stable-baselines3, own MLP, Gymnasium"] = _peer(single, None)
        found = _measured(updates, rounds, f"{sim}, {threads} threads")
    made = PLAIN.num_steps * envs
    ours = sum(found["morphgen"])
    for name, (collecting, learning) in found.items():
        yield {
            "sim": sim,
            "threads": threads,
            "with": name,
            "transitions/s": made / (collecting + learning),
            "collected/s": made / collecting,
            "learned/s": made / learning,
            "morphgen is faster by": (collecting + learning) / ours,
        }


def _measured(
    updates: Mapping[str, Update], rounds: int, what: str
) -> dict[str, tuple[float, float]]:
    """Return the median seconds of collection and of learning, by name."""
    for update in updates.values():
        update()
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in updates}
    for _ in tqdm(range(rounds), unit="round", desc=what):
        for name, update in updates.items():
            seconds[name].append(update())
    medians = {
        name: [statistics.median(each) for each in zip(*own, strict=True)]
        for name, own in seconds.items()
    }
    return {name: (collecting, learning) for name, (collecting, learning) in medians.items()}


def _own_update(learner: Learner) -> tuple[float, float]:
    report = learner.iterate()
    return report.collect_seconds, report.learn_seconds


def _peer(envs: Any, learner: Learner | None) -> Update:  # noqa: ANN401
    """Return the update of stable-baselines3, with a learner's network or with its own."""
    from stable_baselines3 import PPO

    network: dict[str, Any]
    if learner:
        network = {
            "features_extractor_class": _extractor(),
            "features_extractor_kwargs": {"like": learner.batch.observe()},
            "share_features_extractor": False,
            "net_arch": [],
        }
    else:
        layers = [SIZES.mlp_width] * SIZES.mlp_layers
        network = {"net_arch": {"pi": layers, "vf": layers}}
    model = PPO(
        "MultiInputPolicy",
        envs,
        learning_rate=PLAIN.learning_rate,
        n_steps=PLAIN.num_steps,
        batch_size=PLAIN.minibatch_size(envs.num_envs),
        n_epochs=PLAIN.epochs,
        gamma=PLAIN.gamma,
        gae_lambda=PLAIN.gae_lambda,
        clip_range=PLAIN.clip_coef,
        ent_coef=PLAIN.ent_coef,
        max_grad_norm=PLAIN.max_grad_norm,
        policy_kwargs={**network, "log_std_init": INITIAL_LOG_STD},
        seed=0,
        device="cpu",
    )
    if learner:
        ours, theirs = _parameters(learner.actor, learner.critic), _parameters(model.policy)
        if ours != theirs:
            raise ValueError(f"the networks differ: {ours} and {theirs} parameters")
    spent = 0.0
    train = model.train

    def timed() -> None:
        nonlocal spent
        began = time.perf_counter()
        train()
        spent = time.perf_counter() - began

    model.train = timed  # type: ignore[method-assign]

    def update() -> tuple[float, float]:
        began = time.perf_counter()
        model.learn(PLAIN.num_steps * envs.num_envs, reset_num_timesteps=False)
        return time.perf_counter() - began - spent, spent

    return update


def _single(robot: Robot, sim: Any, envs: int) -> Any:  # noqa: ANN401
    """Return Gymnasium environments, one after the other in one process."""
    import gymnasium
    from stable_baselines3.common.vec_env import DummyVecEnv

    made = partial(gymnasium.make, "morphgen/Reach-v0", robot=robot, sim=sim)
    return DummyVecEnv([made] * envs)


def _extractor() -> type[Any]:
    """Return our MLP without its last layer, as a features extractor of stable-baselines3."""
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    class Extractor(BaseFeaturesExtractor):
        def __init__(self, space: Any, like: Observation) -> None:  # noqa: ANN401
            super().__init__(space, SIZES.mlp_width)
            # "actions" has a column for each link in `like`, and for each joint in the space; no
            # layer reads it. The space lacks what has no rows.
            self.kinds = {
                name: (each.dtype, each.shape[1:])
                for name, each in like.items()
                if name != "actions" and name in space.spaces
            }
            self.network = mlp.Network(SE, layout_of(like), 1, per_link=False)
            self.network.leave = cast(torch.nn.Linear, torch.nn.Identity())
            self.network.shape = (SIZES.mlp_width,)

        def forward(self, seen: Observation) -> torch.Tensor:
            restored = {
                name: seen[name].to(dtype).reshape(-1, *shape)
                for name, (dtype, shape) in self.kinds.items()
            }
            return cast(torch.Tensor, self.network(restored))

    return Extractor


def _parameters(*networks: torch.nn.Module) -> int:
    """Return the number of learned parameters before the last layers.

    The last layer of a policy has an output for each link in morphgen, and for each joint in
    stable-baselines3.
    """
    last = {"leave", "action_net", "value_net", "log_std", "raw_log_std"}
    return sum(
        each.numel()
        for network in networks
        for name, each in network.named_parameters()
        if last.isdisjoint(name.split("."))
    )


def _learners(device: str, envs: int, rounds: int) -> list[Row]:
    """Return the rows of the learner alone."""
    updates: dict[str, Update] = {}
    settings = list(product((False, True), repeat=2))
    for bf16, compiled in settings:
        config = PPOConfig(total_timesteps=10**9, bf16=bf16, compile=compiled)
        batch = cast(TaskBatch, _RandomBatch(envs, device))
        learner = Learner(batch, PolicyConfig("me-tf"), config, device=device)
        updates[f"{bf16} {compiled}"] = partial(_own_update, learner)
    found = _measured(updates, rounds, device)
    config = PPOConfig()
    samples = config.num_steps * envs * config.epochs
    name = torch.cuda.get_device_name(device) if device.startswith("cuda") else device
    return [
        {
            "device": name,
            "bf16": "on" if bf16 else "off",
            "compile": "on" if compiled else "off",
            "samples/s": samples / found[f"{bf16} {compiled}"][1],
            "learning an update, s": found[f"{bf16} {compiled}"][1],
        }
        for bf16, compiled in settings
    ]


class _RandomBatch:
    """A replacement of ``TaskBatch`` with random observations and rewards."""

    action_kind = "discrete"

    def __init__(self, envs: int, device: str) -> None:
        self.num_envs, self.device = envs, torch.device(device)
        self.env_robot_index = torch.arange(envs, device=device) % ROBOTS
        generator = torch.Generator(device).manual_seed(0)

        def drawn(*shape: int) -> torch.Tensor:
            return torch.rand(envs, *shape, generator=generator, device=device)

        some = torch.arange(MAX_LINKS, device=device) < 6 + drawn(1) * (MAX_LINKS - 6)
        none = torch.zeros(envs, dtype=torch.bool, device=device)
        self._seen = {
            "tokens": 2 * drawn(MAX_LINKS, TOKEN_SIZE) - 1,
            "links": some,
            "actions": some & (drawn(MAX_LINKS) < 0.8),
            "goal": drawn(7),
            "goal_mask": ~none,
            "object": torch.zeros(envs, 13, device=device),
            "object_mask": none,
            "line": torch.zeros(envs, 1, device=device),
            "obstacles": drawn(OBSTACLES, 13),
            "obstacle_mask": torch.ones(envs, OBSTACLES, dtype=torch.bool, device=device),
        }
        self._score, self._never = drawn(), none

    def advance(self, progress: float) -> None:
        """There is no line."""

    def observe(self) -> Observation:
        """Return the same observation each time."""
        return self._seen

    def reset(self, *, spread: bool) -> Observation:
        """Return the first observation."""
        return self._seen

    def step(self, actions: torch.Tensor) -> Step:
        """Return a reward that depends on the action, and the same observation."""
        reward = self._score * torch.tensor(BINS, device=self.device)[actions].mean(dim=1)
        return Step(
            observation=self._seen,
            reward=reward,
            terminated=self._never,
            truncated=self._never,
            diverged=self._never,
            final_observation=self._seen,
            success=self._never,
            distance=self._score,
            score=self._score,
            terms={"random": reward},
            q=torch.zeros(self.num_envs, 1, device=self.device),
            object_pose=torch.zeros(self.num_envs, 7, device=self.device),
        )


if __name__ == "__main__":
    sys.exit(main())
