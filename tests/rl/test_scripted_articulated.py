"""The scripted controller of drawer, door and dial: its episodes, also in other simulators."""

from contextlib import closing
from dataclasses import dataclass, replace

import pytest
import torch

from helpers.scenes import robot
from helpers.simulators import PYBULLET
from morphgen.grammar.library import default_library
from morphgen.rl.baselines.scripted_articulated import Scripted
from morphgen.rl.inference import run_episodes
from morphgen.splits.split_file import read_split
from morphgen.tasks.registry import SIMULATORS, TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig, member_spec
from morphgen.tasks.scenes.make import batch_from_specs, make_batch

OBJECTS = ("drawer", "door", "dial")
WITH_REACH = (*OBJECTS, "reach")
EPISODES = 4  # of a task


def batch(cache, sim):
    """Make environments of an arm at the tasks, and begin episodes that no success ends."""
    made = make_batch(
        WITH_REACH,
        [robot("arm3-stick")] * len(WITH_REACH),
        EPISODES * len(WITH_REACH),
        sim=sim,
        configs=[TASKS[task].config_type(num_goals=EPISODES) for task in WITH_REACH],
        cache=cache,
    )
    made.reset()
    for name in OBJECTS:
        made.groups[name].formulas.travel.fill_(100.0)
    return made


def positions(task):
    """Return the positions of the objects' joints, and how far they are from their goals."""
    return task.observe()["object_joint"][:, 7:].clone().unbind(1)


@dataclass
class Recording:
    """Actions in MuJoCo, (T, n, L), and the objects' joints when they pass their goals."""

    actions: torch.Tensor
    steps: torch.Tensor  # until then, shape (n,); -1: never
    positions: torch.Tensor  # shape (n,) [rad or m]
    travels: torch.Tensor


@pytest.fixture(scope="module")
def recorded(cache):
    """Episodes of the controller."""
    task, controller = batch(cache, "mujoco"), Scripted(0)
    _, to_go = positions(task)
    steps = torch.where(task.task_mask("reach"), 0, -1)
    ends, actions = torch.zeros_like(to_go), []
    while (steps < 0).any() and len(actions) < 299:
        actions.append(torch.where(steps[:, None] < 1, controller.act(task), 0.0))
        task.step(actions[-1])
        now, left = positions(task)
        over = (steps < 0) & (left * to_go.sign() < 0)
        steps = torch.where(over, len(actions), steps)
        ends = torch.where(over, now, ends)
    task.close()
    return Recording(torch.stack(actions), steps, ends, to_go.abs())


def test_episodes_succeed_and_other_tasks_stand_still(recorded):
    actions = recorded.actions.view(-1, EPISODES, len(WITH_REACH), recorded.actions.shape[2])
    assert (recorded.steps >= 0).all()
    assert recorded.steps.max() < 200
    assert actions.abs().max() <= 1
    assert actions[:, :, :-1].any(dim=3).any(dim=0).all()
    assert not actions[:, :, -1].any()


@pytest.mark.parametrize(
    ("task", "name"),
    [
        # The plate need not turn with the dial, which then moves less than the tool.
        ("dial", "plane-000001"),
        # A slide of the gantry takes a thin stick through the tray's front between coarse tests.
        ("drawer", "cylinder-000003"),
    ],
)
def test_gantries_with_large_and_thin_tools_succeed(task, name):
    members = read_split(f"composition/ee-arm/{task}").side("train")
    member = next(member for member in members if member.name == name)
    spec = member_spec(member, default_library(), GoalConfig())
    with closing(batch_from_specs([spec], EPISODES, layouts="eval")) as task_batch:
        assert all(episode.success for episode in run_episodes(task_batch, Scripted(0), 1))


@pytest.mark.slow
@pytest.mark.parametrize("sim", [PYBULLET, "warp"])
def test_the_same_actions_move_objects_as_far_in_other_simulators(
    sim, recorded, cache, monkeypatch
):
    on_cpu = replace(SIMULATORS[sim], devices=("cpu",))  # on which Warp is slow, but works
    monkeypatch.setitem(SIMULATORS._loaded, sim, on_cpu)
    task = batch(cache, sim)
    ends = torch.zeros_like(recorded.positions)
    for step, action in enumerate(recorded.actions, start=1):
        task.step(action)
        ends = torch.where(recorded.steps == step, positions(task)[0], ends)
    task.close()
    apart = (ends - recorded.positions).abs()
    assert (apart <= 0.05 * recorded.travels).all(), apart / recorded.travels
