"""Errors about the types and shapes that a user's task returns name the task and the part."""

from dataclasses import dataclass, replace

import pytest
import torch

from morphgen.errors import TaskError
from morphgen.rl.config import PPOConfig
from morphgen.rl.runs.checkpoint import config_from
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.envs import ReachEnvs
from morphgen.tasks.reach.task import Reach
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.make import make_batch
from morphgen.tasks.task import GOAL, ObservationField, Task, TaskEnvs

EXTRA = ObservationField("extra", 1, GOAL.mask)


@dataclass(frozen=True)
class HoverConfig(ReachConfig):
    task = "hover"
    num_goals: int = 3


class HoverEnvs(ReachEnvs):
    """Environments of reach with another field."""

    def observe(self, object_pose):
        return {**super().observe(object_pose), "extra": self.goal[:, :1]}


@pytest.fixture
def make(monkeypatch, tmp_path):
    """Return a function that makes two environments of a task with changed parts, and steps."""
    monkeypatch.setattr(TASKS, "_loaded", dict(TASKS._loaded))

    def step(fields=(GOAL, EXTRA), made=None, make_envs=True, sample=Reach.sample, **methods):
        envs = type("Envs", (HoverEnvs,), methods)
        kind = type(
            "Hover",
            (Reach,),
            {
                "name": "hover",
                "config_type": HoverConfig,
                "fields": fields,
                "sample": sample,
                "make_envs": lambda self, *args: made or (envs(*args) if make_envs else None),
            },
        )
        TASKS.register(kind())
        batch = make_batch("hover", ["gantry-plane"], 2, sim="kinematic", cache=tmp_path)
        batch.reset()
        return batch.step(torch.zeros(batch.action_mask.shape))

    return step


def changed(**changes):
    """Return ``evaluate`` with parts of the result changed by functions of them."""

    def evaluate(self, state):
        result = HoverEnvs.evaluate(self, state)
        return replace(result, **{key: new(getattr(result, key)) for key, new in changes.items()})

    return {"evaluate": evaluate}


def test_a_sound_task_is_stepped(make):
    assert make().final_observation["extra"].shape == (2, 1)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"make_envs": None}, "make_envs returned NoneType; expected TaskEnvs"),
        ({"sample": lambda *_, **__: None}, "sample returned NoneType; expected ReachGoalSet"),
        ({"begin": lambda *_: torch.zeros(2, 5)}, "begin returned Tensor; expected two tensors"),
        (
            {"begin": lambda *_: (torch.zeros(2, 1), torch.zeros(2, 7))},
            r"begin: the joint positions has shape \(2, 1\); expected \(2, 5\)",
        ),
        ({"evaluate": lambda *_: (1, 2)}, "evaluate returned tuple; expected a StepResult"),
        (changed(terms=lambda terms: {}), "evaluate: no reward terms; expected one or more"),
        (
            changed(terms=lambda terms: {"a": next(iter(terms.values())).mean()}),
            r"evaluate: the reward term 'a' has shape \(\); expected \(2,\)",
        ),
        (
            changed(terms=lambda terms: {"a": next(iter(terms.values()))[:, None]}),
            r"evaluate: the reward term 'a' has shape \(2, 1\); expected \(2,\)",
        ),
        (changed(terms=lambda terms: {"a": 1.0}), "the reward term 'a': float; expected a tensor"),
        (changed(success=torch.Tensor.float), "success is torch.float32; expected bool"),
        (changed(distance=torch.Tensor.bool), "distance is torch.bool; expected numbers"),
        ({"observe": ReachEnvs.observe}, "observe: the field 'extra' is missing"),
        ({"fields": (GOAL,)}, "observe: 'extra' is no ObservationField in the task's `fields`"),
        (
            {"fields": (GOAL, replace(EXTRA, size=2))},
            r"observe: the field 'extra' has shape \(2, 1\); expected \(2, 2\)",
        ),
        ({"fields": (replace(GOAL, size=9), EXTRA)}, "field 'goal': the name is taken"),
        ({"fields": (GOAL, replace(EXTRA, name="tokens"))}, "field 'tokens': the name is taken"),
    ],
)
def test_faults_are_named(make, parts, message):
    with pytest.raises(TaskError, match=f"task 'hover': .*{message}"):
        make(**parts)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"name": "Hover-Task"}, "'Hover-Task': expected a name of lower-case letters and digits"),
        ({"name": "float"}, "'float': config_type.task is 'hover'; expected 'float'"),
        ({"config_type": None}, "'hover': the class attribute 'config_type' is missing"),
        ({"config_type": int}, "'hover': config_type is .*int.*; expected a TaskConfig"),
        (
            {"sample": lambda self, robot, config: None},
            r"'hover': sample\(robot, config\): got an unexpected keyword argument 'obstacles'",
        ),
        (
            {"make_envs": lambda self: None},
            r"'hover': make_envs\(\): too many positional arguments",
        ),
    ],
)
def test_an_incomplete_task_is_not_registered(monkeypatch, parts, message):
    monkeypatch.setattr(TASKS, "_loaded", dict(TASKS._loaded))
    described = {name: getattr(Reach, name) for name in ("goal_set_type", "goal_format", "fields")}
    methods = {name: getattr(Reach, name) for name in ("sample", "certify", "make_envs")}
    whole = {"name": "hover", "config_type": HoverConfig, "cache_folder": "hover", **described}
    parts = {name: part for name, part in {**whole, **methods, **parts}.items() if part}
    with pytest.raises(TaskError, match=f"task {message}"):
        TASKS.register(type("Hover", (Task,), parts)())
    assert parts["name"] not in TASKS


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({}, "Bare has no evaluate and no observe; expected these methods, or `formulas`"),
        ({"evaluate": print}, "Bare has no observe; expected this method, or"),
        ({"observe": print}, "Bare has no evaluate; expected this method, or"),
        ({"formulas": None}, "Bare has no evaluate and no observe"),
    ],
)
def test_environments_without_formulas_need_methods(make, parts, message):
    bare = type("Bare", (TaskEnvs,), {"begin": HoverEnvs.begin, **parts})
    with pytest.raises(TaskError, match=f"task 'hover': {message}"):
        make(made=bare())


def test_a_run_of_an_unknown_task_is_named():
    data = {"source": {}, "policy": {}, "ppo": vars(PPOConfig()), "hover": {"near": 0.1}}
    with pytest.raises(TaskError, match="run: unknown task 'hover'; run the script that registers"):
        config_from(data)
