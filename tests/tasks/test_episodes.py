"""Episodes of a batch, and their random numbers."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.device_reads import device_reads
from helpers.goal_sets import draw_spec
from helpers.scenes import robot
from morphgen.errors import TaskError
from morphgen.rl.baselines import reach as reach_baselines
from morphgen.rl.baselines.reach import InverseKinematics, Random, Zero
from morphgen.rl.inference import STEPS_UNREAD, run_episodes
from morphgen.tasks.actions import BINS, encode_actions
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.configs import PushConfig, ReachConfig
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.observation import NOISE, ObservationConfig, observation_config
from morphgen.tasks.random_numbers import EpisodeRandom, EpisodeSequence, Stream, philox
from morphgen.tasks.registry import CHANNELS as CHANNELS_BY_NAME
from morphgen.tasks.renderer import render_state
from morphgen.tasks.scenes.make import batch_from_specs, make_batch
from morphgen.tasks.scenes.robot_tables import build_robot_tables
from morphgen.tasks.sim import base

REACH = ReachConfig(num_goals=6, max_episode_steps=9, train_layouts=3, eval_layouts=1)
PUSH = PushConfig(num_goals=6, max_episode_steps=11, train_layouts=3, eval_layouts=1)
POSE = replace(REACH, goal="pose")
CHANNELS = replace(
    observation_config({*CHANNELS_BY_NAME} - {"ik", "points", "no_state"}), tool=True, points=12
)
"""All channels but ``ik``, which plans on the CPU."""
BOUND = 6.0
"""Largest accepted deviation [standard deviations]."""


@pytest.fixture(scope="module")
def specs(cache):
    arm, gantry = robot("arm3"), robot("prims")
    among = {"obstacles": True, "cache": cache}
    return {
        "reach": draw_spec(arm, REACH, cache=cache),
        "reach among obstacles": draw_spec(arm, REACH, **among),
        "pose": draw_spec(arm, POSE, **among),
        "push": draw_spec(gantry, PUSH, cache=cache),
        "push among obstacles": draw_spec(gantry, PUSH, **among),
    }


class StubSimulation:
    """Joints are at their targets after a step, and blocks move along y.

    ``diverges`` tells the environments that diverge in the next step.
    """

    def __init__(self, scenes, speed=0.05):
        self.scenes, self.device, self.speed = tuple(scenes), torch.device("cpu"), speed
        n, joints = len(scenes), max(scene.robot.dof for scene in scenes)
        self.q, self.qd = torch.zeros(n, joints), torch.zeros(n, joints)
        self.object_pose, self.object_velocity = torch.zeros(n, 7), torch.zeros(n, 6)
        num_obstacles = max(len(scene.obstacles) for scene in scenes)
        self.obstacle_poses = torch.zeros(n, num_obstacles, 7)
        self.has_block = torch.tensor([scene.block is not None for scene in scenes])
        self.diverges = torch.zeros(n, dtype=torch.bool)
        self.resets = torch.zeros(n, dtype=torch.int64)

    def reset(self, mask, q, object_pose, obstacle_poses=None):
        self.q.copy_(torch.where(mask[:, None], q, self.q))
        self.qd.masked_fill_(mask[:, None], 0)
        self.object_pose.copy_(torch.where(mask[:, None], object_pose, self.object_pose))
        if obstacle_poses is not None:
            moved = torch.where(mask[:, None, None], obstacle_poses, self.obstacle_poses)
            self.obstacle_poses.copy_(moved)
        self.resets += mask

    def step(self, targets):
        self.qd.copy_(targets - self.q)
        self.q.copy_(torch.where(self.diverges[:, None], torch.nan, targets))
        self.object_pose[:, 1] += self.speed * self.has_block
        diverged = self.diverges.clone()
        self.diverges.zero_()
        return diverged

    def close(self):
        pass


def stub_batch(specs, names, num_envs, *, first=0, **options):
    chosen = [specs[name] for name in names]
    index = [(first + i) % len(chosen) for i in range(num_envs)]
    simulation = StubSimulation([chosen[i].scene for i in index])
    tables = build_robot_tables([spec.robot for spec in chosen], (), max_links=23)
    return TaskBatch(tables, chosen, index, simulation, first=first, **options)


def recorded_steps(batch, steps, seed=0):
    """Return the numbers of all steps under random actions, by name; some environments diverge."""
    generator = torch.Generator().manual_seed(seed)
    numbers = defaultdict(list)
    for step in range(steps):
        actions = 2 * torch.rand(batch.action_mask.shape, generator=generator) - 1
        if step % 4 == 3:
            batch.simulation.diverges[step % batch.num_envs] = True
        result = vars(batch.step(actions))
        state = {"obstacles": batch.layouts.poses, "resets": batch.simulation.resets}
        for name, value in (result | state).items():
            for key, part in (value if isinstance(value, dict) else {"": value}).items():
                if part is not None:
                    numbers[name, key].append(part.clone())
    return {name: torch.stack(values) for name, values in numbers.items()}


def pairs_of(batch, resets):
    """Return the numbers of start and goal in all episodes, (resets * n,) each."""
    goals = torch.from_numpy(batch.specs[0].goals.q).float()
    found = []
    for _ in range(resets):
        batch.reset()
        ends = torch.stack([batch.q, batch.groups["reach"].goal_configuration])
        distance = (ends[:, :, None] - goals).abs().amax(dim=3)
        assert (distance.amin(dim=2) == 0).all()
        found.append(distance.argmin(dim=2))
    return torch.cat(found, dim=1)


def test_all_pairs_of_start_and_goal_are_equally_likely(specs):
    batch = stub_batch(specs, ["reach"], 300, seed=5)
    start, goal = pairs_of(batch, 40)
    counts = torch.bincount(6 * start + goal, minlength=36).reshape(6, 6)
    assert not counts.diagonal().any()
    expected = len(start) / 30
    others = counts[~torch.eye(6, dtype=torch.bool)]
    assert (others - expected).abs().max() < BOUND * expected**0.5


def test_layouts_are_equally_likely_and_leave_the_goals_free(specs):
    batch = stub_batch(specs, ["reach among obstacles"], 300)
    usable = torch.from_numpy(batch.specs[0].goals.usable)
    counts = torch.zeros(len(usable))
    for _ in range(10):
        start, goal = pairs_of(batch, 1)
        layout = batch.layouts.current
        assert usable[layout, start].all()
        assert usable[layout, goal].all()
        counts += torch.bincount(layout, minlength=len(usable))
    assert counts[REACH.train_layouts :].sum() == 0
    expected = counts.sum() / REACH.train_layouts
    assert (counts[: REACH.train_layouts] - expected).abs().max() < BOUND * expected**0.5


MIXED = ("pose", "push", "push among obstacles")


def test_episodes_do_not_depend_on_the_other_environments(specs):
    whole = stub_batch(specs, MIXED, 9, seed=3, observe=CHANNELS)
    part = stub_batch(specs, MIXED, 3, seed=3, first=3, observe=CHANNELS)
    # The environments of the part end their episodes at other steps than the others.
    for batch in (whole, part):
        batch.reset()
        batch.step(torch.zeros(batch.action_mask.shape))
    for _ in range(30):
        actions = torch.rand(whole.action_mask.shape) * 2 - 1
        whole.simulation.diverges[0] = True
        a, b = whole.step(actions), part.step(actions[3:6])
        for name in ("q", "reward", "truncated"):
            assert torch.equal(getattr(a, name)[3:6], getattr(b, name)), name
        for name, values in b.observation.items():
            assert torch.equal(a.observation[name][3:6], values), name
        assert torch.equal(whole.layouts.poses[3:6], part.layouts.poses)


def test_a_resumed_batch_begins_the_same_episodes(specs):
    one, other = (stub_batch(specs, MIXED, 6, seed=seed, observe=CHANNELS) for seed in (3, 4))
    one.reset()
    one.advance(0.2)
    recorded_steps(one, 25)
    assert one.state_dict()["next_episode"].unique().numel() > 1
    other.load_state_dict(one.state_dict())
    observation = other.reset()
    for name, values in one.reset().items():
        assert torch.equal(values, observation[name]), name
    assert torch.equal(one.groups["push"].line, other.groups["push"].line)
    with pytest.raises(TaskError, match="the state is of 6 environments; expected 3"):
        stub_batch(specs, MIXED, 3).load_state_dict(one.state_dict())


@pytest.mark.parametrize(
    "names", [MIXED, *(pytest.param((task,), marks=pytest.mark.slow) for task in ("reach", "push"))]
)
def test_skipping_what_changes_nothing_changes_no_bit(specs, names, monkeypatch):
    skipping, complete = (stub_batch(specs, names, 6, seed=3, observe=CHANNELS) for _ in range(2))
    for batch in (skipping, complete):
        batch.reset(spread=True)
    numbers = recorded_steps(skipping, 60)
    with monkeypatch.context() as patch:
        patch.setattr(base, "HOST_DEVICES", ())
        expected = recorded_steps(complete, 60)
    assert numbers.keys() == expected.keys()
    for name, values in numbers.items():
        assert torch.equal(values.nan_to_num(7.0), expected[name].nan_to_num(7.0)), name
    assert (numbers["truncated", ""] | numbers["terminated", ""]).any(dim=0).all()
    assert numbers["diverged", ""].any(dim=0).any()
    assert numbers["terminated", ""].any() == ("push" in names)


def test_a_diverged_environment_is_reset_once_and_the_step_undone(specs):
    batch = stub_batch(specs, MIXED, 3, observe=CHANNELS)
    batch.reset()
    before = batch.step(torch.zeros(batch.action_mask.shape))
    batch.simulation.diverges[1] = True
    resets = batch.simulation.resets.clone()
    step = batch.step(torch.ones(batch.action_mask.shape))
    assert step.diverged.tolist() == step.truncated.tolist() == [False, True, False]
    assert torch.equal(step.q[1], before.q[1])
    assert torch.equal(step.object_pose[1], before.object_pose[1])
    assert (batch.simulation.resets - resets).tolist() == [0, 1, 0]
    for part in (step.observation, step.final_observation):
        assert all(values.float().isfinite().all() for values in part.values())


@pytest.mark.parametrize(
    "names", [MIXED, *(pytest.param((task,), marks=pytest.mark.slow) for task in ("reach", "push"))]
)
def test_steps_and_resets_read_no_tensor(specs, names):
    batch = stub_batch(specs, names, 6, observe=CHANNELS)
    controller = Zero()
    batch.reset()
    controller.act(batch)  # fills caches of constants
    batch.simulation.diverges[2] = True
    with device_reads() as reads:
        results = [batch.step(controller.act(batch)) for _ in range(2 * PUSH.max_episode_steps)]
        batch.advance(0.3)
        batch.reset(seed=4, spread=True)
    assert reads.found == []
    assert torch.stack([each.truncated | each.terminated for each in results]).any(dim=0).all()
    assert results[0].diverged.tolist() == [env == 2 for env in range(6)]


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_steps_of_the_kinematic_simulation_read_no_tensor(specs, kind, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(base, "HOST_DEVICES", ())  # the simulation asks once
        batch = batch_from_specs([specs["reach"]], 4, sim="kinematic", kind=kind)
        batch.reset()
        rest = Zero().act(batch)
        batch.step(rest)
    wrong = rest.clone()
    wrong[1, batch.action_mask[1]] = len(rest) * 100 if kind == "discrete" else torch.nan
    with device_reads() as reads:
        results = [batch.step(rest) for _ in range(20)]
        diverged = batch.step(wrong)
        after = batch.step(rest)
    assert reads.found == []
    assert torch.stack([each.truncated for each in results]).any(dim=0).all()
    assert diverged.diverged.tolist() == diverged.truncated.tolist() == [False, True, False, False]
    assert not after.diverged.any()
    assert after.q.isfinite().all()
    assert all(values.float().isfinite().all() for values in after.observation.values())


def test_evaluations_read_tensors_only_now_and_then(specs):
    """Episodes are those of an evaluation that looks at every step."""
    count, reads_of = 3, {}
    expected = run_episodes(stub_batch(specs, MIXED, 6), Zero(), count)
    for limit in (1, count):
        batch = stub_batch(specs, MIXED, 6)
        with device_reads() as reads:
            episodes = run_episodes(batch, Zero(), limit)
        reads_of[limit] = len(reads.found)
    assert repr(episodes) == repr(expected)
    rounds = -(-count * PUSH.max_episode_steps // STEPS_UNREAD)
    assert reads_of[count] <= reads_of[1] * rounds
    assert len(expected) == 6 * count
    assert {each.success for each in expected} == {True, False}


MANY_REACH = ReachConfig(num_goals=20, train_layouts=4, eval_layouts=2)
MANY_PUSH = PushConfig(num_goals=20, train_layouts=4, eval_layouts=2)
LAYOUTS = {
    "reach": ("arm3", MANY_REACH, True),
    "push": ("prims", MANY_PUSH, True),
    "free": ("arm3", MANY_REACH, False),
}
"""Robot and config of environments, and whether they have obstacles."""
LONG_REACH = ReachConfig(num_goals=20, train_layouts=2, eval_layouts=1)
WORDS = ("arm3", "arm=ur5 ee=plane", "prims")


@pytest.fixture
def build(cache, opened):
    """Create batches in MuJoCo of tuples as in ``LAYOUTS``."""

    def make(settings, num_envs=None, **options):
        chosen = [
            draw_spec(robot(words), config, obstacles=obstacles, cache=cache)
            for words, config, obstacles in settings
        ]
        return opened(batch_from_specs(chosen, num_envs or len(chosen), sim="mujoco", **options))

    return make


@pytest.fixture
def build_layouts(build):
    return lambda *names, **options: build([LAYOUTS[name] for name in names], **options)


@pytest.fixture
def build_batch(build):
    def make(num_envs=3, words=WORDS, obstacles=False, config=LONG_REACH, **options):
        return build([(each, config, obstacles) for each in words], num_envs, **options)

    return make


@pytest.mark.parametrize(("side", "expected"), [("train", {0, 1, 2, 3}), ("eval", {4, 5})])
def test_episodes_draw_the_layouts_of_their_side(build_layouts, side, expected):
    batch, drawn = build_layouts("reach", "push", "free", layouts=side), []
    for _ in range(25):
        batch.reset()
        drawn.append(batch.layouts.current.tolist())
    reach, push, free = zip(*drawn, strict=True)
    assert set(reach) == set(push) == expected
    assert set(free) == {-1}
    assert reach != push
    with pytest.raises(TaskError, match="unknown layouts 'test'; valid: train, eval"):
        build_layouts("reach", layouts="test")


def test_observations_and_pictures_follow_the_layout(build_layouts):
    batch = build_layouts("reach", "push", "free", observe=ObservationConfig(points=40))
    tokens = []
    for _ in range(6):
        seen = batch.reset()
        for env in (0, 1):
            layout = batch.specs[env].goals.layouts[batch.layouts.current[env]]
            poses = torch.from_numpy(layout).float()
            assert torch.equal(seen["obstacles"][env, :, :7], poses)
            assert torch.equal(batch.layouts.poses[env], poses)
            assert (render_state(batch, env).obstacles == poses.numpy()).all()
            places = [box.pose.position for box in batch.layouts.obstacles(env)]
            assert places == [tuple(row[:3]) for row in layout.tolist()]
        points = seen["points"][0].double().numpy()
        distance = [_distance(points, box) for box in batch.layouts.obstacles(0)]
        assert np.min(distance, axis=0).max() < 6 * NOISE
        assert not seen["obstacles"][2].any()
        assert not seen["obstacle_mask"][2].any()
        tokens.append(seen["obstacles"].clone())
    assert not all(torch.equal(tokens[0], other) for other in tokens)
    sizes = {tuple(token[0, :, 10:].flatten().tolist()) for token in tokens}
    assert len(sizes) == 1


def _distance(points, box):
    """Return the distances of points from the surface of a box."""
    T = box.pose.inverse().matrix
    local = np.abs(points @ T[:3, :3].T + T[:3, 3]) - np.array(box.size) / 2
    return np.abs(local.max(axis=1))


def test_baselines_plan_around_the_current_obstacles(build_layouts, monkeypatch):
    batch = build_layouts("reach", "reach", layouts="eval")
    controller, scenes = InverseKinematics(0), []

    def recorded(scene):
        scenes.append(scene.obstacles)
        return FreeSpace(scene)

    monkeypatch.setattr(reach_baselines, "FreeSpace", recorded)
    for _ in range(6):
        batch.reset()
        controller.act(batch)
    first = {tuple(batch.specs[0].goals.layouts[k, 0, :3].tolist()) for k in (4, 5)}
    assert {boxes[0].pose.position for boxes in scenes} == first
    assert len(scenes) == 4  # two robots of the batch, two layouts each


def test_reach_episode_has_one_goal_and_ends_only_by_time(build_batch):
    batch = build_batch(config=replace(LONG_REACH, max_episode_steps=5))
    batch.reset()
    goal, controller = batch.field("goal").clone(), Random(0)
    for _ in range(4):
        assert not batch.step(controller.act(batch)).truncated.any()
        assert torch.equal(batch.field("goal"), goal)
    step = batch.step(controller.act(batch))
    assert step.truncated.all()
    assert not step.terminated.any()
    assert not torch.equal(batch.field("goal"), goal)
    assert (batch.episode_step == 0).all()
    assert torch.equal(step.final_observation["goal"], goal)
    assert torch.equal(step.observation["goal"], batch.field("goal"))
    assert not torch.equal(step.observation["tokens"], step.final_observation["tokens"])


def test_batches_smaller_than_the_robot_list_are_rejected():
    with pytest.raises(TaskError, match="2 environments for 3 robots"):
        make_batch("reach", list(WORDS), 2)
    with pytest.raises(TaskError, match=r"expected a list, \['prims'\]"):
        make_batch("reach", "prims", 2)


def test_actions_are_rounded_to_the_nearest_bin_towards_zero():
    shares = torch.tensor([[0.0, 1.0, -1.0, 0.3, -0.3, 0.01]])
    bins = [BINS[i] for i in encode_actions(shares, "discrete")[0].tolist()]
    assert bins == [0.0, 1.0, -1.0, 0.25, -0.25, 0.0]


def test_returned_tensors_are_copies(build_batch):
    """Kept tensors do not change later, and writing to them does not change the batch."""
    observe = ObservationConfig(velocity=True, previous_action=True, tool=True, points=8)
    batch, whole = (build_batch(obstacles=True, observe=observe) for _ in range(2))
    chance = Random(0)

    def tensors(step):
        parts = {"now": step.observation, "final": step.final_observation, "terms": step.terms}
        plain = ("reward", "terminated", "truncated", "diverged", "success", "distance", "score")
        named = {f"{of} {k}": v for of, part in parts.items() for k, v in part.items()}
        return named | {k: getattr(step, k) for k in (*plain, "q", "object_pose")}

    def spoil(values):
        for each in values:
            each.copy_(~each if each.dtype == torch.bool else each + 7)

    spoil(batch.reset().values())
    whole.reset()
    batch.load_state_dict(batch.state_dict())
    spoil([batch.q, batch.field("goal"), batch.field("line")[:, 0]])
    for _ in range(3):
        actions = chance.act(whole)
        spoiled, kept = tensors(batch.step(actions)), tensors(whole.step(actions))
        before = {name: each.clone() for name, each in kept.items()}
        whole.observe()
        for name, each in spoiled.items():
            assert torch.equal(each, before[name]), name
            spoil([each])
        places = [each.data_ptr() for each in spoiled.values() if each.numel()]
        assert len(places) == len(set(places))
        spoil(batch.observe().values())
        assert all(torch.equal(kept[name], before[name]) for name in kept)


def test_spread_reset_staggers_the_first_episodes(build_batch):
    batch = build_batch(60, WORDS[:1], seed=1)
    batch.reset(spread=True)
    passed = batch.episode_step.clone()
    assert passed.unique().numel() > 40
    assert 0 <= passed.min() < 60 < 240 < passed.max() < LONG_REACH.max_episode_steps
    batch.reset(seed=1, spread=True)
    assert torch.equal(batch.episode_step, passed)
    over = torch.zeros(60, dtype=torch.bool)
    for _ in range(LONG_REACH.max_episode_steps - int(passed.max())):
        over |= batch.step(Zero().act(batch)).truncated
    assert torch.equal(over, passed == passed.max())


ZERO, ONES, PI = "00000000", "ffffffff", "243f6a88 85a308d3 13198a2e 03707344"
KNOWN_ANSWERS = [
    (" ".join([ZERO] * 4), f"{ZERO} {ZERO}", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    (" ".join([ONES] * 4), f"{ONES} {ONES}", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    (PI, "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]
"""Counter, key and result of philox4x32 with 10 rounds in the file kat_vectors of Random123."""
MANY = 200_000
"""Largest accepted deviation [standard deviations]; chance exceeds it once in 5e8 numbers."""


def words(text):
    return [int(word, 16) for word in text.split()]


def numbers(n, seed=0, first=0, episode=0):
    return EpisodeRandom(seed, torch.arange(first, first + n), torch.full((n,), episode))


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN_ANSWERS)
def test_the_generator_gives_the_known_answers(counter, key, expected):
    low, high = words(key)
    columns = torch.tensor([words(counter)] * 3).T
    result = philox(columns, low + high * 2**32)
    assert result.T.tolist() == [words(expected)] * 3


def test_numbers_are_uniform():
    uniform = numbers(MANY).uniform(Stream.POINTS, 5)
    assert uniform.dtype == torch.float32
    assert uniform.min() >= 0
    assert uniform.max() < 1
    error = (MANY * 12) ** -0.5
    assert (uniform.mean(dim=0) - 0.5).abs().max() < BOUND * error
    correlation = torch.corrcoef(uniform.T) - torch.eye(5)
    assert correlation.abs().max() < BOUND * MANY**-0.5


@pytest.mark.parametrize("change", [{"seed": 1}, {"seed": 2**32}, {"first": 5}, {"episode": 1}])
def test_numbers_depend_on_seed_environment_and_episode(change):
    one, other = numbers(50), numbers(50, **change)
    assert not torch.equal(one.uniform(Stream.START, 4), other.uniform(Stream.START, 4))
    assert not torch.equal(one.uniform(Stream.START, 4), one.uniform(Stream.LAYOUT, 4))
    assert not torch.equal(one.uniform(Stream.START, 4), one.uniform(Stream.TASK + 1, 4))


@pytest.mark.parametrize("seed", [-1, 2**64])
def test_seeds_out_of_range_are_rejected(seed):
    with pytest.raises(TaskError, match=rf"seed {seed}: expected 0 to 2\^64 - 1"):
        EpisodeSequence(seed, torch.arange(1))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cpu_and_gpu_give_the_same_bits():
    cpu = numbers(1000, seed=11)
    gpu = EpisodeRandom(11, cpu.env_number.cuda(), cpu.episode.cuda())
    assert torch.equal(gpu.uniform(Stream.POINTS, 9).cpu(), cpu.uniform(Stream.POINTS, 9))
    high = torch.arange(1, 1001)
    drawn = gpu.integers(Stream.START, high.cuda())
    assert torch.equal(drawn.cpu(), cpu.integers(Stream.START, high))
