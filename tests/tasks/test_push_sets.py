"""Push goal sets: block positions that every kind of robot can push across the line."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.goal_sets import draw_goals
from helpers.scenes import robot
from morphgen.benchmark.similarity import workspace
from morphgen.errors import BenchmarkError, TaskError
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import frame_pose, joint_limits
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.push.starts import (
    CLOSE,
    path_is_clear,
    push_region,
)
from morphgen.tasks.scenes import obstacles
from morphgen.tasks.scenes.obstacles import place_boxes
from morphgen.tasks.sim.base import Block, Scene

CONFIG = PushConfig(num_goals=5, train_layouts=3, eval_layouts=2)
ARMS = ("arm=ur5 ee=plane", "arm=panda ee=panda_hand", "arm=arm3 ee=claw")
FREE = ("prims", "cubes", "chain beads=3")
SWEEPS = ("stick", "nlink")
SHORT = "stick beam.length=0.15"


def sample_starts(words, cache, *, config=CONFIG, obstacles=False, seed=0, ground=0.0):
    return draw_goals(
        robot(words), config, obstacles=obstacles, seed=seed, ground=ground, cache=cache
    )


def space_of(words, push_set, layout=None):
    boxes = () if layout is None else place_boxes(push_set.obstacles, push_set.layouts[layout])
    return FreeSpace(
        Scene(robot(words), block=push_set.block, obstacles=boxes, ground=push_set.ground)
    )


@pytest.mark.parametrize("words", [*ARMS, *FREE, *SWEEPS, SHORT])
@pytest.mark.parametrize("boxes", [False, True])
def test_every_block_can_be_pushed_across_the_line(words, boxes, cache):
    push_set = sample_starts(words, cache, obstacles=boxes)
    body, space = robot(words), space_of(words, push_set)
    edge, x, y = push_set.block.size[0], *push_set.blocks[:, :2].T
    assert len(push_set.obstacles) == (3 if boxes else 0)
    assert push_set.usable.shape == ((5, 5) if boxes else (0, 5))
    for layout, usable in enumerate(push_set.usable):
        among = space_of(words, push_set, layout)
        assert usable.sum() >= 2
        assert path_is_clear(among, push_set.line, push_set.blocks[usable]).all()
        for q in (push_set.q, push_set.behind):
            assert among.free(q[usable], push_set.blocks[usable]).all()
        assert among.free(push_set.across[usable]).all()
    assert 5 == push_set.accepted == len(push_set.q) <= push_set.tried
    assert push_set.blocks[:, 2] == pytest.approx(edge / 2)
    assert np.linalg.norm(push_set.blocks[:, 3:], axis=1) == pytest.approx(1.0)
    assert ((-0.2 * push_set.scale <= y) & (y <= -0.15 * push_set.scale)).all()
    assert push_set.line == pytest.approx(0.2 * push_set.scale)
    for q in (push_set.q, push_set.behind, push_set.across):
        assert ((q >= joint_limits(body)[:, 0]) & (q <= joint_limits(body)[:, 1])).all()
    assert space.free(push_set.q, push_set.blocks).all()
    assert space.free(push_set.behind, push_set.blocks).all()
    assert space.free(push_set.across).all()
    behind, across = (frame_pose(body, q)[:, :3, 3] for q in (push_set.behind, push_set.across))
    assert (behind[:, 1] < y - edge / 2).all()
    assert np.abs(behind[:, 0] - x).max() < CLOSE
    assert np.abs(across[:, :2] - np.column_stack([x, np.full(5, push_set.line)])).max() < CLOSE
    for tools in (behind, across):
        assert ((tools[:, 2] > 0) & (tools[:, 2] < edge)).all()
    for share in np.linspace(0, 1, 9):
        on_its_way = push_set.blocks.copy()
        on_its_way[:, 1] += share * (push_set.line - y)
        assert space.block_is_clear(on_its_way).all()


@pytest.mark.parametrize("words", ARMS)
def test_arm_block_distance_scales_with_effective_reach(words, cache):
    push_set, work = sample_starts(words, cache), workspace(robot(words))
    edge = push_set.block.size[0]
    reach = np.sqrt(work.reach**2 - (work.shoulder[2] - edge / 2) ** 2)
    assert 0.15 * reach <= edge <= 0.2 * reach
    x = push_set.blocks[:, 0] - work.shoulder[0]
    assert ((0.4 * reach <= x) & (x <= 0.6 * reach)).all()
    assert push_set.scale == 1


@pytest.mark.parametrize("words", FREE)
def test_mobile_bases_have_the_block_at_a_fixed_distance(words, cache):
    push_set = sample_starts(words, cache)
    assert 0.15 <= push_set.block.size[0] <= 0.2
    assert (np.abs(push_set.blocks[:, 0]) <= 0.2).all()
    assert push_set.scale == 1


def test_short_robots_have_a_scaled_down_push_region(cache):
    """A 0.15 m rod with a 0.03 m ball swings on a slide."""
    push_set = sample_starts(SHORT, cache)
    assert push_set.scale == pytest.approx(0.18 / np.sqrt(2) / 0.4, rel=0.2)
    assert 0.15 * push_set.scale <= push_set.block.size[0] <= 0.2 * push_set.scale
    assert push_set.line == pytest.approx(0.2 * push_set.scale)


def test_block_matches_the_config(cache):
    config = replace(CONFIG, block_mass=0.3, friction=0.6, line=0.1, start=-0.1, start_depth=0.0)
    push_set = sample_starts("prims", cache, config=config)
    assert (push_set.block.mass, push_set.block.friction, push_set.line) == (0.3, 0.6, 0.1)
    assert push_set.blocks[:, 1] == pytest.approx(-0.1)
    x, y, z, *turn = push_set.blocks[0].tolist()
    assert push_set.block.pose == Pose((x, y, z), tuple(turn))


def test_block_positions_and_orientations_are_random(cache):
    push_set = sample_starts("prims", cache, config=replace(CONFIG, num_goals=60))
    assert np.histogram(push_set.blocks[:, 0], 3, (-0.2, 0.2))[0] == pytest.approx(20, abs=12)
    yaw = 2 * np.arctan2(push_set.blocks[:, 6], push_set.blocks[:, 3])
    assert np.histogram(yaw, 3, (-np.pi, np.pi))[0] == pytest.approx(20, abs=12)


def test_robot_that_cannot_push_is_rejected_with_the_reason(tmp_path):
    cache = tmp_path / "pushes"
    with pytest.raises(
        TaskError, match=r"'cartpole.*' cannot push: its tool does not move along y"
    ):
        sample_starts("cartpole", cache)
    with pytest.raises(TaskError, match="'prims' can hardly push: only 0 of 150 poses") as caught:
        sample_starts("prims", cache, config=replace(CONFIG, start=-0.9))
    assert "acceptance rate 0), 5 are needed; the tool does not get behind it (100%)" in str(
        caught.value
    )
    with pytest.raises(TaskError, match="its tool does not get down to the ground"):
        push_region(robot(ARMS[0]), CONFIG, -3.0, np.random.default_rng(0))
    with pytest.raises(TaskError, match="its tool is never as low as a block"):
        push_region(robot("nlink"), CONFIG, -0.5, np.random.default_rng(0))
    assert not cache.exists()


def test_obstacles_that_block_every_push_are_an_error(tmp_path, monkeypatch):
    def wall(*_):
        return (Block((9.0, 0.1, 0.1)),)

    def across_the_way(*_):
        return np.array([[0.0, 0.1, 0.05, 1.0, 0.0, 0.0, 0.0]])

    monkeypatch.setattr(obstacles, "draw_boxes", wall)
    monkeypatch.setattr(obstacles, "_draw_poses", across_the_way)
    with pytest.raises(BenchmarkError, match="of its first 20 goals only 0 or fewer: take"):
        sample_starts("prims", tmp_path, obstacles=True)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"num_goals": 0}, "PushConfig: num_goals 0: expected an integer >= 1"),
        ({"block_size": (0.2, 0.1)}, "a block of 0.2 to 0.1"),
        ({"start": 0.3}, "is to cross 0.2: sizes must be positive, and the start"),
        ({"line": -0.3}, "starts 0.05 below -0.15 and is to cross -0.3"),
    ],
)
def test_invalid_constants_are_rejected(changes, text, cache):
    with pytest.raises((TaskError, BenchmarkError), match=text):
        sample_starts("prims", cache, config=replace(CONFIG, **changes))
    with pytest.raises(BenchmarkError, match="with seed -1"):
        sample_starts("prims", cache, seed=-1)
