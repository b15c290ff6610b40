"""One robot has the same shapes, key, goals and score however it is named."""

from dataclasses import replace

import numpy as np
import pytest

import morphgen
from helpers.splits import member, split
from morphgen.benchmark.robot_hash import robot_hash
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.env_specs import load_robot
from morphgen.tasks.scenes.make import make_batch, make_split_batch

WORDS = "arm=ur5 ee=stick"
CONFIG = ReachConfig(num_goals=4)
STEPS = 40
NAMES = ("words", "bundle", "urdf", "robot", "read", "primitives", "bundle of primitives", "member")


@pytest.fixture(scope="module")
def named(tmp_path_factory):
    """The robot under every name except that of a split member."""
    folder = tmp_path_factory.mktemp("robots")
    robot = morphgen.compose(WORDS)
    primitives = morphgen.compose(WORDS, name="primitives", geometry="primitive")
    bundle = morphgen.write(robot, folder, picture=False)
    other = morphgen.write(primitives, folder, picture=False)
    return {
        "words": WORDS,
        "bundle": bundle,
        "urdf": str(bundle / "robot.urdf"),
        "robot": robot,
        "read": morphgen.read(bundle),
        "primitives": primitives,
        "bundle of primitives": other,
    }


@pytest.fixture(scope="module")
def batches(named, tmp_path_factory):
    """One environment per name, with freshly sampled goals."""

    def options(name):
        cache = tmp_path_factory.mktemp(name.replace(" ", "-"))
        return {"sim": "mujoco", "seed": 0, "configs": (CONFIG,), "cache": cache}

    made = {
        name: make_batch("reach", [robot], 1, obstacles=True, **options(name))
        for name, robot in named.items()
    }
    one = split([member(WORDS, task="reach", obstacles=True)], [member("prims", task="reach")])
    made["member"] = make_split_batch(one, "train", 1, **options("member"))
    yield made
    for batch in made.values():
        batch.close()


@pytest.fixture(scope="module")
def scores(batches):
    """Return the rewards of all steps by name, for the same actions."""
    rewards = {}
    for name, batch in batches.items():
        rng = np.random.default_rng(0)
        batch.reset(0)
        rewards[name] = [
            float(batch.step(batch.action_mask * float(rng.uniform(-1, 1))).reward[0])
            for _ in range(STEPS)
        ]
    return rewards


@pytest.mark.parametrize("name", NAMES)
def test_shapes_and_key_are_the_same(batches, name):
    reference, other = (batches[each].specs[0].robot for each in ("words", name))
    assert [link.collisions for link in other.links] == [
        link.collisions for link in reference.links
    ]
    assert other.joints == reference.joints
    assert other.home == reference.home
    assert other.ignore_pairs == reference.ignore_pairs
    assert robot_hash(other, visuals=False) == robot_hash(reference, visuals=False)


@pytest.mark.parametrize("name", NAMES)
def test_goals_are_the_same(batches, name):
    reference, other = (batches[each].specs[0].goals for each in ("words", name))
    assert other.key == reference.key
    assert other.tried == reference.tried
    assert other.obstacles == reference.obstacles
    np.testing.assert_array_equal(other.q, reference.q)
    np.testing.assert_array_equal(other.poses, reference.poses)


@pytest.mark.parametrize("name", NAMES)
def test_tokens_are_the_same(batches, name):
    reference, other = (batches[each].robot_tables.tokens for each in ("words", name))
    assert (other == reference).all()


@pytest.mark.parametrize("name", NAMES)
def test_scores_are_the_same(scores, name):
    assert scores[name] == scores["words"]
    assert len(set(scores[name])) > STEPS / 2


def test_visuals_do_not_change_the_simulation_hash():
    robot = load_robot("arm=ur5 ee=stick")
    bare = robot.with_links([replace(link, visuals=()) for link in robot.links])
    assert robot_hash(bare, visuals=False) == robot_hash(robot, visuals=False)
    assert robot_hash(bare) != robot_hash(robot)


def test_loading_a_robot_twice_changes_nothing():
    once = load_robot("arm=ur5 ee=stick")
    twice = load_robot(once)
    assert [link.collisions for link in twice.links] == [link.collisions for link in once.links]
    assert twice.fits == once.fits
    assert twice.ignore_pairs == once.ignore_pairs
