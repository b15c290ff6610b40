"""Push goal sets: block positions that every kind of robot can push across the line."""

from dataclasses import fields, replace

import numpy as np
import pytest

from helpers.goal_sets import draw_goals
from helpers.scenes import robot
from morphgen.benchmark.workspace import workspace
from morphgen.errors import BenchmarkError, TaskError
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import frame_pose, joint_limits
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.push import starts as module
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.push.starts import (
    CLOSE,
    PushStartSet,
    effective_reach,
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


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "pushes"


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


def test_effective_reach_follows_the_right_triangle():
    reach, height, share = 1.0, 0.4, 0.2
    e = effective_reach(reach, height, share)
    assert np.hypot(e, height - share * e / 2) == pytest.approx(reach)
    assert e > np.sqrt(reach**2 - height**2)
    assert effective_reach(1.0, 0.0, 1e-9) == pytest.approx(1.0)
    assert effective_reach(1.0, 1.5, 0.2) == 0


def test_ground_may_be_below_the_base(cache):
    words = "arm=panda ee=panda_hand"
    push_set = sample_starts(words, cache, ground=-0.05)
    assert push_set.ground == -0.05
    assert push_set.blocks[:, 2] == pytest.approx(push_set.block.size[0] / 2 - 0.05)
    assert push_set.key != sample_starts(words, cache).key


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


@pytest.mark.slow
def test_smaller_sets_are_prefixes_of_larger_ones(cache):
    few = sample_starts("arm=ur5 ee=plane", cache)
    more = sample_starts("arm=ur5 ee=plane", cache, config=replace(CONFIG, num_goals=40))
    for name in ("q", "blocks", "behind", "across"):
        assert (getattr(more, name)[:5] == getattr(few, name)).all()


def test_stored_set_equals_the_sampled_set(cache, monkeypatch):
    fresh = sample_starts("prims", cache, obstacles=True)

    def forbidden(*_):
        raise AssertionError("it was made again")

    monkeypatch.setattr(module, "FreeSpace", forbidden)
    stored = sample_starts("prims", cache, obstacles=True)
    for field in fields(PushStartSet):
        a, b = getattr(stored, field.name), getattr(fresh, field.name)
        assert np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b


def test_same_seed_gives_the_same_bytes(tmp_path):
    for folder in ("here", "there"):
        sample_starts("prims", tmp_path / folder, obstacles=True)
    files = [list((tmp_path / folder).iterdir()) for folder in ("here", "there")]
    assert [path.name for path in files[0]] == [path.name for path in files[1]]
    assert files[0][0].read_bytes() == files[1][0].read_bytes()


@pytest.mark.slow
def test_cache_key_depends_on_exactly_the_relevant_inputs(cache):
    base = {"config": CONFIG}
    changes = [
        base,
        {"config": replace(CONFIG, num_goals=6)},
        {"config": replace(CONFIG, start_depth=0.01)},
        {"config": replace(CONFIG, block_size=(0.15, 0.16))},
        {"config": replace(CONFIG, block_mass=0.2)},
        {"config": replace(CONFIG, free_x=(-0.1, 0.1))},
        {**base, "seed": 1},
        {**base, "obstacles": True},
    ]
    keys = [sample_starts("prims", cache, **change).key for change in changes]
    assert len(set(keys)) == len(keys)
    same = replace(CONFIG, max_episode_steps=5, success_weight=3.0, curriculum_steps=2, obstacles=9)
    other = replace(robot("prims"), name="other")
    push_set = draw_goals(other, same, obstacles=False, seed=0, cache=cache)
    assert (push_set.key, push_set.robot) == (keys[0], "other")


def test_robot_that_cannot_push_is_rejected_with_the_reason(cache):
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


def test_obstacles_that_block_every_push_are_an_error(cache, monkeypatch):
    def wall(*_):
        return (Block((9.0, 0.1, 0.1)),)

    def across_the_way(*_):
        return np.array([[0.0, 0.1, 0.05, 1.0, 0.0, 0.0, 0.0]])

    monkeypatch.setattr(obstacles, "draw_boxes", wall)
    monkeypatch.setattr(obstacles, "_draw_poses", across_the_way)
    with pytest.raises(BenchmarkError, match="of its first 20 goals only 0 or fewer: take"):
        sample_starts("prims", cache, obstacles=True)


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


def test_broken_or_renamed_file_is_named(cache):
    first, second = sample_starts("prims", cache), sample_starts("prims", cache, seed=1)
    paths = [cache / f"{each.key}.npz" for each in (first, second)]
    paths[1].write_bytes(paths[0].read_bytes())
    with pytest.raises(TaskError, match=f"its key is {first.key}, not"):
        sample_starts("prims", cache, seed=1)
    paths[0].write_bytes(paths[0].read_bytes()[:-100])
    with pytest.raises(TaskError, match=f"{paths[0].name}: not a PushStartSet: .*; delete it"):
        sample_starts("prims", cache)


def test_unwritable_cache_is_a_warning(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.warns(UserWarning, match="cannot store a PushStartSet"):
        push_set = sample_starts("prims", tmp_path / "file" / "pushes")
    assert len(push_set.q) == 5
