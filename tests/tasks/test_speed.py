"""``measure_speed`` time shares, measured with a fake clock."""

from contextlib import closing
from dataclasses import replace
from importlib import import_module
from itertools import count

import pytest

import morphgen
from helpers.simulators import PYBULLET
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.scenes.make import make_batch
from morphgen.tasks.speed import measure_speed

CONFIG = replace(ReachConfig(), num_goals=4, max_episode_steps=10)


@pytest.fixture(scope="module")
def robot():
    return morphgen.compose("arm=arm3 ee=claw")


@pytest.mark.parametrize("sim", [PYBULLET, "mujoco"])
def test_shares_sum_to_one_and_separate_the_native_step(robot, sim, tmp_path):
    ticks, (module, step) = count(), SIMULATORS[sim].native_step
    with closing(
        make_batch("reach", [robot], 3, sim=sim, configs=(CONFIG,), cache=tmp_path)
    ) as batch:
        report = measure_speed(
            batch, 2000, own=[(import_module(module), step)], clock=lambda: float(next(ticks))
        )
        assert "step" not in vars(batch.simulation)
        assert "observe" not in vars(batch)
    assert sum(report.shares.values()) == pytest.approx(1)
    for part in ("simulator", "around the simulator", "observation", "rewards", "new episodes"):
        assert report.shares[part] > 0, part
    # A step reads the clock twice per part, and again per environment in the simulator.
    assert report.shares["simulator"] == pytest.approx(3 * report.shares["actions"], rel=0.05)
    assert report.substeps_per_second == 4 * report.steps_per_second > 0


def test_simulator_time_is_one_share_without_the_native_step(robot, tmp_path):
    ticks = count()
    with closing(
        make_batch("reach", [robot], 2, sim="mujoco", configs=(CONFIG,), cache=tmp_path)
    ) as batch:
        report = measure_speed(batch, 507, clock=lambda: float(next(ticks)))
        assert batch.episode_step.tolist() == [0, 0]  # whole episodes
    assert "around the simulator" not in report.shares
    assert report.shares["simulator"] == pytest.approx(report.shares["actions"], rel=0.05)
