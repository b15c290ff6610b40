"""PPO: rollouts, updates, and intervals of scores."""

import functools
import math
from contextlib import closing
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from torch._dynamo.exc import TorchDynamoException

from helpers.device_reads import device_reads
from helpers.goal_sets import draw_spec
from helpers.line_batch import SMALL, OnALine, equal, learner, weights
from helpers.scenes import robot
from morphgen.errors import TaskError
from morphgen.rl import ppo
from morphgen.rl import scores as scoring
from morphgen.rl.baselines.reach import Zero
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.inference import make_env_and_controller, play, read_controller, run_episodes
from morphgen.rl.ppo import Learner, gae, matching_loss, symexp, symlog
from morphgen.rl.scores import stratified_mean_interval, success_interval
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.scenes.make import batch_from_specs, make_batch
from morphgen.tasks.sim import base


def test_policy_loss_by_hand():
    ratio = torch.tensor([1.5, 1.5, 0.5, 0.5, 1.1])
    advantage = torch.tensor([1.0, -1.0, 1.0, -1.0, 2.0])
    found = ppo.policy_loss(ratio.log(), advantage, 0.2)
    torch.testing.assert_close(found, torch.tensor([-1.2, 1.5, -0.5, 0.8, -2.2]))


def test_the_learning_rate_falls_linearly_over_the_updates():
    trainer = learner()
    reports = [trainer.iterate() for _ in range(4)]
    assert trainer.done
    rates = [each.learning_rate for each in reports]
    assert rates == pytest.approx([3e-4 * share for share in (1, 0.75, 0.5, 0.25)])
    assert [each.transitions for each in reports] == [64, 128, 192, 256]
    for each in reports:
        assert sum(each.terms.values()) == pytest.approx(each.reward, rel=1e-5)
        seconds = each.collect_seconds + each.learn_seconds
        assert each.steps_per_second == pytest.approx(64 / seconds)


@pytest.mark.parametrize(
    ("scale", "kl", "expected"),
    [
        (1.0, 0.02, 1 / ppo.KL_FACTOR),
        (0.5, 0.02, 0.5 / ppo.KL_FACTOR),
        (0.5, 0.005, 0.5 * ppo.KL_FACTOR),
        (1.0, 0.005, 1.0),
        (ppo.MIN_ACTOR_LR_SCALE, 9.9, ppo.MIN_ACTOR_LR_SCALE),
    ],
)
def test_the_actors_learning_rate_follows_the_kl_divergence(scale, kl, expected):
    assert ppo.next_actor_lr_scale(replace(SMALL, desired_kl=0.01), scale, kl) == expected
    assert ppo.next_actor_lr_scale(SMALL, scale, kl) == 1


def test_desired_kl_changes_only_the_actors_learning_rate():
    trainer = learner(learning_rate=5e-3, desired_kl=1e-6)
    trainer.iterate()
    rate = trainer.iterate().learning_rate
    actor, critic = (group["lr"] for group in trainer.optimiser.param_groups)
    assert critic == pytest.approx(5e-3 * 3 / 4)
    assert rate == actor == pytest.approx(critic / ppo.KL_FACTOR)


@pytest.mark.parametrize(("factor", "explained"), [(1.0, 1), (0.0, 0), (0.5, 0.75), (-1.0, -3)])
def test_explained_variance_by_hand(factor, explained):
    returns = torch.tensor([[1.0, 2.0], [3.0, 6.0]])
    assert ppo.explained_variance(factor * returns, returns) == pytest.approx(explained)
    assert ppo.explained_variance(returns, torch.ones(2, 2)) == 0


def test_the_metrics_of_a_rollout_by_hand():
    true, false = True, False
    trainer = learner(OnALine(3), num_steps=2, minibatches=1)
    trainer.batch.env_robot_index = torch.tensor([1, 0, 1])
    trainer.use(trainer.batch)
    trainer.rewards[:] = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    trainer.scores[:] = torch.tensor([[0.0, 1.0, 2.0], [4.0, 3.0, 2.0]])
    trainer.successes[:] = torch.tensor([[true, true, false], [false, false, true]])
    trainer.terminated[:] = torch.tensor([[true, false, false], [false, false, false]])
    trainer.truncated[:] = torch.tensor([[false, false, true], [false, true, true]])
    trainer.diverged[:] = torch.tensor([[false, false, true], [false, false, false]])
    terms = {"one": torch.tensor(0.25), "success": torch.tensor(7.0)}  # push has a term "success"
    metrics = trainer._rollout_metrics(terms)
    assert metrics["terms"] == {"one": 0.25, "success": 7.0}
    assert (metrics["reward"], metrics["score"]) == (3.5, 2.0)
    assert metrics["scores"] == (2.0, 2.0)
    assert (metrics["success"], metrics["episodes"]) == (0.5, 4)
    assert metrics["unstable"] == 1
    trainer.terminated[:] = trainer.truncated[:] = False
    trainer.batch.env_robot_index = torch.tensor([1, 1, 1])
    metrics = trainer._rollout_metrics(terms)
    assert math.isnan(metrics["success"])
    assert metrics["scores"] == pytest.approx((math.nan, 2.0), nan_ok=True)


def test_the_slow_critic_follows_every_gradient_step():
    trainer = learner(epochs=1, minibatches=1)
    before = weights(trainer)
    trainer.iterate()
    after = weights(trainer)
    moved = [name[7:] for name in after if name.startswith("critic.")]
    assert moved
    for name in moved:
        fast = after[f"critic.{name}"]
        wanted = torch.lerp(fast, before[f"target_critic.{name}"], trainer.config.slow_decay)
        torch.testing.assert_close(after[f"target_critic.{name}"], wanted)
    assert not equal({k: v for k, v in before.items() if k.startswith("target_critic")}, after)


class Answers(torch.nn.Module):
    """A critic with known values: ten times the position on the line."""

    def forward(self, seen):
        return 10 * seen["tokens"][..., 32].sum(dim=1)


@pytest.mark.parametrize("slow", [True, False])
@pytest.mark.parametrize("logarithmic", [True, False])
def test_returns_by_hand(slow, logarithmic):
    # With lambda 0 a return is the reward and the discounted value of what the action led to.
    batch = OnALine(4, horizon=3)
    trainer = learner(batch, slow_critic=slow, symlog=logarithmic, gae_lambda=0.0, minibatches=4)
    wrong = lambda seen: torch.full_like(seen["line"][:, 0], 99.0)  # noqa: E731
    right = lambda seen: symlog(Answers()(seen)) if logarithmic else Answers()(seen)  # noqa: E731
    used, other = trainer.target_critic, trainer.critic
    used.forward, other.forward = (right, wrong) if slow else (wrong, right)
    steps = []
    step = batch.step
    batch.step = lambda actions: steps.append(step(actions)) or steps[-1]
    trainer._collect_rollout()
    values, advantages, returns = trainer._compute_returns()
    after = torch.stack([Answers()(each.final_observation) for each in steps])
    rewards, terminated, truncated = (
        torch.stack([getattr(each, name) for each in steps])
        for name in ("reward", "terminated", "truncated")
    )
    assert terminated.any()
    assert truncated.any()
    torch.testing.assert_close(returns, rewards + 0.99 * after * ~terminated, rtol=1e-4, atol=1e-4)
    at = Answers()({"tokens": trainer.observations["tokens"].flatten(0, 1)}).reshape(8, 4)
    torch.testing.assert_close(values, at, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(advantages, returns - values)


def losses_and_data(**options):
    """Return a learner after an update, its losses of actor and critic, and their arguments."""
    trainer, seen = learner(**options), []
    losses = of_actor, of_critic = trainer._run_losses
    trainer._run_losses = lambda *data: seen.append(data) or of_actor(*data), of_critic
    trainer.iterate()
    return trainer, losses, seen


def test_each_epoch_has_every_transition_in_one_minibatch():
    _, _, seen = losses_and_data(epochs=3)
    assert [len(data["return"]) for _, data, _ in seen] == [16] * 12

    def whole(epoch, name):
        return torch.cat([data[name] for _, data, _ in seen[4 * epoch : 4 * epoch + 4]])

    for epoch in range(3):
        advantages = whole(epoch, "advantage")
        assert advantages.mean().item() == pytest.approx(0, abs=1e-5)
        assert advantages.std().item() == pytest.approx(1, abs=1e-4)
        assert torch.bincount(whole(epoch, "robot")).tolist() == [32, 32]
    first, second = whole(0, "advantage"), whole(1, "advantage")
    assert not first.equal(second)
    assert first.sort().values.equal(second.sort().values)
    observation, data, _ = seen[0]  # shuffled together
    assert observation["object_mask"].equal(data["robot"] == 1)
    head = learner().actor.distribution(observation)
    torch.testing.assert_close(head.log_prob(data["action"]), data["log_prob"])


def test_before_the_first_step_no_ratio_is_clipped_and_kl_is_zero():
    report = learner(epochs=1, minibatches=1).iterate()
    assert report.kl == pytest.approx(0, abs=1e-6)
    assert report.clip_fraction == 0
    assert report.policy_loss == pytest.approx(0, abs=1e-5)
    assert report.entropy == pytest.approx(math.log(11), rel=1e-3)
    far = learner(epochs=20, minibatches=1, learning_rate=0.03).iterate()
    assert far.kl > 0.01
    assert 0 < far.clip_fraction < 1


def test_gradients_of_actor_and_critic_are_clipped_separately():
    trainer = learner(max_grad_norm=1e-3, epochs=1, minibatches=1)
    report = trainer.iterate()
    for network, norm in ((trainer.actor, "actor_gradient"), (trainer.critic, "critic_gradient")):
        left = torch.stack([each.grad.norm() for each in network.parameters()]).norm()
        assert getattr(report, norm) > 1e-3
        assert left.item() == pytest.approx(1e-3, rel=1e-2)


@pytest.mark.parametrize("fixed", [False, True])
def test_the_std_is_learned_unless_fixed(fixed):
    policy = PolicyConfig("me-mlp", discrete=False, fixed_std=fixed)
    trainer = Learner(OnALine(8, kind="continuous"), policy, replace(SMALL, ent_coef=1.0))
    reports = [trainer.iterate() for _ in range(3)]
    assert trainer.actor.raw_log_std.any() != fixed
    assert (reports[0].entropy == pytest.approx(reports[2].entropy, rel=1e-6)) == fixed


def test_robot_weights_are_one_or_random_with_mean_one():
    assert learner()._robot_weights().tolist() == [1, 1]
    trainer = learner(task_reweighting=True)
    drawn = torch.stack([trainer._robot_weights() for _ in range(4000)])
    assert (drawn > 0).all()
    torch.testing.assert_close(drawn.mean(dim=1), torch.ones(4000))
    torch.testing.assert_close(drawn.mean(dim=0), torch.ones(2), atol=0.05, rtol=0)
    # Half the difference of two normal numbers through tanh: log-odds of variance 2.
    odds = (drawn[:, 0] / drawn[:, 1]).log()
    assert odds.var().item() == pytest.approx(2, rel=0.1)


def test_a_robot_of_weight_zero_does_not_change_the_loss():
    _, losses_of, seen = losses_and_data(epochs=1, minibatches=1, task_reweighting=True)
    ((obs, data, _),) = seen
    changed = {"advantage": 9.0, "return": 9.0}
    other = data | {name: data[name] + by * (data["robot"] == 1) for name, by in changed.items()}
    for robot_weights, same in (([2.0, 0.0], True), ([1.0, 1.0], False)):
        weights = torch.tensor(robot_weights)[data["robot"]]
        for loss in losses_of:
            losses = [loss(obs, each, weights)[0] for each in (data, other)]
            assert losses[0].equal(losses[1]) == same


def test_metrics_that_are_not_finite_stop_the_run():
    batch = OnALine(8)
    trainer = learner(batch)
    step = batch.step
    batch.step = lambda actions: replace(step(actions), reward=torch.full((8,), math.nan))
    with pytest.raises(TaskError, match=r"update 1: not finite: .*value_loss.*; look at"):
        trainer.iterate()


def test_bfloat16_gives_nearly_the_same_update():
    plain = learner(agent="me-tf", epochs=1, minibatches=1).iterate()
    short = learner(agent="me-tf", epochs=1, minibatches=1, bf16=True).iterate()
    assert short.value_loss == pytest.approx(plain.value_loss, rel=0.05)
    assert short.value_loss != plain.value_loss
    assert short.entropy == pytest.approx(plain.entropy, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("agent", "discrete", "options"),
    [
        ("me-mlp", True, {}),
        ("me-mlp", False, {"symlog": False, "slow_critic": False, "task_reweighting": True}),
        ("me-tf", True, {}),
    ],
)
def test_one_policy_learns_two_robots_and_two_tasks(agent, discrete, options):
    batch = OnALine(32, kind="discrete" if discrete else "continuous")
    sizes = {"total_timesteps": 24 * 32 * 24, "num_steps": 24, "minibatches": 4}
    config = PPOConfig(**sizes, learning_rate=1e-3, gamma=0.9, **options)
    trainer = Learner(batch, PolicyConfig(agent=agent, discrete=discrete), config)
    reports = [trainer.iterate() for _ in range(trainer.num_updates)]
    assert trainer.done
    assert reports[0].success < 0.4
    assert reports[-1].success > 0.85
    assert min(reports[-1].scores) > max(reports[0].scores) + 0.2
    assert reports[-1].explained_variance > 0.5


def column(*numbers):
    return torch.tensor(numbers)[:, None]


NEVER, MIDDLE = (False, False, False), (False, True, False)


@pytest.mark.parametrize(
    ("terminated", "truncated", "ahead", "wanted"),
    [
        # delta: 1 + 18 - 10 = 9; 2 + 27 - 20 = 9; 3 + 36 - 30 = 9. Each passes on 0.45 of the next.
        (NEVER, NEVER, 30.0, [9 + 0.45 * (9 + 0.45 * 9), 9 + 0.45 * 9, 9.0]),
        # The middle delta loses its 27, and nothing of the last step passes on to it.
        (MIDDLE, NEVER, 30.0, [9 + 0.45 * (2 - 20), 2.0 - 20, 9.0]),
        # 50 is the value of the episode's last observation: 2 + 45 - 20 = 27.
        (NEVER, MIDDLE, 50.0, [9 + 0.45 * 27, 27.0, 9.0]),
        (MIDDLE, MIDDLE, 50.0, [9 + 0.45 * (2 - 20), 2.0 - 20, 9.0]),
    ],
    ids=["unfinished", "terminated", "truncated", "both"],
)
def test_advantages_by_hand(terminated, truncated, ahead, wanted):
    rewards, values = column(1.0, 2.0, 3.0), column(10.0, 20.0, 30.0)
    ends = column(*terminated), column(*truncated)
    found = gae(rewards, values, column(20.0, ahead, 40.0), *ends, gamma=0.9, gae_lambda=0.5)
    torch.testing.assert_close(found[:, 0], torch.tensor(wanted))


def test_symexp_is_the_inverse_of_symlog_which_is_odd_and_logarithmic():
    x = torch.tensor([-5e4, -3.0, -1e-6, 0.0, 1e-6, 0.5, 7.0, 1e5])
    torch.testing.assert_close(symexp(symlog(x)), x, rtol=1e-5, atol=0)
    assert symlog(-x).equal(-symlog(x))
    torch.testing.assert_close(symlog(torch.tensor(torch.e - 1)), torch.tensor(1.0))


def test_the_matching_loss_is_zero_at_the_target_and_its_gradient_the_error():
    x = torch.linspace(-4, 4, 33).requires_grad_()
    y = torch.linspace(30, -30, 33)
    matching_loss(x, y).sum().backward()
    torch.testing.assert_close(x.grad, symexp(x.detach()) - y)
    torch.testing.assert_close(matching_loss(symlog(y), y), torch.zeros(33), atol=1e-5, rtol=0)


CPU = torch.device("cpu")


def test_a_failed_compilation_is_a_one_line_error(monkeypatch):
    def fail(*args):
        raise TorchDynamoException("no compiler\nand a long story")

    monkeypatch.setattr(torch, "compile", lambda function, **options: fail)
    call = ppo.prepared(torch.exp, CPU, bf16=False, compiled=True)
    with pytest.raises(TaskError, match=r"^--compile: torch cannot compile here: no compiler$"):
        call(torch.zeros(1))


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["me-mlp", "me-tf"])
def test_compilation_gives_nearly_the_same_update(agent):
    plain = learner(agent=agent, epochs=1).iterate()
    compiled = learner(agent=agent, epochs=1, compile=True).iterate()
    torch.compiler.reset()
    assert compiled.value_loss == pytest.approx(plain.value_loss, rel=1e-3)
    assert compiled.actor_gradient == pytest.approx(plain.actor_gradient, rel=1e-2)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
@pytest.mark.parametrize("agent", ["me-mlp", "me-tf"])
def test_cuda_graphs_of_two_learners_in_turn_learn_the_same(agent):
    for seed in (0, 1):
        options = {"agent": agent, "seed": seed, "device": "cuda"}
        plain, graphs = learner(**options), learner(**options, compile=True)
        for _ in range(3):
            wanted, found = plain.iterate(), graphs.iterate()
            assert found.actor_gradient == pytest.approx(wanted.actor_gradient, rel=5e-2)
            for name in ("value_loss", "entropy", "reward"):
                assert getattr(found, name) == pytest.approx(getattr(wanted, name), rel=1e-2)


@pytest.mark.slow
def test_one_process_compiles_many_learners(monkeypatch):
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend="eager"))
    for agent in ("se", "me-mlp", "me-tf"):
        for envs in (2, 4, 6):
            sizes = {"total_timesteps": envs * 8, "num_steps": 8, "minibatches": 2, "epochs": 1}
            config = PPOConfig(**sizes, compile=True)
            Learner(OnALine(envs), PolicyConfig(agent), config).iterate()
    torch.compiler.reset()


def test_the_first_episodes_are_spread():
    batch = OnALine(8)
    learner(batch)
    assert batch.spread


def test_the_loss_of_a_gpu_has_the_gradients_of_actor_and_critic():
    trainer, losses_of, seen = losses_and_data(epochs=1, minibatches=1, task_reweighting=True)
    parameters = [*trainer.actor.parameters(), *trainer.critic.parameters()]
    whole, metrics = trainer._loss(*seen[0])
    apart = [loss_of(*seen[0]) for loss_of in losses_of]
    assert metrics.equal(torch.cat([own for _, own in apart]))
    gradients = torch.autograd.grad(whole, parameters)
    others = torch.autograd.grad(apart[0][0], [*trainer.actor.parameters()])
    others += torch.autograd.grad(apart[1][0], [*trainer.critic.parameters()])
    assert all(map(torch.equal, gradients, others))


@pytest.fixture
def two_threads():
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    assert torch.get_num_threads() == 2
    torch.set_num_threads(threads)


class Counting(Zero):
    """Controller that records the number of threads in which it acts."""

    def __init__(self):
        super().__init__(0)
        self.threads = set()

    def act(self, task):
        self.threads.add(torch.get_num_threads())
        return super().act(task)


def test_episodes_run_in_one_thread(two_threads, tmp_path):
    measured, played = Counting(), Counting()
    run_episodes(make_batch("reach", ["stick"], 1, sim="mujoco", cache=tmp_path), measured, 1)
    spec = read_controller("zero", "reach")
    env, _ = make_env_and_controller(spec, "stick", 0, sim="mujoco", cache=tmp_path)
    with closing(env):
        list(play(env, played, 1, 0, lambda episode: None))
    assert measured.threads == played.threads == {1}


def test_an_episode_ends_early_after_successes_in_a_row(tmp_path):
    spec = read_controller("ik", "reach")
    env, controller = make_env_and_controller(spec, "arm3-stick", 0, sim="mujoco", cache=tmp_path)
    with closing(env):
        early, whole = [], []
        list(play(env, controller, 2, 0, early.append, max_successes=5))
        list(play(env, controller, 2, 0, whole.append))
    assert [episode.steps for episode in whole] == [300, 300]
    for episode in early:
        assert episode.success
        assert 5 <= episode.steps < 300


REACH = ReachConfig(num_goals=6, max_episode_steps=5)


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return draw_spec(robot("arm3"), REACH, cache=tmp_path_factory.mktemp("goals"))


def reads_of_a_rollout(spec, agent, discrete, num_steps):
    """Return what the second rollout of a learner reads, treating the CPU as a GPU."""
    observe = ObservationConfig(velocity=True, jacobian=True, dls=True, tree=True)
    kind = "discrete" if discrete else "continuous"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(base, "HOST_DEVICES", ())
        batch = batch_from_specs([spec], 8, sim="kinematic", kind=kind, observe=observe)
        student = learner(batch, agent=agent, discrete=discrete, num_steps=num_steps)
        student._collect_rollout()
    with device_reads() as reads:
        metrics = student._collect_rollout()
    assert metrics["episodes"] > 0
    assert len(student.final_observations["tokens"]) == metrics["episodes"]
    return reads.found


@pytest.mark.parametrize(
    ("agent", "discrete"), [("me-mlp", False), ("me-mlp", True), ("me-graph", False)]
)
def test_reads_of_a_rollout_do_not_grow_with_its_steps(spec, agent, discrete):
    few, many = (reads_of_a_rollout(spec, agent, discrete, steps) for steps in (4, 16))
    assert few == many
    assert few  # the metrics


def test_final_observations_are_the_same_on_every_device(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    student = learner()
    masks = student.truncated = torch.rand(7, 5, generator=generator) < 0.3
    values = torch.rand(7, 5, 2, generator=generator)

    def gathered():
        seen = [{"links": value, "sum": value.sum(dim=1)} for value in values]
        return student._truncated_rows(list(map(student._rows_to_keep, seen, masks)))

    on_host = gathered()
    monkeypatch.setattr(base, "HOST_DEVICES", ())
    elsewhere = gathered()
    assert torch.equal(on_host["links"], values[masks])
    assert all(torch.equal(on_host[name], elsewhere[name]) for name in on_host)


def all_resamples(values):
    """The exact distribution of the mean of resamples."""
    return [np.mean(chosen) for chosen in product(values, repeat=len(values))]


def test_the_interval_of_one_robot_contains_95_percent_of_the_resamples():
    values = [1.0, 2.0, 4.0]
    low, high = np.quantile(all_resamples(values), (0.025, 0.975), method="inverted_cdf")
    found = stratified_mean_interval([values])
    assert (found.low, found.high) == pytest.approx((low, high))


def test_the_wilson_interval_stays_within_0_and_1():
    for rate, low, high in ((0, 0.0, 0.1611), (0.5, 0.2993, 0.7007), (1, 0.8389, 1.0)):
        found = success_interval(rate, 20)
        assert found.value == rate
        assert (found.low, found.high) == pytest.approx((low, high), abs=1e-4)


@pytest.mark.parametrize("rate", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("trials", [1, 36, [10, 10, 16], [34] * 320, 10**6])
def test_a_success_rate_always_has_an_interval_with_a_width(rate, trials):
    rates = np.full(np.shape(trials), rate)
    interval = success_interval(rates, trials)
    low, high = interval.as_percent()[:-1].split(" (")[1].split(" to ")
    assert (interval.low < interval.high, low != high, interval.value) == (True, True, rate)


def test_robots_of_equally_many_episodes_are_as_one():
    assert success_interval([0.25, 0.75], 20) == success_interval(0.5, 40)
    few, even = success_interval([0.2, 0.4], [5, 35]), success_interval([0.2, 0.4], 20)
    assert few.high - few.low > even.high - even.low  # the mean is no surer than its worst half


def test_seeds_are_the_unit_of_an_interval():
    rng = np.random.default_rng(0)
    seeds = [[rng.normal(mean, 1, 34), rng.normal(mean, 1, 20)] for mean in (0, 0, 10, 10)]
    found, alone = scoring.mean_interval(seeds), scoring.mean_interval(seeds[:1])
    assert alone == stratified_mean_interval(seeds[0])
    assert found.value == pytest.approx(np.mean([[np.mean(each) for each in s] for s in seeds]))
    assert found.low < 0.5 < 9.5 < found.high  # of all seeds alike: one in 16 resamples each
    # Two strata are independent samples of seeds.
    apart = scoring.mean_interval(seeds, together=False)
    assert found.high - found.low > apart.high - apart.low > 1
    assert scoring.mean_error(seeds) == pytest.approx(10 / math.sqrt(12), rel=0.1)
    assert scoring.mean_error([[[0.0, 2.0], [1.0, 3.0]]]) == pytest.approx(1 / math.sqrt(2))
    certain = [[[True] * 20] * 2] * 3
    assert scoring.seeds_success_interval(certain) == success_interval(1, 120)
    differing = scoring.seeds_success_interval([[[True] * 20], [[False] * 20]])
    assert (differing.low, differing.high) == (0, 1)


@pytest.mark.parametrize("episodes", [34, 340])
def test_the_smallest_difference_of_rates_follows_from_the_number_of_episodes(episodes):
    difference = scoring.smallest_rate_difference(episodes)
    low, high = (1 - difference) / 2, (1 + difference) / 2
    spread = 1.959964 * math.sqrt(0.5) + 0.841621 * math.sqrt(low * (1 - low) + high * (1 - high))
    assert episodes == pytest.approx((spread / difference) ** 2)  # Fleiss' formula for n
    assert scoring.smallest_rate_difference(1) == 1
    assert scoring.smallest_mean_difference((3.0, 4.0)) == pytest.approx(2.8016 * 5, abs=1e-3)


@pytest.mark.parametrize("value", [0, 1])
def test_scores_that_are_successes_have_the_interval_of_successes(value):
    scores, successes = [[float(value)] * 12] * 3, [[bool(value)] * 12] * 3
    found = scoring.episode_interval([scores], [successes], relative=False)
    assert found == success_interval(value, 36)
    relative = scoring.episode_interval([scores], [successes], relative=True)
    assert (relative.value, math.isnan(relative.low)) == (value, True)
    mixed = [[0.0, 1.0], [1.0, 1.0]]
    assert scoring.episode_interval([mixed], [mixed], relative=False) == success_interval(0.75, 4)


@pytest.mark.parametrize(
    "scores", [[[0.0] * 36], [[5.5] * 3, [5.5] * 3], [[1.0] * 9, [2.0] * 9], [[3.0]]]
)
def test_scores_without_a_spread_have_no_interval(scores):
    for found in (
        stratified_mean_interval(scores),
        scoring.episode_interval(
            [scores], [[[False] * len(each) for each in scores]], relative=True
        ),
    ):
        assert isinstance(found, scoring.Interval)
        assert math.isnan(found.low)
        assert math.isnan(found.high)
