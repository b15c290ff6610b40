"""Ways to name a robot, which has the same shapes, goals and score in each; its meshes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import morphgen
from helpers.robots import arm
from helpers.scenes import robot
from helpers.splits import member, split
from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import CompositionError, FormatError, PartError, TaskError
from morphgen.formats.fits import has_meshes
from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar.library import default_library
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.env_specs import load_robot
from morphgen.tasks.scenes.make import make_batch, make_split_batch, with_geometry
from morphgen.tasks.sim.base import Scene

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


@pytest.mark.parametrize("name", NAMES)
def test_shapes_goals_and_scores_are_the_same(batches, name):
    reference, other = (batches[each].specs[0].robot for each in ("words", name))
    assert [link.collisions for link in other.links] == [
        link.collisions for link in reference.links
    ]
    assert other.joints == reference.joints
    assert other.home == reference.home
    assert other.ignore_pairs == reference.ignore_pairs
    assert robot_hash(other, visuals=False) == robot_hash(reference, visuals=False)
    assert (batches[name].robot_tables.tokens == batches["words"].robot_tables.tokens).all()
    reference, other = (batches[each].specs[0].goals for each in ("words", name))
    assert (other.key, other.tried) == (reference.key, reference.tried)
    assert other.obstacles == reference.obstacles
    np.testing.assert_array_equal(other.q, reference.q)
    np.testing.assert_array_equal(other.poses, reference.poses)
    rewards, expected = (rewards_of(batches[each]) for each in (name, "words"))
    assert rewards == expected
    assert len(set(rewards)) > STEPS / 2


def rewards_of(batch):
    """Return the rewards of all steps, for the same actions."""
    rng = np.random.default_rng(0)
    batch.reset(0)
    actions = [batch.action_mask * float(rng.uniform(-1, 1)) for _ in range(STEPS)]
    return [float(batch.step(action).reward[0]) for action in actions]


def test_visuals_do_not_change_the_simulation_hash():
    robot = load_robot("arm=ur5 ee=stick")
    bare = robot.with_links([replace(link, visuals=()) for link in robot.links])
    assert robot_hash(bare, visuals=False) == robot_hash(robot, visuals=False)
    assert robot_hash(bare) != robot_hash(robot)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("gantry-cube", "base=gantry ee=cube"),
        ("pedestal-arm3-stick", "base=pedestal arm=arm3 ee=stick"),
        ("chain beads=4", "chain beads=4"),
        ("arm=arm3 ee=stick ee.length=0.3", "arm=arm3 ee=stick ee.length=0.3"),
    ],
)
def test_names_are_compose_arguments(given, words):
    expected = morphgen.compose(words, geometry="primitive")
    assert load_robot(given).name == expected.name
    assert robot_hash(load_robot(given)) == robot_hash(expected)


def test_collision_shapes_are_primitives_by_default():
    for given, expected in (({}, False), ({"geometry": "mesh"}, True)):
        links = load_robot("ur5-plane", **given).links
        assert any(has_meshes(link.collisions) for link in links) is expected


def test_robot_files_are_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = morphgen.write(arm(), "bundles", picture=False)
    Path("own.urdf").write_text(urdf_text(arm(), str))
    for given in (folder, str(folder), "bundles/arm", "own.urdf", Path("own.urdf")):
        assert load_robot(given).dof == arm().dof
        assert load_robot(given).frame("tool")
    Path("lr=3").mkdir()
    Path("own.urdf").rename("lr=3/own.urdf")
    assert load_robot("lr=3/own.urdf").dof == arm().dof


def test_folder_that_is_not_a_bundle_does_not_hide_a_grammar(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("prims").mkdir()
    assert load_robot("prims").name == "prims"


@pytest.mark.parametrize(
    ("given", "error", "says"),
    [
        ("ur5-plain", CompositionError, "'plain' is not a part; did you mean 'plane'?"),
        ("chian beads=4", CompositionError, "did you mean 'chain'?"),
        ("bead", CompositionError, "'bead' is a segment, which only a grammar can use"),
        ("ur5-ur10", CompositionError, "arm is given twice: ur5 and ur10"),
        ("arm=ur5 ee=plain", PartError, "did you mean 'plane'?"),
        ("robots/missing", FormatError, "robots/missing: no such file"),
        (Path("missing"), FormatError, "missing: no such file"),
        (" ", CompositionError, "no robot is named"),
    ],
)
def test_unknown_name_suggests_the_nearest(given, error, says):
    with pytest.raises(error) as caught:
        load_robot(given)
    assert says in str(caught.value)


PANDA = "arm=panda ee=panda_hand"


def test_unknown_and_unused_geometries_are_refused():
    with pytest.raises(TaskError, match="geometry 'hull'; valid: convex, primitive"):
        make_batch("reach", ["arm3"], 1, sim="mujoco", geometry="hull")
    with pytest.raises(TaskError, match="'convex': simulator 'kinematic' has no contacts"):
        make_batch("reach", ["arm3"], 1, sim="kinematic", geometry="convex")


def test_convex_robots_collide_as_their_meshes():
    batches = [
        make_batch("push", [PANDA], 2, sim="mujoco", geometry=geometry, seed=4)
        for geometry in ("primitive", "convex")
    ]
    first, other = (batch.reset() for batch in batches)
    assert all(torch.equal(first[name], other[name]) for name in first)
    simulated = batches[1].simulation.scenes[0].robot
    assert batches[1].specs[0].robot.links == batches[0].specs[0].robot.links != simulated.links
    meshed = [link for link in simulated.links if has_meshes(link.collisions)]
    assert len(meshed) == 9  # the Panda's meshes are convex, so each is its own piece
    assert simulated.joints == batches[0].specs[0].robot.joints


def test_convex_pieces_need_the_meshes():
    composed = robot(PANDA)
    stranger = replace(composed, provenance={})
    with pytest.raises(TaskError, match="'convex' needs its meshes"):
        with_geometry([Scene(stranger)], "convex")
    changed = replace(composed.joints[0], name="renamed")
    with pytest.raises(TaskError, match="'convex' needs its meshes"):
        with_geometry(
            [Scene(replace(composed, joints=(changed, *composed.joints[1:])))],
            "convex",
            default_library().folders,
        )
    simple = robot("prims")
    assert with_geometry([Scene(simple)], "convex")[0].robot is simple
