"""Tables of robots, names of robots, actions, rewards, checks of tasks, and speed."""

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import morphgen
from helpers.robots import arm
from helpers.scenes import reset_envs, robot
from helpers.splits import member, split
from morphgen.encoding.robot_hash import robot_hash
from morphgen.encoding.tokens import tokens
from morphgen.errors import (
    CompositionError,
    FormatError,
    PartError,
    RobotError,
    TaskError,
)
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar.library import default_library
from morphgen.model.kinematics import random_configurations
from morphgen.model.kinematics_torch import matrix_from_quaternion
from morphgen.model.robot import Frame, Link, Robot
from morphgen.rl.config import PPOConfig
from morphgen.rl.runs.checkpoint import config_from
from morphgen.tasks.actions import ActionDecoder, JointMotion
from morphgen.tasks.configs import PushConfig, ReachConfig
from morphgen.tasks.gym.vector import TaskVector
from morphgen.tasks.observation import LinkTokens
from morphgen.tasks.push.envs import PushFormulas, curriculum_part, moving_result
from morphgen.tasks.reach.envs import ReachEnvs, ReachFormulas
from morphgen.tasks.reach.task import Reach
from morphgen.tasks.registry import TASKS
from morphgen.tasks.rows import limit_violation, numpy_row, positive_part
from morphgen.tasks.scenes.env_specs import load_robot
from morphgen.tasks.scenes.make import make_batch, make_split_batch
from morphgen.tasks.scenes.robot_tables import STEP_SLIDE, STEP_TURN, build_robot_tables
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.task import GOAL, ObservationField, Task, TaskState

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("actions", "kind", "words"),
    [
        (torch.zeros(1, 3), "continuous", r"shape \(1, 3\); expected \(1, 2\)"),
        (torch.tensor([[0.0, np.nan]]), "continuous", "environment 0, link 1 is not finite"),
        (torch.tensor([[0, 11]]), "discrete", "environment 0, link 1: .* 0 to 10"),
        (torch.tensor([[0, -1]]), "discrete", "from 0 to 10"),
        (torch.tensor([[0.0, 1.0]]), "discrete", "integers from 0"),
        (torch.tensor([[0.0, 1.0]], dtype=torch.float16), "discrete", "integers from 0"),
    ],
)
def test_invalid_actions_are_rejected_and_others_clipped(actions, kind, words):
    decoders = {name: ActionDecoder(name, CPU) for name in ("continuous", "discrete")}
    numbers = decoders["continuous"](torch.tensor([[2.0, -0.5]]), (1, 2))
    assert numbers.tolist() == [[1.0, -0.5]]
    numbers = decoders["discrete"](torch.tensor([[0, 5, 10]]), (1, 3))
    assert numbers.tolist() == [[-1.0, 0.0, 1.0]]
    with pytest.raises(TaskError, match=words):
        decoders[kind](actions, (1, 2))


@pytest.mark.parametrize("dtype", ["uint8", "int8", "int16", "int32", "int64"])
def test_discrete_actions_are_integers_of_any_size(dtype):
    decode = ActionDecoder("discrete", CPU)
    actions = torch.tensor([[0, 5, 10]], dtype=getattr(torch, dtype))
    assert decode(actions, (1, 3)).tolist() == [[-1.0, 0.0, 1.0]]
    assert numpy_row(decode)(actions[0].numpy(), (3,)).tolist() == [-1.0, 0.0, 1.0]
    with pytest.raises(TaskError, match="integers from 0 to 10"):
        numpy_row(decode)(np.zeros(3, np.float16), (3,))


@pytest.mark.parametrize("value", [-1.0, 0.0, 2.0, np.nan])
def test_the_positive_part_is_the_same_in_numpy(value):
    batch = positive_part(torch.tensor([value]))[0].item()
    np.testing.assert_equal(float(positive_part(np.float32(value))), batch)


def test_targets_stay_within_limits_and_masked_links_do_not_move(robot_tables):
    body = torch.tensor([1])
    mask = robot_tables.action_mask(fingers=False)[body]
    motion = JointMotion(robot_tables, body)
    home, upper, moved = robot_tables.home[1], robot_tables.upper[1], robot_tables.moves_tool[1]
    motion.targets.copy_(home)
    motion.act(0.5 * mask)
    half = torch.minimum(home + robot_tables.max_step[1] / 2, upper)
    assert torch.equal(motion.targets[0], torch.where(moved, half, home))
    for _ in range(400):
        motion.act(1.0 * mask)
    assert torch.equal(motion.targets[0], torch.where(moved, upper, home))


def reached(config, distance, angle=None, violation=0.0, acceleration=0.0):
    """Return the results of tools at distances from their goals, and turned by angles about z."""
    n = len(distance)
    tool, rotation, numbers = torch.zeros(n, 3), torch.eye(3).repeat(n, 1, 1), torch.zeros(n)
    tool[:, 0] = distance
    if angle is not None:
        rotation[:, 0, 0] = rotation[:, 1, 1] = torch.cos(angle)
        rotation[:, 0, 1], rotation[:, 1, 0] = -torch.sin(angle), torch.sin(angle)
    state = TaskState(
        *(tool, torch.zeros(n, 7), numbers + violation, numbers + acceleration, numbers > 0),
        tool_rotation=None if angle is None else rotation,
    )
    goals = torch.eye(3).repeat(n, 1, 1) if config.goal == "pose" else None
    return ReachFormulas(config, torch.zeros(n, 7), goals).evaluate(state)


def test_reach_reward_terms():
    config = ReachConfig()
    distance = torch.tensor([0.029, 0.031])
    q = torch.tensor([[1.5, 0.0], [0.0, -2.5]])
    violation = limit_violation(q, torch.tensor([-1.0, -2.0]), torch.tensor([1.0, 2]))
    assert violation.tolist() == pytest.approx([0.5, 0.5])
    result = reached(config, distance, None, violation, torch.tensor([10.0, 0.0]))
    terms = result.terms
    assert terms["near"].tolist() == [config.near_weight, 0.0]
    assert terms["distance"].tolist() == pytest.approx([-0.029, -0.031])
    assert terms["joint_limits"].tolist() == pytest.approx([-0.5, -0.5])
    assert terms["joint_acceleration"].tolist() == pytest.approx([-1e-4, 0.0])
    assert result.score.tolist() == pytest.approx([200.0, -50 * 0.031**2])
    with pytest.raises(TaskError, match="without terms: expected at least one reward term"):
        replace(result, terms={})


def test_push_reward_terms():
    tool, zero = torch.tensor([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]]), torch.zeros(2)
    state = TaskState(tool, torch.zeros(2, 7), zero, zero, diverged=zero > 0)
    to_go, arrived = torch.tensor([0.0, 0.3]), torch.tensor([True, False])
    terms = moving_result(PushConfig(), state, to_go, arrived, torch.zeros(2, 3)).terms
    assert terms["success"].tolist() == [10.0, 0.0]
    assert terms["distance"].tolist() == pytest.approx([0.0, -0.3])
    assert terms["approach"].tolist() == pytest.approx([-0.05, -0.1])


def test_a_diverged_step_is_never_a_success():
    """Even with the tool at the goal and the block across the line."""
    tool, block, zero = torch.zeros(2, 3), torch.zeros(2, 7), torch.zeros(2)
    state = TaskState(tool, block, zero, zero, diverged=torch.tensor([False, True]))
    reached = ReachFormulas(ReachConfig(), torch.zeros(2, 7), None).evaluate(state)
    assert reached.success.tolist() == [True, False]
    lines = torch.tensor([-0.1, -0.1])
    pushed = PushFormulas(PushConfig(), lines, torch.zeros(2, 13)).evaluate(state)
    assert pushed.success.tolist() == pushed.terminated.tolist() == [True, False]
    assert pushed.score.tolist() == [1.0, 0.0]


def test_curriculum_grows_during_the_first_half_of_training():
    parts = [curriculum_part(PushConfig(), p / 100) for p in range(101)]
    assert parts[0] == pytest.approx(0.1)
    assert parts[:51] == sorted(set(parts))
    assert parts[50:] == [pytest.approx(1.0)] * 51


FOLDERS = default_library(()).folders
WORDS = ("arm=ur5 ee=plane", "arm=panda ee=panda_hand", "chain beads=2", "prims", "arm3")


@pytest.fixture(scope="module")
def robots():
    return [morphgen.compose(words) for words in WORDS]


@pytest.fixture(scope="module")
def robot_tables(robots):
    return build_robot_tables(robots, FOLDERS)


def test_position_codes_match_the_tokens(robots, robot_tables):
    rng = np.random.default_rng(0)
    for i, each in enumerate(robots):
        q = torch.zeros(4, robot_tables.max_joints)
        q[:, : each.dof] = torch.from_numpy(random_configurations(each, 4, rng))
        together, n = LinkTokens(robot_tables, torch.full((4,), i))(q), len(each.links)
        expected = tokens(each, token_shapes(each, FOLDERS), q[:, : each.dof].numpy())
        # The fastest sine has angular frequency 64 pi, which costs five digits in float32.
        assert together[:, :n].numpy() == pytest.approx(expected, abs=2e-4)
        assert (together[:, n:] == 0).all()


def test_masks_and_step_sizes_match_the_joints(robots, robot_tables):
    for i, each in enumerate(robots):
        links = torch.arange(robot_tables.max_links)
        assert torch.equal(robot_tables.link_mask[i], links < len(each.links))
        moved = [k + 1 for k in each.independent_joints]
        assert links[robot_tables.joint_of_link[i] >= 0].tolist() == moved
        for j, k in enumerate(each.independent_joints):
            joint = each.joints[k]
            most = STEP_SLIDE if joint.kind == "prismatic" else STEP_TURN
            expected = min(most, (joint.velocity or np.inf) * CONTROL_PERIOD)
            assert robot_tables.max_step[i, j] == pytest.approx(expected)
            limits = (float(robot_tables.lower[i, j]), float(robot_tables.upper[i, j]))
            assert limits == pytest.approx(joint.effective_limits)
        assert (robot_tables.max_step[i, each.dof :] == 0).all()


def test_fingers_are_actuated_in_push_but_not_in_reach(robots, robot_tables):
    panda = 1
    reach, push = (robot_tables.action_mask(fingers=fingers)[panda] for fingers in (False, True))
    names = [link.name for link in robots[panda].links]
    fingers = [names[i] for i in torch.nonzero(push & ~reach)[:, 0].tolist()]
    assert reach.sum() == 7
    assert fingers
    assert all("finger" in name for name in fingers)


def test_robots_without_a_tool_or_moving_joint_are_rejected():
    bare = Robot("r", (Link("a"),))
    with pytest.raises(RobotError, match="tool"):
        build_robot_tables([bare])
    with pytest.raises(RobotError, match="no joint moves"):
        build_robot_tables([replace(bare, frames=(Frame("tool", "a"),))])


POSITION = ReachConfig(num_goals=5, max_episode_steps=6)
POSE = replace(POSITION, goal="pose")


@pytest.fixture
def made(tmp_path, opened):
    def make(config, words=("arm3-stick",), n=4, task="reach", **options):
        given = {"cache": tmp_path, "configs": (config,), "sim": "mujoco", **options}
        batch = opened(make_batch(task, [robot(each) for each in words], n, **given))
        batch.reset()
        return batch

    return make


def test_success_needs_position_and_orientation():
    distance = torch.tensor([0.02, 0.02, 0.04, 0.04])
    angle = torch.tensor([9.0, 11.0, 9.0, 11.0]).deg2rad()
    assert reached(POSITION, distance).success.tolist() == [True, True, False, False]
    result = reached(POSE, distance, angle)
    assert result.success.tolist() == [True, False, False, False]
    expected = [200, -50 * 0.02**2, -50 * 0.04**2, -50 * 0.04**2]
    assert result.score.tolist() == pytest.approx(expected)


def test_the_rotation_term_weighs_the_angle_as_the_distance_of_the_same_tolerance():
    config = replace(POSE, near=0.05, near_angle=0.25, rotation_weight=3.0)
    terms = reached(config, torch.tensor([0.05, 0.1]), torch.tensor([0.25, 0.5])).terms
    assert terms["rotation"].tolist() == pytest.approx([-0.15, -0.3])
    assert torch.allclose(terms["rotation"], 3 * terms["distance"])


def test_at_its_goals_configuration_a_robot_succeeds_and_elsewhere_the_angle_is_that_of_the_tool(
    made,
):
    batch = made(POSE)
    envs = batch.groups["reach"]
    goal_q = envs.goal_configuration.clone()
    reset_envs(batch.simulation, torch.arange(4), goal_q)
    batch.targets.copy_(goal_q)
    step = batch.step(torch.zeros(batch.action_mask.shape))
    assert step.success.all()
    assert (step.angle < math.radians(1)).all()
    assert torch.equal(envs.target_rotations(), matrix_from_quaternion(envs.goal[:, 3:]))


def test_goals_and_episodes_are_those_of_the_position(made):
    """Only the evaluation differs: the goal set has the same key, and physics does not change."""
    pose, position = made(POSE), made(POSITION)
    assert pose.specs[0].goals.key == position.specs[0].goals.key
    assert position.groups["reach"].target_rotations() is None
    for _ in range(3):
        actions = torch.rand(pose.action_mask.shape) * 2 - 1
        one, other = pose.step(actions), position.step(actions)
        assert torch.equal(one.q, other.q)
        assert torch.equal(one.distance, other.distance)
        assert other.angle is None
        assert "rotation" not in other.terms
        expected = other.reward - other.terms["near"] + one.terms["near"] + one.terms["rotation"]
        assert torch.allclose(one.reward, expected)
        assert (one.terms["near"] <= other.terms["near"]).all()


def test_in_a_batch_with_another_task_only_reach_has_angles(made):
    words, push = ("arm3-stick", "prims"), PushConfig(num_goals=3)
    batch = made(POSE, words, task=["reach", "push"], configs=(POSE, push))
    step = batch.step(torch.zeros(batch.action_mask.shape))
    assert torch.isfinite(step.angle).tolist() == [True, False, True, False]
    alone = made(POSE, words[:1], n=1)
    assert torch.equal(alone.step(torch.zeros(alone.action_mask.shape)).angle, step.angle[:1])
    vector = TaskVector(batch)
    vector.reset(seed=0)
    infos = vector.step(np.zeros(vector.action_space.shape, np.float32))[-1]
    assert (infos["angle"][::2] > 0).all()


EXTRA = ObservationField("extra", 1, GOAL.mask)


@dataclass(frozen=True)
class HoverConfig(ReachConfig):
    task = "hover"
    num_goals: int = 3


class HoverFormulas(ReachFormulas):
    """Formulas of reach with another field."""

    def observe(self, object_pose):
        return {**super().observe(object_pose), "extra": self._goal[..., :1]}


@pytest.fixture
def make(monkeypatch, tmp_path):
    """Return a function that makes two environments of a task with changed parts, and steps."""
    monkeypatch.setattr(TASKS, "_loaded", dict(TASKS._loaded))

    def step(
        fields=(GOAL, EXTRA),
        make_envs=True,
        sample=Reach.sample,
        begin=ReachEnvs.begin,
        **methods,
    ):
        def envs(*args):
            made = type("Envs", (ReachEnvs,), {"begin": begin})(*args)
            made.formulas.__class__ = type("Formulas", (HoverFormulas,), methods)
            return made

        parts = {"name": "hover", "config_type": HoverConfig, "fields": fields, "sample": sample}
        parts["make_envs"] = lambda self, *args: envs(*args) if make_envs else None
        TASKS.register(type("Hover", (Reach,), parts)())
        batch = make_batch("hover", ["gantry-plane"], 2, sim="kinematic", cache=tmp_path)
        batch.reset()
        return batch.step(torch.zeros(batch.action_mask.shape))

    return step


def changed(**changes):
    """Return ``evaluate`` with parts of the result changed by functions of them."""

    def evaluate(self, state):
        result = ReachFormulas.evaluate(self, state)
        return replace(result, **{key: new(getattr(result, key)) for key, new in changes.items()})

    return {"evaluate": evaluate}


def test_a_sound_task_is_stepped(make):
    assert make().final_observation["extra"].shape == (2, 1)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"make_envs": None}, "NoneType has no `formulas`; expected StepFormulas"),
        (
            {"begin": lambda *_: (torch.zeros(2, 1), torch.zeros(2, 7))},
            r"begin: the joint positions has shape \(2, 1\); expected \(2, 5\)",
        ),
        (
            changed(terms=lambda terms: {"a": next(iter(terms.values())).mean()}),
            r"evaluate: the reward term 'a' has shape \(\); expected \(2,\)",
        ),
        ({"observe": ReachFormulas.observe}, "observe returned goal; expected .*: goal, extra"),
        ({"fields": (GOAL,)}, "observe returned goal, extra; expected the task's `fields`: goal"),
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
    ],
)
def test_an_incomplete_task_is_not_registered(monkeypatch, parts, message):
    monkeypatch.setattr(TASKS, "_loaded", dict(TASKS._loaded))
    copied = ("goal_set_type", "goal_format", "fields", "sample", "certify", "make_envs")
    whole = {"name": "hover", "config_type": HoverConfig, "cache_folder": "hover"}
    whole |= {name: getattr(Reach, name) for name in copied}
    parts = {name: part for name, part in {**whole, **parts}.items() if part}
    with pytest.raises(TaskError, match=f"task {message}"):
        TASKS.register(type("Hover", (Task,), parts)())
    assert parts["name"] not in TASKS


def test_a_run_of_an_unknown_task_is_named():
    data = {"source": {}, "policy": {}, "ppo": vars(PPOConfig()), "hover": {"near": 0.1}}
    with pytest.raises(TaskError, match="run: unknown task 'hover'; run the script that registers"):
        config_from(data)


WORDS_ONE_ROBOT = "arm=ur5 ee=stick"
CONFIG = ReachConfig(num_goals=4, train_layouts=2, eval_layouts=1)
STEPS = 40
NAMES = ("words", "bundle", "urdf", "robot", "read", "primitives", "bundle of primitives", "member")


@pytest.fixture(scope="module")
def named(tmp_path_factory):
    """The robot under every name except that of a split member."""
    folder = tmp_path_factory.mktemp("robots")
    robot = morphgen.compose(WORDS_ONE_ROBOT)
    primitives = morphgen.compose(WORDS_ONE_ROBOT, name="primitives", geometry="primitive")
    bundle = morphgen.write(robot, folder, picture=False)
    return {
        "words": WORDS_ONE_ROBOT,
        "bundle": bundle,
        "urdf": str(bundle / "robot.urdf"),
        "robot": robot,
        "read": morphgen.read(bundle),
        "primitives": primitives,
        "bundle of primitives": morphgen.write(primitives, folder, picture=False),
    }


@pytest.fixture(scope="module")
def batches(named, tmp_path_factory):
    """One environment per name, with freshly sampled goals."""

    def options():
        cache = tmp_path_factory.mktemp("goals")
        return {"sim": "mujoco", "seed": 0, "configs": (CONFIG,), "cache": cache}

    made = {
        name: make_batch("reach", [robot], 1, obstacles=True, **options())
        for name, robot in named.items()
    }
    train = member(WORDS_ONE_ROBOT, task="reach", obstacles=True)
    of_split = split([train], [member("prims", task="reach")])
    made["member"] = make_split_batch(of_split, "train", 1, **options())
    yield made
    for batch in made.values():
        batch.close()


@pytest.mark.parametrize("name", NAMES)
def test_shapes_goals_and_scores_are_the_same(batches, name):
    batch, reference = batches[name], batches["words"]
    robot, expected = (each.specs[0].robot for each in (batch, reference))
    assert [link.collisions for link in robot.links] == [link.collisions for link in expected.links]
    for part in ("joints", "home", "ignore_pairs"):
        assert getattr(robot, part) == getattr(expected, part)
    assert robot_hash(robot, visuals=False) == robot_hash(expected, visuals=False)
    bare = robot.with_links([replace(link, visuals=()) for link in robot.links])
    assert robot_hash(bare, visuals=False) == robot_hash(robot, visuals=False)
    assert robot_hash(bare) != robot_hash(robot)
    assert (batch.robot_tables.tokens == reference.robot_tables.tokens).all()
    goals, expected = (each.specs[0].goals for each in (batch, reference))
    for part in ("key", "tried", "obstacles"):
        assert getattr(goals, part) == getattr(expected, part)
    np.testing.assert_array_equal(goals.q, expected.q)
    np.testing.assert_array_equal(goals.poses, expected.poses)
    rewards = rewards_of(batch)
    assert rewards == rewards_of(reference)
    assert len(set(rewards)) > STEPS / 2


def rewards_of(batch):
    """Return the rewards of all steps, for the same actions."""
    rng = np.random.default_rng(0)
    batch.reset(0)
    actions = [batch.action_mask * float(rng.uniform(-1, 1)) for _ in range(STEPS)]
    return [float(batch.step(action).reward[0]) for action in actions]


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
    found, expected = load_robot(given), morphgen.compose(words, geometry="primitive")
    assert (found.name, robot_hash(found)) == (expected.name, robot_hash(expected))


def test_robot_files_are_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = morphgen.write(arm(), "bundles", picture=False)
    Path("lr=3").mkdir()
    for path in ("own.urdf", "lr=3/own.urdf"):
        Path(path).write_text(urdf_text(arm(), str))
    for given in (
        folder,
        str(folder),
        "bundles/arm",
        "own.urdf",
        Path("own.urdf"),
        "lr=3/own.urdf",
    ):
        assert load_robot(given).dof == arm().dof
        assert load_robot(given).frame("tool")


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
    with pytest.raises(error, match=re.escape(says)):
        load_robot(given)
