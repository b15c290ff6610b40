"""The smallest training runs: two sliding robots to train on and one to test on, in MuJoCo."""

from dataclasses import replace

from helpers.splits import member, split
from morphgen.rl.agents import AGENTS, mlp
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.evaluation import EvalConfig
from morphgen.rl.runs.checkpoint import RunConfig, read_checkpoint
from morphgen.rl.runs.robot_source import robot_source, split_source
from morphgen.rl.runs.training import ExecutionConfig, read_metrics

QUIET = ExecutionConfig(tensorboard=False)
EVAL = EvalConfig(episodes=2, sim="mujoco")
POLICY = PolicyConfig("me-mlp", network=mlp.Config(4, 8, 1))
PPO = PPOConfig(total_timesteps=6 * 4 * 8, num_steps=8, epochs=1, minibatches=2)
"""Six updates of four environments."""
NETWORK = ("--set", "mlp_width=8")
ROLLOUT = ("--set", "num_steps=8", "--set", "minibatches=2", "--set", "epochs=1")
SMALL = ("--sim", "mujoco", "--envs", "4", *ROLLOUT, *NETWORK)
RUN = ("train", "planar-cube", "task=reach", "--agent", "me-mlp", *SMALL)
"""Words of the command line for such a run."""


def small_split(name="mine/small", task="reach"):
    train = (member("base=planar ee=cube", task=task), member("base=gantry ee=cube", task=task))
    return split(train, (member("base=gantry ee=plane", task=task),), name=name)


def small_source(**more):
    return split_source(small_split(**more))


def small_config(source=None, *, agent="me-mlp", seed=0, **ppo):
    small = POLICY.network if AGENTS[agent].config is mlp.Config else None
    policy = replace(POLICY, agent=agent, network=small)
    source = source or robot_source("planar-cube", "reach")
    return RunConfig(source, policy, replace(PPO, **ppo), seed=seed, sim="mujoco", num_envs=4)


class StoppedError(Exception):
    """Stands for Ctrl-C after a recorded update."""


def after(update, act):
    """Return a callback of training that calls a function after an update."""
    return lambda part: lambda report, updates: act() if report.update == update else None


def stop_after(update):
    """Return a callback of training that stops after an update."""

    def stop():
        raise StoppedError

    return after(update, stop)


def untimed(folder):
    """Return the recorded metrics of a run without its timings."""
    timed = ("collect_seconds", "learn_seconds", "steps_per_second")
    return [{k: v for k, v in each.items() if k not in timed} for each in read_metrics(folder)]


def weights(folder):
    """Weights of actor and critic of a run's last checkpoint, by name."""
    _, learner = read_checkpoint(folder)
    return {f"{part}.{k}": v for part in ("actor", "critic") for k, v in learner[part].items()}


def equal(one, other):
    return one.keys() == other.keys() and all(one[name].equal(other[name]) for name in one)
