"""The smallest runs there are: two sliding bodies to train on, one to test on, in MuJoCo."""

from dataclasses import replace

from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.evaluation import Exam
from morphgen.rl.runs import RunConfig, read_checkpoint
from morphgen.rl.sources import robot_source, split_source
from morphgen.rl.training import Way
from splits import member, split

QUIET = Way(tensorboard=False)
EXAM = Exam(episodes=2, sim="mujoco")
POLICY = PolicyConfig("me-mlp", mlp_features=4, mlp_width=8, mlp_layers=1)
PPO = PPOConfig(transitions=6 * 4 * 8, steps=8, epochs=1, minibatches=2)
"""Six updates of four environments."""


def small_split(name="mine/small", task="reach"):
    train = (member("base=planar ee=cube", task=task), member("base=gantry ee=cube", task=task))
    return split(train, (member("base=gantry ee=plane", task=task),), name=name)


def small_source(**more):
    return split_source(small_split(**more))


def small_config(source=None, *, agent="me-mlp", seed=0, **ppo):
    policy = replace(POLICY, agent=agent)
    source = source or robot_source("planar-cube", "reach")
    return RunConfig(source, policy, replace(PPO, **ppo), seed=seed, sim="mujoco", envs=4)


def weights(folder):
    """Weights of actor and critic of a run's last checkpoint, by name."""
    _, learner = read_checkpoint(folder)
    return {f"{part}.{k}": v for part in ("actor", "critic") for k, v in learner[part].items()}


def equal(one, other):
    return one.keys() == other.keys() and all(one[name].equal(other[name]) for name in one)
